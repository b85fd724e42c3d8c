"""Settings of `perilune-train explain`."""

from typing import Annotated

from pydantic import Field

from perilune_shared.config.resolve import Section
from perilune_train.config import Device, Seed

_Several = Annotated[int, Field(ge=2, le=100_000)]
_Factor = Annotated[float, Field(gt=0, le=100)]


class ExplainConfig(Section):
    """The section `explain`."""

    seed: Seed = 0
    """Random seed for nulls, intervals, controls and untrained networks."""
    n_frames: _Several = 32
    """Number of test frames, evenly spaced through the split, for correlations."""
    n_pairs: _Several = 48
    """Number of test pairs for correlations. Only whole runs of at most 8 consecutive pairs are used, at least one."""
    n_validation: _Several = 16
    """Number of validation frames, and of validation pairs. The expected sign of each correlation, and the gate whose
    pixels are removed, are chosen on them."""
    n_changed: _Several = 16
    """Number of the `n_frames` test frames that interventions use: gates forced, pixels removed, weights randomised."""
    n_changed_pairs: _Several = 24
    """Number of the `n_pairs` test pairs that interventions use."""
    n_attributed: Annotated[int, Field(ge=1, le=100_000)] = 4
    """Number of the `n_frames` test frames that Grad-CAM, integrated gradients and occlusion use."""
    n_drawn: Annotated[int, Field(ge=1, le=8)] = 3
    """Number of frames, and of pairs, whose masks are drawn, evenly spaced from the highest to the lowest altitude."""
    removed_share: Annotated[float, Field(gt=0, lt=0.5)] = 0.2
    """Share of the pixels of an image that are removed (replaced)."""
    integration_steps: Annotated[int, Field(ge=1, le=10_000)] = 8
    """Number of integration points of integrated gradients."""
    occlusion_px: Annotated[int, Field(ge=8, le=4096)] = 32
    """Side and stride of the square that occlusion sets to grey, pixels."""
    ring_factors: tuple[_Factor, _Factor, _Factor, _Factor] = (1.1, 1.2, 1.3, 1.4)
    """alpha_1 to alpha_4: outer radii of the grey rings in the ground-truth mask, divided by the crater's radius."""
    device: Device = "auto"
    """Where to compute: auto (the GPU if there is one), cpu or cuda."""
