"""The target `pose` of the stack network: settings, scales, windows, floors, errors, steps of training."""

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from tests.train.motion.train.small_networks import NETWORK, pose_settings, saved_detector
from torch._subclasses.fake_tensor import FakeTensorMode

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_train.data.frames import normalised
from perilune_train.models.navigator import Recurrent, StackNavigator, StackOptions, cell_means
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.data.trajectories import load_trajectories
from perilune_train.motion.metrics.errors import pose_errors, pose_summary
from perilune_train.motion.metrics.floors import Known, mean_poses, ridge_poses
from perilune_train.motion.metrics.report import worse_than_floor
from perilune_train.motion.network import Scales
from perilune_train.motion.pose import (
    causal_outputs,
    normalised_frames,
    pose_of,
)
from perilune_train.motion.train.task import Initial, NavigationTask, axis_weights, learning_rate_factor
from perilune_train.motion.train.windows import OutputUnits, Windows, truth


def settings(fusion="stack", **changes):
    return pose_settings(changes.pop("attention", "cbam_identity"), fusion, **changes)


@pytest.fixture(scope="module")
def trajectories(dataset_nav):
    return load_trajectories(open_dataset(dataset_nav))


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    """A detector whose whole backbone fits the stack network."""
    return saved_detector(tmp_path_factory.mktemp("detector"), "cbam_identity", [8, 16, 32])


def test_only_stack_estimates_a_pose():
    with pytest.raises(ValidationError, match=r"warp.target=motion, since only stack has this setting"):
        NavigateConfig(warp=NETWORK | {"target": "pose"}, stack=NETWORK)
    with pytest.raises(ValidationError, match=r"warp.pool=1"):
        NavigateConfig(warp=NETWORK | {"pool": 4}, stack=NETWORK)
    with pytest.raises(ValidationError, match=r"pool"):
        NavigateConfig(warp=NETWORK, stack=NETWORK | {"pool": 3})


def test_the_truth_as_output_gives_the_pose(trajectories):
    training = [one for one in trajectories if one.split == "train"]
    scales = Scales.measured(training, "stack", "pose")
    position = np.concatenate([one.position_m[1:] for one in training])
    np.testing.assert_allclose(scales.mean_m, position.mean(0))
    np.testing.assert_allclose(scales.spread_m, position.std(0))
    own = trajectories[-1]
    standardised, angles = truth(own, OutputUnits("pose", scales))
    assert standardised.shape == angles.shape == (7, 3)
    turned = own.pose[1] @ np.array(scales.mean_rotation).T
    columns = np.concatenate([turned[:, :, 0] - [1, 0, 0], turned[:, :, 1] - [0, 1, 0]], axis=1) / scales.rotation_rad
    output = torch.cat([standardised, torch.from_numpy(columns).float()], dim=1)
    found, rotation = pose_of(output, scales)
    np.testing.assert_allclose(found, own.position_m[1:], atol=1e-3)
    np.testing.assert_allclose(rotation, own.rotation_camera_from_site[1:], atol=1e-6)


def test_axes_weigh_between_metres_and_spreads():
    scales = Scales([0.0] * 3, [8.0, 128.0, 512.0], 0.1, np.eye(3).tolist())
    weights = axis_weights(scales, "pose")
    assert float(weights[1] / weights[0]) == pytest.approx(4) and float(weights[2] / weights[1]) == pytest.approx(2)
    assert axis_weights(scales, "motion").tolist() == [1, 1, 1]


def test_cells_of_each_frame_by_hand():
    features = torch.arange(8 * 4, dtype=torch.float32).reshape(1, 1, 8, 4)
    cells = cell_means(features, 4, 2)
    assert cells.shape == (1, 1, 4, 2) and float(cells[0, 0, 0, 0]) == features[0, 0, :2, :2].mean()
    assert float(cells[0, 0, 3, 1]) == features[0, 0, 6:, 2:].mean()
    assert torch.equal(cell_means(features, 1, 1)[..., 0, 0], features.mean((2, 3)))
    torch.testing.assert_close(cell_means(features[:, :, :3], 2, 2).shape, torch.Size([1, 1, 2, 2]))


