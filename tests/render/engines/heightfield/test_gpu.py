"""The engine on a CUDA device, in numba's simulator: frames agree with the processor's."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from tests.helpers import in_process
from tests.helpers.rendered import QUICK
from tests.helpers.simulated_gpu import FIELDS, LAWS, SEEDS

import perilune_render.cli.main
from perilune_render.config.dataset import RenderConfig
from perilune_render.provenance.versions import device_of

SIMULATED = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
SMALL = (
    *QUICK, "--set=dataset.camera.width_px=16", "--set=dataset.camera.height_px=16", "--set=dataset.detect.n_frames=2",
    "--set=dataset.labels.min_radius_px=0.5",
)  # fmt: skip


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    path = tmp_path_factory.mktemp("gpu") / "frames.npz"
    command = [sys.executable, "-m", "tests.helpers.simulated_gpu", str(path)]
    done = subprocess.run(command, env=SIMULATED, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return np.load(path)


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_frames_agree_with_the_processor(rendered, law):
    for k in range(len(SEEDS)):
        pair = {name: (rendered[f"{law}.{k}.{name}.cpu"], rendered[f"{law}.{k}.{name}.gpu"]) for name in FIELDS}
        cpu, gpu = pair["radiance_factor"]
        assert cpu.mean() > 0.01 and np.ptp(cpu) > 0.01
        np.testing.assert_allclose(gpu, cpu, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(*pair["depth_m"], rtol=1e-5)
        np.testing.assert_allclose(*pair["normal"], atol=1e-5)
        np.testing.assert_array_equal(*pair["sunlit"])
    first, second = (rendered[f"{law}.{k}.radiance_factor.gpu"] for k in (0, 1))
    assert not np.array_equal(first, second)


@pytest.mark.slow
def test_rolling_shutter_and_parts_agree(rendered):
    for name in ("rows", "again"):
        np.testing.assert_allclose(rendered[f"{name}.gpu"], rendered[f"{name}.cpu"], rtol=1e-4, atol=1e-7)
    assert not np.allclose(rendered["rows.gpu"], rendered["again.gpu"])


@pytest.mark.slow
def test_a_batch_is_handed_over_without_a_copy_of_other_values(rendered):
    assert rendered["dlpack"].shape == (len(SEEDS), 16, 16)
    np.testing.assert_array_equal(rendered["dlpack"], rendered["batch"])


@pytest.mark.slow
def test_a_dataset_states_its_device_and_is_regenerated_without_one(tmp_path):
    out = tmp_path / "data"
    options = "--preset", "tiny", "--kind", "detect", "--workers", "1", "--out", str(out), *SMALL
    start = "from perilune_render.cli.main import main; main()"
    command = [sys.executable, "-c", start, "dataset", *options, "--set=dataset.render.device=auto"]
    done = subprocess.run(command, env=SIMULATED, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    (recipe,) = json.loads((out / "detect" / "dataset.json").read_text())["recipes"].values()
    assert recipe["config"]["render"]["device"] == "cuda"
    main = perilune_render.cli.main.main
    again = in_process.call(main, "regenerate", "--manifest", out / "detect", "--verify", "--sample", "1")
    assert "rendered on a CUDA device" in again.stdout + again.stderr


def test_without_a_device_cuda_is_refused_in_one_line(tmp_path):
    main = perilune_render.cli.main.main
    refused = in_process.call(
        main, "dataset", "--preset", "tiny", "--out", tmp_path / "data", *QUICK, "--set=dataset.render.device=cuda"
    )
    (line,) = refused.stderr.strip().splitlines()
    assert refused.returncode == 2
    assert line.startswith(
        "error: configuration: dataset.render.device: got cuda, but no CUDA device is found, expected"
    )
    assert not (tmp_path / "data").exists()


def test_blender_has_no_device():
    with pytest.raises(ValueError, match="device cpu, or engine heightfield"):
        RenderConfig(engine="cycles", device="cuda")


def test_auto_is_the_processor_without_a_device():
    assert device_of(RenderConfig(engine="heightfield", device="auto")) == "cpu"
