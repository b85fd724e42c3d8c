"""Comparison of exported files with torch."""

from pathlib import Path

import numpy as np
import torch

from perilune_shared.errors import UserError
from perilune_train.detect.deploy.engines import Array, Engine
from perilune_train.models.yolo import YOLOv3

MAX_DIFFERENCE_PX = 1e-3
"""Largest allowed difference of a coordinate of a compared box from torch's float32, pixels."""
MAX_DIFFERENCE_SCORE = 1e-3
"""Largest allowed difference of any predictor's score."""
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
    """Largest differences of a file's outputs from torch's. Raises UserError if one exceeds its limit."""
    px, score = difference(network, engine, images, min_score)
    if not (px <= MAX_DIFFERENCE_PX and score <= MAX_DIFFERENCE_SCORE):
        raise UserError(
            path.name,
            name,
            f"boxes {px:.2g} px and scores {score:.2g} from torch's",
            f"at most {MAX_DIFFERENCE_PX} px and {MAX_DIFFERENCE_SCORE}",
        )
    return {"frames": len(images), "largest_px": px, "largest_score": score}


def noise_frames(count: int, size_px: int) -> np.ndarray:
    """Grey frames (count, size_px, size_px) of seeded noise, used if there are no real frames to compare on."""
    return np.random.default_rng(0).integers(0, 256, (count, size_px, size_px)).astype(np.uint8)
