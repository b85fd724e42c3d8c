"""Comparison of exported files with torch."""

from pathlib import Path

import numpy as np
import torch

from perilune_shared.errors import UserError
from perilune_train.detect.deploy.engines import Array, Engine
from perilune_train.models.yolo import YOLOv3

MOST_PX = 1e-3
"""Largest allowed difference of a box coordinate from torch's float32, pixels, of the boxes compared."""
MOST_SCORE = 1e-3
"""Largest allowed difference of a score, of all predictors."""
_CHECKED_BOXES = 100


@torch.no_grad()
def difference(network: YOLOv3, engine: Engine, images: Array, min_score: float) -> tuple[float, float]:
    """Largest differences from torch's float32: of box coordinates in pixels, and of scores.

    Compares all scores, and the boxes with a score of at least `min_score` or among the best 100 of their image.
    """
    boxes, scores = (part.numpy() for part in network.detect(torch.as_tensor(images)))
    found_boxes, found_scores = engine(images)
    if found_boxes.shape != boxes.shape or found_scores.shape != scores.shape:
        return float("inf"), float("inf")
    # Always compare some boxes, also if the network detects nothing in these frames.
    best = np.sort(scores, axis=1)[:, -_CHECKED_BOXES:, None].min(axis=1)
    counts = scores >= np.minimum(best, min_score)
    apart = np.abs(found_boxes - boxes)[counts]
    return float(apart.max(initial=0.0)), float(np.abs(found_scores - scores).max())


def check(path: Path, name: str, network: YOLOv3, engine: Engine, images: Array, min_score: float) -> dict[str, float]:
    """Largest differences of a written file over all images. Raises UserError if one exceeds its limit."""
    px, score = difference(network, engine, images, min_score)
    if not (px <= MOST_PX and score <= MOST_SCORE):
        raise UserError(
            path.name, name, f"boxes {px:.2g} px and scores {score:.2g} from torch's", f"{MOST_PX} px, {MOST_SCORE}"
        )
    return {"frames": len(images), "largest_px": px, "largest_score": score}


def noise_frames(count: int, size_px: int) -> np.ndarray:
    """Grey frames (count, size_px, size_px) of seeded noise, used if there are no real frames to compare on."""
    return np.random.default_rng(0).integers(0, 256, (count, size_px, size_px)).astype(np.uint8)
