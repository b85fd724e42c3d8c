"""Learned features in direct alignment: the training, and the control without training."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.train import learned_alignment as learned
from perilune_shared.dataset.manifest import open_single
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_train.motion.classical.alignment import ContrastResiduals, aligned_trajectory
from perilune_train.motion.classical.contrast import Level, local_contrast
from perilune_train.motion.data.trajectories import load_split
from tests.helpers.drawn_dataset import build_dataset


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory):
    """A descent of 16 frames of 128 px."""
    folder = tmp_path_factory.mktemp("learned") / "nav"
    made = build_dataset(folder, "nav", side_px=128, splits={"train": 1}, n_frames=16, craters=600)
    return load_split(open_single(str(made)), "train")[0]


@pytest.fixture(scope="module")
def pairs(trajectory):
    return learned.training_pairs(trajectory)


def test_the_control_is_alignment(trajectory):
    aligned, control = aligned_trajectory(trajectory), learned.learned_trajectory(learned.ContrastOnly(), trajectory)
    # The errors of alignment are 0.2 m to 2 m.
    np.testing.assert_allclose(control.motion[0], aligned.motion[0], atol=0.005)
    turned = rotation_vectors(control.motion[1] @ np.swapaxes(aligned.motion[1], 1, 2))
    assert np.degrees(np.abs(turned)).max() < 1e-3
    sigmas, control_sigmas = (np.sqrt(np.diagonal(one.covariance, 0, 1, 2)) for one in (aligned, control))
    np.testing.assert_allclose(control_sigmas, sigmas, rtol=0.005)


def test_a_step_of_the_control_is_a_step_of_alignment(pairs):
    pair = pairs[8]
    turn = matrix_from_rotation_vector([1e-4, -2e-4, 1e-4])
    beside = replace(
        pair.state,
        translation_m=pair.state.translation_m + np.array([0.3, -0.2, 0.1]),
        rotation_c2_from_c1=turn @ pair.state.rotation_c2_from_c1,
    )
    first, second = (Level(pair.camera, local_contrast(image)) for image in pair.images)
    normal, gradient = ContrastResiduals(first, second, pair.prior).normal_equations(beside)
    precision = pair.prior.precision()
    moved = beside.changed(-np.linalg.solve(normal + precision, gradient + precision @ beside.offset(pair.prior)))
    true_translation_m, true_rotation = pair.motion
    found_m, found_rad = learned.step_errors(learned.ContrastOnly(), replace(pair, state=beside))
    np.testing.assert_allclose(found_m.numpy(), moved.translation_m - true_translation_m, atol=0.005)
    expected_rad = rotation_vectors(moved.rotation_c2_from_c1 @ true_rotation.T)
    np.testing.assert_allclose(found_rad.numpy(), expected_rad, atol=1e-5)
    assert np.linalg.norm(moved.translation_m - beside.translation_m) > 0.05


def test_training_lowers_the_loss(pairs):
    pairs = pairs[2:6]
    torch.manual_seed(1)
    network = learned.FeatureNetwork()

    @torch.no_grad()
    def mean_loss():
        return np.mean([learned.loss_of(*learned.step_errors(network, pair)).item() for pair in pairs])

    before = mean_loss()
    history = learned.train(network, pairs, 16, np.random.default_rng(1))
    assert mean_loss() < 0.8 * before
    assert [row["pairs"] for row in history] == [60, 64]
    assert all(weights.grad is not None for weights in network.parameters())


def test_weights_of_a_run_can_be_validated_again(tmp_path, capsys):
    dataset = build_dataset(tmp_path / "nav", "nav", splits={"train": 1, "val": 1}, scenes=1, n_frames=3)
    learned.main([dataset], train_on=dataset, steps=2, out=tmp_path / "a.json")
    learned.main([dataset], weights=tmp_path / "a.ckpt", out=tmp_path / "b.json")
    lines = [line for line in capsys.readouterr().out.splitlines() if "2 pairs: alignment" in line]
    first, second = (line.split("learned ")[1].split(",")[0] for line in lines)
    assert first == second
    with pytest.raises(UserError, match="both, expected one of them"):
        learned.main([dataset], train_on=dataset, weights=tmp_path / "a.ckpt", out=tmp_path / "c.json")
    assert not (tmp_path / "c.json").exists()
