"""Fly the filter over the files of one descent and write its estimates."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.dataset.metadata import CameraRecord
from perilune_shared.export.foreign_text import write_csv
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, quaternion_from_matrix
from perilune_shared.storage.files import new_folder
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.images.suspect import Suspicion
from perilune_train.detect.novelty import is_novel
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.filter.flight import Estimate, Instruments, fly
from perilune_train.landing.filter.lander import Lander, Recorder, Surroundings
from perilune_train.landing.filter.state import ATTITUDE, MOUNTING, N_ERRORS, POSITION, State
from perilune_train.landing.fly.catalogue import read_catalogue
from perilune_train.landing.fly.clocks import check_clocks
from perilune_train.landing.fly.detections import Detect, UnreadableFrame
from perilune_train.landing.fly.picture import draw_flight
from perilune_train.landing.fly.settings import FlightPrior, read_camera, read_prior
from perilune_train.landing.fly.tables import FrameFiles, InstrumentFiles, read_frame_files, read_instruments
from perilune_train.landing.fly.truth import Truth, read_truth, with_errors_of
from perilune_train.landing.fly.units import Prior, doubts

OPTIONAL_FILES = ("ranges.csv", "truth.csv", "star_tracker.csv", "doppler_lidar.csv")
ESTIMATES, PICTURE = "estimates", "flight.png"
_NOTHING = Detections(np.zeros((0, 4)), np.zeros(0))


@dataclass(frozen=True, slots=True)
class DescentFiles:
    """The files of one descent; `perilune-train navigate descent` writes an example of each."""

    frames: Path
    """Folder of images with frames.csv (columns file, time_s)."""
    camera: Path
    """Intrinsics and mounting: camera.yaml."""
    catalogue: Path
    """Craters of the landing site, Parquet or CSV."""
    imu: Path | None
    """Inertial measurements: imu.csv; None without an inertial unit."""
    prior: Path
    """Expected state at the first frame, and standard deviations of all errors: prior.yaml."""
    ranges: Path | None = None
    """Ranges of a laser altimeter: ranges.csv."""
    truth: Path | None = None
    """True poses, from which errors of the estimates are computed: truth.csv."""
    star_tracker: Path | None = None
    """Attitudes of a star tracker: star_tracker.csv."""
    doppler_lidar: Path | None = None
    """Ranges and speeds along the beams of a Doppler lidar: doppler_lidar.csv."""

    @property
    def instruments(self) -> InstrumentFiles:
        """The files of the measurements."""
        return InstrumentFiles(self.imu, self.ranges, self.star_tracker, self.doppler_lidar)

    @classmethod
    def of_folder(cls, folder: str | PathLike[str]) -> "DescentFiles":
        """The files of a folder under their usual names; files named in `OPTIONAL_FILES` may be absent."""
        root = Path(folder)
        needed = (root / name for name in ("frames", "camera.yaml", "catalogue.parquet", "imu.csv", "prior.yaml"))
        optional = (root / name for name in OPTIONAL_FILES)
        return cls(*needed, *(path if path.is_file() else None for path in optional))


@dataclass(frozen=True, slots=True)
class Descent:
    """The files of one descent, read and checked."""

    camera: CameraRecord
    """Camera intrinsics and mounting."""
    prior: FlightPrior
    """Expected state at the first frame, and errors of the measurements."""
    frames: FrameFiles
    """Frames and their times."""
    instruments: Instruments
    """Measurements other than frames."""
    catalogue: Catalogue
    """Craters of the landing site."""
    truth: Truth | None
    """True poses of the frames; None if unknown."""


def read_descent(files: DescentFiles) -> Descent:
    """Read all files of a descent. Raises UserError on the first missing or invalid file."""
    record, expected = read_camera(files.camera), read_prior(files.prior)
    craters = read_catalogue(files.catalogue, expected.catalogue_use)
    frames = read_frame_files(files.frames, record.intrinsics())
    mounting = np.array(record.rotation_camera_from_body)
    true = read_truth(files.truth, frames.time_s, mounting) if files.truth else None
    instruments = read_instruments(files.instruments, expected.star_tracker_sigmas_rad, expected.lidar_errors)
    check_clocks(files.frames, frames.time_s, files.instruments, instruments)
    return Descent(record, expected, frames, instruments, craters, true)


def fly_descent(
    descent: Descent,
    detect: Detect,
    out: Path | None,
    tell: Callable[[str], None] = lambda line: None,
    live: Path | None = None,
    suspicions: Mapping[Path, Suspicion] | None = None,
) -> pd.DataFrame:
    """Fly the filter over a descent with the craters that `detect` finds; returns one row per frame.

    Writes estimates.parquet, estimates.csv and flight.png to the new folder `out`; writes nothing if `out` is None.
    `tell` receives one line of text per frame. `live` is the path of a picture that is redrawn after every frame.
    `suspicions` are the suspicions that `detect` adds while it runs.
    """
    rows: list[dict[str, object]] = []
    faults: dict[int, str] = {}
    novelty: dict[int, float] = {}
    with contextlib.nullcontext() if out is None else new_folder(out) as folder:
        lander = lander_of(descent)
        seen = sightings(descent, detect, faults, novelty)
        mounting = np.array(descent.camera.rotation_camera_from_body)
        for estimate in fly(lander, descent.instruments, descent.frames.time_s, seen):
            row = _row(estimate, descent.frames, mounting, faults.get(estimate.frame, ""))
            row["novelty"] = novelty.get(estimate.frame, np.nan)
            suspicion = (suspicions or {}).get(descent.frames.paths[estimate.frame])
            rows.append(row | {"suspect": suspicion.reason if suspicion else ""})
            tell(_line(row))
            if live is not None:
                draw_flight(live, with_errors_of(pd.DataFrame(rows), descent.truth))
        table = with_errors_of(pd.DataFrame(rows), descent.truth)
        if folder is not None:
            table.to_parquet(folder / f"{ESTIMATES}.parquet", index=False)
            write_csv(table, folder / f"{ESTIMATES}.csv")
            draw_flight(folder / PICTURE, table)
    return table


def doubts_of(descent: Descent, *, is_lost: bool = False) -> list[str]:
    """Reasons to doubt the units of the inertial measurements; empty without doubts.

    If the flight is lost, less evidence is enough for a doubt.
    """
    mounting, expected = np.array(descent.camera.rotation_camera_from_body), descent.prior
    sigmas = expected.position_sigma_m, expected.velocity_sigma_mps
    prior = Prior(_start(descent), *sigmas, mounting[2], float(descent.frames.time_s[-1]))
    return doubts(descent.instruments.inertial, prior, is_lost=is_lost)


def _start(descent: Descent) -> State:
    """The expected state at the first frame."""
    mounting = np.array(descent.camera.rotation_camera_from_body)
    return replace(descent.prior.state(mounting), time_s=float(descent.frames.time_s[0]))


def surroundings_of(descent: Descent) -> Surroundings:
    """Camera, catalogue and ground of a descent; the camera is the pinhole that covers the view."""
    mounting, prior = np.array(descent.camera.rotation_camera_from_body), descent.prior
    camera = descent.camera.intrinsics().covering_pinhole()
    return Surroundings(camera, mounting, descent.catalogue, prior.range_sigma_m, prior.relief_m)


def lander_of(descent: Descent, recorder: Recorder | None = None) -> Lander:
    """The filter at the first frame of a descent; `recorder` receives its steps."""
    return Lander(_start(descent), descent.prior.noise, surroundings_of(descent), recorder=recorder)


def sightings(
    descent: Descent, detect: Detect, faults: dict[int, str], novelty: dict[int, float] | None = None
) -> Iterator[Sightings]:
    """Yield the craters of each frame.

    An unreadable frame has no craters, and `faults` receives the error message under the number of the frame. `novelty`
    receives the novelty of each frame (detect/novelty.py), if the detector knows it.
    """
    for number, path in enumerate(descent.frames.paths):
        try:
            found = detect(path)
        except UnreadableFrame as error:
            faults[number], found = str(error), _NOTHING
        if novelty is not None and found.novelty is not None:
            novelty[number] = found.novelty
        yield sightings_of(found, descent.camera.intrinsics()).strongest()


def sightings_of(found: Detections, camera: Camera) -> Sightings:
    """Convert detections of a camera to the pinhole camera that covers its view.

    Detections without a valid ray are left out. The standard deviation of a centre changes as the side of its box.
    """
    boxes = np.asarray(found.boxes, np.float64)
    sigmas_px = None if found.shapes is None else np.asarray(found.shapes[:, 1:3], np.float64)
    if not camera.distorts:
        return Sightings.of_boxes(boxes, found.scores, sigmas_px)
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    pinhole = camera.covering_pinhole()
    left, right = (np.column_stack([boxes[:, side], middle[:, 1]]) for side in (0, 2))
    top, bottom = (np.column_stack([middle[:, 0], boxes[:, side]]) for side in (1, 3))
    left, right, top, bottom, middle = (
        pinhole.project(camera.rays(points)) for points in (left, right, top, bottom, middle)
    )
    half = np.column_stack([np.linalg.norm(right - left, axis=1), np.linalg.norm(bottom - top, axis=1)]) / 2
    straight = np.column_stack([middle - half, middle + half])
    reached = np.isfinite(straight).all(axis=1)
    if sigmas_px is not None:
        sigmas_px = (sigmas_px * 2 * half / np.clip(boxes[:, 2:] - boxes[:, :2], 1e-6, None))[reached]
    return Sightings.of_boxes(straight[reached], found.scores[reached], sigmas_px)


def _row(estimate: Estimate, frames: FrameFiles, rotation_camera_from_body: Array, fault: str) -> dict[str, object]:
    state = estimate.state
    mounted = matrix_from_rotation_vector(state.mounting_rad) @ rotation_camera_from_body
    rotation = quaternion_from_matrix(mounted @ state.rotation_site_from_body.T)
    # The error of the camera's attitude consists of the errors of the body's attitude and of the mounting.
    errors = np.concatenate([np.eye(3), -mounted.T], axis=1)
    parts = [*range(N_ERRORS)[ATTITUDE], *range(N_ERRORS)[MOUNTING]]
    attitude_sigma = np.sqrt(np.diag(errors @ state.covariance[np.ix_(parts, parts)] @ errors.T))
    sigma = np.sqrt(np.diag(state.covariance))
    located = estimate.located
    pixels = located.fix.rms_px if located else np.nan
    own = {"file": frames.paths[estimate.frame].name, "time_s": float(frames.time_s[estimate.frame])}
    return {
        **own,
        "status": estimate.status,
        **_named("{}_m", "xyz", state.position_m),
        **_named("velocity_{}_mps", "xyz", state.velocity_mps),
        **_named("rotation_{}", "wxyz", rotation),
        **_named("sigma_{}_m", "xyz", sigma[POSITION]),
        **_named("sigma_attitude_{}_deg", "xyz", np.degrees(attitude_sigma)),
        "n_matched": len(located.fix.crater) if located else 0,
        "rms_px": pixels,
        "n_refused": estimate.n_refused,
        "disagreeing": ", ".join(estimate.disagreeing),
        "fault": fault,
    }


def _named(form: str, axes: str, values: Array) -> dict[str, float]:
    return {form.format(axis): float(value) for axis, value in zip(axes, values, strict=True)}


def _line(row: dict[str, object]) -> str:
    place = " ".join(f"{row[f'{axis}_m']:9.2f}" for axis in "xyz")
    sigma = " ".join(f"{row[f'sigma_{axis}_m']:.2f}" for axis in "xyz")
    turn = max(float(str(row[f"sigma_attitude_{axis}_deg"])) for axis in "xyz")
    line = f"{row['time_s']:9.2f} s  {row['status']:8}  {place} m  sigma {sigma} m  {turn:.3f} deg"
    line += f"  {row['n_matched']:3} craters"
    if row["disagreeing"]:
        line += f"  disagreeing: {row['disagreeing']}"
    if is_novel(float(str(row["novelty"]))):
        line += f"  unlike the training: novelty {row['novelty']:.2f}"
    return f"{line}  {row['fault']}" if row["fault"] else line


def novelty_of(table: pd.DataFrame) -> str | None:
    """One line on frames that are unlike the detector's training, from the table of `fly_descent`; None if none."""
    novel = table[table["novelty"] > 1]
    if not len(novel):
        return None
    return (
        f"{len(novel)} of {len(table)} frames are unlike the detector's training frames, from "
        f"{novel['time_s'].iloc[0]:.2f} s (novelty up to {novel['novelty'].max():.2f}, limit 1): its craters are "
        "unreliable there"
    )


def suspects_of(table: pd.DataFrame) -> str | None:
    """One line about the frames that may not show regolith, from the table of `fly_descent`; None if there are none."""
    suspects = table[table["suspect"] != ""]
    if not len(suspects):
        return None
    reasons = ", ".join(f"{count} {reason}" for reason, count in suspects["suspect"].value_counts().items())
    first = suspects["file"].iloc[0]
    return f"{len(suspects)} of {len(table)} frames may not show regolith ({reasons}; first {first}): column suspect"


def disagreement_of(table: pd.DataFrame) -> str | None:
    """One line that names the sensors that disagree with the state, from the table of `fly_descent`; None if none."""
    frames = table[table["disagreeing"] != ""]
    if not len(frames):
        return None
    sensors = sorted({sensor for names in frames["disagreeing"] for sensor in names.split(", ")})
    return (
        f"sensors that disagree with the state more than their stated errors allow: {', '.join(sensors)} "
        f"({len(frames)} of {len(table)} frames, from {frames['time_s'].iloc[0]:.2f} s): check their units, axes and "
        "stated errors, the mounting and the catalogue"
    )