def test_frames_on_a_device_are_normalised_alike():
    frames = np.random.default_rng(0).integers(0, 256, (3, 32, 32), dtype=np.uint8)
    frames[1] = 7
    np.testing.assert_allclose(normalised_frames(torch.from_numpy(frames)), normalised(frames), atol=1e-5)


@pytest.mark.parametrize("n_pairs", [1, 3, 9, 20])
def test_causal_windows_are_those_of_a_loop(n_pairs):
    torch.manual_seed(0)
    recurrent = Recurrent(5, 7).eval()
    torch.nn.init.normal_(recurrent.output.weight)
    features = torch.randn(9, 5)
    with torch.no_grad():
        found = causal_outputs(recurrent, features, n_pairs)
        naive = [recurrent(features[max(0, i + 1 - n_pairs) : i + 1][None])[0][0, -1] for i in range(9)]
    torch.testing.assert_close(found, torch.stack(naive))


def test_positions_keep_their_digits_under_autocast():
    torch.manual_seed(0)
    network = StackNavigator(1, 0.125, "none", 16, StackOptions(pool=2, standardised=True)).eval()
    torch.nn.init.normal_(network.recurrent.output.weight, std=0.1)
    torch.nn.init.constant_(network.recurrent.output.bias, 1.5)
    pooled = torch.randn(6, network.feature_mean.numel())
    with torch.no_grad():
        expected = causal_outputs(network.recurrent, network.recurrent.summary(pooled), 4)
        with torch.autocast("cpu", torch.bfloat16):
            whole, _ = network.recurrent(pooled[None, :4])
            features = network.pooled(*torch.randn(2, 1, 2, 64, 64))
    torch.testing.assert_close(whole[0], expected[:4])
    assert features.dtype == torch.float32


def test_windows_gather_what_the_trajectories_have(trajectories):
    training = [one.shrunk(64) for one in trajectories if one.split == "train"]
    scales = Scales.measured(training, "stack", "pose")
    # This process has the second and the fourth trajectory.
    windows = Windows(training, [1, 3], 3, OutputUnits("pose", scales), torch.device("cpu"))
    places = torch.tensor([[3, 2], [1, 0]])
    first, second = windows.pictures(places)
    np.testing.assert_allclose(first[0], normalised(training[3].images[2:5]), atol=1e-5)
    np.testing.assert_allclose(second[1], normalised(training[1].images[1:4]), atol=1e-5)
    pairs = windows.pairs(places)
    assert pairs.tolist() == [[9, 10, 11], [0, 1, 2]]
    position, angles = truth(training[3], OutputUnits("pose", scales))
    assert torch.equal(windows.position[pairs][0], position[2:5]) and torch.equal(windows.angles[pairs][0], angles[2:5])


def _step(task, places, monkeypatch):
    """The gradients of a training step of the coarse stage."""
    for name in ("log", "log_dict"):
        monkeypatch.setattr(task, name, lambda *_, **__: None)
    place = task.training_trajectories, range(4), 4, OutputUnits("pose", task.scales), torch.device("cpu")
    task.windows = Windows(*place, task.views)
    task.zero_grad()
    task.training_step(places, 0).backward()
    return {name: own.grad.clone() for name, own in task.network.recurrent.named_parameters()}


@pytest.mark.parametrize("views", [0, 1])
def test_a_step_on_stored_features_is_that_of_the_whole_network(trajectories, detector, monkeypatch, views):
    torch.manual_seed(1)
    content = torch.load(detector, weights_only=True)["state_dict"]
    backbone = {key.removeprefix("backbone."): value for key, value in content.items() if key.startswith("backbone.")}
    task = NavigationTask(settings(dropout=0.0, views=views), "stack", trajectories, initial=Initial(backbone))
    assert task.stores and task.coarse
    torch.nn.init.normal_(task.network.recurrent.output.weight)
    task._store()
    assert float(task.network.feature_spread.min()) > 0 and float(task.stored["train"][0].mean().abs()) < 1e-4
    places = torch.tensor([[2, 1], [4 * views, 3]])
    stored = _step(task, places, monkeypatch)
    task.stores = False
    task.network.backbone.eval()
    whole = _step(task, places, monkeypatch)
    assert stored.keys() == whole.keys() and max(float(one.abs().max()) for one in whole.values()) > 1e-3
    for key, value in whole.items():
        torch.testing.assert_close(stored[key], value, atol=1e-4, rtol=1e-3, msg=key)


