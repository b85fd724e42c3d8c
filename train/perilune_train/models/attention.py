"""CBAM, the convolutional block attention module (Woo et al. 2018, doi 10.1007/978-3-030-01234-2_1)."""

from typing import Any, Literal

import torch
from torch import Tensor, nn

Form = Literal["plain", "identity", "centred"]
AMPLITUDE = 0.5
"""Largest deviation of a centred spatial gate from 1."""


class MeanAndMax(torch.autograd.Function):
    """Mean and maximum of a tensor along one dimension, which is kept with length 1.

    The results equal x.mean and x.amax, but the backward pass writes the gradient once and in the memory layout of x.
    This saves an eighth of a training step on a CPU. If several elements share the maximum, the first one gets the
    gradient.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
        largest, where = x.max(dim, keepdim=True)
        ctx.save_for_backward(where)
        ctx.dim, ctx.shape = dim, x.shape
        ctx.order = sorted(range(x.ndim), key=x.stride, reverse=True)
        return x.mean(dim, keepdim=True), largest

    @staticmethod
    def backward(ctx: Any, mean_grad: Tensor, max_grad: Tensor) -> tuple[Tensor, None]:
        (where,) = ctx.saved_tensors
        share = mean_grad / ctx.shape[ctx.dim]
        # Use the memory order of x, because scatter_ copies a tensor in another order twice.
        order = ctx.order
        grad = share.expand(ctx.shape).permute(order).contiguous()
        grad.scatter_(order.index(ctx.dim), where.permute(order), (share + max_grad).permute(order))
        return grad.permute([order.index(k) for k in range(grad.ndim)]), None


def mean_and_max(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Mean and maximum of a tensor along one dimension, which is kept with length 1."""
    # On a GPU use plain reductions: finding the index of a maximum is slow, and a compiler can fuse the two reductions.
    return (x.mean(dim, keepdim=True), x.amax(dim, keepdim=True)) if x.is_cuda else MeanAndMax.apply(x, dim)


class CBAM(nn.Module):
    """Channel gate, then spatial gate (the paper's section "CBAM Attention").

    F'  = M_c(F) F,   M_c(F)  = s(W1 relu(W0 avg(F)) + W1 relu(W0 max(F))), avg and max over the image;
    F'' = M_s(F') F', M_s(F') = s(f_7x7 [avg(F'); max(F')]), avg and max over the channels.

    Plain form: s is the sigmoid. Both gates are between 0 and 1 and start near 0.5, so one module scales its input by
    about 0.25. Identity form: s is twice the sigmoid, and W1 and f_7x7 start at zero. Both gates are between 0 and 2
    and are exactly 1 at initialisation, so a pretrained backbone keeps its features. Long training drives spatial gates
    of this form to a constant 2. Centred form: the channel gate is as in the identity form, and M_s(F') = 1 + 0.5
    tanh(n(f_7x7 [avg(F'); max(F')])), where n is a batch norm without weights. The spatial gate is between 0.5 and 1.5,
    is centred over pixels and frames, and cannot become constant.

    Input and output have the shape (N, C, H, W). The layers have no bias, as in the equations.
    """

    def __init__(self, channels: int, reduction: int = 16, kernel: int = 7, form: Form = "plain"):
        super().__init__()
        hidden = max(channels // reduction, 4)
        self.squeeze = nn.Linear(channels, hidden, bias=False)
        self.excite = nn.Linear(hidden, channels, bias=False)
        self.spatial = nn.Conv2d(2, 1, kernel, padding=kernel // 2, bias=False)
        self.norm = nn.BatchNorm2d(1, affine=False) if form == "centred" else None
        self.scale = 1.0 if form == "plain" else 2.0
        if form != "plain":
            nn.init.zeros_(self.excite.weight)
        if form == "identity":
            nn.init.zeros_(self.spatial.weight)

    def channel_gate(self, x: Tensor) -> Tensor:
        """M_c (N, C, 1, 1) of features (N, C, H, W)."""
        pooled = torch.stack(mean_and_max(x.flatten(2), 2))[..., 0]
        # W1 is linear, so summing before it gives the sum in the equation with one matrix product fewer.
        logits = self.excite(torch.relu(self.squeeze(pooled)).sum(0))
        return (self.scale * torch.sigmoid(logits))[:, :, None, None]

    def spatial_gate(self, x: Tensor) -> Tensor:
        """M_s (N, 1, H, W) of features (N, C, H, W) that have passed the channel gate."""
        logits = self.spatial(torch.cat(mean_and_max(x, 1), dim=1))
        if self.norm is None:
            return self.scale * torch.sigmoid(logits)
        return 1 + AMPLITUDE * torch.tanh(self.norm(logits.float()))

    def gated(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Spatial mask M_s (N, 1, H, W) and refined features F'' (N, C, H, W)."""
        x = self.channel_gate(x).to(x.dtype) * x
        mask = self.spatial_gate(x)
        return mask, mask.to(x.dtype) * x

    def forward(self, x: Tensor) -> Tensor:
        return self.gated(x)[1]
