"""The report's sections on navigation: trajectory, errors by altitude and step, comparison of all methods."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError, one_line
from perilune_train.landing.monte_carlo.page import by_trajectory, run_summary
from perilune_train.motion.metrics.floors import FLOORS
from perilune_train.records.markdown import number
from perilune_train.records.spread import read_spread
from perilune_train.report.content import Figure, Provenance, Section, Table
from perilune_train.report.pictures import COLOURS, DASHES, drawing, label_axes, logarithmic, picture_of, plain, svg_of
from perilune_train.report.sources import Run, sources_of

_ERRORS = (
    "scene_id", "trajectory_id", "step", "altitude_m", "position_error_m", "orientation_error_deg", "drift_m",
    "drift_x_m", "drift_y_m", "drift_z_m", "method",
)  # fmt: skip
_DRAWN = ("warp", "stack", "klt", "alignment", "nominal")
"""Methods that the figures show in addition to the methods of the runs. The table has all methods."""
_POSE = {
    "position_rmse_vector_m": "position RMSE, vector (m)",
    "position_rmse_per_component_m": "per component (m)",
    "position_error_median_m": "median (m)",
    "orientation_rmse_angle_deg": "orientation RMSE (deg)",
}
_BINS = 8
_PERCENTILES = (5, 50, 95)
_SCORED = ("position_rmse_vector_m", "position_rmse_m")
_SCORED_ANGLES = ("orientation_rmse_angle_deg", "attitude_rmse_deg")
_METHOD_PICTURES = {
    "altitude.png": "Position errors over ground by altitude: median, and 5 to 95 %.",
    "flights.png": "Errors of the filter along each descent, within three standard deviations.",
    "matches_high.png": "First frame: matched detections (cyan), unmatched detections (red), and catalogue craters at"
    " the estimated pose (yellow).",
    "matches_low.png": "Last frame, in the colours of the picture of the first frame.",
}
LANDING_TABLE = "draws.parquet"
_LANDING_ROWS = ("scene_id", "trajectory_id", "draw", "time_s", "status", "error_m", "turn_deg", "squared")
_LANDING_COLUMNS = {
    "position_rmse_m": "position RMSE (m)",
    "position_end_rmse_m": "at the end (m)",
    "attitude_rmse_deg": "attitude RMSE (deg)",
    "in_band_share": "share in the 95 % band",
}
_LANDING_PICTURES = {
    "errors.png": "Position errors over all draws: 50, 95 and 100 % quantiles, and the median of three stated sigmas.",
    "consistency.png": "Mean normalised error squared over the draws of a descent, 6 if the covariance is correct, and"
    " normalised innovation squared per part, by altitude.",
}
_METHOD_COLUMNS = {
    "kind": "kind",
    "n_frames": "frames",
    "position_rmse_m": "position RMSE (m)",
    "attitude_rmse_deg": "attitude RMSE (deg)",
    "position_end_rmse_m": "at the end (m)",
    "in_band_share": "share in the 95 % band",
    "seconds_per_frame": "seconds per frame",
}


def navigation_section(runs: Sequence[Run], dataset: Dataset | None) -> Section:
    """The section on navigation runs. `dataset` has the true positions; with None, no trajectory is drawn."""
    of_poses = [run for run in runs if run.metrics.get("evaluation/target") == "pose"]
    leads = (*(headline(run) for run in runs), *_starts(runs))
    tables, pictures = (_poses(of_poses),) if of_poses else (), [_pose_picture(run) for run in of_poses]
    runs = [run for run in runs if run not in of_poses]
    if not runs:
        return Section("navigation", "Navigation", leads, tables, tuple(pictures))
    errors = {run.name: _read(run.folder / "errors.parquet", _ERRORS) for run in runs}
    joined = pd.concat([table.assign(run=name) for name, table in errors.items()], ignore_index=True)
    # Each run also evaluates the methods without a network. Their results are equal in all runs, so keep one copy.
    joined = joined.drop_duplicates(["method", "scene_id", "trajectory_id", "step"])
    run_methods = {run.metrics.get("evaluation/method") for run in runs}
    drawn = [name for name in joined["method"].unique() if name in _DRAWN or name in run_methods]
    sources = sources_of(runs)
    figures = [] if dataset is None else _trajectory(joined, drawn, dataset, sources)
    figures += [*_bands(joined, drawn, sources), _drift(joined, drawn, sources)]
    return Section(
        "navigation",
        "Navigation",
        leads,
        (_table(runs), *tables),
        (*figures, *pictures),
    )


def headline(run: Run) -> str:
    """One sentence with the errors of a network and the smallest error of a method without training."""
    position, angle = (
        _spread(run, f"test/{key}") for key in ("position_rmse_vector_m", "orientation_rmse_angle_deg")
    )  # fmt: skip
    method = run.metrics.get("evaluation/method", run.name)
    if run.metrics.get("evaluation/target") == "pose":
        loses = run.metrics.get("evaluation/worse_than")
        text = (
            f"The navigator {run.name} ({method}) has an r.m.s. error of {position} m and {angle} degrees in its poses"
        )
        return f"{text}, worse than {loses}." if loses else f"{text}."
    text = f"The navigator {run.name} ({method}) has an r.m.s. error of {position} m and {angle} degrees in a step"
    others = {
        key.split("/")[1]: float(value)
        for key, value in run.metrics.items()
        if re.fullmatch("baseline/[^/]+/position_rmse_vector_m", key) and isinstance(value, int | float)
    }
    if not others:
        return f"{text}."
    best = min(others, key=lambda name: others[name])
    return f"{text}; the best method without training, {best}, has {others[best]:.3f} m."


def methods_section(folder: Path, sources: tuple[Provenance, ...]) -> Section:
    """The section that compares all methods on the same descents. `folder` has the output of `make navigate`."""
    rows = _read(folder / "navigation.parquet", None)
    columns = {key: title for key, title in _METHOD_COLUMNS.items() if key in rows and rows[key].notna().any()}
    cells = tuple((str(row["method"]), *(_cell(row[key]) for key in columns)) for row in rows.to_dict("records"))
    table = Table("All methods", ("method", *columns.values()), cells, sources)
    figures = [_compared(rows, sources)]
    for name, caption in _METHOD_PICTURES.items():
        if (folder / name).is_file():
            wide = name != "matches_high.png" and name != "matches_low.png"
            figures.append(Figure(picture_of(folder / name, caption), caption, sources, wide=wide))
    absolute = rows[rows["kind"] == "absolute"].sort_values("position_rmse_m")
    lead: tuple[str, ...] = ()
    if len(absolute):
        best = absolute.iloc[0]
        lead = (f"Lowest position error over ground: {best['method']}, {number(best['position_rmse_m'])} m RMSE.",)
    return Section("methods", "Methods of navigation", lead, (table,), tuple(figures))


def _starts(runs: Sequence[Run]) -> list[str]:
    """One line for each run that did not start from random weights."""
    starts = {run.name: str(run.metrics.get("network/backbone", "from scratch")) for run in runs}
    # An absolute path of the training machine says nothing to readers. Keep the last folders, which name the run.
    shortened = {name: re.sub(r"(?<=\s)/\S*/(?=(?:[^/\s]+/){3}[^/\s]+$)", "", start) for name, start in starts.items()}
    return [f"{name} started {start}." for name, start in shortened.items() if not start.startswith("from scratch")]


def landing_section(folder: Path, sources: tuple[Provenance, ...]) -> Section:
    """The section on the filter over the test descents. `folder` has the output of `navigate monte-carlo`."""
    rows, columns = read_landing(folder), _LANDING_COLUMNS
    cells = tuple(("/".join(ids), *(number(row[key]) for key in columns)) for ids, row in by_trajectory(rows).items())
    table = Table("Descents, with all draws of each", ("descent", *columns.values()), cells, sources)
    figures = [
        Figure(picture_of(folder / name, caption), caption, sources, wide=True)
        for name, caption in _LANDING_PICTURES.items()
        if (folder / name).is_file()
    ]
    lead = (
        landing_headline(rows),
        "The filter uses the installed detector, a catalogue of the craters with errors, a tactical inertial unit and "
        "an altimeter. Draws differ in the errors of the start, of the catalogue and of the inertial unit.",
    )
    return Section("landing", "Landing with the filter", lead, (table,), tuple(figures))


def landing_headline(rows: pd.DataFrame) -> str:
    """One sentence with the filter's position errors, from the table of draws."""
    summary = run_summary(rows)
    over, end = number(summary["position_rmse_m"]), number(summary["position_end_rmse_m"])
    return (
        f"The filter with the installed detector has an r.m.s. position error of {over} m over the test descents, "
        f"and of {end} m at their end."
    )


