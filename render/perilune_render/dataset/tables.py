"""Build the rows of the manifest's tables from scenes, plans and labels."""

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from perilune_render.config.dataset import DatasetConfig, InstrumentsConfig
from perilune_render.flight.instruments import (
    measure_attitudes,
    measure_beams,
    measure_ranges,
    measure_ranges_of_frames,
    measured,
    true_increments,
)
from perilune_render.flight.plan import ScenePlan, TrajectoryPlan
from perilune_render.labels.frame_labels import Labels
from perilune_render.terrain.craters.population import ORIGINS
from perilune_render.terrain.scene import Scene
from perilune_shared.content import content_sha256
from perilune_shared.dataset.names import IMAGE_KINDS, SCENE_FILE_KINDS
from perilune_shared.dataset.schema import ANGULAR_VELOCITY, TABLES, complete
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, quaternion_from_matrix, selenographic_from_site

_CAMERA = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
_FILES = tuple(f"{kind}_{name}" for kind in IMAGE_KINDS for name in ("path", "sha256", "bytes"))
_OF_SCENE = tuple(f"{kind}_{name}" for kind in SCENE_FILE_KINDS for name in ("path", "sha256", "bytes"))
_OF_LABELS = ("n_craters_above_max_radius",)


def _table(name: str, columns: dict) -> pa.Table:
    return complete(name, _columns(name, columns))


def _columns(name: str, columns: dict) -> pa.Table:
    return pa.table(columns, schema=pa.schema([TABLES[name].field(column) for column in columns]))


def _vectors(values: ArrayLike) -> pa.Array:
    rows = np.asarray(values, np.float64)
    return pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), rows.shape[1])


def ground_tables(scene_id: str, scene: Scene) -> dict[str, pa.Table]:
    """Rows of the tables `craters` and `boulders` of one scene."""
    craters, rims, boulders = scene.craters, scene.rims, scene.boulders
    latitude, longitude = selenographic_from_site(craters.x_m, craters.y_m, scene.latitude_deg, scene.longitude_deg)
    return {
        "craters": _table(
            "craters",
            {
                "scene_id": [scene_id] * len(craters),
                "crater_id": scene.crater_id,
                "x_m": craters.x_m,
                "y_m": craters.y_m,
                "z_m": rims.z_m,
                "normal_x": rims.normal[:, 0],
                "normal_y": rims.normal[:, 1],
                "normal_z": rims.normal[:, 2],
                "diameter_m": craters.diameter_m,
                "depth_m": rims.depth_m,
                "fresh_depth_m": pa.array(craters.fresh_depth_m, from_pandas=True),
                "age_myr": pa.array(craters.age_myr, from_pandas=True),
                "origin": np.array(ORIGINS)[craters.origin],
                "latitude_deg": latitude,
                "longitude_deg": longitude,
                "catalogue_diameter_m": pa.array(craters.listed_diameter_m, from_pandas=True),
                "rim_rms_share": pa.array(craters.rim_rms_share, from_pandas=True),
                "rim_axis_ratio": pa.array(craters.rim_axis_ratio, from_pandas=True),
            },
        ),
        "boulders": _table(
            "boulders",
            {
                "scene_id": [scene_id] * len(boulders),
                "boulder_id": np.arange(len(boulders)),
                "x_m": boulders.x_m,
                "y_m": boulders.y_m,
                "z_m": scene.boulder_z_m,
                "diameter_m": boulders.diameter_m,
                "shape_id": boulders.shape_id.astype(np.int64),
                "rotation_wxyz": _vectors(boulders.rotation_wxyz.reshape(-1, 4)),
            },
        ),
    }


