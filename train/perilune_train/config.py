"""Types that the sections `detect`, `navigate` and `explain` share."""

from typing import Annotated, Literal

from pydantic import Field

Attention = Literal["none", "cbam", "cbam_identity", "cbam_centred", "cbam_last"]
"""none: plain Darknet53; cbam: the paper's gates; cbam_identity: gates that are exactly 1 at initialisation;
cbam_centred: spatial gates between 0.5 and 1.5 that cannot become constant; cbam_last: the gates of cbam_centred, but
only after the last residual unit of each stage (5 gates instead of 23)."""
Precision = Literal["auto", "bf16", "float32"]
"""auto: bfloat16 if the hardware supports it."""
Device = Literal["auto", "cpu", "cuda"]
"""auto: the GPU if there is one."""
Strategy = Literal["auto", "ddp", "ddp_find_unused_parameters_true"]
"""Lightning's strategy for several processes. auto: ddp, with a search for unused parameters if some weights are
frozen. One process needs no strategy."""
Fraction = Annotated[float, Field(ge=0, le=1)]
Weight = Annotated[float, Field(gt=0, le=1e6)]
"""Weight of a part of a loss."""
Rate = Annotated[float, Field(gt=0, le=1000)]
"""Learning rate. Far below the upper bound, training already diverges and ends with an error message."""
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Epochs = Annotated[int, Field(ge=0, le=1_000_000)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
