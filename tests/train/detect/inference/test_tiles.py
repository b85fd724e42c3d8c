"""Tiling: every crater once, whole, wherever the borders of the tiles run."""

import cv2
import numpy as np
import pytest
import torch
from tests.helpers.stored_run import settings_of, store_run

from perilune_shared.errors import UserError
from perilune_train.detect.evaluate.boxes import iou_matrix, suppress
from perilune_train.detect.inference.detector import Detector, open_detector
from perilune_train.detect.inference.scales import Enlarged, detect_at_scales, resized
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.detect.inference.tiles import (
    Tiling,
    count_tiles,
    detect_image,
    padded,
    suppress_in_blocks,
    tile_starts,
)
from perilune_train.detect.inference.tiling import described_by_image
from perilune_train.models.ellipse import semi_axes


class Blobs(torch.nn.Module):
    """Finds bright patches as far as the tile shows them: at a border, only the part that is seen."""

    def detect_ellipses(self, images):
        boxes, scores = [], []
        for image in images[:, 0].numpy():
            bright = (image > (image.max() + image.min()) / 2).astype(np.uint8)
            stats = cv2.connectedComponentsWithStats(bright)[2][1:]
            x, y, w, h, area = stats.T[:5]
            boxes.append(np.stack([x, y, x + w, y + h], axis=1))
            # Half a crater with a better score than a whole one: only the rule against halves can remove it.
            scores.append(1 - area / 1e5)
        most = max(len(part) for part in scores)
        fill = [np.pad(b, [(0, most - len(b)), (0, 0)]) for b in boxes]
        every = np.stack([np.pad(s, (0, most - len(s))) for s in scores])
        return torch.tensor(np.stack(fill)), torch.tensor(every), None


class EllipticBlobs(Blobs):
    """As Blobs; the correlation depends on the score, and the deviations are a tenth of sides and semi-axes."""

    def detect_ellipses(self, images):
        boxes, scores, _ = super().detect_ellipses(images)
        sides = (boxes[..., 2:] - boxes[..., :2]) / 10
        axes = semi_axes(boxes, scores - 0.5) / 10
        return boxes, scores, torch.cat([scores[..., None] - 0.5, sides, axes], dim=-1)


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    run = store_run(tmp_path_factory.mktemp("runs"))
    return open_detector(run / "checkpoints/best.ckpt", settings_of(run))


def discs(height, width, spacing, radius):
    image = np.full((height, width), 20, np.uint8)
    middles = [
        (x + (y * 13 // spacing) % 17, y)
        for y in range(radius + 2, height - radius - 2, spacing)
        for x in range(radius + 2, width - radius - 20, spacing)
    ]
    for middle in middles:
        cv2.circle(image, middle, radius, 220, -1)
    boxes = np.array([[x - radius, y - radius, x + radius + 1, y + radius + 1] for x, y in middles], float)
    return image, boxes


@pytest.mark.parametrize(("scales", "least"), [((1.0,), 0.999), ((2.0,), 0.85), ((1.0, 0.5), 0.8)])
@pytest.mark.parametrize(("size", "radius"), [((700, 900), 12), ((256, 411), 28)])
def test_each_crater_is_found_once_and_whole(detector, scales, least, size, radius):
    blobs = Detector(Blobs(), detector.config, "cpu", False)
    image, truth = discs(*size, 2 * radius + 15, radius)
    counted = []
    tiling = Tiling(scales=scales, overlap_px=96 if 2 in scales else 64)
    if 2 in scales and 2 * 2 * radius > 96:
        tiling = Tiling(scales=scales, overlap_px=128)
    found = detect_image(blobs, image, tiling, counted.append)
    assert sum(counted) == count_tiles(*size, tiling)
    overlap = iou_matrix(found.boxes, truth)
    assert len(found.boxes) == len(truth)
    assert (overlap.max(axis=0) >= least).all()
    assert (np.diff(found.scores) <= 0).all()


@pytest.mark.parametrize("scales", [(1.0,), (2.0,), (1.0, 0.5)])
def test_shapes_stay_with_their_boxes(detector, scales):
    image, truth = discs(700, 900, 40, 12)
    tiling = Tiling(scales=scales, overlap_px=96)
    found = detect_image(Detector(EllipticBlobs(), detector.config, "cpu", False), image, tiling)
    assert len(found.boxes) == len(truth)
    np.testing.assert_allclose(found.shapes[:, 0], found.scores - 0.5, rtol=1e-6)
    sides = found.boxes[:, 2:] - found.boxes[:, :2]
    np.testing.assert_allclose(found.shapes[:, 1:], np.hstack([sides, found.ellipses[:, 2:4]]) / 10, rtol=1e-6)


def test_large_images_are_enlarged_tile_by_tile(detector, monkeypatch):
    """The same craters as of the image that is enlarged as a whole."""
    blobs = Detector(Blobs(), detector.config, "cpu", False)
    image, truth = discs(301, 411, 60, 14)
    tiling = Tiling(scales=(2.5,), overlap_px=128)
    whole = detect_image(blobs, image, tiling)
    monkeypatch.setattr("perilune_train.detect.inference.tiles._MAX_ENLARGED_PIXELS", 1000)
    parts = detect_image(blobs, image, tiling)
    assert len(parts.boxes) == len(whole.boxes) == len(truth)
    assert np.abs(np.sort(parts.boxes, axis=0) - np.sort(whole.boxes, axis=0)).max() <= 0.5


@pytest.mark.parametrize("factor", [1.0, 1.37, 2.0, 3.3])
def test_a_part_of_an_enlarged_image_has_the_pixels_of_the_whole(factor):
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (80, 101), np.uint8), (0, 0), 2)
    size = round(101 * factor), round(80 * factor)
    whole, lazily = resized(image, *size), Enlarged(image, *size)
    assert lazily.shape == whole.shape
    for rows, columns in (((0, 40), (0, 50)), ((33, 80), (20, 101)), ((size[1] - 9, size[1]), (0, size[0]))):
        place = slice(*rows), slice(*columns)
        assert np.abs(lazily[place].astype(int) - whole[place]).max() <= 4


