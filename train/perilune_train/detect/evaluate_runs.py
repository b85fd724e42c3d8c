"""Evaluate a finished run on a split of any dataset, and compare evaluations in a table and a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from perilune_shared.dataset.manifest import open_single
from perilune_shared.errors import UserError
from perilune_shared.export.foreign_text import for_markdown
from perilune_shared.storage.tables.limits import RUN_TABLE
from perilune_shared.storage.tables.read import read_table
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.detectability import (
    DETECTABILITY_FILE,
    by_detectability,
    read_d_prime,
    write_by_detectability,
)
from perilune_train.detect.evaluate.matching import EDGE
from perilune_train.detect.evaluate.metrics import Curve
from perilune_train.detect.evaluate.pictures import draw_curves
from perilune_train.detect.evaluate.report import CURVE_FILE, write_evaluation
from perilune_train.detect.evaluate.split_evaluation import (
    WRITTEN,
    dataset_entries,
    evaluate_split,
    novel_entries,
    report_head,
    score_meaning,
    selection_entries,
    write_detections,
)
from perilune_train.detect.finished_run import check_output, chosen_threshold
from perilune_train.detect.inference.detector import open_run
from perilune_train.detect.inference.scales import detect_split
from perilune_train.detect.train.threshold import threshold_on_validation
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics, write_metrics
from perilune_train.records.provenance import (
    EvaluatedSplit,
    Provenance,
    Status,
    TerrainCheck,
    check_terrain,
    protocol_of,
    read_provenance,
    split_terrain,
)
from perilune_train.records.spread import read_spread
from perilune_train.training import runs

_COLUMNS = {
    "ap50_paper": "AP",
    "edge/ap50_paper": "edge AP",
    "strict/ap50_paper": "strict AP",
    "ap50_95_paper": "AP 0.50:0.95",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
}
_LOWEST = {f"lowest_ap50_paper_by_{by}": f"lowest AP of the {by} bins" for by in ("radius", "altitude", "sun")}


def evaluate_again(
    run: Path,
    config: DetectConfig,
    evaluated: EvaluatedSplit,
    threshold: float | Literal["run", "validation"] = "run",
    out: Path | None = None,
    detectability: Path | None = None,
) -> Path:
    """Evaluate a run's best weights on a split of a dataset; returns the folder of the output.

    `threshold` is a score, "run" for the threshold that the run chose, or "validation" to choose a new threshold on the
    validation split of the dataset. Without `out`, the output folder is `evaluation` in the run's folder.
    `detectability` is a table of `perilune-render detectability`, with which recall and AP by d' are computed too.
    """
    folder = out or run / "evaluation"
    check_output(folder, run)
    choose_threshold, split = threshold == "validation", evaluated.split
    if isinstance(threshold, str):
        chosen, threshold_source = chosen_threshold(run), "of the run, chosen on its validation split"
    else:
        chosen, threshold_source = threshold, "given on the command line"
    known = read_metrics(run).get("dataset/name")
    dataset = open_single(evaluated.dataset)
    best = runs.RunFolder(run).best
    terrain = read_provenance(runs.load_weights(best), best)
    if choose_threshold:
        terrain = Provenance(split_terrain(dataset, "val", "calibrated")).joined([terrain])
    terrain_check = check_terrain(terrain, dataset, split, evaluated.allow_overlap)
    protocol = protocol_of(dataset.info)
    if known is not None and known != dataset.info.name:
        protocol = f"not the run's dataset ({known}); split by {dataset.info.split_by}"
    if split != "test":
        protocol += f"; {split} frames, used to {'train' if split == 'train' else 'select'} the network"
    detector = open_run(run, config)
    frames = load_split(dataset, split, config.labels, (1.0, 1 / EDGE))
    d_prime = None if detectability is None else read_d_prime(detectability, frames)
    if choose_threshold:
        val = load_split(dataset, "val", config.labels)
        seen, _ = detect_split(detector, val, "val")
        chosen, chosen_on = threshold_on_validation(detector, val, seen)
        threshold_source = f"{chosen_on} of the dataset"
    detections, rate = detect_split(detector, frames, split)
    evaluation = evaluate_split(frames, detections, config, chosen)
    write_detections(folder / "detections.parquet", frames, detections)
    about = report_head(dataset, split, config, protocol, run.resolve().name, threshold_source)
    about.append(score_meaning(detector.calibration))
    write_evaluation(folder, evaluation, list(frames.frames.images), about)
    metrics = (
        selection_entries(config, frames) | dataset_entries(dataset, split, config) | {"dataset/protocol": protocol}
    )
    metrics |= {f"{split}/{key}": value for key, value in evaluation.figures().items()}
    metrics |= novel_entries(detections, f"{split}/")
    metrics[f"{split}/images_per_s"] = round(rate, 2)
    if d_prime is not None:
        by_d_prime = by_detectability(frames, detections, d_prime, chosen, config.evaluation.match_iou)
        write_by_detectability(folder, by_d_prime, about)
        metrics |= {f"{split}/{key}": value for key, value in by_d_prime.figures().items()}
    mark_files(folder, WRITTEN if d_prime is None else (*WRITTEN, DETECTABILITY_FILE), terrain_check.mark)
    write_metrics(folder, metrics | terrain_check.metrics())
    return folder


def compare_folders(folders: Sequence[Path], out: Path, allow_overlap: bool = False) -> str:
    """Write compare.md and precision_recall.png into `out`; returns the table.

    Raises UserError if a folder has no metrics or no curve, or if a network was evaluated on its training terrain.
    `allow_overlap` accepts such a network, and marks table and picture.
    """
    rows, curves, marks = [], {}, []
    for folder in folders:
        metrics = read_metrics(folder)
        name = _name(folder)
        if any(key.rpartition("/")[2] == "ap50" for key in metrics):
            raise UserError(
                folder / METRICS_FILE,
                "ap50",
                "the interpolated AP of an earlier release",
                "ap50_paper: run `perilune-train detect evaluate` again",
            )
        if "images/name" in metrics:
            # An evaluation on real images has keys without a split.
            split, figures, selection = "images", metrics, f"from {metrics.get('min_size_px')} px"
            entries: list[object] = [metrics.get("images/name"), split, None, selection, metrics.get("scales")]
        else:
            split = str(metrics.get("evaluation/split", "test"))
            figures = {key.removeprefix(f"{split}/"): metrics[key] for key in metrics if key.startswith(f"{split}/")}
            entries = [metrics.get("dataset/name"), split, metrics.get("dataset/protocol")]
            entries += [metrics.get("labels/selection"), metrics.get("evaluation/scales", 1)]
        status, mark = _terrain(folder, metrics, allow_overlap)
        marks += [f"{name}: {mark}"] if mark else []
        entries.insert(3, status)
        cells = [for_markdown(name), *map(_text, (*entries, figures.get("frames"), figures.get("labels")))]
        cells += [_cell(figures, key) for key in _COLUMNS]
        rows.append(cells + [number(figures.get(key)) for key in _LOWEST])
        # Take AP from the metrics: the file has only some points of the curve, so their area differs from AP.
        label = f"{len(rows)} {name}, {split}: AP {number(figures.get('ap50_paper'))}"
        curves[label] = read_curve(folder / CURVE_FILE)
    head = ["run", "dataset", "split", "protocol", "terrain", "selection", "scales", "frames", "labels"]
    head += [*_COLUMNS.values(), *_LOWEST.values()]
    text = "\n".join(table(head, rows)) + "\n"
    write_markdown(
        out / "compare.md",
        "# Comparison of runs\n\n"
        "In brackets: 95 % intervals, or the value of each scene (trajectory, image) if there are fewer than five.\n\n"
        + text,
    )
    draw_curves(curves, out / "precision_recall.png")
    mark_files(out, ("compare.md", "precision_recall.png"), "; ".join(marks))
    return text


def _terrain(folder: Path, metrics: Metrics, allow_overlap: bool) -> tuple[str, str]:
    """Terrain status of an evaluation, and the mark for its output; "" if it needs no mark."""
    if "images/name" in metrics:
        return "real images", ""
    status, mark = metrics.get("terrain/status"), metrics.get("terrain/mark")
    if status == "overlap" and not allow_overlap:
        expected = "an evaluation on other terrain; --allow-overlap accepts it and marks all output"
        raise UserError(folder / METRICS_FILE, "terrain/mark", mark, expected)
    known = status in get_args(Status) and isinstance(mark, str)
    return (str(status), str(mark)) if known else ("unknown", TerrainCheck("unknown").mark)


def read_curve(path: Path) -> Curve:
    """Read the curve of an evaluation. Raises UserError if the table is missing or has other columns."""
    columns = read_table(path, RUN_TABLE, {"score": "number", "precision": "number", "recall": "number"})
    return Curve(*(columns.numbers(name) for name in ("score", "precision", "recall")))


def _name(folder: Path) -> str:
    """Name of a run, such as small; for an evaluation, the last two folders, such as small/evaluation."""
    parts = folder.resolve().parts
    return "/".join(parts[-2:]) if not (folder / "checkpoints").is_dir() else parts[-1]


def _text(value: object) -> str:
    return "-" if value is None else for_markdown(value)


def _cell(figures: dict, key: str) -> str:
    value = figures.get(key)
    return read_spread(figures, key).text(value) if isinstance(value, int | float) else number(value)
