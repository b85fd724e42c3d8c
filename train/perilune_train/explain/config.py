"""Settings of `perilune-train explain`."""

from typing import Annotated

from pydantic import Field

from perilune_shared.config import Section
from perilune_train.config import Device


class ExplainConfig(Section):
    """The section `explain`."""

    n_frames: Annotated[int, Field(ge=2)] = 32
    """Number of test frames, evenly spaced through the split, over which PCC1 and PCC2 are averaged."""
    n_pairs: Annotated[int, Field(ge=2)] = 32
    """Number of test pairs, evenly spaced, over which PCC3 and PCC4 are averaged."""
    n_drawn: Annotated[int, Field(ge=1, le=8)] = 3
    """Number of frames and of pairs whose masks are drawn."""
    ring_factors: tuple[float, float, float, float] = (1.1, 1.2, 1.3, 1.4)
    """alpha_1 to alpha_4: outer radii of the grey rings in the ground-truth mask, divided by the crater's radius."""
    device: Device = "auto"
    """Where to compute: auto (the GPU if there is one), cpu or cuda."""
