"""Write one descent of a dataset as files for `navigate fly`, with random errors added."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from perilune_shared.config.yaml_text import to_yaml_text
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.export.foreign_text import write_csv
from perilune_shared.geometry.frames import Array, matrix_from_quaternion, quaternion_from_matrix
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_shared.storage.files import new_folder
from perilune_train.data.pinhole import check_pinhole
from perilune_train.landing.craters.catalogue import (
    MIN_DIAMETER_M,
    Catalogue,
    CatalogueErrors,
    exact_catalogue,
    with_errors,
)
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.fly.tables import (
    BEAM_DIRECTION,
    CRATER_COLUMNS,
    FORCES,
    FRAME_COLUMNS,
    FRAMES_FILE,
    INERTIAL_COLUMNS,
    NORMAL_COLUMNS,
    RANGE_COLUMNS,
    RATES,
    STAR_TRACKER_COLUMNS,
)
from perilune_train.landing.fly.truth import TRUTH_COLUMNS


def unpack_descent(
    dataset: Dataset,
    ids: tuple[str, str],
    out: Path,
    grade: InertialGrade,
    exact: bool,
    offset: tuple[float, float, float],
    seed: int,
) -> int:
    """Write the files of a trajectory to the new folder `out`; returns the number of frames.

    `ids` are scene_id and trajectory_id. Unless `exact`, the catalogue has random errors. `offset` holds the standard
    deviations of the prior's errors per axis: position (m), velocity (m/s) and attitude (degrees). `seed` determines
    the errors of the catalogue and the prior. Raises UserError if the dataset lacks the
    trajectory or its inertial measurements, or if its camera has a lens model.
    """
    check_pinhole(dataset)
    columns = ["frame_id", "time_s", "position_m", "velocity_mps", "rotation_wxyz", "png_path"]
    frames = dataset.table("frames", columns, *ids).sort_by("time_s")
    if not frames.num_rows:
        known = dataset.table("trajectories", ["scene_id", "trajectory_id"]).to_pylist()
        first = ", ".join("/".join(row.values()) for row in known[:3])
        raise UserError(dataset.store, "trajectory", "/".join(ids), f"one of its {len(known)}: {first} ...")
    inertial = dataset.table("inertial", None, *ids).to_pandas()
    inertial = inertial[inertial["grade"] == grade].sort_values("time_s")
    if inertial.empty:
        expected = f"inertial measurements of grade {grade}; render the dataset with dataset.nav.inertial"
        raise UserError(dataset.store, "inertial", f"none of {'/'.join(ids)}", expected)
    rng = np.random.default_rng(seed)
    catalogue = exact_catalogue(dataset, ids[0], MIN_DIAMETER_M)
    if not exact:
        catalogue = with_errors(catalogue, CatalogueErrors(), rng)
    with new_folder(out) as folder:
        _write_frames(dataset, frames, folder)
        camera = dataset.info.camera.model_dump(mode="json")
        (folder / "camera.yaml").write_text(to_yaml_text(camera), encoding="utf-8")
        _write_catalogue(folder / "catalogue.parquet", catalogue)
        measured = {
            **{name: inertial[name] for name in INERTIAL_COLUMNS[:2]},
            **_columns(RATES, inertial["angular_rate_radps"]),
            **_columns(FORCES, inertial["specific_force_mps2"]),
        }
        write_csv(pd.DataFrame(measured), folder / "imu.csv")
        ranges = dataset.table("ranges", list(RANGE_COLUMNS), *ids).to_pandas().sort_values("time_s")
        write_csv(ranges, folder / "ranges.csv")
        _write_sensors(dataset, ids, folder)
        sun_elevation_deg = dataset.table("scenes", ["sun_elevation_deg"], ids[0])["sun_elevation_deg"][0].as_py()
        prior = _prior(frames, np.array(dataset.info.camera.rotation_camera_from_body), grade, catalogue, offset, rng)
        prior["sun_elevation_deg"] = sun_elevation_deg
        # The frames of a dataset have exact mounting and times.
        prior |= {"camera_mounting_sigma_deg": 0.0, "camera_time_sigma_s": 0.0, **_recorded_sigmas(dataset, ids[0])}
        (folder / "prior.yaml").write_text(to_yaml_text(prior), encoding="utf-8")
        poses = np.column_stack([frames[name].to_pylist() for name in ("time_s", "position_m", "rotation_wxyz")])
        write_csv(pd.DataFrame(poses, columns=list(TRUTH_COLUMNS)), folder / "truth.csv")
    return int(frames.num_rows)


def _columns(names: tuple[str, ...], vectors: pd.Series) -> dict[str, Array]:
    values = np.stack(vectors.to_list())
    return {name: values[:, place] for place, name in enumerate(names)}


def _write_frames(dataset: Dataset, frames: pa.Table, out: Path) -> None:
    folder = out / "frames"
    folder.mkdir()
    names = {frame_id: f"{place:04d}.png" for place, frame_id in enumerate(frames["frame_id"].to_pylist())}
    for frame_id, png in dataset.pngs(frames):
        (folder / names[frame_id]).write_bytes(png)
    rows = {FRAME_COLUMNS[0]: list(names.values()), FRAME_COLUMNS[1]: frames["time_s"].to_pylist()}
    write_csv(pd.DataFrame(rows), folder / FRAMES_FILE)


def _write_sensors(dataset: Dataset, ids: tuple[str, str], out: Path) -> None:
    """Write star_tracker.csv and doppler_lidar.csv if the trajectory has such measurements."""
    stars = dataset.table("star_tracker", None, *ids).to_pandas().sort_values("time_s")
    if len(stars):
        columns = _columns(STAR_TRACKER_COLUMNS[1:], stars["rotation_wxyz"])
        write_csv(pd.DataFrame({"time_s": stars["time_s"], **columns}), out / "star_tracker.csv")
    lidar = dataset.table("doppler_lidar", None, *ids).to_pandas().sort_values(["time_s", "beam"])
    if len(lidar):
        columns = {"time_s": lidar["time_s"], **_columns(BEAM_DIRECTION, lidar["beam_in_body"])}
        measured = {name: lidar[name] for name in ("speed_mps", "range_m")}
        write_csv(pd.DataFrame(columns | measured), out / "doppler_lidar.csv")


def _recorded_sigmas(dataset: Dataset, scene_id: str) -> dict[str, object]:
    """The standard deviations of star tracker and Doppler lidar for prior.yaml, from a scene's recipe."""
    recipe = dataset.info.recipes[dataset.table("scenes", ["recipe"], scene_id)["recipe"][0].as_py()]
    settings = recipe.config.get(recipe.kind)
    instruments = settings.get("instruments") if isinstance(settings, dict) else None
    if not isinstance(instruments, dict):
        return {}
    keys = ("star_tracker_sigma_arcsec", "doppler_speed_sigma_mps", "doppler_range_sigma_m")
    return {key: instruments[key] for key in keys if key in instruments}


