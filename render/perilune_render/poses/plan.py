"""The plan of given poses: the user's trajectories over one ground, and the views that it must cover."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.scene import HIGHEST_M, SceneConfig, ViewConfig
from perilune_render.flight.plan import Plan, ScenePlan, TrajectoryPlan, seen_by
from perilune_render.flight.pose_checks import edge_points, ground_in_view
from perilune_render.flight.rig import MountedCamera, Rig, rig_of
from perilune_render.flight.trajectories import Flight
from perilune_render.flight.view import scene_view
from perilune_render.poses.file import GivenPoses
from perilune_render.streams import derived_seed
from perilune_shared.dataset.names import Kind
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_quaternion
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory

SAME_SUN_DEG = 0.05
"""Angle, degrees, a tenth of the Sun's diameter. Frames whose Suns differ by a smaller angle share the Sun of the first
of these frames."""
_MAX_SCENES = 1000
_N_VIEWS = 24
"""Largest number of views that are made from poses."""
_LOWER = 0.9
"""Smallest height of a camera above the ground, divided by its height above z = 0; the ground may be above z = 0."""
_WIDER = 1.05
"""Factor on horizontal distances, a margin for relief."""
_SPLIT = "test"
_N_CHECKED = 1000
"""Number of evenly spaced poses whose attitudes are checked for other interpretations of the file."""


def scene_seed(config: DatasetConfig) -> int:
    """Random seed of the ground under given poses."""
    return derived_seed(config.seed, config.name, "given", "scene", 0)


def trajectory_seed(seed: int, number: int) -> int:
    """Random seed of a trajectory of given poses over the ground with this seed."""
    return derived_seed(seed, "given", "trajectory", number)


def views_of(poses: GivenPoses, rig: Rig, where: object) -> tuple[ViewConfig, ...]:
    """Views that contain all ground seen by any camera from any pose, with margins for relief.

    Heights and reaches are rounded to three digits. The ground is taken to be at most a tenth of a camera's height
    above or below the plane z = 0. Raises UserError for a pose that is not above the plane or that shows the horizon.
    """
    seen = [_reach(poses, mounted, name, where) for name, mounted in rig.items()]
    height, reach = (np.concatenate(each) for each in zip(*seen, strict=True))
    return tuple(_views(height, reach))


def horizon_views_of(poses: GivenPoses, rig: Rig, where: object) -> tuple[ViewConfig, ...]:
    """Views with horizon that contain all poses, rounded to three digits.

    The last view is at the highest pose. The ground is taken to be at most a tenth of a camera's height above the plane
    z = 0. Raises UserError for a pose that is not above the plane, or higher than HIGHEST_M.
    """
    places = []
    for name, mounted in rig.items():
        position = _poses_of(poses, mounted, name)[0]
        z = position[:, 2]
        _check_above(z, poses, where)
        _refuse(z > HIGHEST_M, poses, where, lambda n, z=z: f"z {z[n]:.0f} m", f"at most {HIGHEST_M:g} m with horizon")
        places.append(position)
    position = np.concatenate(places)
    height, away = position[:, 2], np.abs(position[:, :2]).max(axis=1)
    views = _views(height, np.maximum(_WIDER * away, 0.1 * height))
    highest = min(_rounded(height.max(), np.ceil), HIGHEST_M)
    return (*views, ViewConfig(height_m=highest, reach_m=views[-1].reach_m))


def _views(height_m: Array, reach_m: Array) -> list[ViewConfig]:
    """Views that contain cameras at heights (N,) with reaches (N,), both in metres."""
    edges = np.geomspace(_LOWER * height_m.min(), _LOWER * height_m.max() * 1.001, _N_VIEWS + 1)
    views: list[ViewConfig] = []
    for low, high in pairwise(edges):
        farthest = _rounded(reach_m[_LOWER * height_m <= high].max(), np.ceil)
        lowest_m = _rounded(low, np.floor)
        if not views or (farthest > views[-1].reach_m and lowest_m > views[-1].height_m):
            views.append(ViewConfig(height_m=lowest_m, reach_m=farthest))
    return views


def _check_above(height_m: Array, poses: GivenPoses, where: object) -> None:
    """Raise UserError for cameras whose height (N,) over O_L's plane is not positive."""
    _refuse(height_m <= 0, poses, where, lambda n: f"z {height_m[n]:.1f} m", "above 0, the height of the site")


def _poses_of(poses: GivenPoses, mounted: MountedCamera, name: str | None) -> tuple[Array, Array]:
    """Positions (N, 3) and rotations (N, 4) of a camera, for given poses of the body."""
    if name is None:
        return poses.position_m, poses.rotation_wxyz
    return mounted.poses(poses.position_m, poses.rotation_wxyz)