def scene_tables(
    plan: ScenePlan, scene: Scene, config: DatasetConfig, recipe: str, files: dict | None = None
) -> dict[str, pa.Table]:
    """Rows of the tables `scenes`, `craters` and `boulders` of one scene.

    `recipe` is the key of the scene's recipe. `files` holds the columns that describe the scene's files, such as
    `hazard_path`.
    """
    ground = ground_tables(plan.scene_id, scene)
    return {
        "scenes": _table(
            "scenes",
            {
                "scene_id": [plan.scene_id],
                "seed": [plan.seed],
                "latitude_deg": [scene.latitude_deg],
                "longitude_deg": [scene.longitude_deg],
                "sun_azimuth_deg": [plan.sun_azimuth_deg],
                "sun_elevation_deg": [plan.sun_elevation_deg],
                "photometry": [config.light.photometry],
                "dem_source": [scene.dem_source],
                "extent_m": [scene.grid.extent_m],
                "recipe": [recipe],
                "content_sha256": [content_sha256(ground["craters"], ground["boulders"])],
                **{name: [(files or {}).get(name)] for name in _OF_SCENE},
            },
        ),
        **ground,
    }


def trajectory_table(trajectories: list[TrajectoryPlan]) -> pa.Table:
    """Rows of the table `trajectories`."""
    nominal = [trajectory.flight.nominal for trajectory in trajectories]
    return _table(
        "trajectories",
        {
            "scene_id": [t.scene_id for t in trajectories],
            "trajectory_id": [t.trajectory_id for t in trajectories],
            "seed": [t.seed for t in trajectories],
            "n_frames": [len(t.splits) for t in trajectories],
            "split": [t.split for t in trajectories],
            "nominal_position_m": _vectors([n.position_m for n in nominal]),
            "nominal_velocity_mps": _vectors([n.velocity_mps for n in nominal]),
            "nominal_acceleration_mps2": _vectors([n.acceleration_mps2 for n in nominal]),
            "duration_s": [n.duration_s for n in nominal],
        },
    )


def frame_table(trajectory: TrajectoryPlan, camera: Camera, sun: Array, files: list[dict]) -> pa.Table:
    """Rows of the table `frames` of one trajectory.

    `files` holds, for each frame, the columns that describe its files, and `real_ground_share` and
    `n_craters_above_max_radius` if they are known.
    """
    flight, n = trajectory.flight, len(trajectory.splits)
    columns: dict = {
        "frame_id": [trajectory.frame_id(i) for i in range(n)],
        "scene_id": [trajectory.scene_id] * n,
        "trajectory_id": [trajectory.trajectory_id] * n,
        "frame_index": np.array(trajectory.frame_index),
        "time_s": flight.time_s,
        "split": list(trajectory.splits),
        **{name: [getattr(camera, name)] * n for name in _CAMERA},
        "position_m": _vectors(flight.position_m),
        "rotation_wxyz": _vectors(flight.rotation_wxyz),
        "velocity_mps": _vectors(flight.velocity_mps),
        "sun_direction": _vectors(np.tile(sun, (n, 1))),
        "real_ground_share": [row.get("real_ground_share") for row in files],
        "camera": pa.array([trajectory.camera] * n, pa.string()),
    }
    if flight.angular_velocity_radps is not None:
        columns |= dict(zip(ANGULAR_VELOCITY, flight.angular_velocity_radps.T, strict=True))
    return _table("frames", columns | {name: [row.get(name) for row in files] for name in (*_FILES, *_OF_LABELS)})


