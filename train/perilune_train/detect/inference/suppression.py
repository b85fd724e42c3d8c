"""Select the detections of a batch: minimum score, aspect limit, non-maximum suppression."""

import torch
from torch import Tensor

from perilune_train.detect.config import EvaluationSettings
from perilune_train.detect.evaluate.boxes import suppress
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.models.boxes import iou

_BLOCK = 256
"""Number of boxes in a block: larger blocks compute more overlaps, smaller blocks need more steps."""


def detections_of(
    boxes: Tensor, scores: Tensor, settings: EvaluationSettings, shapes: Tensor | None = None
) -> list[Detections]:
    """Detections of each frame from all predictors' boxes (N, K, 4), scores (N, K) and, if known, shapes (N, K, 5).

    For tensors on a GPU, suppression runs on the GPU for the whole batch. For tensors on a CPU it runs frame by frame,
    which is faster there (`make bench-suppress`). Both keep the boxes that OpenCV keeps, in OpenCV's order.
    """
    strong = scores >= settings.min_score
    if settings.max_aspect is not None:
        sides = boxes[..., 2:] - boxes[..., :2]
        strong &= sides.amax(-1) <= settings.max_aspect * sides.amin(-1)
    if boxes.device.type == "cpu":
        every = [None] * len(boxes) if shapes is None else shapes
        return [_of_frame(*frame, settings) for frame in zip(boxes, scores, strong, every, strict=True)]
    return _of_batch(boxes, scores, strong, shapes, settings)


def _of_batch(
    boxes: Tensor, scores: Tensor, strong: Tensor, shapes: Tensor | None, settings: EvaluationSettings
) -> list[Detections]:
    kept = suppress_batch(boxes, scores, strong, settings.nms_iou)
    # Transfer the whole batch at once.
    boxes, scores, kept = (part.cpu() for part in (boxes, scores, kept))
    shapes = None if shapes is None else shapes.cpu()
    detections = []
    for frame, chosen in enumerate(kept):
        best = chosen[chosen >= 0][: settings.max_detections]
        frame_shapes = None if shapes is None else shapes[frame, best]
        detections.append(_arrays(boxes[frame, best], scores[frame, best], frame_shapes))
    return detections


def _of_frame(
    boxes: Tensor, scores: Tensor, strong: Tensor, shapes: Tensor | None, settings: EvaluationSettings
) -> Detections:
    candidates = _arrays(boxes[strong], scores[strong], None if shapes is None else shapes[strong])
    return candidates.take(suppress(candidates.boxes, candidates.scores, settings.nms_iou, settings.max_detections))


def _arrays(boxes: Tensor, scores: Tensor, shapes: Tensor | None) -> Detections:
    return Detections(
        boxes.double().numpy(), scores.double().numpy(), None if shapes is None else shapes.double().numpy()
    )


@torch.no_grad()
def suppress_batch(boxes: Tensor, scores: Tensor, allowed: Tensor, threshold_iou: float) -> Tensor:
    """Non-maximum suppression of N frames at once, on the tensors' device.

    Keeps the boxes that `suppress` keeps. Takes boxes (N, K, 4), scores (N, K) and a mask `allowed` (N, K) of the boxes
    to consider. Returns indices (N, M) of the kept boxes of each frame, best first, padded with -1.

    Boxes are processed in blocks by decreasing score. Within a block, the result of the greedy rule is a fixed point: a
    box is kept unless a kept box of a higher score overlaps it. An iteration converges to this fixed point, because the
    overlap matrix is strictly triangular. The kept boxes of a block then remove later boxes, and the remaining boxes
    move up, so that later blocks contain no removed box.
    """
    rows = torch.arange(len(boxes), device=boxes.device)[:, None]
    # Use float32 scores like OpenCV; equal scores keep their order.
    order = torch.where(allowed, scores.float(), -1.0).sort(dim=1, descending=True, stable=True).indices
    order = order[:, : int(allowed.sum(1).amax())] if allowed.any() else order[:, :0]
    candidates, corners = allowed.gather(1, order), boxes.double()[rows, order]
    # OpenCV's rectangles store a corner and a size.
    corners = torch.cat([corners[..., :2], corners[..., :2] + (corners[..., 2:] - corners[..., :2])], dim=-1)
    kept = []
    while candidates.shape[1]:
        block, allowed_here = corners[:, :_BLOCK], candidates[:, :_BLOCK]
        overlapped = (_overlap(block, block) > threshold_iou).triu(1)
        chosen = allowed_here
        while True:
            updated = allowed_here & ~(overlapped & chosen[:, :, None]).any(1)
            if torch.equal(updated, chosen):
                break
            chosen = updated
        kept.append(torch.where(chosen, order[:, :_BLOCK], -1))
        # Put kept boxes first, so that overlaps are computed only for them.
        first = chosen.byte().argsort(dim=1, descending=True, stable=True)[:, : int(chosen.sum(1).amax())]
        removed = (_overlap(block[rows, first], corners[:, _BLOCK:]) > threshold_iou) & chosen.gather(1, first)[
            ..., None
        ]
        candidates = candidates[:, _BLOCK:] & ~removed.any(1)
        remaining = candidates.byte().argsort(dim=1, descending=True, stable=True)[
            :, : int(candidates.sum(1).amax()) if candidates.numel() else 0
        ]
        order, corners, candidates = (
            order[:, _BLOCK:][rows, remaining],
            corners[:, _BLOCK:][rows, remaining],
            candidates.gather(1, remaining),
        )
    if not kept:
        return order
    merged = torch.cat(kept, dim=1)
    count = int((merged >= 0).sum(1).amax())
    return merged.gather(1, (merged >= 0).byte().argsort(dim=1, descending=True, stable=True)[:, :count])


def _overlap(first: Tensor, second: Tensor) -> Tensor:
    """IoU (N, A, B) of boxes (N, A, 4) and (N, B, 4), rounded as in OpenCV; 1 for boxes without area."""
    a, b = first[:, :, None], second[:, None]
    # OpenCV computes 1 - IoU in float64, which is 0 for two boxes without area, and stores it as float32.
    empty = (a[..., 2:] == a[..., :2]).any(-1) & (b[..., 2:] == b[..., :2]).any(-1)
    return torch.where(empty, 1.0, 1.0 - (1.0 - iou(a, b)).float())
