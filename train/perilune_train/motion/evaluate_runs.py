"""Evaluate a navigation run, or alignment, on a split of any dataset; compare evaluations in a table and a picture."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from perilune_shared.console.terminal import progress_bar, say_page
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.export.foreign_text import for_markdown
from perilune_train.motion.covariance import stated_covariances
from perilune_train.motion.data.trajectories import Motion, Pose, Trajectory, load_split
from perilune_train.motion.metrics.baselines import ALIGNMENT, MethodMotions, alignment_ms_per_pair, baselines
from perilune_train.motion.metrics.floors import FLOORS, constant_pose
from perilune_train.motion.metrics.pictures import draw_errors
from perilune_train.motion.metrics.report import ERRORS_FILE, write_evaluation, write_pose_evaluation
from perilune_train.motion.network import Fusion, Scales, load_navigator, predict, predict_by_pairs, target_of
from perilune_train.motion.pose import predict_pose, predict_pose_by_pairs
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics
from perilune_train.records.provenance import (
    EvaluatedSplit,
    Provenance,
    check_terrain,
    protocol_of,
    read_provenance,
    split_terrain,
)
from perilune_train.records.spread import read_spread
from perilune_train.training.runs import RunFolder, load_weights

_COLUMNS = {
    "position_rmse_per_component_m": "position RMSE, per component (m)",
    "position_rmse_vector_m": "position RMSE, vector (m)",
    "orientation_rmse_per_component_deg": "orientation RMSE, per component (deg)",
    "orientation_rmse_angle_deg": "orientation RMSE, angle (deg)",
    "drift_final_m": "drift at the end (m)",
    "ms_per_single_pair": "ms per pair, one at a time",
}
_DRAWN = ["position_error_m", "orientation_error_deg", "error_x_m", "error_y_m", "error_z_m"]


def evaluate_navigator(run: Path, evaluated: EvaluatedSplit, out: Path) -> Path:
    """Evaluate a run's best weights, the classical methods and the nominal motion on a split; returns `out`.

    Raises UserError if `run` is not a navigation run, if `out` is the run's own folder, or if the network was trained
    on the test terrain (`evaluated.allow_overlap` permits this).
    """
    if out.resolve() == run.resolve():
        expected = "another folder; a run keeps the metrics of its training"
        raise UserError(out, "--out", "the run's own folder", expected)
    best = RunFolder(run).best
    content = load_weights(best)
    fusion = fusion_of(best, content["architecture"])
    dataset, split = open_single(evaluated.dataset), evaluated.split
    terrain_check = check_terrain(read_provenance(content, best), dataset, split, evaluated.allow_overlap)
    trajectories = load_split(dataset, split)
    network, architecture = load_navigator(best, fusion)
    if target_of(architecture) == "pose":
        _check_area(best, read_provenance(content, best), dataset, split)
        named: Metrics = {"dataset/name": dataset.info.name, "dataset/protocol": protocol_of(dataset.info)}
        _evaluate_pose(network, architecture, split, trajectories, out, named | terrain_check.metrics())
        return out
    motions_of_network, seconds = _timed(predict, network, architecture, trajectories)
    pairs = sum(trajectory.n_pairs for trajectory in trajectories)
    details = {
        f"{split}/pairs": pairs,
        f"{split}/ms_per_pair": round(1e3 * seconds / pairs, 2),
        f"{split}/ms_per_single_pair": round(1e3 * predict_by_pairs(network, architecture, trajectories[0])[1], 2),
        "network/parameters": sum(p.numel() for p in network.parameters()),
        "dataset/name": dataset.info.name,
        "dataset/protocol": protocol_of(dataset.info),
        **terrain_check.metrics(),
    }
    # Mean motions need the training set, which this dataset may not have.
    classical = baselines([], trajectories)
    motions, covariances = {fusion: motions_of_network, **classical.motions}, classical.covariances
    stated = stated_covariances(run, network, architecture, trajectories)
    if stated is not None:
        covariances = {fusion: stated, **covariances}
    write_evaluation(out, fusion, split, trajectories, MethodMotions(motions, covariances), details)
    return out


def evaluate_alignment(evaluated: EvaluatedSplit, out: Path) -> Path:
    """Evaluate direct alignment, and the other methods without training, on a split; returns `out`.

    Writes the same files as `evaluate_navigator`, with the method `alignment` in place of a network.
    """
    dataset, split = open_single(evaluated.dataset), evaluated.split
    trajectories = load_split(dataset, split)
    details: Metrics = {
        f"{split}/pairs": sum(trajectory.n_pairs for trajectory in trajectories),
        f"{split}/ms_per_single_pair": alignment_ms_per_pair(trajectories[0]),
        "dataset/name": dataset.info.name,
        "dataset/protocol": protocol_of(dataset.info),
        **check_terrain(Provenance(), dataset, split).metrics(),
    }
    write_evaluation(out, ALIGNMENT, split, trajectories, baselines([], trajectories), details)
    return out


def _check_area(path: Path, known: Provenance, dataset: Dataset, split: str) -> None:
    """Raise UserError unless a split is over the landing area that a pose network was trained on."""
    trained = {use.sha256 for use in known.uses if use.use == "trained"}
    if trained and not {use.sha256 for use in split_terrain(dataset, split, "tested")} <= trained:
        expected = f"the landing area that {path} was trained on; it estimates poses only there"
        raise UserError(dataset.store, "terrain", "other terrain", expected)


def _evaluate_pose(
    network: Any, architecture: dict[str, Any], split: str, trajectories: list[Trajectory], out: Path, details: Metrics
) -> None:
    """Evaluate a pose network and the mean pose of its training frames, the only baseline that a checkpoint stores."""
    scales = Scales(**architecture["scales"])
    poses, seconds = _timed(predict_pose, network, architecture, trajectories)
    mean = np.array(scales.mean_m), np.array(scales.mean_rotation)
    pairs = sum(trajectory.n_pairs for trajectory in trajectories)
    _, by_pairs = predict_pose_by_pairs(network, architecture, trajectories[0])
    measured: Metrics = {
        f"{split}/pairs": pairs,
        f"{split}/ms_per_pair": round(1e3 * seconds / pairs, 2),
        f"{split}/ms_per_single_pair": round(1e3 * by_pairs, 2),
        "network/parameters": sum(p.numel() for p in network.parameters()),
    }
    methods = {"stack": poses, "mean_pose": [constant_pose(*mean, trajectory.n_pairs) for trajectory in trajectories]}
    page = write_pose_evaluation(out, "stack", split, trajectories, methods, measured | details)
    say_page(page)


def learned_motions(run: Path, trajectories: list[Trajectory]) -> MethodMotions:
    """Motions that a run's best weights estimate, and their covariances if the run has calibrated them."""
    best = RunFolder(run).best
    fusion = fusion_of(best, load_weights(best)["architecture"])
    network, architecture = load_navigator(best, fusion)
    motions, _ = _timed(predict, network, architecture, trajectories)
    stated = stated_covariances(run, network, architecture, trajectories)
    return MethodMotions({fusion: motions}, {} if stated is None else {fusion: stated})


