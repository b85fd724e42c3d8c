"""Trajectories that are tilted by `flight.off_nadir_deg`, and datasets of them up to the horizon."""

import json
import shutil

import numpy as np
import pytest
from tests.helpers import in_process
from tests.helpers.scenes import config_with

from perilune_render.cli.main import main
from perilune_render.config.dataset import FlightConfig, KindConfig
from perilune_render.flight.motion import draw_motion
from perilune_render.flight.rig import rig_of
from perilune_render.flight.view import rig_envelope
from perilune_render.imaging.exr import read_radiance
from perilune_render.provenance.recipe import recorded_settings
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import camera_from_site
from perilune_shared.geometry.ellipse import rim_points
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.labels.masks import SLACK_PX, SLACK_RADII
from perilune_shared.validation.validate import validate

STEADY = {"attitude_sigma_deg": 0.0, "azimuth_deg": {"low": 0.0, "high": 360.0}}
TIMES = np.linspace(0, 65, 8)


def _axis(motion) -> np.ndarray:
    """The camera's axis at TIMES, O_L (8, 3)."""
    return motion.rotation_camera_from_site_at(TIMES)[:, 2]


def _ahead(motion) -> np.ndarray:
    """The horizontal direction of flight at the start, O_L (3,)."""
    velocity = np.array([*motion.nominal.velocity_mps[:2], 0.0])
    return velocity / np.linalg.norm(velocity)


@pytest.mark.parametrize(("around_deg", "ahead", "right"), [(0, 1, 0), (90, 0, 1), (180, -1, 0), (270, 0, -1)])
def test_the_camera_looks_in_the_stated_direction(around_deg, ahead, right):
    config = FlightConfig(**STEADY, off_nadir_deg=60.0, off_nadir_azimuth_deg=float(around_deg))
    for seed in range(5):
        motion = draw_motion(config, seed)
        forward = _ahead(motion)
        # Z_L points up, so this is the direction to the right of the flight, seen from above.
        rightward = np.cross(forward, [0.0, 0.0, 1.0])
        horizontal = np.sin(np.radians(60)) * (ahead * forward + right * rightward)
        np.testing.assert_allclose(_axis(motion), np.tile([*horizontal[:2], -0.5], (8, 1)), atol=1e-12)


def test_a_pitch_ahead_leaves_the_cross_track_axis_level():
    motion = draw_motion(FlightConfig(**STEADY, off_nadir_deg=60.0), 3)
    across = np.cross(_ahead(motion), [0.0, 0.0, 1.0])
    rotation = motion.rotation_site_from_body_at(TIMES)
    np.testing.assert_allclose(rotation @ across, np.tile(across, (8, 1)), atol=1e-12)


def test_tilt_and_direction_are_drawn_evenly_and_independently():
    config = FlightConfig(
        **STEADY, off_nadir_deg={"low": 20, "high": 60}, off_nadir_azimuth_deg={"low": 0, "high": 360}
    )
    motions = [draw_motion(config, seed) for seed in range(400)]
    axis = np.array([_axis(motion)[0] for motion in motions])
    tilt = np.degrees(np.arccos(-axis[:, 2]))
    assert 20 <= tilt.min() < 21 and 59 < tilt.max() <= 60
    assert abs(tilt.mean() - 40) < 2
    ahead = np.array([motion_axis @ _ahead(motion) for motion, motion_axis in zip(motions, axis, strict=True)])
    assert abs(np.mean(ahead > 0) - 0.5) < 0.08
    assert abs(np.corrcoef(tilt, np.sign(ahead))[0, 1]) < 0.15


def test_a_tilt_changes_nothing_else_of_a_flight():
    """A tilt changes neither the positions nor the perturbations of the attitude, which are about the axes of O_L."""
    level, tilted = (draw_motion(FlightConfig(**more), 7) for more in ({}, {"off_nadir_deg": 50.0}))
    for a, b in zip(level.path_at(TIMES), tilted.path_at(TIMES), strict=True):
        assert np.array_equal(a, b)
    nominal = tilted.rotation_site_from_nominal
    assert level.rotation_site_from_nominal is None and nominal is not None
    expected = level.rotation_site_from_body_at(TIMES) @ nominal
    assert np.array_equal(tilted.rotation_site_from_body_at(TIMES), expected)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"off_nadir_deg": 81.0}, "0 to 80"),
        ({"off_nadir_deg": -1.0}, "0 to 80"),
        ({"off_nadir_deg": {"low": 50, "high": 20}}, "high at least low, 50"),
        ({"off_nadir_azimuth_deg": 721.0}, "-720 to 720"),
        ({"off_nadir_deg": 10.0, "start_altitude_m": 20_000.0}, "start_altitude_m of at most 19976"),
    ],
)
def test_wrong_values_are_refused(settings, text):
    with pytest.raises(ValueError, match=text):
        FlightConfig(**settings)


def _kind(**flight) -> KindConfig:
    return KindConfig(n_scenes=1, trajectories_per_scene=1, n_frames=2, split_by="scene", flight=FlightConfig(**flight))


