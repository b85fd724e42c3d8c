"""Trajectories that are tilted by `flight.off_nadir_deg`."""

import numpy as np
import pytest

from perilune_render.config.dataset import FlightConfig
from perilune_render.flight.motion import draw_motion

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
    """Positions and perturbations of the attitude are those of the level flight, about the axes of O_L."""
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
