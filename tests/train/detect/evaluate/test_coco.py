"""The same figures as pycocotools, an independent implementation."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from tests.train.detect.evaluate.coco_reference import coco_evaluation

from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.evaluate.matching import COCO_IOUS, Detections, find_overlaps
from perilune_train.detect.evaluate.metrics import curve, figures_over_ious

SIZE_PX = 1000
EVERY_RADIUS = (0.0, 1e9)
QUICK = (Phase.explicit, Phase.generate)
"""The seed tells a case: nothing is gained by shrinking it, which would take minutes."""


def our_average_precisions(found, labels):
    overlaps = find_overlaps(found, labels, np.full((len(found), 2), SIZE_PX))
    by_iou = [overlaps.match(iou, EVERY_RADIUS) for iou in COCO_IOUS]
    curves = [curve(part) for part in by_iou]
    both = [c.ap_coco101() for c in curves], [c.ap_envelope() for c in curves]
    assert figures_over_ious(by_iou)["ap50_95_coco101"] == pytest.approx(np.mean(both[0]))
    return both


def labels_of(boxes, selected):
    boxes = np.asarray(boxes, np.float64).reshape(-1, 4)
    radius = np.sqrt(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)) / 2
    return FrameLabels(boxes, radius, np.zeros((len(boxes), 5)), selected, selected)


def random_frames(seed, n_frames, crowd_px, on_grid, ignored_share, score_levels):
    """Frames with labels in a square of `crowd_px`, detections near them and elsewhere, scores of few levels (ties);
    on a grid also many overlaps are the same to the last bit."""
    rng = np.random.default_rng(seed)
    found, labels = [], []
    for _ in range(n_frames):
        count = int(rng.integers(1, 60))
        corner, size = rng.uniform(0, crowd_px, (count, 2)), rng.uniform(4, 24, (count, 1)) * np.ones((1, 2))
        near = rng.integers(0, count, int(rng.integers(1, 120)))
        moved = corner[near] + rng.normal(0, 1.5, (len(near), 2))
        grown = size[near] * rng.uniform(0.8, 1.25, (len(near), 1))
        boxes = [np.concatenate([at, at + side], axis=1) for at, side in ((corner, size), (moved, grown))]
        if on_grid:
            boxes = [np.round(box / 4) * 4 + [0, 0, 4, 4] for box in boxes]
        labels.append(labels_of(boxes[0], rng.random(count) >= ignored_share))
        scores = rng.integers(1, score_levels + 1, len(near)) / (score_levels + 1)
        order = rng.permutation(len(near))
        found.append(Detections(np.clip(boxes[1], 0, SIZE_PX)[order], scores[order]))
    return found, labels


@settings(max_examples=60, deadline=None, phases=QUICK)
@given(
    seed=st.integers(0, 2**32),
    n_frames=st.integers(1, 4),
    crowd_px=st.sampled_from([30, 100, 500]),
    on_grid=st.booleans(),
    score_levels=st.sampled_from([3, 20, 10**6]),
)
def test_random_crowds_with_ties(seed, n_frames, crowd_px, on_grid, score_levels):
    found, labels = random_frames(seed, n_frames, crowd_px, on_grid, 0.0, score_levels)
    for ours, theirs in zip(our_average_precisions(found, labels), coco_evaluation(found, labels), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


@settings(max_examples=10, deadline=None, phases=QUICK)
@given(seed=st.integers(0, 2**32), crowd_px=st.sampled_from([30, 100]), score_levels=st.sampled_from([3, 10**6]))
def test_ignored_labels_that_absorb_any_number(seed, crowd_px, score_levels):
    found, labels = random_frames(seed, 2, crowd_px, False, 0.4, score_levels)
    if not any(part.selected.any() for part in labels):
        return
    for ours, theirs in zip(our_average_precisions(found, labels), coco_evaluation(found, labels, None), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def with_crowds(labels, rng):
    """The same labels, with regions that hold any number of craters."""
    made = []
    for one in labels:
        count = int(rng.integers(0, 4))
        corner = rng.uniform(0, 80, (count, 2))
        boxes = np.concatenate([one.boxes, np.concatenate([corner, corner + rng.uniform(20, 80, (count, 2))], axis=1)])
        is_crowd = np.arange(len(boxes)) >= len(one.boxes)
        selected = np.append(one.selected, np.zeros(count, bool))
        radius = np.sqrt(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)) / 2
        made.append(FrameLabels(boxes, radius, np.zeros((len(boxes), 5)), selected, selected, crowd=is_crowd))
    return made


@settings(max_examples=40, deadline=None, phases=QUICK)
@given(
    seed=st.integers(0, 2**32),
    crowd_px=st.sampled_from([100, 500]),
    on_grid=st.booleans(),
    ignored_share=st.sampled_from([0.0, 0.3]),
    score_levels=st.sampled_from([3, 10**6]),
)
def test_crowds_ignore_the_detections_inside_them(seed, crowd_px, on_grid, ignored_share, score_levels):
    found, labels = random_frames(seed, 3, crowd_px, on_grid, ignored_share, score_levels)
    labels = with_crowds(labels, np.random.default_rng(seed))
    if not any(part.selected.any() for part in labels):
        return
    copies = 1 if ignored_share == 0 else None
    for ours, theirs in zip(our_average_precisions(found, labels), coco_evaluation(found, labels, copies), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_small_detections_in_a_large_crowd_are_ignored():
    boxes = [[0.0, 0, 10, 10], [200, 200, 400, 400]]
    crowd = np.array([False, True])
    label = FrameLabels(np.array(boxes), np.array([5.0, 100.0]), np.zeros((2, 5)), ~crowd, ~crowd, crowd=crowd)
    inside = [[220.0, 220, 230, 230], [300, 300, 310, 310], [395, 300, 405, 310]]
    found = [Detections(np.array([*inside, [0, 0, 10, 10]]), np.array([0.9, 0.8, 0.7, 0.6]))]
    # Half of the third is inside.
    for average in (our_average_precisions(found, [label]), coco_evaluation(found, [label])):
        assert average[1][0] == pytest.approx(1)
    whole = FrameLabels(np.array(boxes), np.array([5.0, 100.0]), np.zeros((2, 5)), ~crowd, ~crowd)
    assert our_average_precisions(found, [whole])[1][0] == pytest.approx(0.25)


def test_where_ours_and_cocos_ignored_labels_differ():
    """A selected label found, and two better detections on an ignored one: COCO counts the second of these as false."""
    square = [0.0, 0.0, 10.0, 10.0]
    labels = [labels_of([square, [50, 50, 60, 60]], np.array([False, True]))]
    found = [Detections(np.array([square, square, [50, 50, 60, 60]]), np.array([0.9, 0.8, 0.7]))]
    assert our_average_precisions(found, labels)[1][0] == 1
    assert coco_evaluation(found, labels)[1][0] == pytest.approx(0.5)
    assert coco_evaluation(found, labels, copies=2)[1][0] == pytest.approx(1)
