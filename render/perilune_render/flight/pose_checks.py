"""Check the poses of a plan against the ground.

The camera must be above the ground, and frames must show only ground. If the ground extends to the horizon, frames may
show the sky, but must also show ground.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perilune_render.flight.plan import Plan, TrajectoryPlan
from perilune_render.terrain.boulders import largest_height_m, tops_m
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.curvature import hits_sphere, horizon_m
from perilune_shared.geometry.frames import Array, matrix_from_quaternion

MIN_CLEARANCE_M = 1.0
"""Smallest height of the camera above the ground or above a boulder, metres."""
LARGEST_MPS, LARGEST_RADPS = 12_000.0, 100.0
"""Largest velocity, metres per second (five times escape velocity), and angular velocity, radians per second."""
_CHECKED_FRAMES = 20_000
"""Approximate number of frames that `check_plan` checks, which takes a few seconds."""
_POINTS_PER_SIDE = 8
"""Number of tested points along each side of the image."""
_UNIT_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of the camera in N frames of one scene."""

    frame_id: Sequence[str]
    """Names of the frames (N,) for messages: the id, with the line or row in the user's pose file if there is one."""
    position_m: Array
    """Position of the camera, O_L, metres (N, 3)."""
    rotation_wxyz: Array
    """rotation_camera_from_site, quaternions (N, 4)."""

    @classmethod
    def planned(cls, trajectories: Sequence[TrajectoryPlan]) -> "Poses":
        """Poses of all frames of trajectories over one scene."""
        return cls(
            [_named(t, i) for t in trajectories for i in range(len(t.splits))],
            np.concatenate([t.flight.position_m for t in trajectories]),
            np.concatenate([t.flight.rotation_wxyz for t in trajectories]),
        )


def _named(trajectory: TrajectoryPlan, index: int) -> str:
    """Id of a frame, with the line or row of its pose in the user's file."""
    frame_id = trajectory.frame_id(index)
    return frame_id if trajectory.origin is None else f"{frame_id}, {trajectory.origin(index)}"


def check_plan(plan: Plan, grid: Grid, where: object) -> None:
    """Check a plan before the heights of the ground are known.

    The Sun must be up, poses must be over the mesh, and ground must be in view. Poses are checked in the first scenes,
    up to about _CHECKED_FRAMES; `check_poses` checks the other scenes once their ground is known. Raises UserError with
    `where` (the configuration or the manifest) and the first scene or frame that fails.
    """
    for scene in plan.scenes:
        if not 0 < scene.sun_elevation_deg <= 90:
            found = f"{scene.sun_elevation_deg:g} degrees"
            raise UserError(where, f"{scene.scene_id}: sun_elevation_deg", found, "above 0 (the horizon), at most 90")
    n_checked = 0
    for trajectory in plan.trajectories:
        camera = plan.rig[trajectory.camera].exr_camera
        _check_mesh(Poses.planned([trajectory]), camera, grid, where, horizon=plan.view.horizon)
        n_checked += len(trajectory.splits)
        if n_checked >= _CHECKED_FRAMES:
            break


def check_trajectories(plan: Plan, trajectories: Sequence[TrajectoryPlan], scene: Scene, where: object) -> None:
    """Check the poses of all frames of planned trajectories over one scene with `check_poses`."""
    for name, mounted in plan.rig.items():
        of_camera = [trajectory for trajectory in trajectories if trajectory.camera == name]
        if of_camera:
            check_poses(Poses.planned(of_camera), mounted.exr_camera, scene, where)


def check_poses(poses: Poses, camera: Camera, scene: Scene, where: object) -> None:
    """Check poses against the ground of a scene.

    Positions must be valid (`check_places`), and frames must show ground. The ray through every tested point of the
    image border must hit the mesh, unless the scene's views may show the sky. Seen from above, the mesh is a square. A
    ray that begins above the ground hits the mesh if and only if the ray is below the edge of the mesh where it leaves
    this square. Raises UserError with `where` and the first frame that fails.
    """
    horizon = scene.view is not None and scene.view.horizon
    rays = _check_mesh(poses, camera, scene.grid, where, horizon=horizon)
    check_places(poses, scene, where)
    if horizon:
        return
    edge, leaves_x, leaves_y = _leaving(poses.position_m, rays, scene.grid.extent_m / 2)
    beyond = edge > value_at(scene.height_m, scene.grid, leaves_x, leaves_y)
    _refuse(
        beyond.any(axis=1),
        poses,
        where,
        lambda n: f"{beyond[n].mean():.0%} of the image's edge is beyond the terrain's edge",
        lambda n: f"a view within {scene.grid.extent_m / 2:.0f} m of the site: a lower, nearer or less tilted camera",
    )


def check_places(poses: Poses, scene: Scene, where: object) -> None:
    """Check that cameras are over a scene's mesh, and MIN_CLEARANCE_M above its ground and boulders.

    In scenes with horizon, cameras must be low enough for the horizon to lie within the mesh. Raises UserError with
    `where` and the first frame that fails.
    """
    _check_over(poses, scene.grid, where, horizon=scene.view is not None and scene.view.horizon)
    x, y, z = poses.position_m.T
    ground = value_at(scene.height_m, scene.grid, x, y)
    _check_clearance(poses, ground, "ground", where)
    low = np.flatnonzero(z < ground + MIN_CLEARANCE_M + largest_height_m(scene.boulders))
    top = np.full(len(z), -np.inf)
    top[low] = tops_m(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed, x[low], y[low])
    _check_clearance(poses, top, "boulder below it", where)


