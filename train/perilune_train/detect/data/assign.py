"""Assignment of predictors to labels.

A predictor is one anchor in one cell of a scale's grid. For each scale:

1. `matching_anchors` selects the anchors whose size fits a label.
2. The predictors of these anchors in the cell of the label's centre, and in the nearest cells, become positive.
3. For an ignored label, the predictors whose cells touch the middle of the label become ignored (`_cells_touched`).
4. All other predictors are negative.

The number of positive predictors depends on the labels. If the GPU assigned predictors, the CPU would have to wait for
this number in every step. Therefore the loader assigns predictors on the CPU, and the loss only gathers their outputs.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from perilune_train.models.boxes import iou


@dataclass(frozen=True)
class BatchLabels:
    """Labels of a batch, one row each."""

    boxes: Tensor
    """x0, y0, x1, y1 in pixels (T, 4)."""
    frame: Tensor
    """Index in the batch of each label's frame (T,)."""
    selected: Tensor
    """False for a label to ignore, such as a crater with little contrast (T,)."""
    correlations: Tensor | None = None
    """Correlation of the ellipse in each box (T,), see detect/ellipses.py; None if only boxes are learned."""


@dataclass(frozen=True)
class Assignment:
    """Positive predictors of one scale with their labels, and ignored predictors."""

    predictors: Tensor
    """Frame, anchor, row and column of each positive predictor (4, P)."""
    boxes: Tensor
    """Label box of each positive predictor: x0, y0, x1, y1 in pixels (P, 4)."""
    ignored: Tensor
    """Predictors that are neither positive nor negative (N, 3, h, w), bool."""
    counted: Tensor | None = None
    """False for rows that only pad the other arrays to a constant length (P,); None: no row is padding."""
    correlations: Tensor | None = None
    """Correlation of the ellipse in the label box of each positive predictor (P,); None if only boxes are learned."""

    @property
    def positive(self) -> Tensor:
        """The positive predictors (N, 3, h, w), bool."""
        if self.counted is None:
            mask = torch.zeros_like(self.ignored)
            mask[tuple(self.predictors)] = True
            return mask
        flat = flat_predictors(self.predictors, self.ignored.shape)
        counts = torch.zeros(self.ignored.numel(), device=flat.device)
        return (counts.scatter_reduce(0, flat, self.counted.float(), "amax") > 0).view_as(self.ignored)

    def pin_memory(self) -> "Assignment":
        """The assignment in page-locked memory; a DataLoader calls this."""
        return self._each(Tensor.pin_memory)

    def to(self, device: torch.device) -> "Assignment":
        """Copy the assignment to another device; the process does not wait for a copy from page-locked memory."""
        return self._each(lambda part: part.to(device, non_blocking=True))

    def _each(self, change: Callable[[Tensor], Tensor]) -> "Assignment":
        return Assignment(**{name: change(part) for name, part in vars(self).items() if part is not None})


