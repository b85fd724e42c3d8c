"""Errors of estimated motions and poses, and their summaries."""

import itertools

import numpy as np
import pandas as pd

from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_train.motion.data.trajectories import Motion, Pose, Trajectory
from perilune_train.motion.geometry import dead_reckoning
from perilune_train.records.spread import Resamples, Spread, draw_resamples, spreads

_ALTITUDES_M = (0, 200, 400, 800, 1200, 1600, 100_000)
"""Limits of the altitude bins for pose errors, metres."""


def motion_errors(
    trajectories: list[Trajectory], motions: list[Motion], covariances: list[Array] | None = None
) -> pd.DataFrame:
    """Errors of motions, and of the positions dead-reckoned from the true first pose; one row per pair.

    Columns: scene_id, trajectory_id, step, altitude_m (nominal).
    Position: position_error_m (length), and its components error_x_m, error_y_m, error_z_m in O_C of the earlier frame.
    Orientation: orientation_error_deg (angle of the residual rotation), and its components error_x_deg, error_y_deg,
    error_z_deg (rotation vector, O_C of the later frame).
    Dead reckoning: drift_m (length), and its components drift_x_m, drift_y_m, drift_z_m in O_L.
    With `covariances` (n - 1, 6, 6) as in `EstimatedMotion`: normalised_error_squared, and stated_error_m, the root
    mean square length of the position error that the covariance predicts.
    """
    tables = []
    stated = covariances if covariances is not None else [None] * len(trajectories)
    for trajectory, (translation, rotation), covariance in zip(trajectories, motions, stated, strict=True):
        true_translation, true_rotation = trajectory.motion
        shift = translation - true_translation
        turn = np.degrees(rotation_vectors(rotation @ np.swapaxes(true_rotation, 1, 2)))
        path, _ = dead_reckoning(
            trajectory.position_m[0], trajectory.rotation_camera_from_site[0], translation, rotation
        )
        drift = (path - trajectory.position_m)[1:]
        columns = {
            "scene_id": trajectory.ids[0],
            "trajectory_id": trajectory.ids[1],
            "step": np.arange(trajectory.n_pairs),
            "altitude_m": trajectory.altitude_m,
            "position_error_m": np.linalg.norm(shift, axis=1),
            "orientation_error_deg": np.linalg.norm(turn, axis=1),
            "drift_m": np.linalg.norm(drift, axis=1),
        }
        for i, axis in enumerate("xyz"):
            columns |= {f"error_{axis}_m": shift[:, i], f"error_{axis}_deg": turn[:, i], f"drift_{axis}_m": drift[:, i]}
        if covariance is not None:
            columns["stated_error_m"] = np.sqrt(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2))
            columns["normalised_error_squared"] = normalised_errors(trajectory, (translation, rotation), covariance)
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def pose_errors(trajectories: list[Trajectory], poses: list[Pose]) -> pd.DataFrame:
    """Errors of the pose in O_L at the later frame of each pair; one row per pair.

    The columns are as in `motion_errors`, without drift. Components of the position error are in O_L, and altitude_m is
    the nominal altitude at the later frame.
    """
    tables = []
    for trajectory, (position_m, rotation) in zip(trajectories, poses, strict=True):
        true_position_m, true_rotation = trajectory.pose
        shift = position_m - true_position_m
        turn = np.degrees(rotation_vectors(rotation @ np.swapaxes(true_rotation, 1, 2)))
        columns = {
            "scene_id": trajectory.ids[0],
            "trajectory_id": trajectory.ids[1],
            "step": np.arange(trajectory.n_pairs),
            "altitude_m": trajectory.nominal_position_m[1:, 2],
            "position_error_m": np.linalg.norm(shift, axis=1),
            "orientation_error_deg": np.linalg.norm(turn, axis=1),
        }
        for i, axis in enumerate("xyz"):
            columns |= {f"error_{axis}_m": shift[:, i], f"error_{axis}_deg": turn[:, i]}
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def pose_summary(errors: pd.DataFrame) -> dict[str, float]:
    """`summary` for poses, with the medians of the lengths of both errors, and the position errors by altitude."""
    figures = summary(errors)
    figures["position_error_median_m"] = float(errors["position_error_m"].median())
    figures["orientation_error_median_deg"] = float(errors["orientation_error_deg"].median())
    for low, high in itertools.pairwise(_ALTITUDES_M):
        in_bin = errors[(errors["altitude_m"] >= low) & (errors["altitude_m"] < high)]
        if len(in_bin):
            figures[f"altitude_{low}_{high}_m/position_rmse_per_component_m"] = (
                _rms(in_bin["position_error_m"]) / 3**0.5
            )
    return figures


