"""Score detections on all parts of the benchmark, by label selection, scoring rule, bin and region."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_train.detect.config import LabelSettings
from perilune_train.detect.data.frame_facts import facts_of, joined_facts
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.evaluate.bootstrap import average_precisions
from perilune_train.detect.evaluate.evaluation import Evaluation, evaluate_detections
from perilune_train.detect.evaluate.matching import EDGE, Criteria, Detections, Matches
from perilune_train.detect.evaluate.metrics import at_threshold, curve
from perilune_train.records.benchmark_parts import Part
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.spread import Spread, spreads

SELECTIONS = ("visible", "paper")
"""Selections of labels (shared/labels/thresholds.py)."""
SCORING_RULES = {"usual": "", "edge": "edge/", "strict": "strict/"}
"""Rules that decide which detections are false positives (matching.py), and their prefix in the figures."""
MATCH_IOU = 0.5
SEED = 1
"""Random seed of the intervals."""


@dataclass(frozen=True)
class Region:
    """Figures of one region for one selection of labels.

    They follow the usual scoring rule unless the field states another rule.
    """

    name: str
    """See `Part.region`."""
    scenes: int
    """Number of scenes."""
    labels: int
    """Number of selected labels."""
    ap50_paper: float
    """AP as defined in the paper."""
    spread: Spread
    """Spread of ap50_paper over the scenes."""
    edge_ap50_paper: float
    """AP by the edge scoring rule."""
    f1: float
    """F1 at the threshold."""


@dataclass(frozen=True)
class Score:
    """All figures of a set of detections."""

    evaluations: dict[str, Evaluation]
    """Evaluation of all frames without the region `APART`, by selection of labels."""
    regions: dict[str, list[Region]]
    """Figures of each region, `APART` included, by selection of labels."""
    images: list[NDArray[np.uint8]]
    """The frames of `evaluations` (height, width), for pictures."""
    frames_of: dict[str, tuple[int, int]]
    """Number of frames scored and number of frames of the locked manifest, by part."""

    def least(self, metric: str) -> tuple[str, str, float]:
        """Lowest `metric` (ap50_paper or f1) over all selections and scoring rules: selection, rule, value."""
        values = {
            (selection, rule): float(evaluation.figures()[f"{prefix}{metric}"] or 0.0)
            for selection, evaluation in self.evaluations.items()
            for rule, prefix in SCORING_RULES.items()
        }
        selection, rule = min(values, key=lambda key: values[key])
        return selection, rule, values[selection, rule]

    def figures(self) -> Metrics:
        """Entries of benchmark.json.

        The keys are headline/..., <selection>/<key of an evaluation>, <selection>/region/<name>/..., frames/<part> and
        locked_frames/<part>.
        """
        figures: Metrics = {}
        for metric in ("ap50_paper", "f1"):
            selection, rule, value = self.least(metric)
            figures |= {f"headline/{metric}": value, f"headline/{metric}_account": f"{selection}, {rule}"}
        for selection, evaluation in self.evaluations.items():
            figures |= {f"{selection}/{key}": value for key, value in evaluation.figures().items()}
            for region in self.regions[selection]:
                prefix = f"{selection}/region/{region.name.replace(' ', '_')}"
                for name in ("scenes", "labels", "ap50_paper", "edge_ap50_paper", "f1"):
                    figures[f"{prefix}/{name}"] = getattr(region, name)
                figures |= region.spread.keys(f"{prefix}/ap50_paper")
        for part, (n_frames, n_locked) in self.frames_of.items():
            figures |= {f"frames/{part}": n_frames, f"locked_frames/{part}": n_locked}
        return figures


def load_parts(parts: Sequence[Part]) -> dict[str, dict[str, DetectSplit]]:
    """Frames and labels of each part, by selection of labels.

    Raises UserError if the parts have different ranges of radii.
    """
    settings = {selection: LabelSettings(selection=selection) for selection in SELECTIONS}
    loaded = {
        selection: {part.name: load_split(part.dataset, "test", labels, (1.0, 1 / EDGE)) for part in parts}
        for selection, labels in settings.items()
    }
    ranges = {split.radius_px for split in loaded["paper"].values()}
    if len(ranges) > 1:
        raise UserError(parts[0].dataset.store, "labels", sorted(ranges), "the same range of radii in all parts")
    return loaded


def score(
    parts: Sequence[Part],
    loaded: Mapping[str, Mapping[str, DetectSplit]],
    detections_by_part: Mapping[str, list[Detections]],
    threshold: float,
) -> Score:
    """Score detections on all parts; the overall figures exclude the region `APART`.

    `detections_by_part` has a list for each part of the benchmark, with one entry per frame. `loaded` is the result of
    `load_parts`. `threshold` is the minimum score of the detections that count in precision, recall and F1.
    """
    evaluations, regions = {}, {}
    splits = loaded[SELECTIONS[0]]
    counted, apart = ([part for part in parts if part.is_apart == is_apart] for is_apart in (False, True))
    of_frame = [part.region for part in counted for _ in range(len(splits[part.name]))]

    def evaluated(chosen: Sequence[Part], by_part: Mapping[str, DetectSplit]) -> Evaluation:
        labels: list[FrameLabels] = [each for part in chosen for each in by_part[part.name].labels]
        detections = [each for part in chosen for each in detections_by_part[part.name]]
        facts = joined_facts({part.name: facts_of(splits[part.name].frames) for part in chosen})
        radius_px = next(iter(by_part.values())).radius_px
        return evaluate_detections(detections, labels, facts, Criteria(threshold, radius_px, MATCH_IOU), SEED)

    for selection, by_part in loaded.items():
        evaluation = evaluated(counted, by_part)
        evaluations[selection] = evaluation
        regions[selection] = [_region(evaluation, name, of_frame) for name in dict.fromkeys(of_frame)]
        for part in apart:
            of_part = evaluated([part], by_part)
            regions[selection].append(_region(of_part, part.region, [part.region] * len(splits[part.name])))
    images = [image for part in counted for image in splits[part.name].frames.images]
    return Score(evaluations, regions, images, {part.name: (len(splits[part.name]), part.n_locked) for part in parts})


def _region(evaluation: Evaluation, name: str, of_frame: list[str]) -> Region:
    chosen = np.array([each == name for each in of_frame])

    def in_region(matches: Matches) -> Matches:
        return matches.of_frames(chosen)

    matches = in_region(evaluation.matches)
    spread = spreads(
        lambda drawn: {"ap50_paper": average_precisions(matches, drawn)}, matches.selected_frame, evaluation.resamples
    )
    return Region(
        name,
        len({scene for scene, inside in zip(evaluation.facts.scene, chosen, strict=True) if inside}),
        len(matches.selected_frame),
        curve(matches).ap_paper(),
        spread["ap50_paper"],
        curve(in_region(evaluation.at_edge)).ap_paper(),
        at_threshold(matches, evaluation.threshold)[2],
    )
