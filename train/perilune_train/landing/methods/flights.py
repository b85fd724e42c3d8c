"""Run the filter over descents, and tabulate its errors and stated standard deviations."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_shared.geometry.inertial_errors import drawn_errors
from perilune_shared.geometry.inertial_grades import CALIBRATED, GRADES, InertialErrors, InertialGrade
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.filter.flight import Estimate, Instruments, StarTracker, fly
from perilune_train.landing.filter.lander import RANGE_SIGMA_M, RELIEF_M, Lander, Surroundings
from perilune_train.landing.filter.propagate import InertialNoise, start_sigmas
from perilune_train.landing.filter.state import ATTITUDE, POSITION, CameraErrors, State
from perilune_train.landing.methods.seen import SeenDescent

START_M, START_MPS = 60.0, 1.0
"""Standard deviations at the start on each axis: position (metres) and velocity (metres per second)."""
BAND = (1.24, 14.45)
"""Interval that contains the sum of six squared standard normal numbers with probability 95 %."""


def flights(
    dataset: Dataset,
    descents: list[SeenDescent],
    catalogues: Mapping[str, Catalogue],
    grade: InertialGrade,
    attitude_deg: float,
    smooth: bool = False,
) -> pd.DataFrame:
    """Errors of the filter, or of the smoother, at every frame of all descents.

    The errors at the start are random; the index of the descent is the random seed.
    """
    tables = []
    rotation_camera_from_body, sigmas = mounting_of(dataset), default_sigmas(grade, attitude_deg)
    with progress_bar() as progress:
        task = progress.add_task(
            f"{'smoother' if smooth else 'filter'}, {attitude_deg:g} deg", total=len(descents), unit="descents", note=""
        )
        for number, descent in enumerate(descents):
            instruments = Instruments.of_trajectory(dataset, descent.ids, grade)
            start = Start(GRADES[grade], sigmas, sigmas[:9] * np.random.default_rng(number).normal(size=9))
            catalogue = catalogues[descent.ids[0]]
            begun = time.process_time()
            flown = flight(descent, instruments, rotation_camera_from_body, catalogue, start, smooth)
            tables.append(flown.assign(seconds=(time.process_time() - begun) / max(len(flown), 1)))
            progress.advance(task)
    return pd.concat(tables, ignore_index=True)


STAR_TRACKER_UNIT = CALIBRATED
"""Inertial unit of a lander with a star tracker."""
STAR_TRACKER_ARCSEC = (10.0, 10.0, 60.0)
"""Standard deviations of the star tracker about the body's axes, seconds of arc."""


def flights_with_star_tracker(
    dataset: Dataset, descents: list[SeenDescent], catalogues: Mapping[str, Catalogue], attitude_deg: float
) -> pd.DataFrame:
    """Errors of the filter with a star tracker in flight, at every frame of all descents.

    The star tracker measures the attitude at the time of each frame. Attitudes and inertial errors of
    `STAR_TRACKER_UNIT` are drawn here, since the dataset need not have them; the small errors of grade `navigation`
    are neglected. The index of the descent is the random seed.
    """
    tables = []
    rotation_camera_from_body, sigmas_rad = mounting_of(dataset), np.radians(np.array(STAR_TRACKER_ARCSEC) / 3600)
    sigmas = start_sigmas(START_M, START_MPS, attitude_deg, STAR_TRACKER_UNIT)
    with progress_bar() as progress:
        task = progress.add_task("filter, star tracker in flight", total=len(descents), unit="descents", note="")
        for number, descent in enumerate(descents):
            reference = Instruments.of_trajectory(dataset, descent.ids, "navigation")
            rng = np.random.default_rng(number)
            start = Start(STAR_TRACKER_UNIT, sigmas, sigmas[:9] * rng.normal(size=9))
            gyro, accelerometer = drawn_errors(STAR_TRACKER_UNIT, reference.inertial.interval_s, rng)
            rate = reference.inertial.angular_rate_radps + gyro
            force = reference.inertial.specific_force_mps2 + accelerometer
            inertial = replace(reference.inertial, angular_rate_radps=rate, specific_force_mps2=force)
            turns = sigmas_rad * rng.normal(size=(len(descent.true), 3))
            attitudes = [
                matrix_from_rotation_vector(-turn) @ rotation_camera_from_body.T @ true.rotation_camera_from_site
                for turn, true in zip(turns, descent.true, strict=True)
            ]
            stars = StarTracker(descent.time_s, np.array(attitudes), sigmas_rad)
            instruments = replace(reference, inertial=inertial, star_tracker=stars)
            begun = time.process_time()
            flown = flight(descent, instruments, rotation_camera_from_body, catalogues[descent.ids[0]], start)
            tables.append(flown.assign(seconds=(time.process_time() - begun) / max(len(flown), 1)))
            progress.advance(task)
    return pd.concat(tables, ignore_index=True)


def mounting_of(dataset: Dataset) -> Array:
    """rotation_camera_from_body (3, 3). Raises UserError unless the camera is at the body's origin."""
    camera = dataset.info.camera
    if any(camera.position_in_body_m):
        where = dataset.store.at("dataset.json")
        raise UserError(where, "camera.position_in_body_m", list(camera.position_in_body_m), "[0, 0, 0]")
    return np.array(camera.rotation_camera_from_body)


