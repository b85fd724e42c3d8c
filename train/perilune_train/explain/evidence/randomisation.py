"""Compare masks before and after weights are randomised.

This is the sanity check of Adebayo et al. 2018, arXiv 1810.03292.
"""

import copy
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, Protocol

import cv2
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.stats import rankdata
from torch import nn

from perilune_shared.geometry.frames import Array
from perilune_train.explain.correlation.pearson import is_constant, pearson_rows
from perilune_train.explain.maps.masks import Masks
from perilune_train.models.darknet import AttentionDarknet53

Direction = Literal["top_down", "bottom_up"]


class WithBackbone(Protocol):
    """A network with an attention backbone."""

    backbone: AttentionDarknet53
    """The backbone."""


GRID_PX = 64
"""Largest width, pixels, at which masks are compared."""
_SIGMA_PX, _WINDOW_PX = 1.5, 11
_K1, _K2 = 0.01, 0.03


def cascade(
    backbone: AttentionDarknet53,
    direction: Direction,
    rng_seed: int,
    run: Callable[[AttentionDarknet53], object] | None = None,
) -> Iterator[tuple[str, AttentionDarknet53]]:
    """Yield the name of each step and a copy of the backbone, with more stages randomised at each step.

    "top_down" randomises stage 5, then stages 5 and 4, and so on, as in Adebayo et al. "bottom_up" randomises the stem
    and stage 1, then also stage 2, and so on. Steps have names such as "stages 4-5" and "stages 1-2"; the last step of
    each direction is "all". A stage includes its attention gates. The copies are in evaluation mode. The original and
    the random state of PyTorch are unchanged.

    A mask depends only on the stages up to its gate. Top-down randomisation therefore does not change masks of lower
    stages. The bottom-up cascade is more informative: it shows whether deep masks need the trained features of lower
    stages. (In Adebayo et al., saliency maps come from gradients, which pass through all layers.)

    All weights, also those of attention gates, are drawn with the default initialisation of PyTorch's layers. In an
    untrained network of the form cbam_identity, the attention weights are zero; its masks would be constant and have no
    similarity to compare.

    `run` passes images through a backbone. With `run`, the batch norms of randomised stages get the statistics of these
    images (`calibrate`). Without `run`, they have mean 0 and variance 1, and deep gates of the form cbam are constant.
    """
    changed = copy.deepcopy(backbone).eval()
    parts: list[nn.Module] = []
    count = len(changed.downs)
    order = range(count, 0, -1) if direction == "top_down" else range(1, count + 1)
    for step, stage in enumerate(order, start=1):
        with torch.random.fork_rng(devices=[]):
            # Each stage has a separate seed, so that both directions draw equal weights for a stage.
            torch.manual_seed(int(np.random.SeedSequence([rng_seed, stage]).generate_state(1)[0]))
            for part in _parts(changed, stage):
                _reset(part)
                parts.append(part)
        if run is not None:
            calibrate(changed, parts, run)
        low, high = min(order[0], stage), max(order[0], stage)
        name = "all" if step == count else f"stages {low}-{high}" if low < high else f"stage {stage}"
        yield name, copy.deepcopy(changed)


