"""Settings of `perilune-train navigate`."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from perilune_shared.config import Section
from perilune_train.config import Attention, Count, Device, Positive, Precision


class FusionConfig(Section):
    """One network and its training."""

    size_px: Annotated[int, Field(ge=32, le=4096, multiple_of=32)]
    """Width to which frames are shrunk before the network sees them."""
    width: Positive
    """Factor on the backbone's channels; 1 is the paper's."""
    attention: Attention = "cbam_identity"
    """Attention after every residual unit."""
    hidden: Count
    """States of each of the two LSTM layers; the paper has 1000."""
    sequence_pairs: Count = 16
    """Pairs in a training sequence, as the paper."""
    batch_sequences: Count = 8
    """Sequences in a batch, as the paper."""
    coarse_epochs: Annotated[int, Field(ge=0)]
    """Epochs with the loss L^(S1) and, where a detector gave it, a frozen backbone."""
    fine_epochs: Annotated[int, Field(ge=0)]
    """Epochs with the loss L^(S2), everything trained."""
    learning_rate: Positive
    """Highest learning rate; the paper has 1e-4."""
    jitter: Annotated[float, Field(ge=0)] = 0.0
    """Extra motion drawn for each pair in training, times the spread of the residuals in the training set."""


class NavigateConfig(Section):
    """The section `navigate`."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of weights, order and augmentation."""
    fusion: Literal["both", "warp", "stack"] = "both"
    """Which networks to train."""
    kappa: Positive = 1.0
    """Weight of the orientation in the coarse loss; both errors are over their spread, so 1 is even."""
    flow_weight: Annotated[float, Field(ge=0)] = 3.0
    """Weight of the flow's error (pixels) in the loss of warp."""
    in_channels: Literal[1, 3] = 1
    """Channels of the stack network's first layer; grey is repeated. A detector's weights need its own number."""
    detector: Path | None = None
    """best.ckpt of a detector whose backbone the stack network starts from; none: the default run, if there is one."""
    precision: Precision = "auto"
    """bfloat16 where the hardware has it, or as said."""
    device: Device = "auto"
    """Where to compute."""
    warp: FusionConfig
    """The second frame warped by the nominal motion, stacked in channels: it flies."""
    stack: FusionConfig
    """The paper's form, stacked in height: it is explained."""