def test_no_step_needs_a_value(trajectories, monkeypatch):
    """A GPU would have to be waited for. Fake tensors have no values: an operation that needs one raises an error."""
    task = NavigationTask(settings(coarse_epochs=0, dropout=0.0, views=1), "stack", trajectories)
    for name in ("log", "log_dict"):
        monkeypatch.setattr(task, name, lambda *_, **__: None)
    place = task.training_trajectories, range(4), 4, OutputUnits("pose", task.scales), torch.device("cpu")
    windows = Windows(*place, task.views)
    windows.pictures(torch.tensor([[0, 0]]))
    task.windows = windows
    with FakeTensorMode(allow_non_fake_inputs=True) as fake:
        task.training_step(fake.from_tensor(torch.tensor([[0, 1], [2, 3]])), 0).backward()


def test_floors_by_hand(trajectories):
    training, test = trajectories[:4], trajectories[-1:]
    found = mean_poses(training, test)
    position = np.stack([one.position_m for one in training])
    np.testing.assert_allclose(found["mean_pose"][0][0], np.tile(position[:, 1:].mean((0, 1)), (7, 1)))
    np.testing.assert_allclose(found["mean_pose_at_frame"][0][0], position[:, 1:].mean(0))
    turns = found["mean_pose_at_frame"][0][1]
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-12)


@pytest.mark.parametrize("inputs", [12, 60])
def test_ridge_finds_a_linear_law(trajectories, inputs):
    """From features of which the pose is a linear function; with more features than pairs too."""
    rng = np.random.default_rng(2)
    mixing = rng.normal(size=(3, inputs))

    def known(own):
        return Known(own, [(one.position_m[1:] / 100) @ mixing + 5 for one in own])

    training, validation, test = (
        known([one for one in trajectories if one.split == s]) for s in ("train", "val", "test")
    )
    found = ridge_poses(training, validation, test.features)
    np.testing.assert_allclose(found[0][0], test.trajectories[0].position_m[1:], atol=1.0)
    constant = mean_poses(training.trajectories, test.trajectories)["mean_pose"]
    assert np.abs(constant[0][0] - test.trajectories[0].position_m[1:]).max() > 100


def test_errors_by_hand(trajectories):
    own = trajectories[-1]
    turn = matrix_from_rotation_vector([0, np.radians(2), 0])
    shifted = own.position_m[1:] + np.array([3.0, 0, 4.0])
    table = pose_errors([own], [(shifted, turn @ own.rotation_camera_from_site[1:])])
    np.testing.assert_allclose(table["position_error_m"], 5)
    np.testing.assert_allclose(table["error_z_m"], 4)
    np.testing.assert_allclose(table["orientation_error_deg"], 2)
    np.testing.assert_allclose(table["error_y_deg"], 2)
    np.testing.assert_allclose(table["altitude_m"], own.nominal_position_m[1:, 2])
    figures = pose_summary(table)
    assert figures["position_rmse_vector_m"] == pytest.approx(5) and "drift_rms_m" not in figures
    assert figures["position_rmse_per_component_m"] == pytest.approx(5 / 3**0.5)
    bands = {key: value for key, value in figures.items() if key.startswith("altitude_")}
    assert len(bands) >= 2 and list(bands.values()) == pytest.approx([5 / 3**0.5] * len(bands))


def test_a_network_that_loses_is_named():
    rows = {"stack": 3.0, "mean_pose": 9.0, "ridge": 2.0}
    tables = {name: {"position_rmse_per_component_m": value} for name, value in rows.items()}
    assert worse_than_floor("stack", tables) == "ridge"
    assert worse_than_floor("stack", tables | {"ridge": {"position_rmse_per_component_m": 3.1}}) == ""


def test_each_stage_has_its_own_cosine():
    factors = np.array([learning_rate_factor(step, 200, 500, 5, 4.0) for step in range(700)])
    assert factors[100] == pytest.approx(2.0, abs=0.05) and factors[199] < 0.001 and factors[:200].max() > 3.8
    assert factors[250] == pytest.approx(0.5, abs=0.02) and factors[300] == pytest.approx(1) and factors[299] < 0.001
    assert factors[200] < 0.03
