"""Fly the filter over a descent and write every input, intermediate and output as tables."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from perilune_shared.config.yaml_text import to_yaml_text
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, quaternion_from_matrix
from perilune_shared.storage.tables.limits import FRAMES
from perilune_shared.storage.tables.read import read_table
from perilune_train.landing.filter.flight import Instruments, fly
from perilune_train.landing.fly.catalogue import read_catalogue
from perilune_train.landing.fly.clocks import check_clocks
from perilune_train.landing.fly.detections import SIGMA_COLUMNS, Detect, by_network, by_table
from perilune_train.landing.fly.run import Descent, DescentFiles, lander_of, read_descent, sightings, surroundings_of
from perilune_train.landing.fly.settings import UnitErrors, read_camera, read_prior
from perilune_train.landing.fly.tables import (
    CRATER_COLUMNS,
    DOPPLER_LIDAR_COLUMNS,
    FRAME_COLUMNS,
    INERTIAL_COLUMNS,
    NORMAL_COLUMNS,
    RANGE_COLUMNS,
    STAR_TRACKER_COLUMNS,
    FrameFiles,
    InstrumentFiles,
    increasing,
    read_instruments,
)
from perilune_train.landing.trace.record import TraceRecorder
from perilune_train.shipped.models import shipped_run

INPUTS = "inputs"
"""Folder of the inputs within a trace."""
_FRAMES, _DETECTIONS = "frames.parquet", "detections.parquet"
_BOX = ("x0_px", "y0_px", "x1_px", "y1_px")


def write_trace(folder: Path, out: Path) -> dict[str, pd.DataFrame]:
    """Write the trace of a descent to the existing, empty folder `out`; returns its tables by name.

    `folder` is the folder `inputs` of a trace, or a folder as `navigate descent` writes. The latter may have
    detections.parquet, as `navigate fly --detections` reads it; otherwise the installed detector finds the craters.
    Raises UserError on a missing or invalid file.
    """
    inputs = out / INPUTS
    if (folder / _FRAMES).is_file():
        inputs.mkdir()
        for path in sorted(folder.iterdir()):
            if path.suffix in (".parquet", ".yaml"):
                shutil.copyfile(path, inputs / path.name)
    else:
        files = DescentFiles.of_folder(folder)
        if files.imu is not None and not files.imu.is_file():
            files = replace(files, imu=None)
        descent = read_descent(files)
        table = folder / _DETECTIONS
        detect = by_table(table, descent.frames.paths) if table.is_file() else by_network(shipped_run("detect"))
        inputs.mkdir()
        write_inputs(descent, detect, inputs)
    tables = trace_of(inputs)
    for name, rows in tables.items():
        write_table(rows, out / f"{name}.parquet")
    return tables


def trace_of(inputs: Path) -> dict[str, pd.DataFrame]:
    """Fly the filter over the inputs of a trace; returns the tables of the trace by name."""
    return flown(*read_inputs(inputs))


def flown(descent: Descent, detect: Detect) -> dict[str, pd.DataFrame]:
    """Fly the filter over a descent; returns the tables of the trace by name."""
    recorder = TraceRecorder(surroundings_of(descent))
    seen = sightings(descent, detect, {})
    for _ in fly(lander_of(descent, recorder), descent.instruments, descent.frames.time_s, seen):
        pass
    return recorder.tables()


def read_inputs(folder: Path) -> tuple[Descent, Detect]:
    """Read the inputs of a trace. Raises UserError on a missing or invalid file."""
    record, prior = read_camera(folder / "camera.yaml"), read_prior(folder / "prior.yaml")
    catalogue = read_catalogue(folder / "catalogue.parquet", prior.catalogue_use)
    table = read_table(folder / _FRAMES, FRAMES, {"file": "text", "time_s": "number"})
    if not table.n_rows:
        raise UserError(folder / _FRAMES, "rows", 0, "one row for each frame")
    frames = FrameFiles([Path(name) for name in table.texts("file").to_list()], increasing(table))
    optional = (folder / f"{name}.parquet" for name in ("imu", "ranges", "star_tracker", "doppler_lidar"))
    files = InstrumentFiles(*(path if path.is_file() else None for path in optional))
    instruments = read_instruments(files, prior.star_tracker_sigmas_rad, prior.lidar_errors)
    check_clocks(folder / _FRAMES, frames.time_s, files, instruments)
    detect = by_table(folder / _DETECTIONS, frames.paths)
    return Descent(record, prior, frames, instruments, catalogue, None), detect


def write_inputs(descent: Descent, detect: Detect, folder: Path) -> None:
    """Write the inputs of a descent as the filter uses them, with all defaults, to an existing folder."""
    catalogue = descent.catalogue
    craters = np.column_stack([catalogue.centre_m, 2 * catalogue.radius_m, catalogue.normal])
    write_table(_named(craters, (*CRATER_COLUMNS, *NORMAL_COLUMNS)), folder / "catalogue.parquet")
    names = [path.name for path in descent.frames.paths]
    write_table(pd.DataFrame(dict(zip(FRAME_COLUMNS, (names, descent.frames.time_s), strict=True))), folder / _FRAMES)
    _write_instruments(descent.instruments, folder)
    found = [(path.name, detect(path)) for path in descent.frames.paths]
    boxes = _named(np.concatenate([each.boxes for _, each in found]), _BOX)
    boxes.insert(0, "image", np.repeat(names, [len(each.scores) for _, each in found]))
    boxes = boxes.assign(score=np.concatenate([each.scores for _, each in found]))
    if any(each.shapes is not None for _, each in found):
        shapes = [np.full((len(each.scores), 5), np.nan) if each.shapes is None else each.shapes for _, each in found]
        boxes = boxes.assign(**dict(zip(SIGMA_COLUMNS, np.concatenate(shapes)[:, 1:3].T, strict=True)))
    write_table(boxes, folder / _DETECTIONS)
    (folder / "camera.yaml").write_text(to_yaml_text(descent.camera.model_dump(mode="json")), encoding="utf-8")
    prior = descent.prior.model_dump(mode="json", exclude_none=True)
    # The catalogue has been converted to O_L.
    for key in ("site_latitude_deg", "site_longitude_deg", "catalogue_columns"):
        prior.pop(key, None)
    prior["inertial"] = {name: getattr(descent.prior.unit, name) for name in UnitErrors.model_fields}
    (folder / "prior.yaml").write_text(to_yaml_text(prior), encoding="utf-8")


def _write_instruments(instruments: Instruments, folder: Path) -> None:
    inertial, stars, lidar = instruments.inertial, instruments.star_tracker, instruments.doppler_lidar
    if len(inertial):
        times = np.column_stack([inertial.time_s, inertial.interval_s])
        values = np.concatenate([times, inertial.angular_rate_radps, inertial.specific_force_mps2], axis=1)
        write_table(_named(values, INERTIAL_COLUMNS), folder / "imu.parquet")
    if len(instruments.range_time_s):
        values = np.column_stack([instruments.range_time_s, instruments.range_m])
        write_table(_named(values, RANGE_COLUMNS), folder / "ranges.parquet")
    if stars is not None:
        rotations = [
            quaternion_from_matrix(each) if np.isfinite(each).all() else np.full(4, np.nan)
            for each in stars.rotation_body_from_site
        ]
        values = np.column_stack([stars.time_s, np.reshape(rotations, (-1, 4))])
        write_table(_named(values, STAR_TRACKER_COLUMNS), folder / "star_tracker.parquet")
    if lidar is not None:
        beams = [[*beam.direction_in_body, beam.speed_mps, beam.range_m] for beam in lidar.beams]
        values = np.column_stack([lidar.time_s, np.reshape(beams, (-1, 5))])
        write_table(_named(values, DOPPLER_LIDAR_COLUMNS), folder / "doppler_lidar.parquet")


def _named(values: Array, names: tuple[str, ...]) -> pd.DataFrame:
    return pd.DataFrame(values, columns=list(names))


def write_table(rows: pd.DataFrame, path: Path) -> None:
    """Write a Parquet table with encodings that keep measurements small."""
    table = pa.Table.from_pandas(rows, preserve_index=False).replace_schema_metadata(None)
    # Measurements hardly repeat: without a dictionary and with bytes of equal weight together they compress best.
    encodings = {
        field.name: "BYTE_STREAM_SPLIT" if pa.types.is_floating(field.type) else "DELTA_BINARY_PACKED"
        for field in table.schema
        if pa.types.is_floating(field.type) or pa.types.is_integer(field.type)
    }
    texts = [field.name for field in table.schema if field.name not in encodings]
    pq.write_table(
        table,
        path,
        compression="zstd",
        compression_level=19,
        use_dictionary=texts or False,
        column_encoding=encodings,
        write_statistics=False,
    )
