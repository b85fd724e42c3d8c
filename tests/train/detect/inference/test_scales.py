"""Frames looked at enlarged: the same craters at the same places, small ones too."""

import cv2
import numpy as np
import pytest
import torch
from tests.helpers.stored_run import settings_of, store_run

from perilune_shared.config.resolve import resolve
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.evaluate.boxes import suppress
from perilune_train.detect.inference.detector import Detector, open_detector
from perilune_train.detect.inference.scales import detect_at_scales, multiply_adds_of_a_frame, resized, scaled_size
from perilune_train.models.ellipse import semi_axes
from perilune_train.models.size import multiply_adds


def config_with(*settings):
    return resolve(DetectConfig, "detect", "perilune_train", "tiny", None, settings)


class OneSpot(torch.nn.Module):
    """Finds the bright part of each image, if it is 8 pixels wide or more, and remembers what it looked at."""

    def __init__(self):
        super().__init__()
        self.shapes = []

    def detect_ellipses(self, images):
        self.shapes.append(tuple(images.shape))
        boxes = []
        for image in images[:, 0].numpy():
            y, x = np.nonzero(image > (image.max() + image.min()) / 2)
            boxes.append([[x.min(), y.min(), x.max() + 1, y.max() + 1]])
        wide = torch.tensor(boxes, dtype=torch.float32)
        return wide, ((wide[..., 2] - wide[..., 0]) >= 8).float() * 0.9, None


class OneEllipse(OneSpot):
    """As OneSpot; standard deviations are a tenth of the sides of the box and of the semi-axes."""

    def detect_ellipses(self, images):
        boxes, scores, _ = super().detect_ellipses(images)
        sides = (boxes[..., 2:] - boxes[..., :2]) / 10
        correlations = torch.full_like(scores, 0.3)
        axes = semi_axes(boxes, correlations) / 10
        return boxes, scores, torch.cat([correlations[..., None], sides, axes], dim=-1)


def cpu(network, *settings):
    return Detector(network, config_with(*settings), "cpu", False)


def spot(height, width, box):
    image = np.full((height, width), 10, np.uint8)
    image[box[1] : box[3], box[0] : box[2]] = 200
    return image


@pytest.mark.parametrize("factor", [0.5, 1.0, 1.3, 2.0, 3.0])
@pytest.mark.parametrize("size", [(256, 256), (96, 160)])
def test_boxes_come_back_in_pixels_of_the_frame(factor, size):
    boxes = np.array([[40, 20, 72, 60], [8, 36, 60, 76]])
    frames = np.stack([spot(*size, box) for box in boxes])
    network = OneSpot()
    found = detect_at_scales(cpu(network, f"detect.evaluation.scales=[{factor}]"), frames)
    assert network.shapes == [(2, 1, *scaled_size(*size, factor))]
    for part, box in zip(found, boxes, strict=True):
        assert part.boxes == pytest.approx(box[None], abs=1 / factor)


@pytest.mark.parametrize("size", [(256, 256), (96, 160)])
def test_ellipses_come_back_in_pixels_of_the_frame(size):
    """At all scales; (96, 160) at 1.3 becomes 128 x 224, which is 1.333 by 1.4 times the frame."""
    frames = np.stack([spot(*size, (40, 20, 72, 60))])
    for factor in (0.5, 1.0, 1.3, 2.0):
        (found,) = detect_at_scales(cpu(OneEllipse(), f"detect.evaluation.scales=[{factor}]"), frames)
        sides = found.boxes[0, 2:] - found.boxes[0, :2]
        assert found.shapes[0, 0] == pytest.approx(0.3)
        np.testing.assert_allclose(found.shapes[0, 1:], [*sides / 10, *found.ellipses[0, 2:4] / 10], rtol=1e-5)
    (both,) = detect_at_scales(cpu(OneEllipse(), "detect.evaluation.scales=[1,2]"), frames)
    assert both.shapes.shape == (1, 5)


