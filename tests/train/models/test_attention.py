"""CBAM against its equations."""

import pytest
import torch

from perilune_train.models.attention import CBAM, MeanAndMax


def test_gates_follow_the_equations():
    torch.manual_seed(0)
    cbam = CBAM(8, reduction=2)
    x = torch.randn(2, 8, 5, 6)
    w0, w1 = cbam.squeeze.weight, cbam.excite.weight

    def mlp(v):
        return torch.relu(v @ w0.T) @ w1.T

    gate = torch.sigmoid(mlp(x.mean((2, 3))) + mlp(x.amax((2, 3))))
    refined = x * gate[:, :, None, None]
    pooled = torch.stack([refined.mean(1), refined.amax(1)], dim=1)
    mask = torch.sigmoid(torch.nn.functional.conv2d(pooled, cbam.spatial.weight, padding=3))
    torch.testing.assert_close(cbam.gated(x)[0], mask)
    torch.testing.assert_close(cbam(x), refined * mask)
    torch.testing.assert_close(cbam.spatial_mask(x), mask)


def test_identity_form_returns_its_input_exactly_and_still_learns():
    cbam = CBAM(16, form="identity")
    x = torch.randn(3, 16, 7, 7)
    assert torch.equal(cbam(x), x)
    cbam(x).square().sum().backward()
    assert cbam.spatial.weight.grad.abs().max() > 0
    assert cbam.excite.weight.grad.abs().max() > 0


def test_plain_form_shrinks_its_input_about_four_times():
    torch.manual_seed(1)
    x = torch.randn(4, 32, 16, 16)
    ratio = CBAM(32)(x).norm() / x.norm()
    assert 0.15 < ratio < 0.4


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_keeps_shape_and_type(dtype):
    x = torch.randn(1, 8, 4, 4, dtype=dtype)
    assert CBAM(8).to(dtype)(x).dtype == dtype
    assert CBAM(8).to(dtype)(x).shape == x.shape


@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_pooling_and_its_gradient(memory_format):
    torch.manual_seed(2)
    x = torch.randn(2, 3, 4, 5, dtype=torch.float64).contiguous(memory_format=memory_format).requires_grad_()
    mean, largest = MeanAndMax.apply(x, 1)
    assert torch.equal(mean, x.mean(1, keepdim=True)) and torch.equal(largest, x.amax(1, keepdim=True))
    assert torch.autograd.gradcheck(lambda v: MeanAndMax.apply(v, 1), x)
    assert torch.autograd.gradcheck(lambda v: MeanAndMax.apply(v.flatten(2), 2), x)
    (grad,) = torch.autograd.grad(largest.sum(), x)
    assert grad.is_contiguous(memory_format=memory_format)
