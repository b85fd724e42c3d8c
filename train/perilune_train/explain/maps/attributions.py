"""Compute attribution maps of the detector by Grad-CAM, integrated gradients and occlusion (Captum).

All maps are float32 (N, height, width), as large as the frames. Frames must be normalised, so that 0 is the mean grey
of each frame. The baseline of integrated gradients and of occlusion is 0.
"""

from typing import Protocol

import cv2
import numpy as np
import torch
from captum.attr import IntegratedGradients, LayerGradCam, Occlusion
from numpy.typing import NDArray
from torch import Tensor, nn

from perilune_train.detect.data.batches import network_input
from perilune_train.models.darknet import UNITS, AttentionDarknet53
from perilune_train.models.yolo import YOLOv3


class DetectorTarget(nn.Module):
    """Module that sums the objectness of the predictors that score at least `min_score` on the unchanged image.

    The best predictor of an image is always in the sum. The network must be in evaluation mode.
    """

    def __init__(self, network: YOLOv3, min_score: float = 0.5):
        super().__init__()
        _check_evaluation(network)
        self.network, self.min_score = network, min_score
        self.in_channels = next(network.backbone.parameters()).shape[1]

    @property
    def backbone(self) -> AttentionDarknet53:
        """The network's backbone."""
        return self.network.backbone

    @property
    def last_layer(self) -> nn.Module:
        """The layer before the head of the finest stride, the default layer of Grad-CAM."""
        return self.network.branches[str(self.network.strides[0])]

    def scores(self, grey: Tensor) -> Tensor:
        """Objectness (N, K) of all K predictors for grey images (N, 1, height, width)."""
        outputs = self.network(network_input(grey[:, 0], self.in_channels))
        return torch.cat([raw[..., 4].sigmoid().flatten(1) for raw in outputs], dim=1)

    @torch.no_grad()
    def fixed(self, grey: Tensor) -> tuple[Tensor, ...]:
        """Mask (N, K) of the predictors in the sum. Keep this mask while the images are changed."""
        scores = self.scores(grey)
        return ((scores >= self.min_score) | (scores == scores.amax(1, keepdim=True)),)

    def forward(self, grey: Tensor, *fixed: Tensor) -> Tensor:
        """Sums (N,) for normalised grey images (N, 1, height, width)."""
        return (self.scores(grey) * fixed[0]).sum(1)


def last_of_stage(backbone: AttentionDarknet53, stage: int) -> nn.Module:
    """Last residual unit of a stage 1..5 of a backbone, or the attention gate after this unit if there is one."""
    name = f"B_{stage}{UNITS[stage - 1]}"
    return backbone.attentions[name] if name in backbone.attentions else backbone.units[name]


def grad_cam(target: DetectorTarget, frames: NDArray[np.float32], stage: int | None = None) -> NDArray[np.float32]:
    """Grad-CAM (N, height, width) of normalised frames, on the last layer of a stage 1..5, resized to the frames.

    Selvaraju et al. 2017, doi 10.1109/ICCV.2017.74, with their ReLU. Without a stage, the layer is `target.last_layer`.
    A map is zero everywhere if every weighted sum is negative; this happens on stage 2 of the installed detector.
    """
    method = LayerGradCam(target, target.last_layer if stage is None else last_of_stage(target.backbone, stage))

    def attribution(grey: Tensor, fixed: tuple[Tensor, ...]) -> Tensor:
        return method.attribute(grey, additional_forward_args=fixed, relu_attributions=True)

    return _each(target, frames, attribution)


def integrated_gradients(
    target: DetectorTarget, frames: NDArray[np.float32], n_steps: int = 16, signed: bool = False
) -> NDArray[np.float32]:
    """Absolute integrated gradients (N, height, width) of normalised frames.

    Sundararajan et al. 2017, arXiv 1703.01365, by Gauss-Legendre quadrature with `n_steps` points on the path from mean
    grey to the frame. With `signed` the sign is kept, and the sum over pixels is the change of the target along this
    path.
    """
    method = IntegratedGradients(target)

    def attribution(grey: Tensor, fixed: tuple[Tensor, ...]) -> Tensor:
        gradients = method.attribute(grey, additional_forward_args=fixed, n_steps=n_steps, internal_batch_size=_BATCH)
        return gradients if signed else gradients.abs()

    return _each(target, frames, attribution)


def occlusion(
    target: DetectorTarget, frames: NDArray[np.float32], window_px: int = 16, stride_px: int = 16
) -> NDArray[np.float32]:
    """Decrease of the target (N, height, width) where a square window of normalised frames is set to mean grey.

    Zeiler & Fergus 2014, doi 10.1007/978-3-319-10590-1_53. The value at a pixel is the mean over the windows that
    contain it.
    """
    method = Occlusion(target)

    def attribution(grey: Tensor, fixed: tuple[Tensor, ...]) -> Tensor:
        return method.attribute(
            grey,
            sliding_window_shapes=(1, window_px, window_px),
            strides=(1, stride_px, stride_px),
            additional_forward_args=fixed,
            perturbations_per_eval=_BATCH,
        )

    return _each(target, frames, attribution)


_BATCH = 8
"""Number of images that pass through the network in one batch."""


class _Method(Protocol):
    def __call__(self, grey: Tensor, fixed: tuple[Tensor, ...]) -> Tensor: ...


def _each(target: DetectorTarget, frames: NDArray[np.float32], method: _Method) -> NDArray[np.float32]:
    """Apply `method` to one frame after the other; returns the maps (N, height, width), resized to the frames."""
    device = next(target.backbone.parameters()).device
    height, width = frames.shape[1:]
    maps = np.empty(frames.shape, np.float32)
    for i, frame in enumerate(frames):
        grey = torch.from_numpy(frame)[None, None].to(device)
        attribution = method(grey, target.fixed(grey))[0, 0].detach().float().cpu().numpy()
        maps[i] = cv2.resize(attribution, (width, height), interpolation=cv2.INTER_LINEAR)
    return maps


def _check_evaluation(network: nn.Module) -> None:
    if network.training:
        raise ValueError("the network is in training mode, expected evaluation mode")