def test_a_small_crater_is_seen_at_the_scale_that_enlarges_it_and_a_large_one_once():
    frames = np.stack([spot(128, 128, (60, 60, 65, 65)), spot(128, 128, (30, 30, 60, 60))])
    plain = detect_at_scales(cpu(OneSpot()), frames)
    both = detect_at_scales(cpu(OneSpot(), "detect.evaluation.scales=[1,2]"), frames)
    assert [len(part.scores) for part in plain] == [0, 1]
    assert [len(part.scores) for part in both] == [1, 1]
    assert both[0].boxes[0] == pytest.approx([60, 60, 65, 65], abs=0.6)


class CoarseOnly(OneSpot):
    """As OneSpot, but finds nothing in frames of 128 px."""

    def detect_ellipses(self, images):
        boxes, scores, _ = super().detect_ellipses(images)
        return boxes, scores * (images.shape[-1] < 128), None


@pytest.mark.parametrize(("scales", "least", "count"), [("0.5", 6, 1), ("0.5,1", 3, 1), ("0.5,1", 6, 0)])
def test_a_reduced_frame_gives_large_craters_only_if_a_finer_scale_is_used(scales, least, count):
    """In the reduced frame, the crater has a radius of 4.5 px."""
    frames = spot(128, 128, (30, 30, 50, 46))[None]
    settings = f"detect.evaluation.scales=[{scales}]", f"detect.evaluation.min_coarse_radius_px={least}"
    (found,) = detect_at_scales(cpu(CoarseOnly(), *settings), frames)
    assert len(found.scores) == count


def test_several_scales_go_through_one_suppression(tmp_path):
    """Of a real network: the same as both looks put together by hand."""
    run = store_run(tmp_path)
    detector = open_detector(run / "checkpoints/best.ckpt", settings_of(run))
    frames = np.random.default_rng(5).integers(0, 256, (2, 128, 128), np.uint8)
    one, two, both = (
        detect_at_scales(
            Detector(detector.network, settings_of(run, f"detect.evaluation.scales={scales}"), "cpu", False), frames
        )
        for scales in ("[1]", "[2]", "[1,2]")
    )
    for a, b, merged in zip(one, two, both, strict=True):
        assert len(a.scores) > 20 and len(b.scores) > 20
        boxes, scores = np.concatenate([a.boxes, b.boxes]), np.concatenate([a.scores, b.scores])
        kept = suppress(boxes, scores, detector.config.evaluation.nms_iou, len(scores))
        # Boxes suppressed within one scale alone may come back only through those that the other scale suppresses.
        assert set(np.round(scores[kept], 6)) <= set(np.round(merged.scores, 6))
        assert merged.scores.max() == max(a.scores.max(), b.scores.max())
    work = multiply_adds(detector.network, (1, detector.config.in_channels, 128, 128))
    assert multiply_adds_of_a_frame(detector.network, detector.config, 128, 128) == work


def test_resizing_keeps_means_and_leaves_the_same_size_alone():
    image = cv2.GaussianBlur(np.random.default_rng(6).integers(0, 256, (64, 96), np.uint8), (0, 0), 3)
    assert resized(image, 96, 64) is image
    for factor in (0.5, 2):
        other = resized(image, round(96 * factor), round(64 * factor))
        assert other.shape == (64 * factor, 96 * factor)
        assert other.mean() == pytest.approx(image.mean(), abs=0.6)
    assert scaled_size(256, 256, 1) == (256, 256) and scaled_size(250, 100, 1) == (250, 100)
    assert scaled_size(256, 100, 1.5) == (384, 160) and scaled_size(40, 40, 0.25) == (32, 32)


@pytest.mark.parametrize("scales", ["[]", "[0]", "[1,9]", "2", "[1,1,1,1,1]"])
def test_scales_that_nothing_can_look_at_are_refused(scales):
    with pytest.raises(UserError, match=r"evaluation\.scales"):
        config_with(f"detect.evaluation.scales={scales}")
