"""Export of a navigator: the file, streamed with its state, beside torch; the README's program; bad input."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from tests.helpers import in_process
from torch import nn

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.cli.main import main
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.deploy import export, flight_navigator
from perilune_train.motion.network import build, load_navigator, predict
from perilune_train.training.runs import RunFolder, save_weights

onnx = pytest.importorskip("onnx", reason="the extra `export` is not installed")
SIZE = 64
COMMON = {"size_px": SIZE, "width": 0.125, "attention": "cbam_identity", "hidden": 16}
SCALES = {"spread_m": [2.0, 2.0, 3.0], "rotation_rad": 0.002}
ARCHITECTURES = {
    "warp": {
        **COMMON, "fusion": "warp", "in_channels": 8, "focal_over_width": 1.1, "scales": {**SCALES, "mean_m": [0.0] * 3}
    },
    "stack": {**COMMON, "fusion": "stack", "in_channels": 1, "scales": {**SCALES, "mean_m": [0.0, 1.0, 30.0]}},
}  # fmt: skip


def lively(architecture):
    """A network whose every weight and statistic matters, in evaluation mode."""
    torch.manual_seed(3)
    network = build(architecture).eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.uniform_(module.bias, -0.5, 0.5)
            nn.init.uniform_(module.running_mean, -0.5, 0.5)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
        elif isinstance(module, nn.Linear | nn.Conv2d) and not module.weight.any():
            nn.init.normal_(module.weight, std=0.1)
    return network


@pytest.fixture(scope="module", params=["warp", "stack"])
def run_folder(request, tmp_path_factory):
    """A run of random weights."""
    root, architecture = tmp_path_factory.mktemp(request.param), ARCHITECTURES[request.param]
    best = RunFolder(root).best
    best.parent.mkdir(parents=True)
    save_weights(best, architecture, lively(architecture))
    return root


def call(*arguments):
    return in_process.call(main, "navigate", "deploy", *map(str, arguments))


@pytest.fixture(scope="module")
def exported(run_folder, dataset_nav, tmp_path_factory):
    out = tmp_path_factory.mktemp("exported") / "flight"
    done = call("--run", run_folder, "--dataset", dataset_nav, "--out", out)
    assert done.returncode == 0, done.stderr
    return out


def test_without_a_run_one_line_says_what_is_needed(tmp_path):
    done = call("--out", tmp_path / "flight")
    assert done.returncode == 2 and done.stderr.startswith("error: --run: got not given, expected the folder of a")
    assert len(done.stderr.strip().splitlines()) == 1 and not (tmp_path / "flight").exists()


def test_files_and_metadata(exported, run_folder, dataset_nav):
    assert sorted(path.name for path in exported.iterdir()) == ["README.md", "navigator.json", "navigator.onnx"]
    facts = json.loads((exported / "navigator.json").read_text())
    trajectory = load_split(open_dataset(dataset_nav), "val")[0]
    np.testing.assert_allclose(facts["camera_matrix"], trajectory.shrunk(SIZE).camera.matrix)
    assert 0 < facts["largest_difference_from_torch"] <= 1e-5
    model = onnx.load(str(exported / "navigator.onnx"))
    assert [one.name for one in model.graph.input] == facts["inputs"]
    assert {one.key: json.loads(one.value) for one in model.metadata_props}["hidden"] == 16
    assert facts["fusion"] == run_folder.name.rstrip("0123456789")


def test_the_readmes_program_gives_the_motions_of_the_whole_trajectory(exported, run_folder, dataset_nav):
    fusion = json.loads((exported / "navigator.json").read_text())["fusion"]
    trajectory = load_split(open_dataset(dataset_nav), "val")[0]
    np.savez(
        exported.parent / "descent.npz",
        images=trajectory.images,
        nominal=trajectory.nominal_motion[0],
        altitude=trajectory.altitude_m,
        down=trajectory.down_c,
    )
    known = "given['nominal'][k], given['altitude'][k], given['down'], " if fusion == "warp" else ""
    program = (exported / "README.md").read_text().split("```python\n")[1].split("```")[0]
    program += f"""
given, state, found = np.load("../descent.npz"), start(), []
images = given["images"]
for k in range(len(images) - 1):
    translation, rotation, state = step(images[k], images[k + 1], {known}state)
    found.append([*translation.tolist(), *rotation.ravel().tolist()])
print(json.dumps(found))
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=exported, capture_output=True, text=True, check=True)
    found = np.array(json.loads(done.stdout))
    network, architecture = load_navigator(RunFolder(run_folder).best, fusion)
    translation, rotation = predict(network, architecture, trajectory)
    np.testing.assert_allclose(found[:, :3], translation, atol=1e-4 * np.abs(translation).max())
    np.testing.assert_allclose(found[:, 3:].reshape(-1, 3, 3), rotation, atol=1e-5)
    # Weights and state matter.
    reference = trajectory.nominal_motion[0] if fusion == "warp" else np.array([[0.0, 1.0, 30.0]])
    assert np.abs(translation - reference).max() > 1e-2


@pytest.mark.slow
def test_without_a_dataset_on_noise(run_folder, tmp_path):
    done = call("--run", run_folder, "--out", tmp_path / "flight")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "flight" / "navigator.json").read_text())["compared_on"] == "noise"


def test_a_file_that_differs_is_not_left(run_folder, tmp_path, monkeypatch):
    original = flight_navigator.FlightNavigator.motion

    def wrong(self, output, nominal_translation_m):
        translation_m, rotation = original(self, output, nominal_translation_m)
        return translation_m + (0.01 if torch.onnx.is_in_onnx_export() else 0.0), rotation

    monkeypatch.setattr(export.FlightNavigator, "motion", wrong)
    done = call("--run", run_folder, "--out", tmp_path / "flight")
    assert done.returncode == 2
    assert "difference from torch" in done.stderr
    assert not list(tmp_path.iterdir())


def test_bad_input_is_one_line(run_folder, dataset_detect, tmp_path):
    for options, words in (
        (["--run", tmp_path / "none"], ["checkpoint", "no such file"]),
        (["--run", run_folder, "--dataset", tmp_path / "none"], ["dataset.json", "no such file"]),
        (["--run", run_folder, "--dataset", dataset_detect], ["nav"]),
    ):
        done = call(*options, "--out", tmp_path / "flight")
        assert done.returncode == 2
        assert len(done.stderr.strip().splitlines()) == 1
        assert all(word in done.stderr for word in words), done.stderr
    assert not list(tmp_path.iterdir())


def test_elimination_solves_positive_definite_equations():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(7, 6, 6))
    normal = torch.from_numpy(root @ root.swapaxes(1, 2) + 0.1 * np.eye(6))
    right = torch.from_numpy(rng.normal(size=(7, 6)))
    found = flight_navigator.solved_by_elimination(normal, right)
    torch.testing.assert_close(found, torch.linalg.solve(normal, right), atol=1e-9, rtol=1e-9)
