"""Two networks that estimate the motion between consecutive frames, or the pose at the later frame."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from perilune_train.config import Attention
from perilune_train.models.darknet import AttentionDarknet53, conv_block

OUTPUTS = 9
"""Number of outputs: 3 for the translation and 6 for the continuous rotation (see motion/geometry.py)."""
State = tuple[Tensor, Tensor]
"""Hidden and cell state of the LSTM, each (2 layers, batch, hidden)."""


class Recurrent(nn.Module):
    """Two LSTM layers (as in DeepVO, Wang et al. 2017, doi 10.1109/ICRA.2017.7989236), then a linear layer to 9 values.

    The last linear layer starts at zero, so that an untrained network outputs the reference motion. With `summary`, a
    linear layer to `summary` values comes before the LSTM. `dropout` acts on the LSTM's input and output. With `exact`,
    the layers compute in float32 even under autocast: positions vary over hundreds of metres, and bfloat16 resolves
    only 1/256 of a value.

    Shape: features (batch, pairs, inputs) to (batch, pairs, 9) and the LSTM's state after the last pair. The argument
    `state` is the LSTM's state before the first pair; None at the start of a trajectory.
    """

    def __init__(self, inputs: int, hidden: int, summary: int | None = None, dropout: float = 0.0, exact: bool = False):
        super().__init__()
        self.exact = exact
        self.summary = nn.Linear(inputs, summary) if summary else nn.Identity()
        self.dropout = nn.Dropout(dropout)
        self.lstm = nn.LSTM(summary or inputs, hidden, num_layers=2, batch_first=True)
        self.output = nn.Linear(hidden, OUTPUTS)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(self, features: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        with self.precision(features):
            return self.over_time(self.summary(features), state)

    def precision(self, values: Tensor) -> AbstractContextManager:
        """Context in which the layers compute: float32 if they are exact, otherwise the caller's precision."""
        return torch.autocast(values.device.type, enabled=False) if self.exact else nullcontext()

    def over_time(self, summaries: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        """Run the layers after `summary` on its outputs (batch, pairs, values); returns the result of `forward`."""
        with self.precision(summaries):
            hidden, state = self.lstm(self.dropout(summaries), state)
            return self.output(self.dropout(hidden)).float(), state


@dataclass(frozen=True, slots=True)
class StackOptions:
    """Options by which a stack network can differ from the paper's network."""

    pool: int = 1
    """Number of cells along each side of a grid over each frame. Features are averaged over each cell, then a linear
    layer reduces them to at most `StackNavigator.SUMMARY` values. 1: average over both frames, no linear layer."""
    stages: int = 5
    """Stages of the backbone."""
    dropout: float = 0.0
    """Fraction of the LSTM's inputs and outputs that a training step sets to 0."""
    standardised: bool = False
    """Whether to standardise each feature by its mean and spread over the training pairs; `measure` computes them."""


AS_PAPER = StackOptions()
"""The paper's network."""


class StackNavigator(nn.Module):
    """The paper's network: two frames stacked in height, attention-Darknet53, global average pool, LSTM.

    Shape: earlier and later frames (batch, pairs, height, width), normalised, to (batch, pairs, 9) and the state of
    the LSTM.
    """

    SUMMARY = 512
    """Largest number of inputs of the LSTM if the features come from a grid of cells."""
    feature_mean: Tensor
    feature_spread: Tensor

    def __init__(
        self,
        in_channels: int,
        width: float,
        attention: Attention,
        hidden: int,
        options: StackOptions = AS_PAPER,
    ):
        super().__init__()
        pool, standardised = options.pool, options.standardised
        self.in_channels, self.pool, self.standardised = in_channels, pool, standardised
        self.backbone = AttentionDarknet53(in_channels, width, attention, stages=options.stages)
        inputs = self.backbone.channels[-1] * (1 if pool == 1 else 2 * pool**2)
        summary = None if pool == 1 else min(inputs, self.SUMMARY)
        self.recurrent = Recurrent(inputs, hidden, summary, options.dropout, exact=standardised)
        if standardised:
            self.register_buffer("feature_mean", torch.zeros(inputs))
            self.register_buffer("feature_spread", torch.ones(inputs))

    def stacked(self, first: Tensor, second: Tensor) -> Tensor:
        """The backbone's input (batch * pairs, in_channels, 2 height, width): the earlier frame above."""
        pair = torch.cat([first, second], dim=2).flatten(0, 1)
        return pair[:, None].expand(-1, self.in_channels, -1, -1).contiguous(memory_format=torch.channels_last)

    def pooled(self, first: Tensor, second: Tensor) -> Tensor:
        """The backbone's last features, averaged over the pair or over each cell (batch, pairs, inputs)."""
        features = self.backbone(self.stacked(first, second))[-1]
        grid = (1, 1) if self.pool == 1 else (2 * self.pool, self.pool)
        # Average in float32, because bfloat16, the type of the features, is too coarse for an average.
        return cell_means(features.float(), *grid).flatten(1).unflatten(0, first.shape[:2])

    def features(self, first: Tensor, second: Tensor) -> Tensor:
        """The input of the recurrent part (batch, pairs, inputs)."""
        return self.scaled(self.pooled(first, second))

    def scaled(self, pooled: Tensor) -> Tensor:
        """Averages (..., inputs), standardised if the network has this option."""
        return (pooled - self.feature_mean) / self.feature_spread if self.standardised else pooled

    def measure(self, pooled: Tensor) -> None:
        """Set the mean and spread for standardising from the averages (pairs, inputs) of training pairs."""
        spread = pooled.std(0)
        self.feature_mean.copy_(pooled.mean(0))
        # Features that hardly vary would otherwise be amplified without limit.
        self.feature_spread.copy_(spread.clamp(min=1e-6).maximum(0.1 * spread.mean()))

    def forward(self, first: Tensor, second: Tensor, state: State | None = None) -> tuple[Tensor, State]:
        return self.recurrent(self.features(first, second), state)


def cell_means(features: Tensor, rows: int, columns: int) -> Tensor:
    """Means of feature maps (N, C, H, W) over a grid of cells (N, C, rows, columns)."""
    if rows == columns == 1:
        return features.mean((2, 3), keepdim=True)
    height, width = (int(size) for size in features.shape[2:])
    if height % rows or width % columns:
        return functional.adaptive_avg_pool2d(features, (rows, columns))
    # Unlike adaptive pooling, this has a deterministic gradient on a GPU.
    return features.unflatten(3, (columns, -1)).unflatten(2, (rows, -1)).mean((3, 5))


class WarpNavigator(nn.Module):
    """Network for two frames stacked in channels; the later frame is warped onto the earlier one by the nominal motion.

    The channels are both frames and, at three levels of blur, the local shift between them (`local_shift`, Lucas &
    Kanade). Without the shift, training needs hundreds of steps to learn the product of brightness change and gradient.
    The backbone ends at stride 8. From the features and the mean local shifts, a head estimates the residual flow after
    the nominal motion, and the weight of this flow, for every cell of the feature map. A least-squares fit with a prior
    gives the motion that explains the flow over the ground plane. The LSTM's output is added as a correction.

    Inputs: earlier and warped later frames (batch, pairs, height, width), normalised, and nominal altitudes (batch,
    pairs) in metres. Outputs: the motion (batch, pairs, 9) in the units of motion/network.py, the flow (batch, pairs,
    height / 8, width / 8, 2) in pixels, and the LSTM's state.
    """

    BLURS_PX = (3, 5, 9)
    unit: Tensor
    CHANNELS = 2 + 2 * len(BLURS_PX)
    STRIDE = 8
    _SUMMARY = 128

    def __init__(
        self,
        width: float,
        attention: Attention,
        hidden: int,
        focal_over_width: float,
        spread_m: list[float],
        rotation_rad: float,
    ):
        super().__init__()
        self.focal_over_width = focal_over_width
        self.backbone = AttentionDarknet53(self.CHANNELS, width, attention, stages=3)
        channels = self.backbone.channels[-1]
        self.mix = conv_block(channels, channels, 3)
        self.place = nn.Conv2d(channels + self.CHANNELS - 2, 3, 1)
        for parameter in self.place.parameters():
            nn.init.zeros_(parameter)
        self.summary = nn.Sequential(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(16 * channels, self._SUMMARY))
        self.log_prior = nn.Parameter(torch.zeros(6))
        self.recurrent = Recurrent(self._SUMMARY + 6, hidden)
        self.register_buffer("unit", torch.tensor([*spread_m, *[rotation_rad] * 3]), persistent=False)

    def stacked(self, first: Tensor, second: Tensor) -> Tensor:
        """The backbone's input (batch * pairs, 8, height, width)."""
        pair = torch.stack([first, second], dim=2).flatten(0, 1)
        channels = [pair, *(local_shift(blurred(pair, size)) for size in self.BLURS_PX)]
        return torch.cat(channels, dim=1).contiguous(memory_format=torch.channels_last)

    def forward(
        self, first: Tensor, second: Tensor, altitude_m: Tensor, state: State | None = None
    ) -> tuple[Tensor, Tensor, State]:
        features, flow_px, weight = self.flow(first, second)
        with torch.autocast(features.device.type, enabled=False):
            normal, right = self.equations(flow_px, weight, altitude_m.flatten(), int(first.shape[-1]))
            fitted = self.solved(normal, right)
        summary = torch.cat([self.summary(features).float(), fitted], dim=-1)
        correction, state = self.recurrent(summary.unflatten(0, first.shape[:2]), state)
        turn = fitted[:, 3:]
        zero = torch.zeros_like(turn[:, 0])
        # First two columns of a small rotation, minus (1, 0, 0) and (0, 1, 0).
        columns = torch.stack([zero, turn[:, 2], -turn[:, 1], -turn[:, 2], zero, turn[:, 0]], dim=-1)
        motion = torch.cat([fitted[:, :3], columns], dim=-1).unflatten(0, first.shape[:2])
        return motion + correction, flow_px.unflatten(0, first.shape[:2]), state

    def flow(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features (N, channels, h, w), flows (N, h, w, 2) in pixels, and flow weights (N, h, w) of all N pairs."""
        stacked = self.stacked(first, second)
        features = self.mix(self.backbone(stacked)[-1])
        with torch.autocast(features.device.type, enabled=False):
            shifts = functional.avg_pool2d(stacked[:, 2:], self.STRIDE)
            estimates = self.place(torch.cat([features.float(), shifts], dim=1)).permute(0, 2, 3, 1)
            return features, estimates[..., :2], torch.exp(estimates[..., 2].clamp(-8, 8))

    def information(self, first: Tensor, second: Tensor, altitude_m: Tensor) -> Tensor:
        """Inverse covariance of translation and rotation vector, in units of their spreads (batch, pairs, 6, 6).

        It is computed from the flows alone, without the prior. The flows are assumed to be independent, and the
        variance of each is 1 / weight times the mean weighted square of the residuals.
        """
        _, flow_px, weight = self.flow(first, second)
        altitude, width_px = altitude_m.flatten(), int(first.shape[-1])
        normal, right = self.equations(flow_px, weight, altitude, width_px)
        motion = self.solved(normal, right)
        explained = torch.einsum("nhwij,nj->nhwi", self.jacobian(flow_px, altitude, width_px), motion)
        residual = (weight[..., None] * (flow_px - explained) ** 2).mean(dim=(1, 2, 3))
        from_flows = normal - torch.eye(6, device=normal.device) * self.log_prior.exp()
        return (from_flows / residual[:, None, None]).unflatten(0, first.shape[:2])

    def equations(self, flow_px: Tensor, weight: Tensor, altitude_m: Tensor, width_px: int) -> tuple[Tensor, Tensor]:
        """Normal equations (N, 6, 6), (N, 6) for translation and rotation vector, in units of their spreads.

        Their solution m minimises the sum of weight |J m - flow|^2 over all flows, plus prior |m|^2. Flows are
        (N, h, w, 2) in pixels, weights (N, h, w) in 1 / px^2, altitudes (N,) in metres. The prior decides between tilt
        and sideways shift, which look alike from above.
        """
        jacobian = self.jacobian(flow_px, altitude_m, width_px)
        weighted = jacobian * weight[..., None, None]
        normal = (
            torch.einsum("nhwij,nhwik->njk", weighted, jacobian)
            + torch.eye(6, device=self.unit.device) * self.log_prior.exp()
        )
        return normal, torch.einsum("nhwij,nhwi->nj", weighted, flow_px)

    def jacobian(self, flow_px: Tensor, altitude_m: Tensor, width_px: int) -> Tensor:
        """Derivatives (N, h, w, 2, 6) of flows with respect to the motion.

        The motion is translation and rotation vector, in units of their spreads. The model is the flow of a plane
        perpendicular to the view, to first order in the motion (Longuet-Higgins & Prazdny 1980, doi
        10.1098/rspb.1980.0057). It neglects the nominal step compared with the altitude.
        """
        focal_px = self.focal_over_width * width_px
        over_altitude = torch.stack([1 / altitude_m] * 3 + [torch.ones_like(altitude_m)] * 3, dim=-1)
        unit = focal_px * self.unit * over_altitude
        # Convert to `int`, because an exporter would make the sizes part of the graph.
        rows, columns = (int(size) for size in flow_px.shape[1:3])
        return self.plane_flow(rows, columns, width_px) * unit[:, None, None, None]

    def solved(self, normal: Tensor, right: Tensor) -> Tensor:
        """Solutions (N, 6) of equations (N, 6, 6), (N, 6). Exports to formats without this operator replace it."""
        # `solve` looks for singular matrices and so makes the process wait for the GPU. The prior excludes them.
        return torch.linalg.solve_ex(normal, right)[0]

    def plane_flow(self, rows: int, columns: int, width_px: int) -> Tensor:
        """Derivatives (rows, columns, 2, 6) of flow / focal length with respect to the motion.

        The motion is translation / altitude, then the rotation vector.
        """
        focal = self.focal_over_width * width_px / self.STRIDE
        x = ((torch.arange(columns, device=self.unit.device) + 0.5 - columns / 2) / focal).expand(rows, columns)
        y = ((torch.arange(rows, device=self.unit.device) + 0.5 - rows / 2) / focal)[:, None].expand(rows, columns)
        zero, ones = torch.zeros_like(x), torch.ones_like(x)
        along_x = torch.stack([-ones, zero, x, -x * y, 1 + x * x, -y], dim=-1)
        along_y = torch.stack([zero, -ones, y, -1 - y * y, x * y, x], dim=-1)
        return torch.stack([along_x, along_y], dim=-2)


def blurred(images: Tensor, size_px: int) -> Tensor:
    """Box blur of images (N, C, H, W): means over squares of `size_px` (odd), which are cropped at the edge."""
    half = size_px // 2
    rows = functional.avg_pool2d(images, (size_px, 1), stride=1, padding=(half, 0), count_include_pad=False)
    return functional.avg_pool2d(rows, (1, size_px), stride=1, padding=(0, half), count_include_pad=False)


def slope(images: Tensor, dim: int) -> Tensor:
    """Central differences along a dimension, one-sided at its ends: `torch.gradient`, which ONNX does not have."""
    n = images.shape[dim]
    inner = (images.narrow(dim, 2, n - 2) - images.narrow(dim, 0, n - 2)) / 2
    first = images.narrow(dim, 1, 1) - images.narrow(dim, 0, 1)
    last = images.narrow(dim, n - 1, 1) - images.narrow(dim, n - 2, 1)
    return torch.cat([first, inner, last], dim=dim)


def local_shift(pair: Tensor, window_px: int = 25) -> Tensor:
    """Local shifts (N, 2, H, W), pixels along x and y, from the first to the second of two images (N, 2, H, W).

    For a square window around each pixel, one least-squares step (Lucas & Kanade 1981) explains the change of
    brightness by the gradient. The step is damped where gradients are small. The result is valid for shifts smaller
    than the finest features of the images.
    """
    mean = pair.mean(1, keepdim=True)
    grad_y, grad_x = slope(mean, 2), slope(mean, 3)
    change = pair[:, :1] - pair[:, 1:]
    products = [grad_x * grad_x, grad_y * grad_y, grad_x * grad_y, grad_x * change, grad_y * change]
    xx, yy, xy, x_change, y_change = blurred(torch.cat(products, dim=1), window_px).split(1, dim=1)
    damping = 0.02 * (xx + yy) + 1e-4
    xx, yy = xx + damping, yy + damping
    shift = torch.cat([yy * x_change - xy * y_change, xx * y_change - xy * x_change], dim=1) / (xx * yy - xy * xy)
    return shift.clamp(-8, 8)