def measurement_tables(
    trajectory: TrajectoryPlan, scene: Scene, config: InstrumentsConfig, *, at_frames: bool
) -> dict[str, pa.Table]:
    """Rows of the tables of measurements of one trajectory; a table without rows is left out.

    Measurements need the motion between frames. If this motion is unknown, only ranges are measured, only with
    `at_frames`, and only at the time of each frame.
    """
    motion = trajectory.flight.motion

    def table(name: str, n_rows: int, columns: dict) -> pa.Table:
        keys = {"scene_id": [trajectory.scene_id] * n_rows, "trajectory_id": [trajectory.trajectory_id] * n_rows}
        return _table(name, keys | columns)

    parts, seed = {}, trajectory.seed
    if config.inertial_grades and motion is not None:
        true = true_increments(motion, config.inertial_rate_hz)
        units = [measured(true, grade, seed) for grade in config.inertial_grades]
        columns = {name: np.concatenate([getattr(unit, name) for unit in units]) for name in ("time_s", "interval_s")}
        for name in ("angular_rate_radps", "specific_force_mps2"):
            columns[name] = _vectors(np.concatenate([getattr(unit, name) for unit in units]))
        grades = [grade for grade in config.inertial_grades for _ in true.time_s]
        parts["inertial"] = table("inertial", len(grades), {"grade": grades, **columns})
    if config.range_rate_hz and (motion is not None or at_frames):
        if motion is not None:
            ranges = measure_ranges(motion, scene, config, motion.nominal.duration_s, seed)
        else:
            ranges = measure_ranges_of_frames(trajectory.flight, trajectory.frame_index, scene, config, seed)
        columns = {"time_s": ranges.time_s, "range_m": pa.array(ranges.range_m, from_pandas=True)}
        parts["ranges"] = table("ranges", len(ranges.time_s), columns)
    if config.star_tracker_rate_hz and motion is not None:
        attitudes = measure_attitudes(motion, config, seed)
        quaternions = np.array([quaternion_from_matrix(each) for each in attitudes.rotation_body_from_site])
        columns = {"time_s": attitudes.time_s, "rotation_wxyz": _vectors(quaternions.reshape(-1, 4))}
        if len(attitudes.time_s):
            parts["star_tracker"] = table("star_tracker", len(attitudes.time_s), columns)
    if config.doppler_rate_hz and motion is not None:
        beams = measure_beams(motion, scene, config, seed)
        n_times, n_beams = len(beams.time_s), len(beams.direction_in_body)
        columns = {
            "beam": np.repeat(np.arange(n_beams), n_times),
            "time_s": np.tile(beams.time_s, n_beams),
            "beam_in_body": _vectors(np.repeat(beams.direction_in_body, n_times, axis=0)),
            "speed_mps": pa.array(beams.speed_mps.ravel(), from_pandas=True),
            "range_m": pa.array(beams.range_m.ravel(), from_pandas=True),
        }
        parts["doppler_lidar"] = table("doppler_lidar", n_times * n_beams, columns)
    return parts


def developed_frame_table(table: pa.Table, camera: Camera, files: list[dict]) -> pa.Table:
    """Rows of the table `frames` with a different camera and different files.

    `files` holds columns as in `frame_table`.
    """
    columns = {name: table[name] for name in table.column_names}
    columns |= {name: [getattr(camera, name)] * len(table) for name in _CAMERA}
    renewed = (*_FILES, *(name for name in _OF_LABELS if name in files[0]))
    return _table("frames", columns | {name: [row.get(name) for row in files] for name in renewed})


def label_table(frame_id: str, labels: Labels) -> pa.Table:
    """Rows of the table `labels` of one frame, without the columns that are copied from the table `frames`."""
    e, boxes = labels.ellipses, labels.ellipses.bounding_boxes()
    return _columns(
        "labels",
        {
            "frame_id": [frame_id] * len(labels.crater_id),
            "crater_id": labels.crater_id.astype(np.int64),
            "ellipse_cx_px": e.cx_px,
            "ellipse_cy_px": e.cy_px,
            "ellipse_a_px": e.a_px,
            "ellipse_b_px": e.b_px,
            "ellipse_theta_rad": e.theta_rad,
            "bbox_x0_px": boxes[:, 0],
            "bbox_y0_px": boxes[:, 1],
            "bbox_x1_px": boxes[:, 2],
            "bbox_y1_px": boxes[:, 3],
            "radius_px": e.radius_px(),
            "visible_fraction": labels.visible_fraction,
            "sunlit_fraction": labels.sunlit_fraction,
            "contrast": labels.contrast,
        },
    )