def default_sigmas(grade: InertialGrade, attitude_deg: float) -> Array:
    """Standard deviations (15,) at the start.

    They are `START_M`, `START_MPS`, `attitude_deg`, and the biases of the grade on each axis.
    """
    return start_sigmas(START_M, START_MPS, attitude_deg, GRADES[grade])


@dataclass(frozen=True, slots=True)
class Start:
    """Standard deviations that the filter assumes at the first frame, and the true error."""

    unit: InertialErrors
    """Errors of the inertial unit."""
    sigmas: Array
    """Standard deviations (15,) with which the filter starts, see `start_sigmas`."""
    error: Array
    """Error (9,) at the start: position (m, O_L), velocity (m/s, O_L) and attitude (rad, O_B)."""


def flight(
    descent: SeenDescent,
    instruments: Instruments,
    rotation_camera_from_body: Array,
    catalogue: Catalogue,
    start: Start,
    smooth: bool = False,
) -> pd.DataFrame:
    """Errors of the filter at every frame of a descent.

    With `smooth` they are the errors of the smoother, which estimates every pose from the measurements of all frames.
    """
    lander = lander_of(descent, rotation_camera_from_body, catalogue, start, smooth)
    estimates = list(fly(lander, instruments, descent.time_s, descent.sightings))
    rows = [row_of(descent, estimate, rotation_camera_from_body) for estimate in estimates]
    if smooth:
        for number, row in enumerate(rows):
            position, rotation_site_from_body = _true(descent, number, rotation_camera_from_body)
            error, covariance = lander.state.past_pose_error(number, position, rotation_site_from_body)
            rows[number] = _row(position[2], row["status"], error, covariance)
    return table_of(descent, rows)


def lander_of(
    descent: SeenDescent,
    rotation_camera_from_body: Array,
    catalogue: Catalogue,
    start: Start,
    smooth: bool = False,
) -> Lander:
    """The lander at the first frame; with `smooth` it keeps the pose of every frame."""
    error = start.error
    pose = descent.true[0].changed(np.concatenate([error[:3], rotation_camera_from_body @ error[6:]]))
    attitude = pose.rotation_camera_from_site.T @ rotation_camera_from_body
    velocity_mps = descent.velocity_mps + error[3:6]
    camera = CameraErrors(descent.sun_elevation_deg)
    state = State.starting(pose.position_m, velocity_mps, attitude, start.sigmas, RELIEF_M, camera)
    surroundings = Surroundings(descent.camera, rotation_camera_from_body, catalogue, RANGE_SIGMA_M, RELIEF_M)
    return Lander(state, InertialNoise.of(start.unit), surroundings, keep_poses=smooth)


def table_of(descent: SeenDescent, rows: list[dict[str, object]]) -> pd.DataFrame:
    """The table of a flight, from one row per frame."""
    ids = {"scene_id": descent.ids[0], "trajectory_id": descent.ids[1]}
    return pd.DataFrame(rows).assign(**ids, time_s=descent.time_s)


def row_of(descent: SeenDescent, estimate: Estimate, rotation_camera_from_body: Array) -> dict[str, object]:
    """Errors of the filter at one frame, as a row of the table."""
    position, rotation_site_from_body = _true(descent, estimate.frame, rotation_camera_from_body)
    covariance = estimate.state.covariance[np.ix_(_POSE, _POSE)]
    return _row(position[2], estimate.status, estimate.state.pose_error(position, rotation_site_from_body), covariance)


_POSE = np.r_[POSITION, ATTITUDE]


def _true(descent: SeenDescent, frame: int, rotation_camera_from_body: Array) -> tuple[Array, Array]:
    """True position (3,) and rotation_site_from_body (3, 3) at a frame."""
    true = descent.true[frame]
    return true.position_m, true.rotation_camera_from_site.T @ rotation_camera_from_body


def _row(altitude_m: float, status: object, error: Array, covariance: Array) -> dict[str, object]:
    """A row of the table, from the step (6,) to the true pose and the covariance (6, 6) of this step."""
    return {
        "altitude_m": altitude_m,
        "status": status,
        **_axes("error", -error[:3]),
        **_axes("sigma", np.sqrt(np.diag(covariance))[:3]),
        "error_m": float(np.linalg.norm(error[:3])),
        "turn_deg": float(np.degrees(np.linalg.norm(error[3:]))),
        "squared": float(error @ np.linalg.solve(covariance, error)),
    }


def _axes(name: str, values: Array) -> dict[str, float]:
    return {f"{name}_{axis}_m": float(value) for axis, value in zip("xyz", values, strict=True)}


def flight_summary(flown: pd.DataFrame) -> dict[str, float]:
    """Metrics of the filter over all frames of all descents."""
    ends = flown.groupby(["scene_id", "trajectory_id"])["error_m"].last()
    inside = flown["squared"].between(*BAND)
    return {
        "n_frames": float(len(flown)),
        "position_rmse_m": float(np.sqrt(np.mean(np.square(flown["error_m"])))),
        "position_end_rmse_m": float(np.sqrt(np.mean(np.square(ends)))),
        "position_end_worst_m": float(ends.max()),
        "attitude_rmse_deg": float(np.sqrt(np.mean(np.square(flown["turn_deg"])))),
        "normalised_error_squared_mean": float(flown["squared"].mean()),
        "in_band_share": float(inside.mean()),
        "right_share": float((flown["status"] == "tracking").mean()),
        "seconds_per_frame": float(flown["seconds"].mean()),
    }
