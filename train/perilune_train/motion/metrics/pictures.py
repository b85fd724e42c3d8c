"""Draw the pictures of a navigation run."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from perilune_train.motion.data.trajectories import Motion, Trajectory
from perilune_train.motion.geometry import dead_reckoning
from perilune_train.records.pictures import save_figure

COLOURS = {
    "warp": "tab:red",
    "stack": "tab:purple",
    "klt": "tab:green",
    "klt_gyroscope": "tab:olive",
    "alignment": "tab:blue",
    "alignment_gyroscope": "tab:cyan",
    "nominal": "tab:gray",
    "mean_at_step": "tab:orange",
    "mean": "tab:brown",
    "mean_pose": "tab:brown",
    "mean_pose_at_frame": "tab:orange",
    "ridge": "tab:green",
}


def draw_trajectory(
    path: Path, trajectory: Trajectory, motions: dict[str, Motion], errors: dict[str, pd.DataFrame]
) -> None:
    """Draw one trajectory: true and dead-reckoned paths from the side and from above, and the errors by step."""
    figure = Figure(figsize=(16, 9), layout="constrained")
    axes = figure.subplots(2, 3)
    side, top, drift = axes[0]
    true = trajectory.position_m
    side.plot(_along(true), true[:, 2], color="black", linewidth=3, label="true")
    top.plot(true[:, 0], true[:, 1], color="black", linewidth=3, label="true")
    drift.axhline(0, color="black", linewidth=1)
    steps = np.arange(1, len(true))
    for method, (translation, rotation) in motions.items():
        estimated, _ = dead_reckoning(true[0], trajectory.rotation_camera_from_site[0], translation, rotation)
        style = {"color": COLOURS[method], "label": method}
        side.plot(_along(estimated), estimated[:, 2], **style)
        top.plot(estimated[:, 0], estimated[:, 1], **style)
        drift.plot(steps, np.linalg.norm(estimated - true, axis=1)[1:], **style)
        rows = errors[method].query("scene_id == @trajectory.ids[0] and trajectory_id == @trajectory.ids[1]")
        axes[1, 0].plot(rows["altitude_m"], rows["position_error_m"], **style)
        axes[1, 1].plot(rows["altitude_m"], rows["orientation_error_deg"], **style)
    _label(side, "path from the side", "distance from the site (m)", "altitude (m)")
    _label(top, "path from above", "x, west (m)", "y, south (m)")
    top.axis("equal")
    _label(drift, "dead-reckoned position", "step", "error (m)")
    _label(axes[1, 0], "position error of each step", "altitude (m)", "error (m)")
    _label(axes[1, 1], "orientation error of each step", "altitude (m)", "error (deg)")
    for axis in axes[1, :2]:
        axis.invert_xaxis()
    frame, image = axes[1, 2], trajectory.images[0]
    frame.imshow(image, cmap="gray", vmin=0, vmax=max(1, np.percentile(image, 99.5)))
    frame.set_title(f"frame 0 of {'/'.join(trajectory.ids)}, {true[0, 2]:.0f} m")
    frame.axis("off")
    side.legend()
    save_figure(path, figure)


def draw_pose_errors(path: Path, errors: dict[str, pd.DataFrame], network: str) -> None:
    """Draw the position errors in O_L along the test trajectories, by component, and their distribution.

    Thick lines are root mean squares over the trajectories at each step. Thin lines are single trajectories of
    `network`.
    """
    figure = Figure(figsize=(16, 9), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    for axis, name in zip(axes, "xyz", strict=False):
        column = f"error_{name}_m"
        for _, single in errors[network].groupby(["scene_id", "trajectory_id"]):
            axis.plot(single["step"], single[column].abs(), color=COLOURS[network], linewidth=0.5, alpha=0.5)
        for method, table in errors.items():
            of_step = np.sqrt(table.assign(squared=table[column] ** 2).groupby("step")["squared"].mean())
            axis.plot(of_step.index, of_step, color=COLOURS[method], label=method)
        axis.set_yscale("log")
        _label(axis, f"position error along {name} of O_L", "step", "error (m)")
    for method, table in errors.items():
        values = np.sort(table["position_error_m"])
        axes[3].plot(values, np.arange(1, len(values) + 1) / len(values), color=COLOURS[method], label=method)
    axes[3].set_xscale("log")
    _label(axes[3], "position error", "length of the error vector (m)", "fraction of pairs below")
    axes[3].legend()
    save_figure(path, figure)


def draw_errors(path: Path, errors: dict[str, pd.DataFrame]) -> None:
    """Draw, for each method, the cumulative distribution of the errors of test pairs, and the errors by axis."""
    figure = Figure(figsize=(16, 5), layout="constrained")
    axes = figure.subplots(1, 3)
    for method, table in errors.items():
        for axis, column in ((axes[0], "position_error_m"), (axes[1], "orientation_error_deg")):
            values = np.sort(table[column])
            axis.plot(values, np.arange(1, len(values) + 1) / len(values), color=COLOURS.get(method), label=method)
    _label(axes[0], "position error of a step", "length of the error vector (m)", "fraction of pairs below")
    _label(axes[1], "orientation error of a step", "residual rotation angle (deg)", "fraction of pairs below")
    bar_position, width = np.arange(3), 0.8 / len(errors)
    for i, (method, table) in enumerate(errors.items()):
        heights = [float(np.sqrt(np.mean(table[f"error_{axis}_m"] ** 2))) for axis in "xyz"]
        axes[2].bar(bar_position + i * width, heights, width, color=COLOURS.get(method), label=method)
    axes[2].set_xticks(bar_position + 0.4 - width / 2, ["x", "y", "z (view)"])
    _label(axes[2], "position RMSE of each component, by axis of O_C", "", "RMSE (m)")
    axes[0].legend()
    save_figure(path, figure)


def _along(position_m: np.ndarray) -> np.ndarray:
    return np.hypot(position_m[:, 0], position_m[:, 1])


def _label(axis: Axes, title: str, x: str, y: str) -> None:
    axis.set(title=title, xlabel=x, ylabel=y)
    axis.grid(alpha=0.3)