def read_landing(folder: Path) -> pd.DataFrame:
    """Read the table of draws. Raises UserError if it is damaged."""
    return _read(folder / LANDING_TABLE, _LANDING_ROWS)


def scores_section(scores: Sequence[Run]) -> Section:
    """The section on scores of navigation on the locked benchmark: networks, classical methods and the filter."""
    rows, figures = [], []
    for score in scores:
        for key in score.metrics:
            method, _, name = key.partition("/")
            if name in _SCORED:
                angles = (f"{method}/{name}" for name in _SCORED_ANGLES)
                angle = next((key for key in angles if key in score.metrics), "")
                rows.append((method, score.name, _spread(score, key), _spread(score, angle)))
        for path in sorted(score.folder.glob("*.png")):
            caption = f"{score.name}: {path.stem.replace('_', ' ')}."
            figures.append(Figure(picture_of(path, caption), caption, (score.provenance,), wide=True))
    head = ("method", "score", "position RMSE (m)", "attitude RMSE (deg)")
    table = Table("Scores on the locked benchmark", head, tuple(rows), sources_of(scores))
    lead = ("In brackets: 95 % intervals over scenes.",)
    return Section("benchmark-navigation", "Navigation on the locked benchmark", lead, (table,), tuple(figures))


def _table(runs: Sequence[Run]) -> Table:
    rows = []
    for run in runs:
        prefixes = [("test", str(run.metrics.get("evaluation/method", run.name)))]
        baselines = dict.fromkeys(key.split("/")[1] for key in run.metrics if key.startswith("baseline/"))
        prefixes += [(f"baseline/{name}", name) for name in baselines] if run is runs[-1] else []
        for prefix, name in prefixes:
            keys = (
                "position_rmse_vector_m", "position_rmse_per_component_m", "orientation_rmse_angle_deg", "drift_final_m"
            )  # fmt: skip
            rows.append((name, *(_spread(run, f"{prefix}/{key}") for key in keys)))
    head = (
        "method",
        "position RMSE, vector (m)",
        "per component (m)",
        "orientation RMSE (deg)",
        "drift at the end (m)",
    )
    return Table("Motion between consecutive frames", head, tuple(rows), sources_of(runs))


