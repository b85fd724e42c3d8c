"""The loss of ellipses by hand; that it leaves boxes alone; that it learns drawn ellipses and their errors."""

import math

import numpy as np
import pytest
import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode

from perilune_train.data.frames import normalised
from perilune_train.detect.config import AugmentSettings, DetectConfig, LossSettings
from perilune_train.detect.data.assign import Assignment, BatchLabels, assign
from perilune_train.detect.data.augment import augment
from perilune_train.detect.data.batches import batch_labels, network_input
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.ellipses import correlations_of, ellipses_of
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.detect.train.ellipse_loss import ellipse_loss
from perilune_train.detect.train.loss import detection_loss
from perilune_train.models.yolo import YOLOv3

ANCHORS = torch.tensor([[[8.0, 8.0], [16.0, 16.0], [30.0, 30.0]]])
STRIDES = (8,)


def one_label(correlation):
    boxes = torch.tensor([[8.0, 8.0, 16.0, 16.0]])
    return BatchLabels(boxes, torch.tensor([0]), torch.tensor([True]), torch.tensor([correlation]))


def targets_of(labels, frames=1):
    return assign(labels, ANCHORS, STRIDES, [(frames, 4, 4)], 1.5)


def test_loss_by_hand():
    raw = torch.zeros(1, 3, 4, 4, 10)
    found = ellipse_loss([raw], targets_of(one_label(0.5)), ANCHORS, STRIDES, LossSettings())
    # Three positive predictors: one has the label's box, the others are 8 px away (IoU 0) and learn the correlation.
    correlation = 0.5**2
    sigma = math.sqrt(8) * math.exp(-2)
    axes = [4 - 4 * math.sqrt(1.5), 4 - 4 * math.sqrt(0.5)]
    likelihood = sum((error / sigma) ** 2 / 2 + math.log(sigma) for error in (0, 0, *axes))
    assert [part.item() for part in found] == pytest.approx([correlation, likelihood / 3], rel=1e-5)
    sums = ellipse_loss([raw], targets_of(one_label(0.5)), ANCHORS, STRIDES, LossSettings(reduction="sums"))
    assert [part.item() for part in sums] == pytest.approx([3 * correlation, likelihood], rel=1e-5)


def test_boxes_get_no_gradient():
    random = torch.Generator().manual_seed(0)
    raw = (0.3 * torch.randn(1, 3, 4, 4, 10, generator=random)).requires_grad_()
    targets = targets_of(one_label(0.3))
    plain = detection_loss([raw[..., :5]], targets, ANCHORS, STRIDES, LossSettings())
    (gradient,) = torch.autograd.grad(sum(plain), raw)
    whole = detection_loss([raw], targets, ANCHORS, STRIDES, LossSettings())
    loss = sum(whole) + sum(ellipse_loss([raw], targets, ANCHORS, STRIDES, LossSettings()))
    (with_ellipses,) = torch.autograd.grad(loss, raw)
    assert gradient[..., :5].abs().sum() > 0 and torch.equal(with_ellipses[..., :5], gradient[..., :5])
    assert (with_ellipses[..., 5:].abs().sum((0, 1, 2, 3)) > 0).all()


def test_standard_deviations_become_the_errors():
    """At the minimum of the loss, the mean of (error / standard deviation)^2 is 1."""
    random = torch.Generator().manual_seed(1)
    shift = 0.8 * torch.randn(400, 2, generator=random) * torch.tensor([1.0, 0.5])
    boxes = torch.tensor([[8.0, 8.0, 16.0, 16.0]]) + shift.repeat(1, 2)
    predictors = torch.tensor([[0, 0, 1, 1]] * 400).T
    ignored = torch.zeros(1, 3, 4, 4, dtype=torch.bool)
    targets = [Assignment(predictors, boxes, ignored, correlations=torch.zeros(400))]
    raw = torch.zeros(1, 3, 4, 4, 10, requires_grad=True)
    optimizer = torch.optim.Adam([raw], 0.05)
    for _ in range(400):
        optimizer.zero_grad()
        sum(ellipse_loss([raw], targets, ANCHORS, STRIDES, LossSettings())).backward()
        optimizer.step()
    own = torch.tensor([[8.0, 8.0, 16.0, 16.0]])
    close = (own.clamp(max=100) - boxes).abs()[:, :2].max(1).values < 2.0  # IoU of 0.5 or more for most.
    sigmas = math.sqrt(8) * (raw.detach()[0, 0, 1, 1, 6:8] - 2).exp()
    expected = shift[close].square().mean(0).sqrt()
    torch.testing.assert_close(sigmas, expected, rtol=0.1, atol=0)


