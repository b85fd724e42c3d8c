"""Compare maps from scores to probabilities on held-out validation scenes, by expected calibration error.

    python -m benchmarks.train.calibration DATASET [--run RUN] [--out FILE]

Each scene is left out in turn: a map is fitted on the other scenes, on frames as they are and varied, and applied to
the left-out scene. The table shows the errors of the detections of all left-out scenes together.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import answer
from perilune_shared.dataset.manifest import open_single
from perilune_shared.storage.files import write_text
from perilune_train.detect.calibration import fit_calibration, log_features, logistic_fit
from perilune_train.detect.data.frame_facts import facts_of
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.matching import FOUND, IGNORED, find_overlaps
from perilune_train.detect.evaluate.reliability import ScoredMatches, draw_reliability, expected_calibration_error
from perilune_train.detect.finished_run import config_of_run, raw_threshold
from perilune_train.detect.inference.detector import open_detector
from perilune_train.detect.train.threshold import detect_validation
from perilune_train.shipped.models import shipped_run
from perilune_train.training.runs import RunFolder

Array = NDArray[np.float64]
Fit = Callable[[Array, Array, NDArray[np.bool_]], Callable[[Array, Array], Array]]
"""Function of scores, radii and matches that returns a map of scores and radii."""


def _none(scores: Array, radius_px: Array, matched: NDArray[np.bool_]) -> Callable[[Array, Array], Array]:
    return lambda s, r: s


def _beta(scores: Array, radius_px: Array, matched: NDArray[np.bool_]) -> Callable[[Array, Array], Array]:
    calibration = fit_calibration(scores, matched)
    assert calibration is not None
    return lambda s, r: calibration.probabilities(s)


def _linear(columns: Callable[[Array, Array], Array]) -> Fit:
    def fit(scores: Array, radius_px: Array, matched: NDArray[np.bool_]) -> Callable[[Array, Array], Array]:
        coefficients = logistic_fit(columns(scores, radius_px), matched.astype(np.float64))
        return lambda s, r: 1 / (1 + np.exp(-(columns(s, r) @ coefficients)))

    return fit


def _platt_columns(scores: Array, radius_px: Array) -> Array:
    log, complement, one = log_features(scores).T
    return np.column_stack([log + complement, one])


def _beta_radius_columns(scores: Array, radius_px: Array) -> Array:
    log_radius = np.log(radius_px)
    return np.column_stack([log_features(scores), log_radius, log_radius**2])


def _isotonic(scores: Array, radius_px: Array, matched: NDArray[np.bool_]) -> Callable[[Array, Array], Array]:
    """Pool adjacent violators; linear between the centres of the pools."""
    order = np.argsort(scores, kind="stable")
    pools: list[list[float]] = []
    for score, hit in zip(scores[order], matched[order], strict=True):
        pools.append([float(hit), 1.0, float(score)])
        while len(pools) > 1 and pools[-2][0] / pools[-2][1] >= pools[-1][0] / pools[-1][1]:
            last = pools.pop()
            pools[-1] = [a + b for a, b in zip(pools[-1], last, strict=True)]
    hits, count, total = np.array(pools).T
    return lambda s, r: np.interp(s, total / count, hits / count)


MAPS: dict[str, Fit] = {
    "none": _none,
    "Platt, 2 parameters": _linear(_platt_columns),
    "beta, 3 parameters": _beta,
    "isotonic": _isotonic,
    "beta and radius, 5 parameters": _linear(_beta_radius_columns),
}


_DRAWN = ("none", "beta, 3 parameters")
"""Maps whose reliability diagrams are drawn."""


def main(
    dataset: Annotated[str, typer.Argument(help="Dataset with the validation frames of the run.")],
    run: Annotated[Path | None, typer.Option(help="Detect run. [default: the installed detector]")] = None,
    out: Annotated[Path, typer.Option(help="File to write.")] = Path("runs/bench/calibration.json"),
) -> None:
    """Print a table of expected calibration errors."""
    folder = run or shipped_run("detect")
    config = config_of_run(folder, ("detect.evaluation.varied_frames=true",))
    split = load_split(open_single(dataset), "val", config.labels)
    found = detect_validation(open_detector(RunFolder(folder).best, config), split)
    sizes = np.tile(found.size_px, (len(found.detections), 1))
    overlaps = find_overlaps(found.detections, found.labels, sizes)
    matches = overlaps.match(config.evaluation.match_iou, found.radius_px)
    radius = overlaps.radius_px()
    inside = (radius >= found.radius_px[0]) & (radius <= found.radius_px[1]) & ~overlaps.off_image
    kept = inside & (matches.outcome != IGNORED)
    scene = np.array(list(facts_of(split.frames).scene) * 2)[matches.frame][kept]
    varied, radius, scores = (matches.frame >= len(split))[kept], radius[kept], matches.scores[kept]
    matched = matches.outcome[kept] == FOUND
    result: dict[str, dict[str, float]] = {}
    for name, fit in MAPS.items():
        mapped = np.zeros(len(scores))
        for left_out in np.unique(scene):
            here = scene == left_out
            mapped[here] = fit(scores[~here], radius[~here], matched[~here])(scores[here], radius[here])
        if name in _DRAWN:
            draw_reliability(ScoredMatches(mapped, matched), out.with_name(f"reliability_{name.split(',')[0]}.png"))
        result[name] = _errors(mapped, matched, scores >= raw_threshold(folder), varied, radius, scene)
        answer(f"{name}: " + ", ".join(f"{key} {value:.4f}" for key, value in result[name].items()))
    write_text(out, json.dumps(result, indent=2) + "\n")


def _errors(
    mapped: Array,
    matched: NDArray[np.bool_],
    strong: NDArray[np.bool_],
    varied: NDArray[np.bool_],
    radius_px: Array,
    scene: NDArray,
) -> dict[str, float]:
    parts = {"all": np.ones(len(mapped), bool), "above threshold": strong, "plain": ~varied, "varied": varied}
    parts |= {
        "radius 2-5 px": radius_px < 5,
        "5-20 px": (radius_px >= 5) & (radius_px < 20),
        "20-50 px": radius_px >= 20,
    }
    errors = {
        name: expected_calibration_error(ScoredMatches(mapped[part], matched[part])) for name, part in parts.items()
    }
    errors["all, equal width"] = expected_calibration_error(ScoredMatches(mapped, matched), equal_width=True)
    of_scene = [
        expected_calibration_error(ScoredMatches(mapped[scene == one], matched[scene == one]))
        for one in np.unique(scene)
    ]
    limited = np.clip(mapped, 1e-6, 1 - 1e-6)
    likelihood = np.where(matched, np.log(limited), np.log1p(-limited))
    return errors | {"worst scene": max(of_scene), "log loss": -float(likelihood.mean()), "detections": len(mapped)}


if __name__ == "__main__":
    run_command_line(one_command(main))
