"""CBAM against its equations."""

import pytest
import torch

from perilune_train.models.attention import CBAM, MeanAndMax
from perilune_train.models.fold import FlightCBAM


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
    torch.testing.assert_close(cbam.gated(x)[0], mask)


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


def test_centred_form_is_bounded_centred_and_never_constant():
    """Over pixels and frames the gate has a mean near 1 and a deviation, however large its logits grow."""
    torch.manual_seed(3)
    cbam = CBAM(16, form="centred")
    x = torch.randn(8, 16, 12, 12).abs()
    for factor in (1e-3, 1.0, 1e3):
        with torch.no_grad():
            cbam.spatial.weight.copy_(factor * torch.randn_like(cbam.spatial.weight))
            mask = cbam.gated(x)[0]
        assert mask.min() >= 0.5 and mask.max() <= 1.5
        assert abs(float(mask.mean()) - 1) < 0.1 and float(mask.std()) > 0.1
    # A constant added to all logits, which drives a sigmoid to its bound, has no effect.
    logits = torch.randn(2, 1, 6, 6)
    torch.testing.assert_close(cbam.norm(logits + 50), cbam.norm(logits), atol=1e-4, rtol=0)


def test_centred_form_follows_its_equation_and_is_equal_when_folded():
    torch.manual_seed(4)
    cbam = CBAM(16, form="centred")
    for _ in range(30):
        cbam(torch.randn(4, 16, 10, 10))
    cbam.eval()
    x = torch.randn(2, 16, 10, 10)
    gated = x * cbam.channel_gate(x)
    logits = torch.nn.functional.conv2d(
        torch.stack([gated.mean(1), gated.amax(1)], dim=1), cbam.spatial.weight, padding=3
    )
    standard = (logits - cbam.norm.running_mean) / torch.sqrt(cbam.norm.running_var + cbam.norm.eps)
    expected = 1 + 0.5 * torch.tanh(standard)
    torch.testing.assert_close(cbam.gated(x)[0], expected)
    torch.testing.assert_close(FlightCBAM(cbam)(x), gated * expected)
