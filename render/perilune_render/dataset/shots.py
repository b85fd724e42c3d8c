"""Build the shot (pose, motion and random seed) of a frame from a plan or from a row of a manifest."""

from typing import Any

import numpy as np

from perilune_render.engines.frame_source import Shot
from perilune_render.flight.plan import TrajectoryPlan
from perilune_render.streams import camera_seed
from perilune_shared.dataset.schema import ANGULAR_VELOCITY
from perilune_shared.geometry.frames import matrix_from_quaternion


def planned_shot(trajectory: TrajectoryPlan, index: int) -> Shot:
    """The shot of the frame at `index` in a planned trajectory."""
    flight = trajectory.flight
    turn = flight.angular_velocity_radps
    return Shot(
        flight.position_m[index],
        flight.rotation_camera_from_site[index],
        flight.velocity_mps[index],
        camera_seed(trajectory.seed, trajectory.camera),
        trajectory.frame_index[index],
        flight.nominal.approach_deg,
        np.zeros(3) if turn is None else turn[index],
    )


def recorded_shot(row: dict[str, Any], trajectory_seed: int, approach_deg: int = 0) -> Shot:
    """The shot of a row of the manifest's table `frames`.

    `approach_deg` is needed only for rendering.
    """
    return Shot(
        np.array(row["position_m"]),
        matrix_from_quaternion(row["rotation_wxyz"]),
        np.array(row["velocity_mps"]),
        camera_seed(trajectory_seed, row["camera"]),
        row["frame_index"],
        approach_deg,
        np.array([row.get(name) or 0.0 for name in ANGULAR_VELOCITY]),
    )
