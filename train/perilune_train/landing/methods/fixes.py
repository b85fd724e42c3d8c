"""Estimate poses of single frames from craters, with an inaccurate prior or lost in space."""

import time
from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from perilune_shared.console.terminal import progress_bar
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import PosePrior
from perilune_train.landing.craters.locate import Located, locate, lost_in_space
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.search import Area
from perilune_train.landing.methods.seen import SeenDescent

PRIOR_M, PRIOR_DEG = 100.0, 1.0
"""Standard deviations of the prior's errors per axis, metres and degrees."""
WRONG_PX = 5.0
"""A fix with a larger error, in pixels on the ground, counts as wrong."""
LOST_ABOVE_M, LOST_ALTITUDE_SHARE = 800.0, 0.1
"""Limits of lost-in-space fixes: smallest altitude, metres, and largest relative error of the known altitude."""


def fixes_near_a_prior(descents: list[SeenDescent], catalogues: Mapping[str, Catalogue], seed: int) -> pd.DataFrame:
    """Errors of the fixes of all frames, computed from priors with random errors.

    The standard deviations of the priors are `PRIOR_M` and `PRIOR_DEG` on each axis.
    """
    rng, sigma = np.random.default_rng(seed), np.repeat([PRIOR_M, np.radians(PRIOR_DEG)], 3)
    rows = []
    for descent in _followed("fixes", descents):
        for true, sightings in zip(descent.true, descent.sightings, strict=True):
            prior = PosePrior(true.changed(sigma * rng.normal(size=6)), np.diag(sigma**2))
            begun = time.process_time()
            located = locate(sightings, catalogues[descent.ids[0]], descent.camera, prior)
            rows.append(_row(descent, true, located, time.process_time() - begun))
    return pd.DataFrame(rows)


def fixes_lost_in_space(descents: list[SeenDescent], catalogues: Mapping[str, Catalogue], seed: int) -> pd.DataFrame:
    """Errors of the lost-in-space fixes of all frames above 800 m.

    The camera is known to be level and the altitude is known to 10 %. The heading and the position within the catalogue
    are unknown.
    """
    rng, rows = np.random.default_rng(seed), []
    for descent in _followed("lost in space", descents):
        catalogue = catalogues[descent.ids[0]]
        low, high = catalogue.centre_m[:, :2].min(axis=0), catalogue.centre_m[:, :2].max(axis=0)
        for true, sightings in zip(descent.true, descent.sightings, strict=True):
            if true.position_m[2] < LOST_ABOVE_M:
                continue
            altitude_m = true.position_m[2] * rng.uniform(1 - LOST_ALTITUDE_SHARE, 1 + LOST_ALTITUDE_SHARE)
            limits = altitude_m / (1 + LOST_ALTITUDE_SHARE), altitude_m / (1 - LOST_ALTITUDE_SHARE)
            area = Area((low + high) / 2, float(np.linalg.norm(high - low) / 2), limits, np.pi)
            heading = rng.uniform(-np.pi, np.pi)
            turned = np.array(
                [[np.cos(heading), np.sin(heading), 0], [-np.sin(heading), np.cos(heading), 0], [0, 0, 1]]
            )
            assumed = Pose(np.array([*area.centre_m, altitude_m]), descent.level_rotation_camera_from_site @ turned)
            begun = time.process_time()
            located = lost_in_space(sightings, catalogue, descent.camera, PosePrior(assumed, np.eye(6)), area)
            rows.append(_row(descent, true, located, time.process_time() - begun))
    return pd.DataFrame(rows)


def _followed(name: str, descents: list[SeenDescent]) -> Iterator[SeenDescent]:
    """The descents, with a progress bar."""
    with progress_bar() as progress:
        task = progress.add_task(name, total=len(descents), unit="descents", note="")
        for descent in descents:
            yield descent
            progress.advance(task)


def _row(descent: SeenDescent, true: Pose, located: Located | None, seconds: float) -> dict[str, object]:
    frame = {"scene_id": descent.ids[0], "trajectory_id": descent.ids[1], "altitude_m": true.position_m[2]}
    if located is None:
        return {
            **frame,
            "error_m": np.nan,
            "error_px": np.nan,
            "turn_deg": np.nan,
            "squared": np.nan,
            "seconds": seconds,
        }
    error = step_to(located.fix.pose, true)
    length_m = float(np.linalg.norm(error[:3]))
    return {
        **frame,
        "error_m": length_m,
        "error_px": length_m * descent.camera.fx_px / true.position_m[2],
        "turn_deg": float(np.degrees(np.linalg.norm(error[3:]))),
        "squared": float(error @ np.linalg.solve(located.fix.covariance, error)),
        "seconds": seconds,
    }


def step_to(pose: Pose, true: Pose) -> Array:
    """The step (6,) to the true pose: shift (metres, O_L), then rotation from the left (radians, O_C)."""
    turn = rotation_vectors(true.rotation_camera_from_site @ pose.rotation_camera_from_site.T)
    return np.concatenate([true.position_m - pose.position_m, turn])


def fix_summary(fixes: pd.DataFrame) -> dict[str, float]:
    """Metrics of a method: errors of correct fixes, and shares of frames with a correct and a wrong fix."""
    right = fixes[fixes["error_px"] < WRONG_PX]
    return {
        "n_frames": float(len(fixes)),
        "position_rmse_m": _rms(right["error_m"]),
        "position_rmse_ground_px": _rms(right["error_px"]),
        "attitude_rmse_deg": _rms(right["turn_deg"]),
        "normalised_error_squared_mean": float(right["squared"].mean()),
        "right_share": len(right) / max(len(fixes), 1),
        "wrong_share": float((fixes["error_px"] >= WRONG_PX).mean()),
        "seconds_per_frame": float(fixes["seconds"].mean()),
    }


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
