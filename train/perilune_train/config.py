"""Types and settings that the sections `detect`, `navigate` and `explain` share."""

from typing import Annotated, Literal

from pydantic import Field

from perilune_shared.config.resolve import Section

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


class ServerConfig(Section):
    """Settings of an image server, `perilune-render serve`, that renders samples during training. A sample is a
    sequence of the navigator or a frame of the detector."""

    address: Annotated[str, Field(min_length=1, max_length=300)]
    """Address of the server's interface for `perilune_shared.client`, such as tcp://127.0.0.1:10364."""
    n_scenes: Annotated[int, Field(ge=1, lt=2**31)] = 1000
    """Number of scenes. Training uses the server's scenes 1 to n_scenes in turn. The server also has a scene 0, so
    start it with `--scenes` n_scenes + 1."""
    share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Fraction of the samples of an epoch that are rendered; the others come from the dataset."""
    seed: Seed = 0
    """Random seed of the poses and the noise of rendered samples."""
    timeout_s: Annotated[float, Field(gt=0, le=100_000)] = 60.0
    """Longest time to wait for a reply from the server, seconds."""
