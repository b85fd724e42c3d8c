"""Attributions against hand-computed values, the completeness axiom and plain autograd."""

import copy

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from perilune_train.explain.maps.attributions import (
    DetectorTarget,
    grad_cam,
    integrated_gradients,
    last_of_stage,
    occlusion,
)
from perilune_train.models.yolo import YOLOv3


class Linear(nn.Module):
    """Weighted sum of the pixels."""

    def __init__(self, weights):
        super().__init__()
        self.backbone = nn.Conv2d(1, 1, weights.shape, bias=False)
        self.backbone.weight = nn.Parameter(torch.as_tensor(weights)[None, None])

    def fixed(self, grey):
        return ()

    def forward(self, grey):
        return self.backbone(grey)[:, 0, 0, 0]


def smooth_noise(rng, count, height=64):
    fields = [cv2.GaussianBlur(rng.normal(size=(height, 64)), (0, 0), 2) for _ in range(count)]
    return np.stack([one / one.std() for one in fields]).astype(np.float32)


def calibrated(network, run):
    """The network in evaluation mode, its batch norms as after training on one batch, its gates not constant.

    The activations are nearly linear, so that the path integral converges with few points.
    """
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = 1.0
        if isinstance(module, nn.LeakyReLU):
            module.negative_slope = 0.8
    for gate in network.backbone.attentions.values():
        nn.init.normal_(gate.spatial.weight, std=0.05)
    with torch.no_grad():
        run(network.train())
    return network.eval()


@pytest.fixture(scope="module")
def frames():
    return smooth_noise(np.random.default_rng(5), 2)


@pytest.fixture(scope="module")
def detector():
    torch.manual_seed(0)
    network = YOLOv3(None, 1, 0.125, "cbam_identity", (4, 8, 16))
    for head in network.heads.values():
        nn.init.normal_(head[-1].weight, std=0.3)
        nn.init.zeros_(head[-1].bias)
    batch = torch.from_numpy(smooth_noise(np.random.default_rng(1), 8))[:, None]
    return calibrated(network, lambda network: network(batch))


def test_attributions_of_a_linear_target_by_hand():
    rng = np.random.default_rng(0)
    weights, frame = rng.normal(size=(2, 4, 4)).astype(np.float32)
    target, product = Linear(weights), weights * frame
    np.testing.assert_allclose(integrated_gradients(target, frame[None])[0], np.abs(product), rtol=1e-4, atol=1e-5)
    sums = product.reshape(2, 2, 2, 2).sum(axis=(1, 3))
    expected = sums.repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_allclose(occlusion(target, frame[None], 2, 2)[0], expected, atol=1e-5)
    # With overlap: pixel (0, 1) is in the two windows of rows 0 and 1 that begin at columns 0 and 1.
    overlapping = occlusion(target, frame[None], 2, 1)[0]
    assert overlapping[0, 1] == pytest.approx((product[:2, :2].sum() + product[:2, 1:3].sum()) / 2, abs=1e-5)


def test_integrated_gradients_of_the_detector_are_complete(detector, frames):
    target = DetectorTarget(detector)
    grey = torch.from_numpy(frames)[:, None]
    fixed = target.fixed(grey)
    with torch.no_grad():
        change = (target(grey, *fixed) - target(torch.zeros_like(grey), *fixed)).numpy()
    found = integrated_gradients(target, frames, n_steps=64, signed=True)
    assert np.abs(change).min() > 1
    np.testing.assert_allclose(found.sum(axis=(1, 2)), change, rtol=0.01)
    np.testing.assert_array_equal(integrated_gradients(target, frames, n_steps=64), np.abs(found))


def test_the_detectors_target_keeps_the_predictors_of_the_unchanged_image(detector, frames):
    target = DetectorTarget(detector, min_score=0.8)
    grey = torch.from_numpy(frames)[:, None]
    _, scores = detector.detect(grey)
    chosen = scores.numpy() >= 0.8
    assert (chosen.sum(axis=1) > 1).all() and not chosen.all()
    fixed = target.fixed(grey)
    np.testing.assert_allclose(target(grey, *fixed).detach(), (scores.numpy() * chosen).sum(axis=1), rtol=1e-5)
    _, dark = detector.detect(torch.zeros_like(grey))
    np.testing.assert_allclose(
        target(torch.zeros_like(grey), *fixed).detach(), (dark.numpy() * chosen).sum(axis=1), rtol=1e-5
    )
    best = DetectorTarget(detector, min_score=1.1)
    np.testing.assert_allclose(best(grey, *best.fixed(grey)).detach(), scores.amax(1), rtol=1e-5)


@pytest.mark.parametrize("stage", [None, 3])
def test_grad_cam_equals_plain_autograd_without_in_place_modules(detector, frames, stage):
    network = copy.deepcopy(detector)
    for module in network.modules():
        if isinstance(module, nn.LeakyReLU):
            module.inplace = False
    target = DetectorTarget(network)
    layer = network.branches["4"] if stage is None else network.backbone.attentions["B_38"]
    kept = []
    layer.register_forward_hook(lambda _module, _inputs, output: kept.append(output))
    grey = torch.from_numpy(frames[:1])[:, None]
    fixed = target.fixed(grey)
    kept.clear()
    (gradient,) = torch.autograd.grad(target(grey, *fixed)[0], kept[0])
    cam = torch.relu((gradient.mean((2, 3), keepdim=True) * kept[0]).sum(1))[0].detach().numpy()
    found = grad_cam(DetectorTarget(detector), frames, stage)
    np.testing.assert_allclose(found[0], cv2.resize(cam, (64, 64)), rtol=1e-3, atol=1e-5 * cam.max())
    assert found.shape == frames.shape and found.dtype == np.float32
    assert (found.std(axis=(1, 2)) > 0).all()


def test_grad_cam_is_on_the_last_unit_without_attention():
    backbone = YOLOv3(None, 1, 0.125, "none").backbone
    assert last_of_stage(backbone, 4) is backbone.units["B_48"]


def test_a_network_in_training_mode_is_refused():
    with pytest.raises(ValueError, match="training mode"):
        DetectorTarget(YOLOv3(None, 1, 0.125))