def calibrate(
    backbone: AttentionDarknet53, parts: Sequence[nn.Module], run: Callable[[AttentionDarknet53], object]
) -> None:
    """Set mean and variance of the batch norms in `parts` from the images that `run` passes through the backbone.

    The statistics of several batches are averaged. Afterwards the batch norms are in evaluation mode.
    """
    norms = [module for part in parts for module in part.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.train()
        norm.momentum = None
    with torch.no_grad():
        run(backbone)
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.eval()
        norm.momentum = momentum


def similarity(trained: Masks, other: Masks, step: str = "") -> pd.DataFrame:
    """Similarity of each gate's masks (N, height, width) to the trained masks.

    Columns: map, step, spearman, ssim. The last two are means over the images with defined values.

    - spearman: Spearman's rank correlation over pixels; undefined if one of the masks is constant.
    - ssim: mean structural similarity (Wang et al. 2004, doi 10.1109/TIP.2003.819861), with the range of the trained
      mask as dynamic range; undefined if the trained mask is constant. Deviation: masks wider than 64 px are first
      averaged to a width of 64 px, the resolution of stage 2 for frames of 256 px.
    """
    rows = []
    for name, trained_maps in trained.items():
        a, b = _small(trained_maps), _small(other[name])
        ranks = [np.stack([rankdata(values) for values in maps.reshape(len(maps), -1)]) for maps in (a, b)]
        spearman = pearson_rows(*ranks)
        # Test the values, since ranks of rounding errors are not constant.
        spearman[[is_constant(x) or is_constant(y) for x, y in zip(a, b, strict=True)]] = np.nan
        ssim = np.array([_ssim(x, y) for x, y in zip(a, b, strict=True)])
        rows.append({"map": name, "step": step, "spearman": _mean(spearman), "ssim": _mean(ssim)})
    return pd.DataFrame(rows, columns=["map", "step", "spearman", "ssim"])


def randomised(
    network: WithBackbone, masks_of: Callable[[NDArray[np.uint8]], Masks], images: NDArray[np.uint8], seed: int
) -> pd.DataFrame:
    """Similarity of a network's masks to the masks under both cascades of random weights.

    Columns: direction, step, map, spearman, ssim. `masks_of` returns the masks of `network` for images. The backbone of
    `network` is replaced while `masks_of` is called, and restored at the end. The batch norms of randomised stages get
    the statistics of `images`.
    """
    trained, backbone, tables = masks_of(images), network.backbone, []

    def run(changed: AttentionDarknet53) -> None:
        network.backbone = changed
        masks_of(images)

    directions: tuple[Direction, ...] = ("top_down", "bottom_up")
    try:
        for direction in directions:
            for step, changed in cascade(backbone, direction, seed, run):
                network.backbone = changed
                tables.append(similarity(trained, masks_of(images), step).assign(direction=direction))
    finally:
        network.backbone = backbone
    return pd.concat(tables, ignore_index=True)


def _parts(backbone: AttentionDarknet53, stage: int) -> list[nn.Module]:
    """The modules of a stage, 1 to 5; stage 1 includes the stem."""
    stage_modules = [
        modules[name] for modules in (backbone.units, backbone.attentions) for name in _names(modules, stage)
    ]
    return [*([backbone.stem] if stage == 1 else []), backbone.downs[stage - 1], *stage_modules]


def _names(modules: nn.ModuleDict, stage: int) -> list[str]:
    return [name for name in modules if name.startswith(f"B_{stage}")]


def _reset(part: nn.Module) -> None:
    for module in part.modules():
        if isinstance(module, nn.Conv2d | nn.Linear | nn.BatchNorm2d):
            module.reset_parameters()


def _small(maps: NDArray[np.floating]) -> Array:
    """Maps (N, height, width) as float64, averaged to a width of at most 64 px."""
    height, width = maps.shape[1:]
    if width <= GRID_PX:
        return maps.astype(np.float64)
    size = GRID_PX, max(1, round(height * GRID_PX / width))
    return np.stack([cv2.resize(map_.astype(np.float64), size, interpolation=cv2.INTER_AREA) for map_ in maps])


def _ssim(a: Array, b: Array) -> float:
    """Mean structural similarity of two maps; dynamic range of `a`, edges mirrored; NaN if `a` is constant."""
    if is_constant(a):
        return float("nan")

    def local_mean(values: Array) -> Array:
        smooth = cv2.GaussianBlur(values, (_WINDOW_PX, _WINDOW_PX), _SIGMA_PX, borderType=cv2.BORDER_REFLECT_101)
        return np.asarray(smooth, np.float64)

    c1, c2 = ((k * np.ptp(a)) ** 2 for k in (_K1, _K2))
    mean_a, mean_b = local_mean(a), local_mean(b)
    variance_a, variance_b = local_mean(a * a) - mean_a**2, local_mean(b * b) - mean_b**2
    covariance = local_mean(a * b) - mean_a * mean_b
    levels = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structures = (2 * covariance + c2) / (variance_a + variance_b + c2)
    return float(np.mean(levels * structures))


def _mean(values: Array) -> float:
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")
