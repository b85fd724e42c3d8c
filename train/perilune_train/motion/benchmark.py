"""Score a network or alignment on the locked benchmark, by region, altitude and Sun elevation."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.export.foreign_text import code_span
from perilune_shared.storage.store import Address
from perilune_train.motion.data.trajectories import Trajectory, load_split
from perilune_train.motion.evaluate_runs import fusion_of, learned_motions, network_ms_per_pair
from perilune_train.motion.metrics.baselines import ALIGNMENT, MethodMotions, alignment_ms_per_pair, baselines
from perilune_train.motion.metrics.errors import motion_errors, summary, summary_spreads
from perilune_train.motion.metrics.report import write_evaluation
from perilune_train.motion.network import check_motion
from perilune_train.records.benchmark_parts import Part, open_parts, part_names
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.records.provenance import Provenance, TerrainCheck, check_terrain, read_provenance
from perilune_train.training.runs import RunFolder, load_weights

PAGE, FIGURES = "benchmark.md", "benchmark.json"
HEADLINE = "position_rmse_vector_m"
"""The headline figure: RMSE of the lengths of the position error vectors. It is larger than the RMSE per component."""
_COLUMNS = {
    HEADLINE: "position RMSE, vector (m)",
    "position_rmse_per_component_m": "position RMSE, per component (m)",
    "orientation_rmse_angle_deg": "orientation RMSE, angle (deg)",
    "drift_final_m": "dead-reckoned position error at the last frame (m)",
    "stated_position_rmse_vector_m": "position RMSE, vector, as the method's covariance predicts (m)",
    "normalised_error_squared_mean": "mean squared normalised error (6 if the covariance is correct)",
}
_OF_BINS = tuple(_COLUMNS)[:3]
"""Figures that are also computed by region, altitude and Sun elevation."""
_ALTITUDES_M = (200, 500, 1000, 1600)
_SUNS_DEG = (0, 15, 30, 45, 60, 90)


def score_navigator(
    run: Path | None, data: Address, manifests: Address, out: Path, allow_overlap: bool = False
) -> Metrics:
    """Score a run's best weights, the classical methods and the nominal motion; return the figures.

    Without a run, the headline figure is the error of alignment. Writes the page, figures, tables and pictures. Raises
    UserError if the benchmark is missing or was changed, or if the network was trained on terrain of the benchmark.
    `allow_overlap` accepts this network and marks all output.
    """
    parts = open_parts("nav", data, manifests)
    checks = _checked(run, parts, allow_overlap)
    trajectories, regions, suns = _load(parts)
    learned = MethodMotions({}, {}) if run is None else learned_motions(run, trajectories)
    headline = next(iter(learned.motions), ALIGNMENT)
    classical = baselines([], trajectories)
    one = trajectories[0]
    ms = alignment_ms_per_pair(one) if run is None else network_ms_per_pair(run, one)
    motions, covariances = learned.motions | classical.motions, learned.covariances | classical.covariances
    errors = {
        method: motion_errors(trajectories, estimated, covariances.get(method)) for method, estimated in motions.items()
    }
    mark = "; ".join(dict.fromkeys(check.mark for check in checks if check.mark))
    counts = {part.name: (part.dataset.info.counts.frames, part.n_locked) for part in parts}
    details: Metrics = {"test/ms_per_single_pair": ms, "terrain/mark": mark, "dataset/name": "locked benchmark"}
    write_evaluation(out, headline, "test", trajectories, MethodMotions(motions, covariances), details)
    figures = _figures(errors, regions, suns) | {"headline/method": headline, f"headline/{HEADLINE}": None}
    figures[f"headline/{HEADLINE}"] = figures[f"{headline}/{HEADLINE}"]
    for name, (n_frames, n_locked) in counts.items():
        figures |= {f"frames/{name}": n_frames, f"locked_frames/{name}": n_locked}
    scored = ALIGNMENT if run is None else f"run {run.resolve().name}"
    write_markdown(out / PAGE, _page(run, headline, errors, figures, ms, counts))
    mark_files(out, [PAGE], mark)
    write_metrics(out, figures | details | {"scored": scored}, FIGURES)
    return figures


def _checked(run: Path | None, parts: list[Part], allow_overlap: bool) -> list[TerrainCheck]:
    """The terrain check of each part. Raises UserError if the run has no navigator of motions, or overlaps a part."""
    provenance = Provenance()
    if run is not None:
        best = RunFolder(run).best
        content = load_weights(best)
        fusion_of(best, content["architecture"])
        check_motion(best, content["architecture"])
        provenance = read_provenance(content, best)
    return [check_terrain(provenance, part.dataset, "test", allow_overlap) for part in parts]


def _load(parts: list[Part]) -> tuple[list[Trajectory], dict[str, str], dict[str, float]]:
    """Trajectories of all parts, and region and Sun elevation (degrees) of each scene, by name <part>/<scene_id>."""
    trajectories, regions, suns = [], {}, {}
    for part in parts:
        for row in part.dataset.table("scenes", ["scene_id", "sun_elevation_deg"]).to_pylist():
            scene = f"{part.name}/{row['scene_id']}"
            regions[scene], suns[scene] = part.region, float(row["sun_elevation_deg"])
        for trajectory in load_split(part.dataset, "test"):
            trajectories.append(replace(trajectory, ids=(f"{part.name}/{trajectory.ids[0]}", trajectory.ids[1])))
    return trajectories, regions, suns


def _figures(errors: dict[str, pd.DataFrame], regions: dict[str, str], suns: dict[str, float]) -> Metrics:
    """Figures of each method, over all scenes and by region, altitude and Sun elevation, with flat keys.

    Keys: <method>/<figure>, <method>/region/<name>/<figure>, <method>/altitude_m/<bin>/<figure>,
    <method>/sun_deg/<bin>/<figure>.
    """
    figures: Metrics = {}
    for method, pairs in errors.items():
        figures |= {f"{method}/{key}": value for key, value in summary(pairs).items()}
        for key, spread in summary_spreads(pairs).items():
            figures |= spread.keys(f"{method}/{key}")
        for kind, names in (
            ("region", pairs["scene_id"].map(regions)),
            ("altitude_m", _bins(pairs["altitude_m"], _ALTITUDES_M)),
            ("sun_deg", _bins(pairs["scene_id"].map(suns), _SUNS_DEG)),
        ):
            for name, rows in pairs.groupby(names):
                figures_of_group = summary(rows)
                figures |= {f"{method}/{kind}/{name}/{key}": figures_of_group[key] for key in _OF_BINS}
                figures[f"{method}/{kind}/{name}/scenes"] = int(rows["scene_id"].nunique())
    return figures


def _bins(values: pd.Series, edges: tuple[int, ...]) -> pd.Series:
    names = [f"{low}-{high}" for low, high in itertools.pairwise(edges)]
    return pd.Series(np.array(names)[np.clip(np.digitize(values, edges) - 1, 0, len(names) - 1)], index=values.index)


def _page(
    run: Path | None,
    headline: str,
    errors: dict[str, pd.DataFrame],
    figures: Metrics,
    ms: float,
    counts: dict[str, tuple[int, int]],
) -> str:
    spreads = {method: summary_spreads(table_of_method) for method, table_of_method in errors.items()}
    value = spreads[headline][HEADLINE].text(float(figures[f"{headline}/{HEADLINE}"] or np.nan))
    scored = "direct alignment" if run is None else f"run {code_span(run.resolve().name)}"
    network = "" if run is None else f"`{headline}`: this network. "
    lines = ["# Locked benchmark of navigation", ""]
    lines += [
        f"**Position RMSE of a step: {value} m** (length of the error vector), {scored}.",
        "",
        "A step is the motion between two consecutive frames.",
        "",
    ]
    for name in part_names("nav"):
        n_frames, n_locked = counts.get(name, (0, 0))
        whole = "all frames" if n_frames == n_locked else f"**a part: {n_frames} of {n_locked} frames**"
        lines.append(f"- `{name}`: {whole} of the shared manifest" if n_frames else f"- `{name}`: **not scored**")
    lines += [
        f"- time for one pair of frames: {ms:g} ms",
        "",
        "## Methods",
        "",
        f"{network}`klt`: tracked corners. `alignment`: direct alignment of both frames. "
        "`_gyroscope`: with the rotation that a gyroscope measured. `nominal`: the nominal motion, without images.",
        "",
    ]
    rows = []
    for method in errors:
        cells = [
            spreads[method][key].text(float(figures[f"{method}/{key}"] or np.nan))
            if key in spreads[method]
            else number(figures.get(f"{method}/{key}"))
            for key in _COLUMNS
        ]
        rows.append([method, *cells])
    lines += [*table(["method", *_COLUMNS.values()], rows), ""]
    lines += ["In brackets: 95 % intervals over scenes, or the value of each scene if there are fewer than five.", ""]
    for kind, title in (("region", "region"), ("altitude_m", "altitude (m)"), ("sun_deg", "Sun elevation (deg)")):
        start = f"{headline}/{kind}/"
        names = [
            key[len(start) : -len("/scenes")] for key in figures if key.startswith(start) and key.endswith("/scenes")
        ]
        lines += [f"## Position RMSE (m) by {title}", ""]
        by_name = [
            [name, *[number(figures.get(f"{method}/{kind}/{name}/{HEADLINE}")) for method in errors]] for name in names
        ]
        lines += [*table([title, *errors], by_name), ""]
    return "\n".join(lines)