def network_ms_per_pair(run: Path, trajectory: Trajectory) -> float:
    """Time that a run's network takes for one pair of frames of a trajectory, milliseconds."""
    best = RunFolder(run).best
    network, architecture = load_navigator(best, fusion_of(best, load_weights(best)["architecture"]))
    return round(1e3 * predict_by_pairs(network, architecture, trajectory)[1], 2)


def fusion_of(path: Path, architecture: dict[str, Any]) -> Fusion:
    """The kind of navigator in a checkpoint. Raises UserError if the checkpoint contains no navigator."""
    fusion = architecture.get("fusion")
    if fusion not in ("warp", "stack"):
        raise UserError(path, "architecture", sorted(map(str, architecture)), "a navigate run's checkpoint")
    return fusion


def _timed(
    predicted: Callable[[Any, dict[str, Any], Trajectory], Motion | Pose],
    network: Any,
    architecture: dict[str, Any],
    trajectories: list[Trajectory],
) -> tuple[list[Motion | Pose], float]:
    """Motions or poses of all trajectories, and the time that this took, seconds."""
    started = time.monotonic()
    with progress_bar() as progress:
        task = progress.add_task("evaluate", total=len(trajectories), unit="trajectories", note="")
        predictions = []
        for trajectory in trajectories:
            predictions.append(predicted(network, architecture, trajectory))
            progress.advance(task)
    return predictions, time.monotonic() - started


