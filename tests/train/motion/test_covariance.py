"""The covariance that a warp network states."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.helpers import in_process

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_train.cli.main import main
from perilune_train.motion.covariance import (
    FILE,
    NAMES,
    MotionInformation,
    fit_numbers,
    information_of,
    read_numbers,
    write_numbers,
)
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.metrics.errors import signed_errors
from perilune_train.motion.network import build

ARCHITECTURE = {
    "fusion": "warp",
    "size_px": 64,
    "width": 0.125,
    "attention": "none",
    "hidden": 8,
    "focal_over_width": 1.07,
    "scales": {"mean_m": [0.0] * 3, "spread_m": [4.0, 4.0, 2.0], "rotation_rad": 0.005},
}
TRUE = [-2.0, 0.7, 0.3, -0.4, 0.2]


@pytest.fixture(scope="module")
def trajectory(dataset_nav):
    return load_split(open_dataset(dataset_nav), "train")[0]


@pytest.fixture
def known(trajectory):
    torch.manual_seed(0)
    network = build(ARCHITECTURE).eval()
    # Untrained, the head finds no flow, so residuals are zero.
    torch.nn.init.normal_(network.place.weight, std=0.1)
    return information_of(network, ARCHITECTURE, trajectory)


def estimate(trajectory, error):
    """Motions whose signed errors are those given (n - 1, 6)."""
    translation, rotation = trajectory.motion
    shift = np.einsum("nji,nj->ni", rotation, error[:, 3:])
    turn = np.stack([matrix_from_rotation_vector(-one) for one in error[:, :3]])
    return translation + shift, turn @ rotation


def test_tilt_and_shift_are_confused_as_over_a_plane(trajectory, known):
    n = trajectory.n_pairs
    shift = np.zeros((n, 6))
    shift[:, 3] = 1.0
    # A camera that moves by x and turns by x / h about y sees a plane at rest.
    turned = shift.copy()
    turned[:, 1] = -1.0 / trajectory.altitude_m
    opposite = shift.copy()
    opposite[:, 1] = 1.0 / trajectory.altitude_m
    for error in (turned, opposite):
        assert np.allclose(signed_errors(trajectory, estimate(trajectory, error)), error, atol=1e-9)
    told_of = [np.einsum("ni,nij,nj->n", error, known.information, error) for error in (turned, opposite, shift)]
    assert (told_of[0] < 0.1 * told_of[1]).all()
    assert (told_of[0] < 0.3 * told_of[2]).all()


def test_numbers_are_those_that_made_the_errors(trajectory, known):
    rng = np.random.default_rng(0)
    many = MotionInformation(
        np.tile(known.information, (400, 1, 1)),
        known.prior,
        np.repeat(np.geomspace(200, 1500, 400), len(known.altitude_m)),
    )
    roots = np.linalg.cholesky(many.covariance(TRUE))
    error = np.einsum("nij,nj->ni", roots, rng.normal(size=(len(roots), 6)))
    copies = np.array_split(np.arange(len(roots)), 400)
    trajectories = [replace(trajectory)] * 400
    motions = [estimate(trajectory, error[own]) for own in copies]
    numbers = fit_numbers([many], trajectories, motions)
    stated = many.covariance(numbers)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(stated), error)
    assert squared.mean() == pytest.approx(6.0, rel=0.05)
    expected = np.log(np.diagonal(many.covariance(TRUE), axis1=1, axis2=2))
    assert np.allclose(np.log(np.diagonal(stated, axis1=1, axis2=2)), expected, atol=0.3)


def test_numbers_are_read_as_written(tmp_path):
    assert read_numbers(tmp_path) is None
    write_numbers(tmp_path, TRUE, 12)
    assert read_numbers(tmp_path) == TRUE


@pytest.mark.parametrize(
    "text", ["", "[]", json.dumps({"numbers": {}}), json.dumps({"numbers": dict.fromkeys(NAMES, 1e9)})]
)
def test_damaged_files_get_one_line(tmp_path, text):
    (tmp_path / FILE).write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match="numbers"):
        read_numbers(tmp_path)


def test_calibrate_writes_the_file_of_a_training(navigated, dataset_nav, tmp_path):
    run = Path(shutil.copytree(navigated / "a", tmp_path / "a"))
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["test/normalised_error_squared_mean"] > 0
    written = json.loads((run / FILE).read_text(encoding="utf-8"))
    (run / FILE).unlink()
    done = in_process.call(main, "navigate", "calibrate", "--run", run, "--dataset", dataset_nav)
    assert done.returncode == 0, done.stderr
    again = json.loads((run / FILE).read_text(encoding="utf-8"))
    assert again["pairs"] == written["pairs"]
    assert again["numbers"] == pytest.approx(written["numbers"])
    for arguments, words in (
        (["--run", tmp_path / "none", "--dataset", dataset_nav], ["none", "no such file"]),
        (["--run", run, "--dataset", dataset_nav, "--split", "tset"], ["--split", "one of"]),
    ):
        failed = in_process.call(main, "navigate", "calibrate", *arguments)
        assert failed.returncode == 2
        assert all(word in failed.stderr for word in words)