def _check_clearance(poses: Poses, surface_m: Array, what: str, where: object) -> None:
    """Check that cameras are MIN_CLEARANCE_M above surfaces with heights `surface_m` (N,), metres."""
    z = poses.position_m[:, 2]
    _refuse(
        z < surface_m + MIN_CLEARANCE_M,
        poses,
        where,
        lambda n: f"a camera {z[n] - surface_m[n]:.1f} m above the {what}",
        lambda n: f"at least {MIN_CLEARANCE_M:g} m: position_m[2] at least {surface_m[n] + MIN_CLEARANCE_M:.1f}",
    )


def _check_mesh(poses: Poses, camera: Camera, grid: Grid, where: object, *, horizon: bool) -> Array:
    """Check that poses are over the mesh and show only ground, or with `horizon` at least some ground.

    Returns rays (N, S, 3), O_L, through S image border points.
    """
    _check_over(poses, grid, where, horizon=horizon)
    matrices = matrix_from_quaternion(poses.rotation_wxyz)
    rays = np.einsum("nji,sj->nsi", matrices, camera.border_rays(edge_points(camera)))
    if horizon:
        _check_not_only_sky(poses, camera, matrices, where)
        return rays
    off_nadir = np.degrees(np.arccos(np.clip(-matrices[:, 2, 2], -1, 1)))
    _refuse(
        (rays[..., 2] >= 0).any(axis=1),
        poses,
        where,
        lambda n: f"a camera axis {off_nadir[n]:.0f} degrees from straight down, with the horizon in view",
        lambda n: "a view of the ground alone",
    )
    return rays


def _check_over(poses: Poses, grid: Grid, where: object, *, horizon: bool) -> None:
    """Check that poses are finite and over the mesh, and with `horizon` that it extends to the horizon."""
    position, rotation = poses.position_m, poses.rotation_wxyz
    unit = np.abs(np.linalg.norm(rotation, axis=1) - 1) <= _UNIT_TOLERANCE
    _refuse(
        ~(np.isfinite(position).all(axis=1) & unit),
        poses,
        where,
        lambda n: f"position {position[n]}, rotation {rotation[n]}",
        lambda n: "finite numbers and a unit quaternion",
    )
    half = grid.extent_m / 2
    _refuse(
        np.abs(position[:, :2]).max(axis=1) > half,
        poses,
        where,
        lambda n: f"a camera at x {position[n, 0]:.0f} m, y {position[n, 1]:.0f} m",
        lambda n: f"|x| and |y| at most {half:.0f} m, over the terrain",
    )
    if not horizon:
        return
    farthest = np.abs(position[:, :2]).max(axis=1) + horizon_m(np.maximum(position[:, 2], 0))
    _refuse(
        farthest > half,
        poses,
        where,
        lambda n: f"a horizon {farthest[n]:.0f} m from the site, beyond the terrain's edge",
        lambda n: f"at most {half:.0f} m; raise height_m and reach_m of the last view in dataset.scene.views",
    )


def _check_not_only_sky(poses: Poses, camera: Camera, matrices: Array, where: object) -> None:
    """Check that each pose shows some ground, not only sky."""
    in_view = ground_in_view(poses.position_m, matrices, camera)
    _refuse(~in_view, poses, where, lambda n: "a view of the sky alone", lambda n: "some ground in view")


def ground_in_view(position_m: Array, matrices: Array, camera: Camera) -> np.ndarray:
    """Whether each view (N,) shows ground; the ground is taken as a sphere with the Moon's radius.

    `matrices` are rotation_camera_from_site (N, 3, 3).
    """
    share = (np.arange(2 * _POINTS_PER_SIDE) + 0.5) / (2 * _POINTS_PER_SIDE)
    u, v = share * camera.width_px, share * camera.height_px
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return hits_sphere(position_m, np.einsum("nji,sj->nsi", matrices, camera.rays(points))).any(axis=1)


def edge_points(camera: Camera) -> Array:
    """Image coordinates (S, 2) of points on the image border, including the corners, pixels."""
    share = np.arange(_POINTS_PER_SIDE) / _POINTS_PER_SIDE
    sides = [(share, 0 * share), (1 + 0 * share, share), (1 - share, 1 + 0 * share), (0 * share, 1 - share)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides]) * [camera.width_px, camera.height_px]


def _leaving(position_m: Array, rays: Array, half_m: float) -> tuple[Array, Array, Array]:
    """Height, x and y (N, S) where downward rays (N, S, 3) leave the square of half-width `half_m`."""
    start = position_m[:, None, :2]
    with np.errstate(divide="ignore"):
        distance = np.where(
            rays[..., :2] != 0, (half_m - np.sign(rays[..., :2]) * start) / np.abs(rays[..., :2]), np.inf
        )
    distance = np.minimum(distance.min(axis=-1), 1e12)
    border = start + distance[..., None] * rays[..., :2]
    return position_m[:, None, 2] + distance * rays[..., 2], border[..., 0], border[..., 1]


def _refuse(faulty: np.ndarray, poses: Poses, where: object, found, expected) -> None:
    """Raise UserError for the first true value of `faulty` (N,).

    `found` and `expected` are functions from its index to texts of the message.
    """
    if faulty.any():
        n = int(np.argmax(faulty))
        raise UserError(where, f"frame {poses.frame_id[n]}", found(n), expected(n))