def _poses(runs: Sequence[Run]) -> Table:
    """Table of the pose errors in the landing frame, for each run and its baselines (`FLOORS`)."""
    rows = []
    for run in runs:
        loses = run.metrics.get("evaluation/worse_than")
        prefixes = {"test": f"{run.name}, worse than {loses}" if loses else run.name}
        known = [name for name in FLOORS if f"baseline/{name}/position_rmse_vector_m" in run.metrics]
        prefixes |= {f"baseline/{name}": FLOORS[name] for name in known}
        rows += [(name, *(_spread(run, f"{prefix}/{key}") for key in _POSE)) for prefix, name in prefixes.items()]
    return Table("Pose in the landing frame", ("method", *_POSE.values()), tuple(rows), sources_of(runs))


def _pose_picture(run: Run) -> Figure:
    caption = f"{run.name}: errors of the position in the landing frame, by component, and their distribution."
    return Figure(picture_of(run.folder / "errors.png", caption), caption, sources_of([run]), wide=True)


def _trajectory(
    errors: pd.DataFrame, methods: Sequence[str], dataset: Dataset, sources: tuple[Provenance, ...]
) -> list[Figure]:
    """Figures of the first test descent from the side and from above: true, and dead reckoned by each method."""
    scene, trajectory = errors["scene_id"].iloc[0], errors["trajectory_id"].iloc[0]
    columns = ["frame_index", "position_m"]
    rows = dataset.table("frames", columns, scene_id=scene, trajectory_id=trajectory).to_pandas()
    of_descent = errors[(errors["scene_id"] == scene) & (errors["trajectory_id"] == trajectory)]
    true = np.array(rows.sort_values("frame_index")["position_m"].tolist(), np.float64).reshape(-1, 3)
    paths = {}
    for method in methods:
        steps = of_descent[of_descent["method"] == method].sort_values("step")
        if len(steps) == len(true) - 1:
            drift = steps[["drift_x_m", "drift_y_m", "drift_z_m"]].to_numpy()
            paths[method] = np.concatenate([true[:1], true[1:] + drift])
    if not paths:
        return []
    figures = []
    for title, view, x, y in (
        ("From the side", _along(true[0]), "distance over ground from the start (m)", "altitude (m)"),
        ("From above", lambda path: (-path[:, 0], -path[:, 1]), "east (m)", "north (m)"),
    ):
        with drawing(height_in=4.2) as figure:
            axes = figure.subplots()
            axes.plot(*view(true), color="#888888", linewidth=4, label="true")
            for place, (method, path) in enumerate(paths.items()):
                axes.plot(*view(path), color=COLOURS[place % 6], linestyle=DASHES[place % 6], label=plain(method))
            label_axes(axes, title, x, y)
            if title == "From above":
                axes.set_aspect("equal", "datalim")
            figure.legend(loc="outside lower center", ncols=3)
            html = svg_of(figure, f"{title}: true trajectory and trajectories dead reckoned by each method")
        caption = f"{title}: test descent {scene}/{trajectory}, true and dead reckoned from the true first pose."
        figures.append(Figure(html, caption, sources))
    return figures


def _along(start: np.ndarray):
    return lambda path: (np.linalg.norm(path[:, :2] - start[:2], axis=1), path[:, 2])


