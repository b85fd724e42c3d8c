"""YOLOv3 (Redmon & Farhadi 2018, arXiv 1804.02767) with one class, on the attention backbone."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from perilune_train.config import Attention
from perilune_train.models.darknet import AttentionDarknet53, conv_block, scaled
from perilune_train.models.ellipse import EllipseTower, decode_correlation, decode_sigmas

ANCHORS_PER_SCALE = 3
OUTPUTS = 5
"""x, y, width, height, objectness."""
_STRIDES = (2, 4, 8, 16, 32)
_MAX_LOG_SCALE = 4.0
_POOLED_STAGES = 2
"""Number of the backbone's stages whose maps are features of an image."""
_PRIOR = 0.01
"""Initial crater probability of every cell, so that the many empty cells do not dominate the first steps."""


class YOLOv3(nn.Module):
    """Backbone, top-down neck, and a head on each of three consecutive strides.

    A cell predicts, for each of its 3 anchors, raw numbers (t_x, t_y, t_w, t_h, t_o); `decode` converts them to boxes.

    Deviations from the original: There are no class outputs, because craters are the only class; the score is the
    objectness. The heads may be on strides 4, 8, 16 instead of 8, 16, 32, since half of all craters are narrower than
    6 px. The neck then still starts at stride 32, with one 1 x 1 convolution. `width` scales backbone and neck.

    With `ellipses`, a tower on the backbone predicts 5 further numbers per anchor: the shape of the ellipse in the box,
    and standard deviations (models/ellipse.py). The first 5 numbers and their weights do not change.
    """

    anchors: Tensor

    def __init__(
        self,
        anchors: Tensor | None = None,
        in_channels: int = 3,
        width: float = 1.0,
        attention: Attention = "none",
        strides: Sequence[int] = (8, 16, 32),
        ellipses: bool = False,
    ):
        """`anchors` (3, 3, 2) are widths and heights in pixels, finest stride first; None if they are loaded later."""
        super().__init__()
        if tuple(strides) not in ((8, 16, 32), (4, 8, 16)):
            raise ValueError(f"strides are {tuple(strides)}, not (8, 16, 32) or (4, 8, 16)")
        self.strides = tuple(strides)
        self.register_buffer("anchors", torch.ones(3, ANCHORS_PER_SCALE, 2) if anchors is None else anchors.float())
        self.backbone = AttentionDarknet53(in_channels, width, attention)
        self.branches, self.heads, self.laterals = nn.ModuleDict(), nn.ModuleDict(), nn.ModuleDict()
        above, joined = 0, {}
        for stride in _STRIDES[:0:-1]:
            if stride < self.strides[0]:
                break
            inputs = self.backbone.channels[_STRIDES.index(stride)] + above
            channels = scaled(16 * stride, width)
            if stride in self.strides:
                self.branches[str(stride)] = nn.Sequential(
                    conv_block(inputs, channels, 1),
                    conv_block(channels, 2 * channels, 3),
                    conv_block(2 * channels, channels, 1),
                    conv_block(channels, 2 * channels, 3),
                    conv_block(2 * channels, channels, 1),
                )
                self.heads[str(stride)] = nn.Sequential(conv_block(channels, 2 * channels, 3), _output(2 * channels))
                joined[stride] = channels + self.backbone.channels[_STRIDES.index(stride)]
                inputs = channels
            if stride > self.strides[0]:
                above = channels // 2
                self.laterals[str(stride)] = nn.Sequential(conv_block(inputs, above, 1), nn.Upsample(scale_factor=2))
        # Create these layers last, so that all other initial weights are the same with and without ellipses.
        self.ellipse_tower: EllipseTower | None = None
        if ellipses:
            below = self.backbone.channels[_STRIDES.index(self.strides[0]) - 1]
            joined_channels = [joined[stride] for stride in self.strides]
            self.ellipse_tower = EllipseTower(self.strides, below, joined_channels, ANCHORS_PER_SCALE)

    @property
    def n_features(self) -> int:
        """Number of features of an image that `detect_with_features` returns."""
        branches = [branch[-1].conv.out_channels for branch in self.branches.values()]  # type: ignore[index]
        return sum([*self.backbone.channels[:_POOLED_STAGES], *branches])

    @property
    def ellipses(self) -> bool:
        """Whether the network predicts ellipses with standard deviations."""
        return self.ellipse_tower is not None

    def forward(self, images: Tensor) -> list[Tensor]:
        """Convert images (N, in_channels, H, W) to raw outputs in float32, finest stride first.

        The outputs of a scale are (N, 3 anchors, h, w, 5), or (N, 3, h, w, 10) with ellipses. H and W must be multiples
        of 32.
        """
        return self._outputs(self.backbone(images))

    def outputs_and_masks(self, images: Tensor) -> tuple[list[Tensor], dict[str, Tensor]]:
        """The result of `forward`, and the spatial attention masks "B_ij" (N, 1, h, w)."""
        features, masks = self.backbone.features_and_masks(images)
        return self._outputs(features), masks

    def _outputs(self, features: list[Tensor], pooled: list[Tensor] | None = None) -> list[Tensor]:
        """Raw outputs of the backbone's features; appends the mean features (N, C) of each branch to `pooled`."""
        outputs: list[Tensor] = []
        above, maps = None, {}
        for index in range(len(_STRIDES) - 1, _STRIDES.index(self.strides[0]) - 1, -1):
            stride = str(_STRIDES[index])
            x = features[index] if above is None else torch.cat([above, features[index]], dim=1)
            if stride in self.branches:
                x = self.branches[stride](x)
                if pooled is not None:
                    pooled.append(x.float().mean((2, 3)))
                maps[stride] = features[index], x
                outputs.insert(0, _per_anchor(self.heads[stride](x)).float())
            if stride in self.laterals:
                above = self.laterals[stride](x)
        if self.ellipse_tower is None:
            return outputs
        below = features[_STRIDES.index(self.strides[0]) - 1]
        shapes = self.ellipse_tower(below, maps).values()
        return [torch.cat([raw, _per_anchor(shape).float()], -1) for raw, shape in zip(outputs, shapes, strict=True)]

    @torch.no_grad()
    def detect(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes (N, K, 4) and scores (N, K) of all K predictors, before non-maximum suppression.

        A box is x0, y0, x1, y1 in pixels.
        """
        boxes, scores, _ = self.detect_ellipses(images)
        return boxes, scores

    @torch.no_grad()
    def detect_ellipses(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Boxes (N, K, 4), scores (N, K) and shapes (N, K, 5) as from `detect`.

        A shape is the correlation of the ellipse in the box and four standard deviations: of the centre's x and y and
        of the semi-major and the semi-minor axis, pixels. None if the network predicts no ellipses.
        """
        return self._decoded(self(images))

    @torch.no_grad()
    def detect_with_features(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
        """The result of `detect_ellipses`, and features (N, F) of the images, from the same forward pass.

        The features are means over the image: of the backbone's maps at strides 2 and 4, and of the maps from which the
        three heads predict.
        """
        maps = self.backbone(images)
        pooled = [part.float().mean((2, 3)) for part in maps[:_POOLED_STAGES]]
        outputs = self._outputs(maps, pooled)
        return *self._decoded(outputs), torch.cat(pooled, dim=1)

    def _decoded(self, outputs: list[Tensor]) -> tuple[Tensor, Tensor, Tensor | None]:
        """Boxes, scores and shapes of raw outputs, as from `detect_ellipses`."""
        boxes, scores, shapes = [], [], []
        for raw, anchors, stride in zip(outputs, self.anchors, self.strides, strict=True):
            boxes.append(decode_grid(raw, anchors, stride).flatten(1, 3))
            scores.append(raw[..., 4].sigmoid().flatten(1))
            if self.ellipses:
                shapes.append(decode_shapes(raw[..., OUTPUTS:].flatten(1, 3), boxes[-1]))
        return torch.cat(boxes, 1), torch.cat(scores, 1), torch.cat(shapes, 1) if shapes else None


def _per_anchor(output: Tensor) -> Tensor:
    """Convert the output (N, 3 x numbers, h, w) of a layer to (N, 3, h, w, numbers)."""
    n, channels, h, w = output.shape
    return output.view(n, ANCHORS_PER_SCALE, channels // ANCHORS_PER_SCALE, h, w).permute(0, 1, 3, 4, 2)


def _output(channels: int) -> nn.Conv2d:
    """Last layer of a head. Its initial boxes are the anchors; its initial objectness is `_PRIOR`."""
    layer = nn.Conv2d(channels, ANCHORS_PER_SCALE * OUTPUTS, 1)
    nn.init.normal_(layer.weight, std=0.01)
    bias = torch.zeros(ANCHORS_PER_SCALE, OUTPUTS)
    bias[:, 4] = math.log(_PRIOR / (1 - _PRIOR))
    layer.bias = nn.Parameter(bias.flatten())
    return layer


def decode(raw: Tensor, cells: Tensor, anchors: Tensor, stride: int) -> Tensor:
    """Convert raw outputs (..., 4 or more) to boxes (..., 4), x0, y0, x1, y1 in pixels.

    `cells` (..., 2) are column and row of the predicting cell, `anchors` (..., 2) width and height in pixels. The
    centre is (cell + 2 s(t) - 0.5) stride with the sigmoid s; the size is anchor exp(t). YOLOv3 has cell + s(t)
    instead. Here the centre can be up to half a cell outside the cell, because neighbouring cells are also trained on
    a crater (detect/data/assign.py).
    """
    centre = (cells + 2 * raw[..., :2].sigmoid() - 0.5) * stride
    half = anchors * raw[..., 2:4].clamp(-_MAX_LOG_SCALE, _MAX_LOG_SCALE).exp() / 2
    return torch.cat([centre - half, centre + half], dim=-1)


def decode_shapes(raw: Tensor, boxes: Tensor) -> Tensor:
    """Convert ellipse outputs (..., 5) with boxes (..., 4) to correlations and standard deviations (..., 5)."""
    return torch.cat([decode_correlation(raw)[..., None], decode_sigmas(raw, boxes)], dim=-1)


def decode_grid(raw: Tensor, anchors: Tensor, stride: int) -> Tensor:
    """Convert the raw outputs (N, 3, h, w, 5 or more) of one scale, with anchors (3, 2), to boxes (N, 3, h, w, 4)."""
    h, w = raw.shape[2:4]
    rows, columns = torch.meshgrid(
        torch.arange(h, device=raw.device), torch.arange(w, device=raw.device), indexing="ij"
    )
    return decode(raw, torch.stack([columns, rows], dim=-1), anchors[:, None, None, :], stride)