def test_recipes_of_level_flights_do_not_record_a_tilt():
    level, tilted = config_with(), config_with(detect=_kind(off_nadir_deg=40.0))
    assert not [name for name in recorded_settings(level, "detect")["detect"]["flight"] if name.startswith("off_nadir")]
    assert recorded_settings(tilted, "detect")["detect"]["flight"]["off_nadir_deg"] == {"low": 40.0, "high": 40.0}


def test_shared_terrain_extends_to_the_horizon_for_both_kinds():
    config = config_with(detect=_kind(off_nadir_deg=40.0), nav=_kind(), shared_terrain=True)
    for kind in ("detect", "nav"):
        assert rig_envelope(rig_of(config), config.ground_flight(kind)).horizon
    assert not rig_envelope(rig_of(config), config.nav.flight).horizon


FLIGHT = {
    "off_nadir_deg": 75.0,
    "off_nadir_azimuth_deg": {"low": 0, "high": 360},
    "azimuth_deg": {"low": 0, "high": 360},
}
RENDERED = {
    "name": "oblique-test",
    "camera": {"width_px": 96, "height_px": 96},
    "terrain": {"spacing_px": 1.5},
    "render": {"exr": True, "engine": "heightfield", "samples": 1},
    "detect": {"n_scenes": 1, "trajectories_per_scene": 3, "n_frames": 2, "split_by": "scene", "flight": FLIGHT},
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("oblique")
    (folder / "own.yaml").write_text(json.dumps({"dataset": RENDERED}))
    options = ["--preset", "tiny", "--config", folder / "own.yaml", "--kind", "detect", "--workers", 0]
    done = in_process.call(main, "dataset", *options, "--out", folder)
    assert done.returncode == 0, done.stderr
    return open_dataset(folder / "detect")


def test_an_oblique_dataset_is_valid_and_shows_sky(dataset):
    assert validate(dataset) == []
    for frame in dataset.frames.to_dict("records"):
        radiance = read_radiance(dataset.store.folder / frame["exr_path"])
        sky = np.isinf(radiance.depth_m)
        assert 0.1 < sky.mean() < 0.6
        assert not radiance.sunlit[sky].any() and (radiance.radiance_factor[sky] == 0).all()
        assert radiance.depth_m[~sky].max() > 10_000


def test_labels_are_the_projected_rims_and_hidden_where_the_ground_hides_them(dataset):
    """Every rim is projected point by point."""
    craters = dataset.table("craters").to_pandas().set_index("crater_id")
    labels = dataset.table("labels").to_pandas()
    n_hidden = 0
    for frame in dataset.frames.to_dict("records"):
        rows = labels[labels["frame_id"] == frame["frame_id"]]
        of_rows = craters.loc[rows["crater_id"]]
        centre = of_rows[["x_m", "y_m", "z_m"]].to_numpy()
        normal = of_rows[["normal_x", "normal_y", "normal_z"]].to_numpy()
        radius = of_rows["diameter_m"].to_numpy() / 2
        rotation = matrix_from_quaternion(frame["rotation_wxyz"])
        rim = camera_from_site(rim_points(centre, normal, radius, 48), frame["position_m"], rotation)
        u, v = (
            frame[f"f{axis}_px"] * rim[..., k] / rim[..., 2] + frame[f"c{axis}_px"] for k, axis in ((0, "x"), (1, "y"))
        )
        # The distance of each point from the ellipse, in its axes.
        ellipse = {name: rows[f"ellipse_{name}"].to_numpy()[:, None] for name in ("cx_px", "cy_px", "a_px", "b_px")}
        turn = rows["ellipse_theta_rad"].to_numpy()[:, None]
        du, dv = u - ellipse["cx_px"], v - ellipse["cy_px"]
        along, across = du * np.cos(turn) + dv * np.sin(turn), dv * np.cos(turn) - du * np.sin(turn)
        off = np.hypot(along / ellipse["a_px"], across / ellipse["b_px"]) - 1
        assert np.abs(off * ellipse["b_px"]).max() < 1e-3
        depth = read_radiance(dataset.store.folder / frame["exr_path"]).depth_m
        inside = (u >= 0) & (v >= 0) & (u < 96) & (v < 96)
        at_point = depth[np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)]
        slack = np.maximum(SLACK_RADII * radius, SLACK_PX * rim[:, 0, 2] / frame["fx_px"])[:, None]
        seen = inside & np.isfinite(at_point) & (rim[..., 2] <= at_point + slack)
        np.testing.assert_allclose(rows["visible_fraction"], seen.mean(axis=1), atol=1e-6)
        n_hidden += int((seen.mean(axis=1) < inside.mean(axis=1) - 0.1).sum())
    assert n_hidden > 0


def test_frames_of_an_oblique_dataset_are_made_again(dataset, tmp_path):
    shutil.copytree(dataset.store.folder, tmp_path / "detect")
    frame_id = dataset.frames["frame_id"].iloc[-1]
    options = ["--manifest", tmp_path / "detect", "--frames", frame_id, "--out", tmp_path / "again"]
    done = in_process.call(main, "regenerate", *options)
    assert done.returncode == 0 and "1 identical" in done.stdout + done.stderr
