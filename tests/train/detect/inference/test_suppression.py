"""Suppression of a whole batch against OpenCV's, frame by frame."""

import numpy as np
import pytest
import torch

from perilune_train.detect.evaluate.boxes import suppress
from perilune_train.detect.inference.suppression import suppress_batch


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