def normalised_errors(trajectory: Trajectory, motion: Motion, covariance: Array) -> Array:
    """Normalised squared errors (n - 1,) of rotation and shift together, by their covariances (n - 1, 6, 6).

    Their mean is 6 if the covariances are correct. Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
    Tracking and Navigation, 2001, section 5.4.
    """
    error = signed_errors(trajectory, motion)
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])


def signed_errors(trajectory: Trajectory, motion: Motion) -> Array:
    """Errors (n - 1, 6) in the order of the covariance of `EstimatedMotion`: turn, radians, then shift, metres."""
    (translation, rotation), (true_translation, true_rotation) = motion, trajectory.motion
    turn = rotation_vectors(true_rotation @ np.swapaxes(rotation, 1, 2))
    shift = np.einsum("nij,nj->ni", true_rotation, translation - true_translation)
    return np.concatenate([turn, shift], axis=1)


def summary(errors: pd.DataFrame) -> dict[str, float]:
    """Root mean squares over all pairs of all trajectories.

    Each RMSE has two forms (`squared_errors`) and is also given by axis. The drift (length) is given over all frames
    and at the last frames; poses have no drift. docs/reference/metrics.md has the formulas.
    """
    figures = {key: float(np.sqrt(np.mean(values))) for key, values in squared_errors(errors).items()}
    figures |= {f"position_rmse_{axis}_m": _rms(errors[f"error_{axis}_m"]) for axis in "xyz"}
    figures |= {f"orientation_rmse_{axis}_deg": _rms(errors[f"error_{axis}_deg"]) for axis in "xyz"}
    if "drift_m" in errors:
        figures["drift_rms_m"] = _rms(errors["drift_m"])
        figures["drift_final_m"] = _rms(errors.groupby(["scene_id", "trajectory_id"])["drift_m"].last())
    if "normalised_error_squared" in errors:
        figures["stated_position_rmse_vector_m"] = _rms(errors["stated_error_m"])
        figures["normalised_error_squared_mean"] = float(errors["normalised_error_squared"].mean())
    return figures


def squared_errors(errors: pd.DataFrame) -> dict[str, Array]:
    """Squared errors (pairs,), by key of the RMSE, which is the square root of their mean.

    per_component is the paper's RMSE: each of the three components of each pair is one value. vector and angle use the
    length of the error vector and are sqrt(3) times as large. The orientation components are the components of the
    residual rotation vector, which equal the differences of the paper's Euler angles to first order.
    """
    length_2 = np.square(np.asarray(errors["position_error_m"], np.float64))
    angle_2 = np.square(np.asarray(errors["orientation_error_deg"], np.float64))
    return {
        "position_rmse_per_component_m": length_2 / 3,
        "position_rmse_vector_m": length_2,
        "orientation_rmse_per_component_deg": angle_2 / 3,
        "orientation_rmse_angle_deg": angle_2,
    }


def summary_spreads(errors: pd.DataFrame, seed: int = 0) -> dict[str, Spread]:
    """Spread of each RMSE of `squared_errors` over test scenes, or over trajectories if there is only one scene."""
    scenes = errors["scene_id"].tolist()
    names = [f"{scene}/{name}" for scene, name in zip(scenes, errors["trajectory_id"], strict=True)]
    rows, squares = np.arange(len(errors)), squared_errors(errors)

    def statistics(drawn: Resamples) -> dict[str, Array]:
        count = drawn.totals(rows)
        return {key: np.sqrt(drawn.totals(rows, values) / count) for key, values in squares.items()}

    return spreads(statistics, rows, draw_resamples(scenes, names, names, np.random.default_rng(seed)))


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