def test_padding_and_empty_batches():
    targets = targets_of(one_label(0.4))
    (own,) = targets
    padded = Assignment(
        torch.cat([own.predictors, torch.zeros(4, 2, dtype=torch.long)], 1),
        torch.cat([own.boxes, torch.tensor([[0.0, 0, 1, 1]] * 2)]),
        own.ignored,
        torch.tensor([True] * own.predictors.shape[1] + [False] * 2),
        torch.cat([own.correlations, torch.zeros(2)]),
    )
    raw = torch.rand(1, 3, 4, 4, 10, generator=torch.Generator().manual_seed(2))
    losses = [torch.stack(ellipse_loss([raw], [given], ANCHORS, STRIDES, LossSettings())) for given in (own, padded)]
    torch.testing.assert_close(*losses)
    none = BatchLabels(
        torch.zeros(0, 4), torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.bool), torch.zeros(0)
    )
    raw.requires_grad_()
    empty = sum(ellipse_loss([raw], targets_of(none), ANCHORS, STRIDES, LossSettings()))
    empty.backward()
    assert empty.item() == 0 and raw.grad.abs().max() == 0


def test_no_step_of_the_loss_needs_a_value():
    targets = targets_of(one_label(0.4))
    with FakeTensorMode() as fake:
        raw = torch.zeros(1, 3, 4, 4, 10, requires_grad=True)
        given = [
            Assignment(**{name: fake.from_tensor(part) for name, part in vars(targets[0]).items() if part is not None})
        ]
        sum(ellipse_loss([raw], given, fake.from_tensor(ANCHORS), STRIDES, LossSettings())).backward()
        assert raw.grad.shape == raw.shape


def drawn(ellipse, side=96, samples=4):
    """A dark frame with a bright ellipse, with `samples` squared samples a pixel."""
    x, y, a, b, theta = ellipse
    at = (np.arange(samples * side) + 0.5) / samples
    dx, dy = at[None] - x, at[:, None] - y
    along, across = dx * np.cos(theta) + dy * np.sin(theta), dy * np.cos(theta) - dx * np.sin(theta)
    inside = ((along / a) ** 2 + (across / b) ** 2 <= 1).astype(np.float32)
    return (40 + 160 * inside.reshape(side, samples, side, samples).mean((1, 3))).astype(np.uint8)


def labels_of(ellipses):
    ellipses = np.asarray(ellipses, float).reshape(-1, 5)
    a, b, theta = ellipses[:, 2:].T
    half = np.column_stack(
        [np.hypot(a * np.cos(theta), b * np.sin(theta)), np.hypot(a * np.sin(theta), b * np.cos(theta))]
    )
    boxes = np.hstack([ellipses[:, :2] - half, ellipses[:, :2] + half])
    every = np.ones(len(ellipses), bool)
    return FrameLabels(boxes, np.sqrt(a * b), ellipses, every, every)


