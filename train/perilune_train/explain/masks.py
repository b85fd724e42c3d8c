"""Spatial attention masks of the trained networks, and their pictures."""

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_train.data.frames import normalised
from perilune_train.evaluation.pictures import save_image
from perilune_train.explain.correlation import is_constant
from perilune_train.models.darknet import AttentionDarknet53
from perilune_train.models.navigator import StackNavigator
from perilune_train.models.yolo import YOLOv3

Masks = dict[str, NDArray[np.float32]]
"""Block "B_ij" to masks (N, height, width) of N images, resized to the size of the frames."""

_BATCH = 8
_CELL_PX = 160
_COLUMNS = 8
_WHITE = (255, 255, 255)


def detector_masks(detector: YOLOv3, images: NDArray[np.uint8], where: Path) -> Masks:
    """Attention masks (N, height, width) of the detector for frames (N, height, width)."""
    backbone = detector.backbone
    channels = next(backbone.parameters()).shape[1]
    device = next(backbone.parameters()).device

    def network_input(part: NDArray) -> torch.Tensor:
        return torch.from_numpy(normalised(part))[:, None].expand(-1, channels, -1, -1).to(device)

    return _collected(
        backbone,
        [network_input(images[i : i + _BATCH]) for i in range(0, len(images), _BATCH)],
        images.shape[1:],
        where,
    )


def navigator_masks(
    navigator: StackNavigator,
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    size: tuple[int, int],
    where: Path,
) -> Masks:
    """Masks (N, 2 height, width) of stacked pairs, from normalised frames (N, h, w); `size` is height and width."""
    device = next(navigator.parameters()).device
    inputs = [
        navigator.stacked(
            torch.from_numpy(first[None, i : i + _BATCH]).to(device),
            torch.from_numpy(second[None, i : i + _BATCH]).to(device),
        )
        for i in range(0, len(first), _BATCH)
    ]
    return _collected(navigator.backbone, inputs, (2 * size[0], size[1]), where)


def _collected(backbone: AttentionDarknet53, inputs: list[torch.Tensor], size: tuple[int, ...], where: Path) -> Masks:
    masks: dict[str, list[np.ndarray]] = {}
    with torch.no_grad():
        for batch in inputs:
            for name, mask in backbone.attention_masks(batch).items():
                own = mask[:, 0].float().cpu().numpy()
                masks.setdefault(name, []).extend(cv2.resize(m, size[::-1]) for m in own)
    if not masks:
        raise UserError(where, "attention", "none", "a checkpoint of a network with attention, cbam or cbam_identity")
    return {name: np.stack(found) for name, found in masks.items()}


def draw_masks(path: Path, images: NDArray[np.uint8], masks: Masks) -> None:
    """Draw a PNG sheet: for each image (N, height, width) the frame, then every block's mask, then a colour bar.

    All masks of the sheet share one scale, from the smallest to the largest value. Below each mask is its own range, or
    "constant" if it does not vary.
    """
    low = min(float(found.min()) for found in masks.values())
    high = max(float(found.max()) for found in masks.values())
    sheet = []
    for n, image in enumerate(images):
        height = round(_CELL_PX * image.shape[0] / image.shape[1])
        grey = np.clip(image / max(1.0, float(np.percentile(image, 99.5))) * 255, 0, 255).astype(np.uint8)
        frame = cv2.cvtColor(cv2.resize(grey, (_CELL_PX, height), interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
        cells = [_labelled(frame, "frame")]
        for name, found in masks.items():
            mask = cv2.resize(found[n], (_CELL_PX, height))
            cells.append(_labelled(_coloured(mask, low, high), caption(name, found[n])))
        cells += [np.full_like(cells[0], 255)] * (-len(cells) % _COLUMNS)
        sheet += [np.hstack(cells[i : i + _COLUMNS]) for i in range(0, len(cells), _COLUMNS)]
    sheet.append(_colour_bar(sheet[0].shape[1], low, high))
    save_image(path, np.vstack(sheet))


def caption(block: str, mask: NDArray[np.floating]) -> str:
    """A block's name with the range of its mask, or with "constant" and the value."""
    own = f"constant {mask.mean():.3f}" if is_constant(mask) else f"{mask.min():.3f}-{mask.max():.3f}"
    return f"{block} {own}"


def _coloured(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """Convert values to colours of the sheet's scale, (height, width, 3) BGR."""
    level = np.clip(255 * (values - low) / max(high - low, 1e-9), 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_TURBO), np.uint8)


def _colour_bar(width_px: int, low: float, high: float) -> NDArray[np.uint8]:
    """Colour bar of the sheet's scale with five values below it, as wide as the sheet."""
    margin = 40
    bar = np.tile(np.linspace(low, high, width_px - 2 * margin), (16, 1))
    picture = cv2.copyMakeBorder(_coloured(bar, low, high), 10, 24, margin, margin, cv2.BORDER_CONSTANT, value=_WHITE)
    for value in np.linspace(low, high, 5):
        x = margin + (value - low) / max(high - low, 1e-9) * (width_px - 2 * margin)
        cv2.putText(
            picture, f"{value:.2f}", (int(x) - 16, 44), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA
        )
    cv2.putText(picture, "gate", (2, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def _labelled(picture: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """The picture with a line of text below and a white margin."""
    framed = cv2.copyMakeBorder(picture, 2, 18, 2, 2, cv2.BORDER_CONSTANT, value=_WHITE)
    cv2.putText(framed, text, (4, framed.shape[0] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return framed
