"""Attention-Darknet53: Darknet53 (Redmon & Farhadi 2018, arXiv 1804.02767) with CBAM after every residual unit."""

from collections import OrderedDict
from typing import cast

from torch import Tensor, nn

from perilune_train.config import Attention
from perilune_train.models.attention import CBAM, Form

UNITS = (1, 2, 8, 8, 4)
"""Residual units in each stage."""
_STEM_CHANNELS = 32
_FORMS: dict[Attention, Form] = {
    "cbam": "plain",
    "cbam_identity": "identity",
    "cbam_centred": "centred",
    "cbam_last": "centred",
}


def scaled(channels: int, width: float) -> int:
    """Number of channels at a width factor: a multiple of 8, at least 8; unchanged at width 1."""
    return max(8, round(channels * width / 8) * 8)


def conv_block(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """The paper's CBL: convolution without bias, batch norm with Darknet's constants, leaky ReLU 0.1."""
    return nn.Sequential(
        OrderedDict(
            conv=nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            norm=nn.BatchNorm2d(outputs, eps=1e-5, momentum=0.1),
            act=nn.LeakyReLU(0.1, inplace=True),
        )
    )


class ResidualUnit(nn.Module):
    """x + f(x), where f is a 1 x 1 convolution to half the channels, then a 3 x 3 convolution back to all of them.

    Shape: (N, C, H, W) to (N, C, H, W).
    """

    def __init__(self, channels: int):
        super().__init__()
        self.reduce = conv_block(channels, channels // 2, 1)
        self.expand = conv_block(channels // 2, channels, 3)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.expand(self.reduce(x))


class AttentionDarknet53(nn.Module):
    """The backbone of all networks: the first `stages` of Darknet53's five stages.

    At width 1, with 3 input channels, 5 stages and no attention, it has 52 convolutions and 40,620,640 floats in
    Darknet's count (weights, and scale, bias, mean and variance of each batch norm). Names follow the paper: residual
    unit j of stage i is `units["B_ij"]`, and the CBAM after it is `attentions["B_ij"]`. The five stages have 1, 2, 8, 8
    and 4 units; i and j count from 1. The form cbam_last has a CBAM only after the last unit of each stage: B_11, B_22,
    B_38, B_48, B_54.

    Deviation from the original at widths other than 1: channels are rounded to multiples of 8.
    """

    def __init__(self, in_channels: int = 3, width: float = 1.0, attention: Attention = "none", stages: int = 5):
        super().__init__()
        if not 1 <= stages <= len(UNITS):
            raise ValueError(f"stages is {stages}, not 1 to {len(UNITS)}")
        self.channels = [scaled(_STEM_CHANNELS * 2**i, width) for i in range(1, stages + 1)]
        """Channels of the feature map after each stage. The strides of these maps are 2, 4, 8, 16, 32."""
        stem = scaled(_STEM_CHANNELS, width)
        self.stem = conv_block(in_channels, stem, 3)
        self.downs = nn.ModuleList(
            conv_block(before, after, 3, stride=2)
            for before, after in zip([stem, *self.channels], self.channels, strict=False)
        )
        self.units, self.attentions = nn.ModuleDict(), nn.ModuleDict()
        for i, channels in enumerate(self.channels):
            for j in range(UNITS[i]):
                name = f"B_{i + 1}{j + 1}"
                self.units[name] = ResidualUnit(channels)
                if attention != "none" and (attention != "cbam_last" or j == UNITS[i] - 1):
                    self.attentions[name] = CBAM(channels, form=_FORMS[attention])

    def forward(self, x: Tensor) -> list[Tensor]:
        """Convert images (N, in_channels, H, W) to one feature map per stage.

        Map i has the shape (N, channels[i], H / 2^(i+1), W / 2^(i+1)).
        """
        return self._run(x, None)

    def attention_masks(self, x: Tensor) -> dict[str, Tensor]:
        """Spatial attention masks "B_ij": (N, 1, h, w) of images (N, in_channels, H, W); empty without attention."""
        return self.features_and_masks(x)[1]

    def features_and_masks(self, x: Tensor) -> tuple[list[Tensor], dict[str, Tensor]]:
        """The results of `forward` and of `attention_masks`."""
        masks: dict[str, Tensor] = {}
        return self._run(x, masks), masks

    def _run(self, x: Tensor, masks: dict[str, Tensor] | None) -> list[Tensor]:
        features = []
        x = self.stem(x)
        for i, down in enumerate(self.downs):
            x = down(x)
            for j in range(UNITS[i]):
                name = f"B_{i + 1}{j + 1}"
                x = self.units[name](x)
                if name not in self.attentions:
                    continue
                cbam = cast(CBAM, self.attentions[name])
                if masks is None:
                    x = cbam(x)
                else:
                    masks[name], x = cbam.gated(x)
            features.append(x)
        return features
