"""All pictures of an explain run, and their captions."""

from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.evidence.removal import CONTROLS, chosen_pixels, random_like, removed, shifted_like
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
from perilune_train.records.pictures import save_image

_DETECT = {
    "pcc1_craterness": "PCC1: mask and craters\n(above 0: stronger on craters)",
    "pcc1_partial": "PCC1 given brightness\nand gradient",
    "pcc2": "PCC2: masks of\ntwo frames",
}
_NAVIGATE = {
    "pcc3": "PCC3: the two halves\nof a mask",
    "pcc4": "PCC4: halves, lower one\nmoved by the true motion",
    "pcc4_minus_pcc3": "PCC4 - PCC3",
}
_SHARED = {
    "gates": "Harm of forcing masks to their means: single gates, stages with several gates, all gates, with 95 %"
    " intervals if there are five or more scenes. Dots: scenes.",
    "removal": "Harm of replacing a share of the pixels, chosen by the strongest gate, by edges and, for the detector,"
    " by a perfect mask of the labelled craters: most attended, two controls, least attended.",
    "before_after": "One image after inpainting: the most attended pixels, random pixels of equal brightness, the same"
    " shape elsewhere, the least attended pixels.",
    "masks": "Attention masks of all gates on one scale, at high, middle and low altitude of one descent.",
    "pcc": "Correlations of all gates, with 95 % intervals if there are five or more scenes. The gates of filled bars"
    " beat every null. Markers: nulls.",
    "randomisation": "Similarity of the masks to the trained masks after stages got random weights, from the top and"
    " from the bottom.",
    "stability": "Mean correlation of the masks before and after a change of the image: noise, shift or another lens.",
}
"""Captions: first what the network uses, then what its masks look like."""
_LOCALISATION = "ROC-AUC of maps on crater pixels (chance: 0.5). Blue: gates, grey: nulls, orange: attribution methods."
CAPTIONS = {f"{name}_{task}.png": text for task in ("detect", "navigate") for name, text in _SHARED.items()} | {
    "localisation_detect.png": _LOCALISATION
}
"""Caption of each picture by file name."""
PICTURES = {
    "detector": [name for name in CAPTIONS if "detect" in name],
    "navigator": [name for name in CAPTIONS if "navigate" in name],
}
"""Picture files of each network."""


Images = TypeVar("Images", LabelledFrames, Pairs)
_CELL_PX = 256
_CAPTION_PX = 20


@dataclass(frozen=True, slots=True)
class Masked(Generic[Images]):
    """Frames or pairs with the masks of all gates."""

    images: Images
    """N frames or pairs."""
    masks: Masks
    """Mask of each image by gate (N, height, width)."""


def draw_detector(
    folder: Path,
    settings: ExplainConfig,
    evidence: Evidence,
    frames: Masked[LabelledFrames],
    descent: Masked[LabelledFrames],
) -> None:
    """Draw all pictures of the detector into a folder.

    Masks are drawn for `n_drawn` frames of the descent, from the highest to the lowest. Removed pixels are drawn for
    the middle frame of `frames`.
    """
    images = descent.images
    drawn = evenly_spaced(len(images.images), settings.n_drawn)
    masks = {gate: values[drawn] for gate, values in descent.masks.items()}
    draw_masks(folder / "masks_detect.png", images.images[drawn], masks, [images.height_m[k] for k in drawn])
    draw_correlations(folder / "pcc_detect.png", evidence.summary, evidence.differences, evidence.tested, _DETECT)
    draw_localisation(folder / "localisation_detect.png", evidence.summary)
    _draw_interventions(folder, "detect", evidence, "decrease of the AP of a frame", higher_is_better=True)
    _draw_removed(folder / "before_after_detect.png", settings, evidence, frames)


def draw_navigator(
    folder: Path, settings: ExplainConfig, evidence: Evidence, pairs: Masked[Pairs], descent: Masked[Pairs]
) -> None:
    """Draw all pictures of the navigator into a folder.

    Masks are drawn for all pairs of `descent`, removed pixels for the middle pair of `pairs`.
    """
    draw_masks(folder / "masks_navigate.png", descent.images.images, descent.masks, descent.images.height_m)
    draw_correlations(folder / "pcc_navigate.png", evidence.summary, evidence.differences, evidence.tested, _NAVIGATE)
    _draw_interventions(folder, "navigate", evidence, "increase of the position error, m", higher_is_better=False)
    _draw_removed(folder / "before_after_navigate.png", settings, evidence, pairs)


def _draw_removed(path: Path, settings: ExplainConfig, evidence: Evidence, masked: Masked) -> None:
    """Draw the middle image before and after removal of the pixels that the strongest gate attends to."""
    gate, middle = evidence.strongest, len(masked.images.images) // 2
    image, mask = masked.images.images[middle], masked.masks[gate][middle]
    draw_removed(path, image, mask, evidence.signs[gate], settings.removed_share, settings.seed)


def _draw_interventions(folder: Path, task: str, evidence: Evidence, unit: str, *, higher_is_better: bool) -> None:
    draw_gates(folder / f"gates_{task}.png", evidence.gates, unit, higher_is_better)
    draw_removal(folder / f"removal_{task}.png", evidence.removal, unit, higher_is_better)
    draw_randomisation(folder / f"randomisation_{task}.png", evidence.randomisation)
    draw_stability(folder / f"stability_{task}.png", evidence.stability)


def draw_removed(
    path: Path, image: NDArray[np.uint8], map_: NDArray[np.floating], sign: int, share: float, seed: int
) -> None:
    """Draw, as one PNG row, an image (height, width), its map, and the image with inpainted pixels.

    Four choices of pixels are inpainted: the most attended, random, shifted and the least attended pixels.
    """
    rng = np.random.default_rng(seed)
    most, least = (chosen_pixels(map_, share, which, sign, rng) for which in ("most", "least"))
    choices = {
        "most attended": most,
        CONTROLS[0]: random_like(image, most, rng),
        CONTROLS[1]: shifted_like(most, rng),
        "least attended": least,
    }
    low, high = float(map_.min()), float(map_.max())
    level = (255 * (map_ - low) / max(high - low, 1e-9)).astype(np.uint8)
    cells = {"before": cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), "mask": cv2.applyColorMap(level, cv2.COLORMAP_CIVIDIS)}
    for name, chosen in choices.items():
        cells[name] = cv2.cvtColor(removed(image, chosen, "inpaint"), cv2.COLOR_GRAY2BGR)
    save_image(path, np.hstack([_captioned(np.asarray(cell, np.uint8), name) for name, cell in cells.items()]))


def _captioned(cell: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    size = _CELL_PX, round(_CELL_PX * cell.shape[0] / cell.shape[1])
    framed = cv2.copyMakeBorder(
        cv2.resize(cell, size), 2, _CAPTION_PX, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255)
    )
    where = 4, framed.shape[0] - 5
    cv2.putText(framed, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(framed, np.uint8)
