"""Suppression, frame by frame and of a whole batch, against OpenCV's."""

import cv2
import numpy as np
import pytest
import torch

from perilune_train.detect.config import EvaluationSettings
from perilune_train.detect.evaluate.boxes import suppress
from perilune_train.detect.inference import suppression
from perilune_train.detect.inference.suppression import detections_of, suppress_batch


def crowd(rng: np.random.Generator, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Boxes (count, 4) of a detector: about fifteen for each crater; some scores are equal, some boxes too."""
    craters = max(1, count // 15)
    which = rng.integers(craters, size=count)
    side = rng.lognormal(1.8, 0.6, (craters, 1)).clip(3, 80)[which]
    centre = rng.uniform(0, 256, (craters, 2))[which] + 0.1 * side * rng.normal(size=(count, 2))
    half = side * np.exp(0.1 * rng.normal(size=(count, 2))) / 2
    boxes = torch.tensor(np.concatenate([centre - half, centre + half], axis=1), dtype=torch.float32)
    boxes[count // 2 :: 7] = boxes[0].clone()
    return boxes, torch.tensor(rng.uniform(0.01, 1, count).round(2), dtype=torch.float32)


def opencv(boxes, scores, threshold):
    """What OpenCV keeps, best first."""
    corner_and_size = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    return np.asarray(cv2.dnn.NMSBoxes(corner_and_size, scores, 0.0, threshold), np.intp).reshape(-1)


@pytest.mark.parametrize("count", [1, 40, 300, 1500, 6000])
@pytest.mark.parametrize("spread", [1.0, 0.02, 30.0])
def test_the_boxes_that_opencv_keeps(count, spread):
    """Boxes of any size, far outside the image too, with equal scores, equal boxes and boxes without area."""
    rng = np.random.default_rng(count)
    boxes, scores = (part.double().numpy() for part in crowd(rng, count))
    boxes = boxes * spread
    boxes[5::97] += rng.normal(0, 3000, (len(boxes[5::97]), 4)).cumsum(1)
    boxes[:, 2:] = np.maximum(boxes[:, :2], boxes[:, 2:])
    boxes[11::211, 2:] = boxes[11::211, :2]
    for threshold in (0.2, 0.45, 0.7):
        expected = opencv(boxes, scores, threshold)
        assert suppress(boxes, scores, threshold, count).tolist() == expected.tolist()
        assert suppress(boxes, scores, threshold, 7).tolist() == expected[:7].tolist()


@pytest.mark.parametrize("count", [1, 40, 300, 1500])
def test_a_batch_keeps_the_boxes_that_opencv_keeps(count):
    rng = np.random.default_rng(count)
    boxes, scores = (torch.stack(parts) for parts in zip(*(crowd(rng, count) for _ in range(3)), strict=True))
    # The frames differ in how many boxes take part; of the last none does.
    allowed = torch.rand(scores.shape, generator=torch.Generator().manual_seed(count)) < 0.8
    allowed[2] = False
    for threshold in (0.2, 0.45, 0.7):
        kept = suppress_batch(boxes, scores, allowed, threshold)
        for frame, found in enumerate(kept):
            own = allowed[frame]
            expected = suppress(boxes[frame][own].double(), scores[frame][own].double(), threshold, count)
            assert found[found >= 0].tolist() == torch.nonzero(own)[:, 0][torch.from_numpy(expected)].tolist()


def test_nothing_to_suppress():
    none = torch.zeros(2, 0)
    assert suppress_batch(torch.zeros(2, 0, 4), none, none.bool(), 0.5).shape == (2, 0)
    assert suppress_batch(torch.zeros(2, 3, 4), torch.ones(2, 3), torch.zeros(2, 3).bool(), 0.5).shape == (2, 0)


def test_shapes_stay_with_their_boxes_on_a_cpu_and_in_a_batch():
    boxes, scores = (torch.stack(parts) for parts in zip(*(crowd(np.random.default_rng(8), 300),) * 2, strict=True))
    shapes = torch.cat([scores[..., None] - 0.5, boxes], dim=-1)
    settings = EvaluationSettings(min_score=0.2, max_detections=30)
    strong = scores >= settings.min_score
    frames, batch = (
        detections_of(boxes, scores, settings, shapes),
        suppression._of_batch(boxes, scores, strong, shapes, settings),
    )
    for found in (*frames, *batch):
        assert len(found.boxes) > 5 and found.shapes.shape == (len(found.boxes), 5)
        np.testing.assert_array_equal(found.shapes[:, 1:], found.boxes)
        np.testing.assert_allclose(found.shapes[:, 0], found.scores - 0.5, atol=1e-6)
    for one, other in zip(frames, batch, strict=True):
        np.testing.assert_array_equal(one.boxes, other.boxes)
    assert all(part.shapes is None for part in detections_of(boxes, scores, settings))
