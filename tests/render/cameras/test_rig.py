"""A camera on the body turns with it: its angular velocity is in its own axes."""

import numpy as np

from perilune_render.config.cameras import CameraConfig
from perilune_render.flight.lens import camera_of
from perilune_render.flight.rig import MountedCamera
from perilune_render.flight.sub_poses import moved
from perilune_render.flight.trajectories import Flight
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
)
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory


def test_a_tilted_camera_has_the_angular_velocity_of_the_body_in_its_own_axes():
    turn, step_s = np.array([0.2, -0.1, 0.4]), 0.05
    still = np.zeros(3)
    start = np.array([0.0, 0.0, 500.0]), matrix_from_rotation_vector([3.0, 0.1, 0.2])
    poses = [moved(start, still, turn, time) for time in (0.0, step_s)]
    nominal = NominalTrajectory((0.0, 0.0, 500.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), step_s)
    body = Flight(
        nominal,
        np.array([0.0, step_s]),
        np.stack([place for place, _ in poses]),
        np.zeros((2, 3)),
        np.stack([quaternion_from_matrix(rotation) for _, rotation in poses]),
        angular_velocity_radps=np.stack([turn, turn]),
    )
    camera = camera_of(CameraConfig())
    tilt = matrix_from_rotation_vector(np.radians([15.0, 3.0, 10.0]))
    seen = MountedCamera(camera, camera, ROTATION_CAMERA_FROM_BODY @ tilt, np.array([2.0, 0.5, -0.3])).flight_of(body)
    first, last = matrix_from_quaternion(seen.rotation_wxyz)
    assert np.allclose(moved((still, first), still, seen.angular_velocity_radps[0], step_s)[1], last, atol=1e-12)
    assert not np.allclose(seen.angular_velocity_radps[0], turn, atol=0.01)
