import pickle

import numpy as np
import pytest
from tests.helpers import in_process
from tests.helpers.scenes import config_with

from perilune_render.cli.main import main
from perilune_render.config.cameras import CameraConfig, DistortionConfig
from perilune_render.config.dataset import KindConfig
from perilune_render.flight.lens import camera_of
from perilune_render.flight.plan import make_plan
from perilune_render.streams import derived_seed, stream
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera


def plan(split_by, **changes):
    kind = KindConfig(
        n_scenes=10, trajectories_per_scene=3, n_frames=20, split_by=split_by, val_share=0.1, test_share=0.2
    )
    return make_plan(config_with(detect=kind, **changes), "detect")


@pytest.mark.parametrize("unit", ["scene", "trajectory", "frame"])
def test_units_are_never_shared_between_splits(unit):
    keys = {}
    for t in plan(unit).trajectories:
        for index, split in enumerate(t.splits):
            key = {"scene": (t.scene_id,), "trajectory": (t.scene_id, t.trajectory_id), "frame": t.frame_id(index)}[
                unit
            ]
            assert keys.setdefault(key, split) == split
    counts = {s: sum(v == s for v in keys.values()) / len(keys) for s in ("train", "val", "test")}
    assert counts == pytest.approx({"train": 0.7, "val": 0.1, "test": 0.2}, abs=0.01)


@pytest.mark.parametrize("unit", ["scene", "trajectory", "frame"])
def test_a_test_set_has_no_other_split(unit):
    counts = {"n_scenes": 2, "trajectories_per_scene": 2, "n_frames": 4, "split_by": unit, "test_share": 1.0}
    made = make_plan(config_with(detect=KindConfig(**counts, val_share=0.0)), "detect")
    assert {split for t in made.trajectories for split in t.splits} == {"test"}
    with pytest.raises(ValueError, match="test_share 1 and val_share 0"):
        KindConfig(**counts, val_share=0.1)


def test_frames_split_at_random_have_no_split_of_their_descent():
    assert plan("frame").trajectories[0].split is None and plan("scene").trajectories[0].split in (
        "train",
        "val",
        "test",
    )


def test_a_plan_follows_from_the_configuration_alone():
    first, second = plan("scene"), plan("scene")
    assert first.scenes == second.scenes
    for a, b in zip(first.trajectories, second.trajectories, strict=True):
        assert a.splits == b.splits and np.array_equal(a.flight.position_m, b.flight.position_m)
    assert plan("scene", seed=2).scenes != first.scenes


def test_adding_scenes_leaves_the_first_ones_as_they_were():
    few = config_with(detect=KindConfig(n_scenes=2, trajectories_per_scene=1, n_frames=4, split_by="scene"))
    more = config_with(detect=KindConfig(n_scenes=5, trajectories_per_scene=1, n_frames=4, split_by="scene"))
    assert make_plan(few, "detect").scenes == make_plan(more, "detect").scenes[:2]


def test_a_plan_of_ten_million_frames_draws_a_flight_when_it_is_used():
    kind = KindConfig(n_scenes=1000, trajectories_per_scene=100, n_frames=100, split_by="frame")
    many = make_plan(config_with(detect=kind), "detect")
    assert len(many.trajectories) == 100_000
    last = many.of_scene("scene-0999")[-1]
    assert (last.scene_id, last.trajectory_id) == ("scene-0999", "trajectory-0099")
    assert "flight" not in vars(last) and last.flight is last.flight
    same = pickle.loads(pickle.dumps(many)).trajectories[-1]  # noqa: S301
    assert (same.seed, same.splits) == (last.seed, last.splits)
    assert np.array_equal(same.flight.position_m, last.flight.position_m)
    assert many.of_scene("scene-1000") == [] and [t.seed for t in many.trajectories[-1:]] == [last.seed]


def test_the_papers_protocol_has_its_numbers():
    from perilune_render.config.dataset import DatasetConfig
    from perilune_shared.config.resolve import resolve

    config = resolve(DatasetConfig, "dataset", "perilune_render", "paper")
    assert (config.detect.n_scenes, config.detect.trajectories_per_scene, config.detect.n_frames) == (1, 343, 100)
    assert (config.labels.min_radius_px, config.labels.max_radius_px) == (2.0, 50.0)
    assert (config.nav.n_scenes, config.nav.trajectories_per_scene, config.nav.n_frames) == (1, 49, 100)
    assert config.detect.split_by == "frame" and config.nav.split_by == "trajectory"
    splits = [s for t in make_plan(config, "nav").trajectories for s in t.splits[:1]]
    assert splits.count("train") == 39


def test_streams_are_named_and_independent():
    assert derived_seed(1, "a", "b") != derived_seed(1, "ab") != derived_seed(2, "ab")
    assert stream(1, "a").random() == stream(1, "a").random() != stream(1, "b").random()


def test_the_camera_is_as_configured():
    assert camera_of(CameraConfig(width_px=128, height_px=96)) == Camera.from_field_of_view(128, 96, 50.0)
    settings = CameraConfig(
        focal_length_px=300.0, principal_x_px=100.5, principal_y_px=90.0, distortion=DistortionConfig(k1=-0.1, p2=0.002)
    )
    camera = camera_of(settings)
    assert camera == Camera(256, 256, 300.0, 300.0, 100.5, 90.0, (-0.1, 0.0, 0.0, 0.002, 0.0))
    made = plan("scene", camera=settings)
    assert made.camera == camera and made.exr_camera == camera.covering_pinhole() != camera
    assert plan("scene").exr_camera == plan("scene").camera


def test_a_distortion_that_folds_back_is_refused():
    with pytest.raises(UserError, match=r"dataset\.camera\.distortion.*folds? back"):
        camera_of(CameraConfig(distortion=DistortionConfig(k1=-1.5)))


def test_frames_that_the_detector_cannot_take_are_reported_before_anything_is_made(tmp_path):
    (tmp_path / "full.txt").touch()
    for kind, warned in (("detect", True), ("nav", False)):
        size = ("--set", "dataset.camera.width_px=200", "--set", "dataset.camera.height_px=96")
        made = in_process.call(main, "plan", "--preset", "tiny", "--kind", kind, *size, "--out", tmp_path)
        assert made.returncode == 2 and "--out" in made.stderr
        assert ("dataset.camera.width_px: 200 is not a multiple of 32" in made.stderr) == warned
        assert "height_px" not in made.stderr