def _check_attitudes(poses: GivenPoses, rig: Rig, where: object, *, horizon: bool) -> None:
    """Raise UserError if attitudes miss the ground and another interpretation shows it in all frames.

    The error names the other interpretation. Checks up to _N_CHECKED poses; other poses that miss the ground are
    rejected later.
    """
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _N_CHECKED)).round().astype(int))
    position = poses.position_m[chosen]
    if poses.attitudes is None or (position[:, 2] <= 0).any():
        return
    stated = replace(poses.attitudes, quaternion_wxyz=poses.attitudes.quaternion_wxyz[chosen])
    fits = _is_ground_shown(position, stated.rotation_wxyz, rig, horizon=horizon)
    if fits.all():
        return
    single, double = stated.alternatives()
    for readings in (single, [] if fits.any() else double):
        fitting = [
            what
            for what, other in readings
            if _is_ground_shown(position, other.rotation_wxyz, rig, horizon=horizon).all()
        ]
        if fitting:
            n = int(chosen[np.argmin(fits)])
            share = "all frames" if not fits.any() else f"{(~fits).mean():.0%} of the frames"
            view, ground, sky = (
                ("a view of the sky alone", "some ground in view", "")
                if horizon
                else ("a view with the horizon", "a view of the ground alone", "; or dataset.scene.horizon=true")
            )
            found = f"{view}, as in {share}"
            expected = f"{ground}, which all frames show with {', or with '.join(fitting)}{sky}"
            raise UserError(where, f"{poses.origin(n)}: pose at {poses.time_s[n]:g} s", found, expected)


def _is_ground_shown(position_m: Array, rotation_wxyz: Array, rig: Rig, *, horizon: bool) -> np.ndarray:
    """Whether all cameras at a pose of the body (N,) show only ground, or with `horizon` some ground."""
    shown = np.ones(len(position_m), bool)
    for name, mounted in rig.items():
        seen = (position_m, rotation_wxyz) if name is None else mounted.poses(position_m, rotation_wxyz)
        camera, matrices = mounted.exr_camera, matrix_from_quaternion(seen[1])
        if horizon:
            shown &= ground_in_view(seen[0], matrices, camera)
        else:
            shown &= (_corner_rays(camera, matrices)[..., 2] < 0).all(axis=1)
    return shown


def _corner_rays(camera: Camera, matrices: Array) -> Array:
    """Rays (N, 4, 3), O_L, through the corners of the image; of a lens model, through S points of its edge.

    `matrices` are rotation_camera_from_site (N, 3, 3).
    """
    places = np.array([[u, v] for u in (0, camera.width_px) for v in (0, camera.height_px)])
    corners = camera.border_rays(places if camera.lens is None else edge_points(camera))
    return np.einsum("nji,sj->nsi", matrices, corners)


def _reach(poses: GivenPoses, mounted: MountedCamera, name: str | None, where: object) -> tuple[Array, Array]:
    """Height of a camera, and largest |x| or |y| of the ground that it sees, metres, (N,) each.

    Raises the errors of `views_of`.
    """
    camera, (position, rotation) = mounted.exr_camera, _poses_of(poses, mounted, name)
    height = position[:, 2]
    _check_above(height, poses, where)
    rays = _corner_rays(camera, matrix_from_quaternion(rotation))
    _refuse(
        (rays[..., 2] > -0.01 * np.linalg.norm(rays, axis=-1)).any(axis=1),
        poses,
        where,
        lambda n: "a view with the horizon",
        "a view of the ground alone; state dataset.scene.views for others, or dataset.scene.horizon=true for the sky",
    )
    lowest = -0.1 * height[:, None, None]
    distance = (lowest - position[:, None, 2:]) / rays[..., 2:]
    reach = _WIDER * np.abs(position[:, None, :2] + distance * rays[..., :2]).max(axis=(1, 2))
    return height, reach


def _rounded(value: float, towards) -> float:
    """Three significant digits, rounded up or down."""
    digit = 10.0 ** (np.floor(np.log10(value)) - 2)
    return float(f"{towards(value / digit) * digit:.6g}")


