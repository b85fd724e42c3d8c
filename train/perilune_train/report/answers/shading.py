"""Which ground decides a detection: occlusion of single patches, and the detection's score in changed frames."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.evaluate.boxes import iou_matrix
from perilune_train.detect.evaluate.matching import Detections

Array = NDArray[np.float64]
Detect = Callable[[NDArray[np.uint8]], list[Detections]]
"""Function that returns the detections of each of N frames (N, height, width)."""
N_PATCHES = 5
"""Number of patches along each side of the square that is covered patch by patch."""
_PATCH_RADII, _MIN_PATCH_PX = 0.8, 2
"""Side of a patch in radii of the detection, and its smallest side, pixels. The square extends to 2 radii."""
_MIN_IOU = 0.5
MIN_DECREASE = 0.05
"""Largest decrease of the score by one patch from which on the text names this patch."""
_SIDE_COSINE = 0.5
"""Cosine of the largest angle, 60 degrees, between a patch and the Sun at which the patch is on the Sun's side."""


@dataclass(frozen=True, slots=True)
class Patches:
    """A square of N_PATCHES x N_PATCHES square patches around a detection."""

    x0_px: int
    """Left edge, pixels; may be outside the image."""
    y0_px: int
    """Upper edge, pixels; may be outside the image."""
    side_px: int
    """Side of a patch, pixels."""

    @classmethod
    def around(cls, box: Array) -> "Patches":
        """The patches around a box x0, y0, x1, y1, pixels. The middle of the box is in the middle patch."""
        radius_px = float(np.sqrt(np.prod(box[2:] - box[:2]))) / 2
        side_px = max(_MIN_PATCH_PX, round(_PATCH_RADII * radius_px))
        x0_px, y0_px = np.round((box[:2] + box[2:]) / 2 - N_PATCHES * side_px / 2).astype(int).tolist()
        return cls(x0_px, y0_px, side_px)

    def slices(self, row: int, column: int, margin_px: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
        """Slices (y, x) of a patch, enlarged by a margin and cut at the edges of an image (height, width)."""
        edges = []
        for origin_px, number, length in ((self.y0_px, row, shape[0]), (self.x0_px, column, shape[1])):
            low = origin_px + number * self.side_px - margin_px
            high = low + self.side_px + 2 * margin_px
            edges.append(slice(min(max(low, 0), length), max(min(high, length), 0)))
        return edges[0], edges[1]


@dataclass(frozen=True, slots=True)
class Occlusion:
    """Effect of each patch on the score of a detection."""

    patches: Patches
    """Place of the patches."""
    score: float
    """Score in the unchanged frame."""
    decrease: Array
    """Decrease of the score if one patch is covered (N_PATCHES, N_PATCHES); 0 for patches outside the image."""
    grey: Array
    """Mean grey value of each patch (N_PATCHES, N_PATCHES); NaN outside the image."""


def score_at(detections: Detections, box: Array) -> float:
    """Highest score of the detections whose IoU with a box is at least 0.5, to 3 digits as in marks; 0 without one."""
    overlap = iou_matrix(detections.boxes.reshape(-1, 4), box[None])[:, 0]
    return round(float(detections.scores[overlap >= _MIN_IOU].max(initial=0.0)), 3)


def covered(image: NDArray[np.uint8], patches: Patches, row: int, column: int) -> NDArray[np.uint8]:
    """The image (height, width) with one patch replaced by the mean of the eight patches around it."""
    inner = patches.slices(row, column, 0, image.shape)
    outer = patches.slices(row, column, patches.side_px, image.shape)
    around = image[outer].astype(np.float64)
    n_around = around.size - image[inner].size
    changed = image.copy()
    if n_around:
        changed[inner] = np.round((around.sum() - image[inner].sum(dtype=np.float64)) / n_around)
    return changed


def occlude(detect: Detect, image: NDArray[np.uint8], box: Array) -> Occlusion:
    """Cover the patches around a detection one by one, and measure the score of the detection each time.

    Occlusion is due to Zeiler & Fergus 2014, doi 10.1007/978-3-319-10590-1_53. `image` is (height, width).
    """
    patches = Patches.around(box)
    grey, decrease = np.full((N_PATCHES, N_PATCHES), np.nan), np.zeros((N_PATCHES, N_PATCHES))
    inside = []
    for row, column in np.ndindex(N_PATCHES, N_PATCHES):
        pixels = image[patches.slices(row, column, 0, image.shape)]
        if pixels.size:
            grey[row, column] = pixels.mean()
            inside.append((row, column))
    frames = np.stack([image, *(covered(image, patches, *place) for place in inside)])
    scores = [score_at(found, box) for found in detect(frames)]
    for place, score in zip(inside, scores[1:], strict=True):
        decrease[place] = scores[0] - score
    return Occlusion(patches, scores[0], decrease, grey)


def sentences_of(occlusion: Occlusion, sun_px: Array) -> list[str]:
    """What the occlusion shows, in sentences. `sun_px` (2,) is the direction of the Sun in the image, x and y."""
    best = np.unravel_index(int(occlusion.decrease.argmax()), occlusion.decrease.shape)
    largest = float(occlusion.decrease[best])
    if largest < MIN_DECREASE:
        return [
            f"No single patch of ground decides: covering any one of {N_PATCHES**2} patches changes the score of "
            f"{occlusion.score:.2f} by at most {max(np.abs(occlusion.decrease).max(), 0.005):.2f}."
        ]
    middle = N_PATCHES // 2
    offset = np.array([best[1] - middle, best[0] - middle], np.float64)
    mean = float(np.nanmean(occlusion.grey))
    shade = "dark" if occlusion.grey[best] < mean else "bright"
    lowered = np.maximum(occlusion.decrease, 0)
    dark_share = lowered[occlusion.grey < mean].sum() / lowered.sum()
    return [
        f"Covering one patch of {occlusion.patches.side_px} px lowers the score most, from {occlusion.score:.2f} to "
        f"{occlusion.score - largest:.2f}: {shade} ground {_side(offset, sun_px)}.",
        f"Dark patches cause {100 * dark_share:.0f} % of the whole decrease, bright patches "
        f"{100 * (1 - dark_share):.0f} %.",
    ]


def _side(offset: Array, sun_px: Array) -> str:
    lengths = float(np.linalg.norm(offset) * np.linalg.norm(sun_px))
    if not np.any(offset):
        return "in the middle of the detection"
    cosine = float(offset @ sun_px) / lengths if lengths else 0.0
    if abs(cosine) < _SIDE_COSINE:
        return "beside the middle, at right angles to the Sun"
    return "on the side towards the Sun" if cosine > 0 else "on the side away from the Sun"