def flat_predictors(predictors: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Indices (P,) of predictors in a flattened tensor of shape (N, 3, h, w).

    `predictors` (4, P) are the frame, anchor, row and column of each predictor.
    """
    frame, anchor, row, column = predictors
    _, anchors, height, width = shape
    return ((frame * anchors + anchor) * height + row) * width + column


Targets = list[Assignment]
"""The assignments of a batch, one per scale."""


def matching_anchors(boxes: Tensor, anchors: Tensor, ratio: float | None) -> Tensor:
    """Whether each anchor (K, 2) is assigned to each label box (T, 4): (T, K) bool.

    True for the anchor of the highest IoU, with anchor and box centred on one point. With `ratio`, also true for every
    anchor whose width and height differ from the box's by less than this factor.
    """
    size = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3)[:, None]
    quotient = size / anchors
    near = torch.maximum(quotient, 1 / quotient).amax(2) < (0.0 if ratio is None else ratio)
    best = torch.zeros_like(near)
    if len(boxes):
        overlap = iou(torch.cat([-size, size], -1) / 2, torch.cat([-anchors, anchors], -1) / 2)
        best[torch.arange(len(boxes), device=boxes.device), overlap.argmax(1)] = True
    return near | best


def assign(
    labels: BatchLabels,
    anchors: Tensor,
    strides: tuple[int, ...],
    shapes: list[tuple[int, int, int]],
    ratio: float | None,
) -> Targets:
    """Positive and ignored predictors of every scale.

    `anchors` (scales, 3, 2) are in pixels; `shapes` has the grid (N, h, w) of each scale.

    A predictor is positive if its anchor matches a selected label (`matching_anchors`) and its cell is one of three:
    the cell that contains the label's centre, the cell nearest to the centre along x, or the cell nearest along y (as
    in later YOLO versions). Deviation: YOLOv3 makes one predictor of one scale positive for each label. Our rule gives
    about nine times as many positives, so a short training suffices. Without `ratio`, each label has one positive
    predictor, as in YOLOv3.

    A predictor is ignored if its anchor matches an ignored label and its cell touches the middle half of that label's
    box. All other predictors are negative, including other predictors around a selected label. Deviation: YOLOv3
    ignores predictors around a label if the IoU of their boxes with the label exceeds 0.5. Here the loss lowers their
    scores, so better boxes score higher.
    """
    matches = matching_anchors(labels.boxes, anchors.flatten(0, 1), ratio).unflatten(1, anchors.shape[:2])
    centre = (labels.boxes[:, :2] + labels.boxes[:, 2:]) / 2
    size = labels.boxes[:, 2:] - labels.boxes[:, :2]
    result = []
    for scale, stride in enumerate(strides):
        frames, height, width = shapes[scale]
        label, anchor = matches[:, scale].nonzero(as_tuple=True)
        at = centre[label] / stride
        limit = at.new_tensor([width, height])
        grid = (frames, anchors.shape[1], height, width)
        selected = labels.selected[label]
        unselected = label[~selected]
        ignored = _cells_touched(
            labels.frame[unselected], anchor[~selected], at[~selected], size[unselected] / stride, grid
        )
        label, anchor, at = label[selected], anchor[selected], at[selected]
        cell = at.floor()
        side = torch.where(at - cell < 0.5, -1.0, 1.0)
        zero = torch.zeros_like(side[:, 0])
        steps = torch.stack(
            [torch.stack([zero, zero], 1), torch.stack([side[:, 0], zero], 1), torch.stack([zero, side[:, 1]], 1)]
        )
        steps = steps[:1] if ratio is None else steps
        cells = (cell + steps).flatten(0, 1)
        label, anchor = label.repeat(len(steps)), anchor.repeat(len(steps))
        inside = ((cells >= 0) & (cells < limit)).all(1)
        cells, label, anchor = cells[inside].long(), label[inside], anchor[inside]
        predictors = torch.stack([labels.frame[label], anchor, cells[:, 1], cells[:, 0]])
        correlations = None if labels.correlations is None else labels.correlations[label]
        assignment = Assignment(predictors, labels.boxes[label], ignored, correlations=correlations)
        result.append(replace(assignment, ignored=ignored & ~assignment.positive))
    return result


def _cells_touched(frame: Tensor, anchor: Tensor, at: Tensor, size: Tensor, shape: tuple[int, int, int, int]) -> Tensor:
    """Whether the cell of each predictor touches the middle half of a box with this anchor: (N, 3, h, w).

    Along x and along y, the centre of such a cell is less than a quarter of the box's side plus half a cell from the
    centre of the box. `at` and `size` (P, 2) are the centres and sizes of the boxes in cells.
    """
    touched = torch.zeros(shape, dtype=torch.bool, device=at.device)
    if not len(at):
        return touched
    reach = size / 4 + 0.5
    span = int(reach.max().ceil()) + 1
    offsets = torch.arange(-span, span + 1, device=at.device)
    # Columns and rows (P, 2, S) around each centre; a cell is touched if both its column and its row are near.
    cells = at.floor()[..., None] + offsets
    limit = at.new_tensor([shape[3], shape[2]])[:, None]
    near = ((cells + 0.5 - at[..., None]).abs() < reach[..., None]) & (cells >= 0) & (cells < limit)
    box, row, column = (near[:, 1, :, None] & near[:, 0, None, :]).nonzero(as_tuple=True)
    cells = cells.long()
    touched[frame[box], anchor[box], cells[box, 1, row], cells[box, 0, column]] = True
    return touched