def _write_catalogue(path: Path, catalogue: Catalogue) -> None:
    values = np.column_stack([catalogue.centre_m, 2 * catalogue.radius_m, catalogue.normal])
    pd.DataFrame(values, columns=[*CRATER_COLUMNS, *NORMAL_COLUMNS]).to_parquet(path, index=False)


def _prior(
    frames: pa.Table,
    rotation_camera_from_body: Array,
    grade: InertialGrade,
    catalogue: Catalogue,
    offset: tuple[float, float, float],
    rng: np.random.Generator,
) -> dict[str, object]:
    """Content of prior.yaml: the true state at the first frame with random errors."""
    off = np.repeat(np.array(offset) * [1, 1, np.radians(1)], 3) * rng.normal(size=9)
    true = Pose(np.array(frames["position_m"][0].as_py()), matrix_from_quaternion(frames["rotation_wxyz"][0].as_py()))
    pose = true.changed(np.concatenate([off[:3], rotation_camera_from_body @ off[6:]]))
    return {
        "position_m": pose.position_m.tolist(),
        "velocity_mps": (np.array(frames["velocity_mps"][0].as_py()) + off[3:6]).tolist(),
        "rotation_wxyz": quaternion_from_matrix(pose.rotation_camera_from_site).tolist(),
        "position_sigma_m": offset[0],
        "velocity_sigma_mps": offset[1],
        "attitude_sigma_deg": offset[2],
        "inertial": grade,
        "catalogue_position_sigma_m": catalogue.position_sigma_m,
        "catalogue_diameter_sigma_share": catalogue.radius_sigma_share,
    }
