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
SCENE = """
import sys
import numpy as np
import perilune
settings = ["dataset.camera.width_px=16", "dataset.camera.height_px=16", "dataset.render.samples=1",
            "dataset.labels.min_radius_px=0.3", "dataset.terrain.spacing_px=2", "dataset.render.device=auto"]
with perilune.Scene("mare", seed=3, settings=settings) as scene:
    poses = perilune.descent(n_frames=2)
    frames = scene.render(poses)
    assert type(frames.images).__name__ == "SharedArray"
    np.savez(
        sys.argv[1], shared=np.from_dlpack(frames.images), items=np.stack([frame.image for frame in frames]),
        alone=scene.render(poses[0]).image, frames=frames.labels["frame"],
    )
"""


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
@pytest.mark.parametrize("name", ["rests", "moves"])
def test_the_sensor_on_the_device_agrees_with_the_processor(rendered, name):
    np.testing.assert_allclose(rendered[f"{name}.time.gpu"], rendered[f"{name}.time.cpu"], rtol=1e-5)
    cpu, gpu = (rendered[f"{name}.light.{device}"] for device in ("cpu", "gpu"))
    # OpenCV rounds the places of a motion blur to 1/32 px.
    np.testing.assert_allclose(gpu, cpu, atol=(0.01 if name == "moves" else 1e-6) * np.ptp(cpu))
    # Noise has other values and the same distribution. Single frames also have the fixed pattern.
    images, mean, noise = (rendered[f"{name}.{part}"] for part in ("images.gpu", "mean", "noise"))
    assert images.dtype == (np.uint8 if name == "rests" else np.uint16)
    inside = (mean > 4 * noise) & (mean + 4 * noise < (255 if name == "rests" else 4095))
    deviations = (images - mean)[inside] / noise[inside]
    assert len(deviations) > 300
    assert abs(deviations.mean()) < 4 / np.sqrt(len(deviations)) and 0.9 < deviations.std() < 1.1
    np.testing.assert_array_equal(rendered[f"{name}.alone"], images[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rests", "moves"])
def test_labels_on_the_device_are_those_of_the_processor(rendered, name):
    prefix = f"{name}.labels.gpu."
    columns = [key.removeprefix(prefix) for key in rendered.files if key.startswith(prefix)]
    assert {"visible_fraction", "sunlit_fraction", "contrast"} <= set(columns)
    for column in columns:
        cpu, gpu = (rendered[f"{name}.labels.{device}.{column}"] for device in ("cpu", "gpu"))
        assert len(cpu) > 20
        if column == "contrast":
            # Contrast reads the image, which differs as stated above.
            np.testing.assert_allclose(gpu, cpu, rtol=1e-3, atol=0.02 if name == "moves" else 1e-4)
        else:
            np.testing.assert_array_equal(gpu, cpu)


@pytest.mark.slow
def test_frames_of_a_scene_stay_on_the_device(tmp_path):
    path = tmp_path / "frames.npz"
    done = subprocess.run(
        [sys.executable, "-c", SCENE, str(path)], env=SIMULATED, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found = np.load(path)
    np.testing.assert_array_equal(found["shared"], found["items"])
    np.testing.assert_array_equal(found["alone"], found["items"][0])
    assert found["shared"].shape == (2, 16, 16) and found["shared"].std() > 1
    assert set(found["frames"]) == {0, 1}


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
