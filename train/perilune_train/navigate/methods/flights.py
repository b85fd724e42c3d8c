"""The filter over descents: errors at every frame with their stated sizes."""

import time
from collections.abc import Mapping

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import GRADES, InertialGrade
from perilune_shared.terminal import progress_bar
from perilune_train.navigate.craters.catalogue import Catalogue
from perilune_train.navigate.filter.flight import Instruments, fly
from perilune_train.navigate.filter.lander import RANGE_SIGMA_M, RELIEF_M, Lander, Surroundings
from perilune_train.navigate.filter.propagate import InertialNoise, start_sigmas
from perilune_train.navigate.filter.state import ATTITUDE, POSITION, State
from perilune_train.navigate.methods.seen import SeenDescent

START_M, START_MPS = 60.0, 1.0
"""Standard deviations of position and velocity at the start, on each axis."""
BAND = (1.24, 14.45)
"""Where a sum of six squares lies in 95 % of cases."""


def flights(
    dataset: Dataset,
    descents: list[SeenDescent],
    catalogues: Mapping[str, Catalogue],
    grade: InertialGrade,
    attitude_deg: float,
) -> pd.DataFrame:
    """Errors of the filter at every frame of all descents; the starts are off, drawn by the place of the descent."""
    tables = []
    mounting, sigmas = np.array(dataset.info.camera.rotation_camera_from_body), default_sigmas(grade, attitude_deg)
    with progress_bar() as progress:
        task = progress.add_task(f"filter, {attitude_deg:g} deg", total=len(descents), unit="descents", note="")
        for place, descent in enumerate(descents):
            instruments = Instruments.of_trajectory(dataset, descent.ids, grade)
            off = sigmas[:9] * np.random.default_rng(place).normal(size=9)
            begun = time.process_time()
            flown = flight(descent, instruments, mounting, catalogues[descent.ids[0]], grade, sigmas, off)
            tables.append(flown.assign(seconds=(time.process_time() - begun) / max(len(flown), 1)))
            progress.advance(task)
    return pd.concat(tables, ignore_index=True)


def default_sigmas(grade: InertialGrade, attitude_deg: float) -> Array:
    """Standard deviations of the start: `START_M`, `START_MPS`, an attitude, and the biases of a grade."""
    return start_sigmas(START_M, START_MPS, attitude_deg, GRADES[grade])


def flight(
    descent: SeenDescent,
    instruments: Instruments,
    mounting: Array,
    catalogue: Catalogue,
    grade: InertialGrade,
    sigmas: Array,
    off: Array,
) -> pd.DataFrame:
    """Errors of the filter at every frame of a descent.

    `mounting` is rotation_camera_from_body (3, 3), `sigmas` states the errors of the start, `off` (9,) has its true
    errors: position, velocity, attitude.
    """
    turned = descent.true[0].changed(np.concatenate([off[:3], mounting @ off[6:]]))
    attitude = turned.rotation_camera_from_site.T @ mounting
    start = State.starting(turned.position_m, descent.velocity_mps + off[3:6], attitude, sigmas, RELIEF_M)
    around = Surroundings(descent.camera, mounting, catalogue, RANGE_SIGMA_M, RELIEF_M)
    lander = Lander(start, InertialNoise.of(GRADES[grade]), around)
    rows = []
    for estimate in fly(lander, instruments, descent.time_s, descent.sightings):
        true = descent.true[estimate.frame]
        error = estimate.state.pose_error(true.position_m, true.rotation_camera_from_site.T @ mounting)
        rows.append(
            {
                "altitude_m": true.position_m[2],
                "status": estimate.status,
                **_axes("error", -error[:3]),
                **_axes("sigma", np.sqrt(np.diag(estimate.state.covariance))[POSITION]),
                "error_m": float(np.linalg.norm(error[:3])),
                "turn_deg": float(np.degrees(np.linalg.norm(error[3:]))),
                "squared": _squared(error, estimate.state.covariance),
            }
        )
    own = {"scene_id": descent.ids[0], "trajectory_id": descent.ids[1]}
    return pd.DataFrame(rows).assign(**own, time_s=descent.time_s)


def _axes(name: str, values: Array) -> dict[str, float]:
    return {f"{name}_{axis}_m": float(value) for axis, value in zip("xyz", values, strict=True)}


def _squared(error: Array, covariance: Array) -> float:
    """Normalised error squared of position and attitude."""
    own = np.r_[POSITION, ATTITUDE]
    return float(error @ np.linalg.solve(covariance[np.ix_(own, own)], error))


def flight_summary(flown: pd.DataFrame) -> dict[str, float]:
    """Figures of the filter over all frames of all descents, none left out."""
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