@pytest.mark.parametrize("seed", range(12))
def test_augmentation_moves_the_ellipse_with_its_pixels(seed):
    """Second moments of the bright pixels give centre and shape of the drawn ellipse after flips, turns and zoom."""
    ellipse = (44.0, 51.0, 18.0, 9.0, 0.5)
    labels = labels_of([ellipse])
    settings = AugmentSettings(scale=(0.6, 1.4), gain=0, gamma=0, blur_px=0, noise=0)
    rng = np.random.default_rng(seed)
    pixels, outlines, _ = augment(drawn(ellipse), labels.outlines, labels.selected, (2, 50), settings, rng)
    assert len(outlines) == 1 and outlines[0, 0] > 0 and (outlines[0, 2:4] < 96).all()
    (found,) = ellipses_of(outlines[:, :4], outlines[:, 4])
    mask = (pixels > 120).astype(float)
    rows, columns = np.indices(mask.shape) + 0.5
    mean = np.array([(mask * columns).sum(), (mask * rows).sum()]) / mask.sum()
    np.testing.assert_allclose(mean, found[:2], atol=0.15)
    offset = np.stack([columns[mask > 0] - mean[0], rows[mask > 0] - mean[1]])
    values, vectors = np.linalg.eigh(4 * np.cov(offset))
    np.testing.assert_allclose(np.sqrt(values[::-1]), found[2:4], rtol=0.03)
    turn = np.arctan2(vectors[1, 1], vectors[0, 1]) - found[4]
    assert abs((turn + np.pi / 2) % np.pi - np.pi / 2) < 0.03


def drawn_batch(rng, count):
    """Ellipses (count, 5) of all directions, the network's input, and the labels, for frames of 64 px."""
    centre, theta = rng.uniform(24, 40, (count, 2)), rng.uniform(0, np.pi, count)
    ellipses = np.column_stack([centre, rng.uniform(10, 14, count), rng.uniform(4, 8, count), theta])
    labels = [labels_of(ellipse) for ellipse in ellipses]
    rows = batch_labels([part.outlines for part in labels], [part.selected for part in labels])
    frames = normalised(np.stack([drawn(ellipse, side=64, samples=2) for ellipse in ellipses]))
    return ellipses, network_input(frames, 1), rows


@pytest.mark.slow
def test_a_network_learns_drawn_ellipses():
    """A short training: losses fall, and ellipses of new frames are found with errors like the deviations."""
    rng, steps, config = np.random.default_rng(0), 250, DetectConfig()
    torch.manual_seed(0)
    anchors = torch.tensor([[[8.0, 8], [12, 12], [16, 16]], [[20.0, 20], [24, 18], [18, 24]], [[24.0, 24]] * 3])
    network = YOLOv3(anchors, 1, 0.125, "none", (4, 8, 16), ellipses=True).train()
    optimizer = torch.optim.AdamW(network.parameters(), 4e-3)
    schedule, losses = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, steps), []
    for _ in range(steps):
        _, images, rows = drawn_batch(rng, 8)
        shapes = [(8, 64 // stride, 64 // stride) for stride in network.strides]
        targets = assign(rows, anchors, network.strides, shapes, config.anchor_ratio)
        outputs = network(images)
        parts = detection_loss(outputs, targets, anchors, network.strides, config.loss)
        parts += ellipse_loss(outputs, targets, anchors, network.strides, config.loss)
        losses.append([part.item() for part in parts])
        optimizer.zero_grad()
        sum(weight * part for weight, part in zip((0.5, 1.0, 0.5, 0.05), parts, strict=True)).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10)
        optimizer.step()
        schedule.step()
    first, last = np.mean(losses[:10], axis=0), np.mean(losses[-10:], axis=0)
    assert last[2] < first[2] / 3 and last[3] < first[3] - 2
    truth, images, _ = drawn_batch(rng, 64)
    boxes, scores, shapes = network.eval().detect_ellipses(images)
    found = [part.take(np.array([0])) for part in detections_of(boxes, scores, config.evaluation, shapes)]
    best, sigmas = (np.concatenate(part) for part in zip(*((f.ellipses, f.shapes[:, 1:]) for f in found), strict=True))
    assert np.corrcoef(correlations_of(best), correlations_of(truth))[0, 1] > 0.95
    turn = (best[:, 4] - truth[:, 4] + np.pi / 2) % np.pi - np.pi / 2
    assert np.degrees(np.median(np.abs(turn))) < 12
    assert np.median(np.abs(best - truth)[:, :4], axis=0).max() < 1.5
    squared = (((best - truth)[:, :4] / sigmas) ** 2).mean(axis=0)
    assert squared.min() > 0.1 and squared.max() < 3, squared