def given_plan(poses: GivenPoses, config: DatasetConfig, kind: Kind, where: object) -> tuple[Plan, DatasetConfig]:
    """The plan of given poses, and the configuration with the views and the hash of the poses.

    Frames whose Suns differ by SAME_SUN_DEG or more are in different scenes over the same ground. A trajectory under
    several Suns is divided among their scenes; the parts keep the indices and times of the whole trajectory. Raises
    UserError if the poses fit no ground, or for more than _MAX_SCENES Suns.
    """
    scene = config.scene or SceneConfig()
    rig = rig_of(config)
    _check_attitudes(poses, rig, where, horizon=scene.horizon)
    views = scene.views or (horizon_views_of(poses, rig, where) if scene.horizon else views_of(poses, rig, where))
    scene = scene.model_copy(update={"views": views, "poses_sha256": poses.sha256})
    suns, lit_by = _suns(poses, scene)
    if len(suns) > _MAX_SCENES:
        found = f"more than {_MAX_SCENES} Suns that differ by {SAME_SUN_DEG} degrees"
        raise UserError(where, "sun_azimuth_deg", found, f"at most {_MAX_SCENES}")
    seed = scene_seed(config)
    scenes = tuple(ScenePlan(f"scene-{k:04d}", seed, *map(float, sun)) for k, sun in enumerate(suns))
    trajectories: list[TrajectoryPlan] = []
    ranges: dict[str, range] = {}
    for k, lit in enumerate(scenes):
        first = len(trajectories)
        numbers = np.unique(poses.trajectory[lit_by == k]).tolist()
        rows = [np.flatnonzero((poses.trajectory == number) & (lit_by == k)) for number in numbers]
        bodies = [_trajectory(poses, of_body, lit, number) for of_body, number in zip(rows, numbers, strict=True)]
        trajectories += [seen_by(body, name, rig) for name in rig for body in bodies]
        ranges[lit.scene_id] = range(first, len(trajectories))
    view = scene_view(scene, *(each.exr_camera for each in rig.values()))
    plan = Plan(rig, view, scenes, tuple(trajectories), ranges)
    return plan, config.model_copy(update={"scene": scene})


def _suns(poses: GivenPoses, scene: SceneConfig) -> tuple[list[Array], np.ndarray]:
    """Azimuth and elevation of each different Sun, degrees, and the index (N,) of each frame's Sun."""
    if poses.sun_deg is None:
        return [np.array([scene.sun_azimuth_deg, scene.sun_elevation_deg])], np.zeros(len(poses), int)
    suns: list[Array] = []
    index = np.empty(len(poses), int)
    for n, sun in enumerate(poses.sun_deg):
        if n == 0 or not _is_same_sun(sun, suns[index[n - 1]]).item():
            same = np.flatnonzero(_is_same_sun(sun, np.array(suns).reshape(-1, 2)))
            if not len(same):
                suns.append(sun)
            if len(suns) > _MAX_SCENES:
                return suns, index
            index[n] = same[0] if len(same) else len(suns) - 1
        else:
            index[n] = index[n - 1]
    return suns, index


def _is_same_sun(sun: Array, others: Array) -> np.ndarray:
    """Whether a Sun (2,) differs by less than SAME_SUN_DEG from others (..., 2)."""
    turn = (sun[0] - others[..., 0] + 180) % 360 - 180
    across = np.abs(turn) * np.cos(np.radians(sun[1]))
    return np.maximum(across, np.abs(sun[1] - others[..., 1])) < SAME_SUN_DEG


def _trajectory(poses: GivenPoses, rows: np.ndarray, scene: ScenePlan, number: int) -> TrajectoryPlan:
    """The frames `rows` of a user's trajectory, with their indices and times in the whole trajectory."""
    name = f"trajectory-{number:04d}"
    whole = np.flatnonzero(poses.trajectory == number)
    part, origin = partial(_flight, poses, rows, whole), partial(_origin, poses, rows)
    seed = trajectory_seed(scene.seed, number)
    # Continue the numbers when the Sun changes, since equal numbers would give equal noise.
    index = (rows - whole[0]).tolist()
    return TrajectoryPlan(scene.scene_id, name, seed, index, (_SPLIT,) * len(rows), part, is_drawn=False, origin=origin)


def _origin(poses: GivenPoses, rows: np.ndarray, index: int) -> str:
    """Location in the pose file of the pose at an index of `rows`, for messages."""
    return poses.origin(int(rows[index]))


def _flight(poses: GivenPoses, rows: np.ndarray, whole: np.ndarray) -> Flight:
    """The flight through the poses `rows` of a trajectory.

    `whole` are all poses of the trajectory, and the first of them has time 0. The nominal trajectory is a straight line
    from the first to the last pose of the whole trajectory.
    """
    first, last = whole[0], whole[-1]
    duration = float(poses.time_s[last] - poses.time_s[first])
    speed = (poses.position_m[last] - poses.position_m[first]) / duration if duration > 0 else np.zeros(3)
    nominal = NominalTrajectory(_three(poses.position_m[first]), _three(speed), (0.0, 0.0, 0.0), duration or 1.0)
    time, position = poses.time_s[rows] - poses.time_s[first], poses.position_m[rows]
    turn = None if poses.angular_velocity_radps is None else poses.angular_velocity_radps[rows]
    return Flight(
        nominal, time, position, poses.velocity_mps[rows], poses.rotation_wxyz[rows], angular_velocity_radps=turn
    )


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _refuse(wrong: np.ndarray, poses: GivenPoses, where: object, found, expected: str) -> None:
    if wrong.any():
        n = int(np.argmax(wrong))
        raise UserError(where, f"{poses.origin(n)}: pose at {poses.time_s[n]:g} s", found(n), expected)
