"""Kinds of value that the sections `detect`, `navigate` and `explain` share."""

from typing import Annotated, Literal

from pydantic import Field

Attention = Literal["none", "cbam", "cbam_identity"]
"""none: plain Darknet53; cbam: the paper's gates; cbam_identity: gates that are exactly 1 at initialisation."""
Precision = Literal["auto", "bf16", "float32"]
"""auto: bfloat16 where the hardware has it."""
Device = Literal["auto", "cpu", "cuda"]
"""auto: the GPU where there is one."""
Strategy = Literal["auto", "ddp", "ddp_find_unused_parameters_true"]
"""auto: one process as it is, several by ddp, where some weights are frozen with unused parameters looked for."""
Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
