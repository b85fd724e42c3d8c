"""Views of training trajectories from other poses: warped frames against renderings, poses, places, stored features."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from pydantic import ValidationError
from tests.train.motion.train.small_networks import NETWORK, pose_settings

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors, sun_direction
from perilune_train.data.shares import ALONE, Share
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.data.trajectories import Trajectory, load_trajectories
from perilune_train.motion.geometry import ground_homography
from perilune_train.motion.network import Scales
from perilune_train.motion.pose import normalised_frames, warped_frames
from perilune_train.motion.train.task import NavigationTask
from perilune_train.motion.train.views import other_views, view_homographies
from perilune_train.motion.train.windows import OutputUnits, WindowPlaces, Windows, truth

LEVEL = np.diag([1.0, -1.0, -1.0])
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def training(dataset_nav):
    found = load_trajectories(open_dataset(dataset_nav))
    return [one.shrunk(64) for one in found if one.split == "train"]


def at(camera, images, position_m, turn_rad=(0.0, 0.0, 0.0)):
    """A trajectory of one pose."""
    rotation = matrix_from_rotation_vector(np.array(turn_rad)) @ LEVEL
    position = np.array([position_m], float)
    return Trajectory(("a", "b"), "train", images, camera, position, rotation[None], position, LEVEL)


def correlation(first, second):
    """Correlation of the middles of two frames, without the slow change of brightness across them."""
    fine = [one - cv2.GaussianBlur(one, (0, 0), 6) for one in (np.float32(first), np.float32(second))]
    return float(np.corrcoef(*(one[12:-12, 12:-12].ravel() for one in fine))[0, 1])


@pytest.mark.parametrize(
    ("position_m", "turn_rad"),
    [
        ([14.0, 0, 300], [0, 0, 0]),
        ([0, -14.0, 300], [0, 0, 0]),
        ([9.0, -7, 330], [0, 0, 0]),
        ([9, 7, 285], [0.02, -0.03, 0.1]),
    ],
)
def test_a_warped_frame_is_the_rendering_at_the_other_pose(position_m, turn_rad):
    """Smooth ground, slopes of about one degree, in low light. Along x, along y, in altitude, with a turn."""
    pytest.importorskip("perilune_render", reason="needs the renderer")
    from tests.helpers.scenes import config_with, flat_scene

    from perilune_render.config.dataset import LightConfig, RenderConfig
    from perilune_render.engines.heightfield.engine import HeightfieldEngine

    camera = Camera.from_field_of_view(96, 96, 50)
    relief = cv2.GaussianBlur(np.random.default_rng(1).standard_normal((301, 301)), (0, 0), 3)
    relief *= np.tan(np.radians(1.0)) * 2.0 / np.gradient(relief)[0].std()
    config = config_with(render=RenderConfig(samples=4), light=LightConfig(albedo_variation=0.0))
    pixels = np.zeros((1, 96, 96), np.uint8)
    own, other = at(camera, pixels, [0, 0, 300.0]), at(camera, pixels, position_m, turn_rad)
    with HeightfieldEngine(flat_scene(600.0, 301, height_m=relief), config, camera, sun_direction(60, 20), 1) as engine:
        seen = [engine.render(p.position_m[0], p.rotation_camera_from_site[0]).radiance_factor for p in (own, other)]
    first, second = (np.clip(np.rint(one * 120 / seen[0].mean()), 0, 255).astype(np.uint8) for one in seen)
    warped = warped_frames(torch.from_numpy(first[None]), view_homographies(own, other)).numpy()[0]
    assert correlation(warped, second) > 0.95 and correlation(first, second) < 0.5
    # Everywhere else the frame is reflected, not black.
    assert np.abs(warped - second).max() < 100 and warped.min() > 0


def test_a_homography_takes_ground_points_to_where_the_camera_sees_them():
    camera = Camera.from_field_of_view(96, 64, 50)
    own = at(camera, np.zeros((1, 64, 96), np.uint8), [20.0, 30, 400], [0.05, 0.02, 0.3])
    points = np.array([[0.0, 0, 0], [100, -50, 0], [20, 90, 0]])
    seen = camera.project(camera_from_site(points, own.position_m[0], own.rotation_camera_from_site[0]))
    mapped = np.array([*points[:, :2].T, np.ones(3)]).T @ ground_homography(camera.matrix, *own_pose(own))[0].T
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], seen)


def own_pose(own):
    return own.position_m, own.rotation_camera_from_site


def test_a_warp_to_the_same_pose_changes_nothing(training):
    own = training[0]
    frames = torch.from_numpy(own.images)
    torch.testing.assert_close(warped_frames(frames, view_homographies(own, own)), frames.float(), atol=0.02, rtol=0)


def test_moves_are_as_large_as_the_deviations_of_the_descents(training):
    position = np.stack([one.position_m[1:] for one in training])
    spread = (position - position.mean(0)).std((0, 1))
    for factor in (1.0, 0.5):
        views = other_views(training, 40, factor, 0)
        assert len(views) == 160
        moves = np.stack([view.position_m - training[i % 4].position_m for i, view in enumerate(views)])
        np.testing.assert_allclose(moves[:, 1:].std((0, 1)), factor * spread, rtol=0.25)
        assert abs(moves.mean()) < 0.2 * moves.std()
        turns = np.stack(
            [
                rotation_vectors(view.rotation_camera_from_site @ np.swapaxes(own.rotation_camera_from_site, 1, 2))
                for view, own in zip(views[:4], training, strict=True)
            ]
        )
        # The descents of this dataset have attitude noise.
        assert 1e-3 < np.abs(turns).max() < 0.1
    assert views[0].images is training[0].images
    again, others = other_views(training, 40, 0.5, 0), other_views(training, 40, 0.5, 1)
    assert np.array_equal(again[7].position_m, views[7].position_m)
    assert not np.array_equal(others[7].position_m, views[7].position_m)


def test_level_descents_have_level_views(training):
    level = [replace(one, rotation_camera_from_site=np.broadcast_to(LEVEL, (8, 3, 3))) for one in training]
    for view in other_views(level, 1, 1.0, 0):
        np.testing.assert_allclose(view.rotation_camera_from_site, level[0].rotation_camera_from_site, atol=1e-9)


def test_windows_gather_the_views_with_their_poses(training):
    scales, views = Scales.measured(training, "stack", "pose"), other_views(training, 2, 1.0, 0)
    # This process has the second and the fourth trajectory.
    windows = Windows(training, [1, 3], 3, OutputUnits("pose", scales), CPU, views)
    # The fourth trajectory itself, its second view, and the first view of the second trajectory.
    places = torch.tensor([[3, 2], [8 + 3, 1], [4 + 1, 0]])
    first, second = windows.pictures(places)
    pairs = windows.pairs(places)
    versions = [training[3], views[4 + 3], views[1]]
    for i, (version, (number, start)) in enumerate(zip(versions, [(3, 2), (3, 1), (1, 0)], strict=True)):
        span = slice(start, start + 4)
        frames = torch.from_numpy(training[number].images)[span]
        expected = normalised_frames(warped_frames(frames, view_homographies(training[number], version)[span]))
        torch.testing.assert_close(first[i], expected[:-1])
        torch.testing.assert_close(second[i], expected[1:])
        position, angles = truth(version, OutputUnits("pose", scales))
        assert torch.equal(windows.position[pairs[i]], position[start : start + 3])
        assert torch.equal(windows.angles[pairs[i]], angles[start : start + 3])
    mean, spread = np.array(scales.mean_m), np.array(scales.spread_m)
    np.testing.assert_allclose(
        windows.position[pairs[1]] * spread + mean, views[7].position_m[2:5], rtol=0, atol=1e-3 * spread.max()
    )


def places(training, views, share=ALONE):
    found = WindowPlaces(training, 3, warp=False, jitter=None, seed=5, share=share)
    found.views = views
    return [[found[key] for key in found.keys(epoch)] for epoch in range(30)]


def test_each_sequence_is_of_a_random_version(training):
    plain, drawn = places(training, 0), places(training, 2)
    assert [[(number % 4, start) for number, start in epoch] for epoch in drawn] == plain
    counts = np.bincount([number // 4 for epoch in drawn for number, _ in epoch], minlength=3)
    assert len(counts) == 3 and counts.min() > 0.25 * counts.sum()
    assert drawn == places(training, 2) and drawn[0] != drawn[1]
    own = {number % 4 for epoch in places(training, 2, Share(1, 2)) for number, _ in epoch}
    assert own == {1, 3}


def test_stored_features_of_views_come_last_and_validation_is_not_warped(dataset_nav):
    trajectories = load_trajectories(open_dataset(dataset_nav))
    stored = {}
    for views in (0, 2):
        torch.manual_seed(0)
        task = NavigationTask(pose_settings("none", views=views), "stack", trajectories)
        task._store()
        network = task.network
        stored[views] = {
            split: torch.cat(parts) * network.feature_spread + network.feature_mean
            for split, parts in task.stored.items()
        }
    plain, more = stored[0], stored[2]
    torch.testing.assert_close(more["val"], plain["val"])
    torch.testing.assert_close(more["train"][:28], plain["train"])
    assert len(plain["train"]) == 28 and len(more["train"]) == 3 * 28
    for version in (1, 2):
        assert float((more["train"][28 * version :][:28] - plain["train"]).abs().max()) > 1e-4


def test_only_a_network_for_poses_has_views():
    with pytest.raises(ValidationError, match=r"stack.target=pose, since stack.views is given"):
        NavigateConfig(warp=NETWORK, stack=NETWORK | {"views": 2})
    with pytest.raises(ValidationError, match=r"warp.views=0, since only stack has this setting"):
        NavigateConfig(warp=NETWORK | {"views": 2}, stack=NETWORK)