def _bands(errors: pd.DataFrame, methods: Sequence[str], sources: tuple[Provenance, ...]) -> list[Figure]:
    """Figures of the error of a step by altitude: the median, and a band from the 5 % to the 95 % quantile."""
    edges = np.linspace(errors["altitude_m"].min(), errors["altitude_m"].max() * 1.0001, _BINS + 1)
    figures = []
    for what, column, unit in (("position", "position_error_m", "m"), ("orientation", "orientation_error_deg", "deg")):
        with drawing(height_in=3.8) as figure:
            axes = figure.subplots()
            for place, method in enumerate(methods):
                of_method = errors[errors["method"] == method]
                in_bin = np.digitize(of_method["altitude_m"], edges) - 1
                used = [k for k in range(_BINS) if (in_bin == k).any()]
                low, middle, high = np.array(
                    [np.percentile(of_method[column].to_numpy()[in_bin == k], _PERCENTILES) for k in used]
                ).T
                x = (edges[used] + edges[np.array(used) + 1]) / 2
                axes.fill_between(x, low, high, color=COLOURS[place % 6], alpha=0.15, linewidth=0)
                axes.plot(x, middle, color=COLOURS[place % 6], linestyle=DASHES[place % 6], label=plain(method))
            logarithmic(axes, "y")
            axes.invert_xaxis()
            label_axes(axes, f"Error of {what} of a step", "altitude (m)", f"error ({unit})")
            figure.legend(loc="outside lower center", ncols=3)
            html = svg_of(figure, f"Error of {what} of a step by altitude, with bands from 5 to 95 percent")
        caption = f"Error of {what} of a step by altitude, over all test pairs: median, and 5 to 95 % quantiles."
        figures.append(Figure(html, caption, sources))
    return figures


def _drift(errors: pd.DataFrame, methods: Sequence[str], sources: tuple[Provenance, ...]) -> Figure:
    """Figure of the error of the dead-reckoned position by step: median and range over all test descents."""
    with drawing(height_in=3.6) as figure:
        axes = figure.subplots()
        for place, method in enumerate(methods):
            of_step = errors[errors["method"] == method].groupby("step")["drift_m"]
            steps = of_step.median().index.to_numpy() + 1
            axes.fill_between(steps, of_step.min(), of_step.max(), color=COLOURS[place % 6], alpha=0.15, linewidth=0)
            axes.plot(
                steps, of_step.median(), color=COLOURS[place % 6], linestyle=DASHES[place % 6], label=plain(method)
            )
        logarithmic(axes, "y")
        label_axes(axes, "Dead-reckoned position", "step", "error (m)")
        figure.legend(loc="outside lower center", ncols=3)
        html = svg_of(figure, "Error of the dead-reckoned position by step")
    count = errors.groupby(["scene_id", "trajectory_id"]).ngroups
    caption = f"Error of the dead-reckoned position: median, and smallest to largest error, over {count} test "
    caption += "descent." if count == 1 else "descents."
    return Figure(html, caption, sources)


def _compared(rows: pd.DataFrame, sources: tuple[Provenance, ...]) -> Figure:
    """Figure of the position RMSE of all methods, as dots on a logarithmic axis."""
    known = rows[rows["position_rmse_m"].notna()].sort_values(["kind", "position_rmse_m"], ascending=[False, False])
    with drawing(height_in=0.28 * len(known) + 1.4) as figure:
        axes = figure.subplots()
        for place, row in enumerate(known.to_dict("records")):
            relative = row["kind"] == "relative"
            axes.plot(
                row["position_rmse_m"], place, "s" if relative else "o", color=COLOURS[0 if relative else 1],
                markersize=8,
            )  # fmt: skip
        axes.set_yticks(range(len(known)), [plain(name) for name in known["method"]])
        logarithmic(axes, "x")
        label_axes(axes, "Position error of all methods", "position RMSE (m)", "")
        html = svg_of(figure, "Position error of all methods of navigation")
    caption = "Position RMSE of all methods. Squares: of the motion in a step. Circles: of the position over ground."
    return Figure(html, caption, sources)


def _read(path: Path, columns: Sequence[str] | None) -> pd.DataFrame:
    try:
        return pd.read_parquet(path, columns=None if columns is None else list(columns))
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise UserError(path, "table", error, "the table of a finished run") from None


def _spread(run: Run, key: str) -> str:
    value = run.metrics.get(key)
    if not isinstance(value, int | float):
        return "-"
    spread = read_spread(run.metrics, key)
    # Without an interval, the spread lists the value of every trajectory, which would fill the table.
    return f"{value:.3f}" if spread.interval is None else spread.text(float(value), one_line)


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, Mapping) or not isinstance(value, int | float):
        return "-"
    return f"{value:.0f}" if float(value).is_integer() else number(value)