def compare_folders(folders: Sequence[Path], out: Path, allow_overlap: bool = False) -> str:
    """Write compare.md and errors.png into `out`; returns the table.

    Each evaluation gets one row for its network. For each dataset and split, the methods without training get rows from
    the first evaluation. Raises UserError if a folder is not an evaluation of navigation, or if a network was trained
    on the terrain of its evaluation. `allow_overlap` accepts these networks and marks table and picture.
    """
    rows, errors, marks, listed = [], {}, [], set()
    for folder in folders:
        metrics = read_metrics(folder)
        method, split = metrics.get("evaluation/method"), metrics.get("evaluation/split")
        if not isinstance(method, str) or not isinstance(split, str):
            expected = "a method, as `perilune-train navigate train` and `evaluate` record it"
            raise UserError(folder / METRICS_FILE, "evaluation/method", method, expected)
        name, mark = _name(folder), metrics.get("terrain/mark")
        if metrics.get("terrain/status") == "overlap" and not allow_overlap:
            expected = "an evaluation on other terrain; --allow-overlap accepts it and marks all output"
            raise UserError(folder / METRICS_FILE, "terrain/mark", mark, expected)
        marks += [f"{name}: {mark}"] if mark else []
        where = [_text(metrics.get(key)) for key in ("dataset/name", "evaluation/split", "dataset/protocol")]
        where += [_text(metrics.get(f"{split}/pairs")), _text(metrics.get("terrain/status"))]
        target = metrics.get("evaluation/target", "motion")
        label = method if target == "motion" else f"{method}, {target}"
        rows.append([for_markdown(f"{name} ({label})"), *where, *_cells(metrics, split)])
        run_errors = _read_errors(folder / ERRORS_FILE)
        errors[name] = run_errors[run_errors["method"] == method]
        for other in ("klt", ALIGNMENT, "nominal", "mean_at_step", "mean", *FLOORS):
            if (target, *where[:-1]) not in listed and f"baseline/{other}/position_rmse_vector_m" in metrics:
                rows.append([other, *where[:-1], "-", *_cells(metrics, f"baseline/{other}")])
        listed.add((target, *where[:-1]))
    head = ["run (network) or method", "dataset", "split", "protocol", "pairs", "terrain", *_COLUMNS.values()]
    text = "\n".join(table(head, rows)) + "\n"
    note = "In brackets: 95 % intervals, or the value of each scene (trajectory, image) if there are fewer than five."
    write_markdown(out / "compare.md", f"# Comparison of navigation runs\n\n{note}\n\n{text}")
    draw_errors(out / "errors.png", errors)
    mark_files(out, ("compare.md", "errors.png"), "; ".join(marks))
    return text


def _cells(metrics: Metrics, prefix: str) -> list[str]:
    cells = []
    for key in _COLUMNS:
        value = metrics.get(f"{prefix}/{key}")
        known = float(value) if isinstance(value, int | float) else None
        cells.append(number(None) if known is None else read_spread(metrics, f"{prefix}/{key}").text(known))
    return cells


def _read_errors(path: Path) -> pd.DataFrame:
    """Read the table of pairs. Raises UserError if the file is missing or lacks columns."""
    if not path.is_file():
        raise UserError(
            path, "errors", "no such file", "a file that `perilune-train navigate train` or `evaluate` wrote"
        )
    try:
        return pd.read_parquet(path, columns=["method", *_DRAWN])
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise UserError(path, "errors", error, f"columns method, {', '.join(_DRAWN)}") from None


def _name(folder: Path) -> str:
    """Name of a run, or run/evaluation for an evaluation of it."""
    parts = folder.resolve().parts
    return parts[-1] if (folder / "checkpoints").is_dir() else "/".join(parts[-2:])


def _text(value: object) -> str:
    return "-" if value is None else for_markdown(value)
