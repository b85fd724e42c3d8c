"""Score a run, or a table of detections, on the locked benchmark; write a page, figures and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from perilune_shared.export.foreign_text import code_span
from perilune_shared.storage.store import Address
from perilune_train.detect.benchmark.page import page_of
from perilune_train.detect.benchmark.score import Score, load_parts, score
from perilune_train.detect.benchmark.submission import read_submission
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.evaluate.report import write_evaluation
from perilune_train.detect.evaluate.split_evaluation import novel_entries, score_meaning
from perilune_train.detect.finished_run import chosen_threshold
from perilune_train.records.benchmark_parts import Part, open_parts
from perilune_train.records.markdown import write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.records.provenance import TerrainCheck, check_terrain, read_provenance

PAGE, FIGURES = "benchmark.md", "benchmark.json"
_PICTURES = (
    "report.md",
    "precision_recall.png",
    "precision_recall.parquet",
    "reliability.png",
    "bins.png",
    "detections.png",
)


def score_run(
    run: Path, config: DetectConfig, data: Address, manifests: Address, out: Path, allow_overlap: bool = False
) -> Score:
    """Score the best weights of a run at the run's own threshold.

    Raises UserError if the benchmark is missing or changed, or if the network was trained on the benchmark's terrain
    (`allow_overlap` permits this).
    """
    # torch takes seconds to load, and a table of detections does not need it.
    from perilune_train.detect.inference.detector import open_run
    from perilune_train.detect.inference.scales import detect_split
    from perilune_train.training import runs

    parts, threshold = open_parts("detect", data, manifests), chosen_threshold(run)
    best = runs.RunFolder(run).best
    provenance = read_provenance(runs.load_weights(best), best)
    checks = [check_terrain(provenance, part.dataset, "test", allow_overlap) for part in parts]
    detector, loaded = open_run(run, config), load_parts(parts)
    detections, rates = {}, {}
    for name, split in next(iter(loaded.values())).items():
        detections[name], rates[name] = detect_split(detector, split, name)
    scales = " and ".join(f"{factor:g}" for factor in config.evaluation.scales)
    about = [f"run {code_span(run.resolve().name)}, best weights, frames evaluated at scale {scales}"]
    about.append(f"threshold {threshold:.4f}, chosen on the validation split of the run's own dataset")
    about.append(score_meaning(detector.calibration))
    more: Metrics = {"scored": f"run {run.resolve().name}", "scales": scales}
    more |= {f"images_per_s/{name}": round(rate, 2) for name, rate in rates.items()}
    more |= novel_entries([each for part in detections.values() for each in part], "")
    for name, of_part in detections.items():
        more |= {f"{key}/{name}": value for key, value in novel_entries(of_part, "").items()}
    return _write(out, parts, loaded, _Entry(detections, threshold, about, more, checks))


def score_submission(
    detections: Path, name: str, threshold: float, data: Address, manifests: Address, out: Path
) -> Score:
    """Score a table of detections (submission.py) at a threshold.

    Raises UserError if the benchmark is missing or changed, or the table is not valid.
    """
    parts = open_parts("detect", data, manifests)
    loaded = load_parts(parts)
    ids = {name: split.frames.table["frame_id"].tolist() for name, split in next(iter(loaded.values())).items()}
    submitted = read_submission(detections, ids)
    about = [f"detections of {code_span(name)}; training data and settings as stated by the authors"]
    about.append(
        f"threshold {threshold:g}, given with the detections; it must not have been chosen on benchmark frames"
    )
    return _write(out, parts, loaded, _Entry(submitted, threshold, about, {"scored": f"detections of {name}"}, []))


@dataclass(frozen=True, slots=True)
class _Entry:
    """Detections to score, and their description."""

    detections: dict[str, list[Detections]]
    """Detections of each frame, by part of the benchmark."""
    threshold: float
    """Minimum score of the detections that count in precision, recall and F1."""
    about: list[str]
    """Lines of Markdown: what was scored and how."""
    extra_metrics: Metrics
    """Further entries of benchmark.json."""
    checks: Sequence[TerrainCheck]
    """Checks of the training terrain against the terrain of each part; empty if the training terrain is unknown."""


def _write(out: Path, parts: Sequence[Part], loaded: dict[str, dict[str, DetectSplit]], entry: _Entry) -> Score:
    """Score detections, write all files and return the score."""
    about, threshold = entry.about, entry.threshold
    result = score(parts, loaded, entry.detections, threshold)
    mark = "; ".join(dict.fromkeys(check.mark for check in entry.checks if check.mark))
    for selection, evaluation in result.evaluations.items():
        write_evaluation(out / selection, evaluation, result.images, [*about, f"labels: selection `{selection}`"])
        mark_files(out / selection, _PICTURES, mark)
    write_markdown(out / PAGE, page_of(result, about))
    mark_files(out, [PAGE], mark)
    write_metrics(out, result.figures() | entry.extra_metrics | {"threshold": threshold, "terrain/mark": mark}, FIGURES)
    return result