def test_boxes_can_get_a_margin(detector):
    blobs = Detector(Blobs(), detector.config, "cpu", False)
    image, _ = discs(300, 400, 40, 10)
    plain, larger = (detect_image(blobs, image, Tiling(box_margin_px=margin)) for margin in (0.0, 1.5))
    assert len(plain.boxes) > 20
    assert larger.boxes == pytest.approx(plain.boxes + np.array([-1.5, -1.5, 1.5, 1.5]))
    with pytest.raises(UserError, match=r"--box-margin: got -1, expected 0 to 10"):
        Tiling(box_margin_px=-1).check()


def test_an_image_of_one_tile_gets_what_frames_get(detector):
    images = np.random.default_rng(3).integers(0, 256, (2, 128, 128), np.uint8)
    frames = detect_at_scales(detector, images)
    assert min(len(part.scores) for part in frames) > 20
    for image, expected in zip(images, frames, strict=True):
        found = detect_image(detector, image, Tiling(tile_px=128))
        assert found.scores == pytest.approx(expected.scores, abs=1e-6)
        # One image or two in a batch round differently, so that nearly equal scores may change places.
        apart_px = np.abs(found.boxes[:, None] - expected.boxes).max(axis=2)
        assert apart_px.min(axis=0).max() < 1e-3 and apart_px.min(axis=1).max() < 1e-3
        assert found.scores[apart_px.argmin(axis=0)] == pytest.approx(expected.scores, abs=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (7, 300), (100, 64), (33, 257)])
def test_small_images_are_padded_and_nothing_is_found_in_the_padding(detector, size):
    image = np.random.default_rng(4).integers(0, 256, size, np.uint8)
    assert all(side % 32 == 0 or side > 256 for side in padded(image, 256).shape)
    found = detect_image(detector, image, Tiling())
    middle = (found.boxes[:, :2] + found.boxes[:, 2:]) / 2
    assert (middle < size[::-1]).all()


@pytest.mark.parametrize("length", [1, 256, 257, 300, 448, 449, 800, 5064])
def test_tiles_cover_a_side_with_enough_overlap(length):
    starts = tile_starts(length, 256, 64)
    assert starts[0] == 0 and (length <= 256 or starts[-1] == length - 256)
    assert (np.diff(starts) <= 256 - 64).all() and (np.diff(starts) > 0).all()


@pytest.mark.parametrize(
    "tiling",
    [Tiling(tile_px=100), Tiling(tile_px=0), Tiling(overlap_px=256), Tiling(overlap_px=-1), Tiling(scales=(0.0,)),
     Tiling(scales=()), Tiling(scales=(float("nan"),)), Tiling(scales=(9.0,))],
)  # fmt: skip
def test_what_cannot_be_cut_is_refused(tiling):
    with pytest.raises(UserError):
        tiling.check()


