"""All pictures of an explain run, and their captions."""

from pathlib import Path

from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.explain.inputs import LabelledFrames, Pairs, evenly_spaced
from perilune_train.explain.maps.drawing import draw_masks
from perilune_train.explain.maps.masks import Masks
from perilune_train.explain.page.bars import (
    draw_correlations,
    draw_gates,
    draw_localisation,
    draw_randomisation,
    draw_removal,
    draw_stability,
)
from perilune_train.explain.page.pairs import draw_removed

_DETECT = {
    "pcc1_craterness": "PCC1: mask and craters\n(above 0: stronger on craters)",
    "pcc1_partial": "the same, given\nbrightness and gradient",
    "pcc2": "PCC2: masks of\ntwo frames",
}
_NAVIGATE = {
    "pcc3": "PCC3: halves",
    "pcc4": "PCC4: halves, lower one\nmoved by the true motion",
    "pcc4_minus_pcc3": "PCC4 - PCC3",
}
_SHARED = {
    "masks": "Attention masks of all gates on one scale, at high, middle and low altitude of one descent.",
    "pcc": "Correlations of all gates, with 95 % intervals over scenes where there are five or more. Filled bars beat"
    " every null; markers are nulls.",
    "gates": "Harm of forcing masks to their means: single gates, stages, all gates. Dots: scenes.",
    "removal": "Harm of replacing a share of the pixels: most attended, two controls, least attended.",
    "randomisation": "Similarity of masks to the trained ones when stages get random weights, from the top and from the"
    " bottom.",
    "stability": "Mean correlation of the masks with those of the same image with noise, shifted, or through another"
    " lens.",
    "before_after": "The same image with the most attended pixels, random ones of the same brightness, the same shape"
    " elsewhere, and the least attended pixels inpainted.",
}
_LOCALISATION = (
    "ROC-AUC of maps on crater pixels (chance: 0.5). Blue: gates, grey: image maps, orange: attribution methods."
)
CAPTIONS = {f"{name}_{task}.png": text for task in ("detect", "navigate") for name, text in _SHARED.items()} | {
    "localisation_detect.png": _LOCALISATION
}
"""Caption of each picture by file name."""
PICTURES = {
    "detector": [name for name in CAPTIONS if "detect" in name],
    "navigator": [name for name in CAPTIONS if "navigate" in name],
}
"""Picture files of each network."""


def draw_detector(
    folder: Path,
    settings: ExplainConfig,
    frames: LabelledFrames,
    masks: Masks,
    found: Evidence,
    descent: LabelledFrames,
    along: Masks,
) -> None:
    """Draw all pictures of the detector into a folder.

    `along` are the masks of the frames of one descent, of which `n_drawn` are drawn, from the highest to the lowest.
    """
    drawn = evenly_spaced(len(descent.images), settings.n_drawn)
    shown = {name: one[drawn] for name, one in along.items()}
    draw_masks(folder / "masks_detect.png", descent.images[drawn], shown, [descent.height_m[k] for k in drawn])
    draw_correlations(folder / "pcc_detect.png", found.summary, found.differences, found.tested, _DETECT)
    draw_localisation(folder / "localisation_detect.png", found.summary)
    _draw_interventions(folder, "detect", found, "decrease of the AP of a frame", higher_is_better=True)
    middle = len(frames.images) // 2
    draw_removed(
        folder / "before_after_detect.png",
        frames.images[middle],
        masks[found.strongest][middle],
        found.signs[found.strongest],
        settings.removed_share,
        settings.seed,
    )


def draw_navigator(
    folder: Path, settings: ExplainConfig, pairs: Pairs, masks: Masks, found: Evidence, descent: Pairs, along: Masks
) -> None:
    """Draw all pictures of the navigator into a folder; `along` are the masks of the drawn pairs of one descent."""
    draw_masks(folder / "masks_navigate.png", descent.images, along, descent.height_m)
    draw_correlations(folder / "pcc_navigate.png", found.summary, found.differences, found.tested, _NAVIGATE)
    _draw_interventions(folder, "navigate", found, "increase of the position error, m", higher_is_better=False)
    middle = len(pairs.images) // 2
    draw_removed(
        folder / "before_after_navigate.png",
        pairs.images[middle],
        masks[found.strongest][middle],
        found.signs[found.strongest],
        settings.removed_share,
        settings.seed,
    )


def _draw_interventions(folder: Path, task: str, found: Evidence, unit: str, *, higher_is_better: bool) -> None:
    draw_gates(folder / f"gates_{task}.png", found.gates, unit, higher_is_better)
    draw_removal(folder / f"removal_{task}.png", found.removal, unit, higher_is_better)
    draw_randomisation(folder / f"randomisation_{task}.png", found.randomisation)
    draw_stability(folder / f"stability_{task}.png", found.stability)