def test_many_boxes_are_suppressed_as_few_are():
    rng = np.random.default_rng(6)
    corner = rng.uniform(-5, 1600, (6_000, 2))
    boxes = np.concatenate([corner, corner + rng.uniform(4, 60, (6_000, 1))], axis=1)
    scores = rng.permutation(6_000) / 6_000 + 1e-5
    kept = suppress_in_blocks(boxes, scores, 0.3)
    expected = suppress(boxes, scores, 0.3, len(boxes))
    assert 1000 < len(expected) < 5_500
    assert np.array_equal(kept, expected)


def test_large_boxes_are_not_compared_with_every_box(monkeypatch):
    """As `suppress`, although boxes as wide as the image lie over all blocks; the work grows with the boxes only."""
    rng = np.random.default_rng(7)
    corner, sides = rng.uniform(0, 5000, (30_000, 2)), np.exp(rng.uniform(np.log(3), np.log(30), (30_000, 1)))
    sides[:60] = np.exp(rng.uniform(np.log(200), np.log(5000), (60, 1)))
    boxes = np.concatenate([corner, corner + sides], axis=1)
    scores = rng.permutation(30_000) / 30_000 + 1e-5
    expected = suppress(boxes, scores, 0.3, len(boxes))
    counts = []

    def counted(some_boxes, *rest):
        counts.append(len(some_boxes))
        return suppress(some_boxes, *rest)

    monkeypatch.setattr("perilune_train.detect.inference.tiles.suppress", counted)
    assert np.array_equal(suppress_in_blocks(boxes, scores, 0.3), expected)
    assert (sides[expected] > 512).sum() > 10
    assert sum(counts) < 12 * len(boxes)


@pytest.mark.parametrize(
    ("size", "finest", "expected"),
    [
        ((1, 1), 1, (1,)),
        ((128, 4000), 1, (1,)),
        ((256, 256), 1, (1, 0.5)),
        ((1024, 1024), 1, (1, 0.5, 0.25, 0.125)),
        ((256, 256), 2, (2, 1, 0.5)),
        ((10_000, 5_000), 1, tuple(0.5**k for k in range(7))),
    ],
)
def test_a_pyramid_ends_with_the_shorter_side_in_half_a_tile(size, finest, expected):
    assert Tiling(scales=None, finest=finest).scales_of(*size) == expected
    assert Tiling(scales=(1.0, 2.0)).scales_of(*size) == (1, 2)


def test_scales_as_text():
    assert described_by_image([(2.0, 1.0, 0.5, 0.25)] * 3) == "2, 1, 1/2, 1/4"
    assert described_by_image([(1.0,), (0.3, 1.0), (1.0,)]) == "1 (2 images); 0.3, 1 (1 image)"


def test_a_crater_as_wide_as_the_image_is_found(detector):
    """A disc of 1000 px in an image of 1024 px: no tile at scale 1 shows more than a part of it."""
    blobs = Detector(Blobs(), detector.config, "cpu", False)
    image, truth = discs(1024, 1024, 1024, 500)
    image[-1, :30] = 0  # a second grey level in the corner tiles
    found = detect_image(blobs, image, Tiling(scales=None))
    assert iou_matrix(found.boxes, truth).max() > 0.95
    assert iou_matrix(detect_image(blobs, image, Tiling(scales=(1.0, 0.5))).boxes, truth).max(initial=0) < 0.7


@pytest.mark.parametrize(
    ("scales", "radius", "expected"),
    [((1.0, 0.5), 8, 1), ((1.0, 0.5), 20, 2), ((0.5,), 8, 1), ((2.0, 1.0), 8, 2)],
)
def test_small_boxes_of_a_reduced_image_are_left_to_finer_scales(detector, scales, radius, expected):
    """Discs of 8 px radius have 4 px at half size, below the limit. At IoU 1 nothing is suppressed."""
    evaluation = detector.config.evaluation.model_copy(update={"nms_iou": 1.0})
    config = detector.config.model_copy(update={"evaluation": evaluation})
    image, truth = discs(250, 250, 3 * radius, radius)
    tiling = Tiling(tile_px=512, scales=scales, min_coarse_radius_px=6)
    found = detect_image(Detector(Blobs(), config, "cpu", False), image, tiling)
    assert len(truth) > 3
    assert len(found.boxes) == expected * len(truth)


def test_long_boxes_go_before_suppression(detector):
    boxes = torch.tensor([[[0.0, 0, 20, 10], [0, 0, 12, 10], [50, 50, 60, 75]]])
    scores = torch.tensor([[0.9, 0.8, 0.7]])
    settings = detector.config.evaluation
    assert detections_of(boxes, scores, settings)[0].scores == pytest.approx([0.9, 0.7])
    (short,) = detections_of(boxes, scores, settings.model_copy(update={"max_aspect": 1.5}))
    assert short.scores == pytest.approx([0.8])
