"""Settings of `perilune-train navigate train`."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from perilune_shared.config.resolve import Section
from perilune_train.config import Attention, Count, Device, Epochs, Precision, Rate, Seed, Weight

_Few = Annotated[int, Field(ge=1, le=4096)]
Target = Literal["motion", "pose"]


class FusionConfig(Section):
    """One network and its training."""

    size_px: Annotated[int, Field(ge=32, le=4096, multiple_of=32)]
    """Width to which frames are shrunk for the network, pixels."""
    width: Annotated[float, Field(gt=0, le=2)]
    """Factor on the backbone's channel counts; 1 is the paper's network."""
    attention: Attention = "cbam_identity"
    """Attention after every residual unit."""
    hidden: Annotated[int, Field(ge=1, le=4096)]
    """Hidden size of each of the two LSTM layers; the paper uses 1000."""
    target: Target = "motion"
    """What stack estimates. motion: the motion from the earlier to the later frame. pose: position and attitude of the
    camera in O_L at the later frame, over the landing area of the training; the dataset must have one scene."""
    pool: Literal[1, 2, 4] = 1
    """Grid over which stack averages the backbone's features. 1: over the pair, as in the paper. 2 or 4: over so many
    by so many cells of each frame, with a linear layer to at most 512 values before the LSTM."""
    stages: Literal[4, 5] = 5
    """Stages of the backbone of stack; the paper has 5. 4 leaves out the last one."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the inputs and outputs of the LSTM of stack that a training step sets to 0."""
    sequence_pairs: _Few = 16
    """Pairs of frames in a training sequence; the paper's value."""
    batch_sequences: _Few = 8
    """Sequences in a batch; the paper's value."""
    accumulate: _Few = 1
    """Batches whose gradients are summed for a step. On little memory, batch_sequences=1 with accumulate=8 is the
    paper's batch, except that batch norms see one sequence at a time."""
    coarse_epochs: Epochs
    """Epochs with the loss L^(S1). A backbone from a detector is frozen in them. If a detector gives all of it, its
    features are computed once, and validation comes about ten times in the stage instead of after every epoch."""
    fine_epochs: Epochs
    """Epochs with the loss L^(S2), all weights trained."""
    learning_rate: Rate
    """Peak learning rate; the paper uses 1e-4."""
    coarse_learning_rate: Rate | None = None
    """Peak learning rate of the coarse stage, which then has a cosine of its own down to 0. None: `learning_rate`
    in both stages, as `cycles` says."""
    backbone_factor: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Factor on the learning rate of a backbone from a detector in the fine stage. AdamW's first steps are as long for
    every weight, and a wide network adds them up: with 1 the fine stage can lose what the coarse stage has learned."""
    cycles: Count = 1
    """Cosines of the learning rate. 1: one over both stages. More (the paper: 5): constant in the coarse stage, then
    this number of cosines, each from the peak down to 0, in the fine stage."""
    jitter: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Standard deviation of a random extra motion of each training pair, as a fraction of the spread of the residuals
    in the training set."""
    views: Annotated[int, Field(ge=0, le=64)] = 0
    """Further versions of each training trajectory for `target=pose`, seen from poses near it: frames are warped over
    the mean ground plane, and these poses are the truth. Each training sequence is of one version, drawn at random.
    Frames of validation and test are never warped."""
    view_spread: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Size of the moves of these versions, as a factor on the deviations of the training trajectories from the mean
    pose of each frame."""


class StreamConfig(Section):
    """Training sequences over new ground, rendered by `perilune-render serve` while the network trains."""

    address: Annotated[str, Field(min_length=1, max_length=300)]
    """Address of the server's interface for `perilune_shared.client`, such as tcp://127.0.0.1:10364."""
    n_scenes: Annotated[int, Field(ge=1, lt=2**31)]
    """Number of scenes: 1 to this number of the server, in turn. Start it with `--scenes` one larger."""
    pairs_per_scene: Count = 64
    """Consecutive rendered pairs over one scene, before the next one."""
    share: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the sequences of an epoch that are rendered; the others are those of the dataset."""
    seed: Seed = 0
    """Random seed of the poses and the noise of rendered sequences."""
    timeout_s: Annotated[float, Field(gt=0, le=100_000)] = 60.0
    """Longest time to wait for a reply of the server, seconds."""


class NavigateConfig(Section):
    """The section `navigate`."""

    seed: Seed = 0
    """Random seed of weights, order and augmentation."""
    fusion: Literal["both", "warp", "stack"] = "both"
    """Which networks to train."""
    kappa: Weight = 1.0
    """Weight of the orientation in the coarse loss. Both errors are divided by their spread, so 1 weighs them
    equally."""
    flow_weight: Annotated[float, Field(ge=0, le=1e6)] = 3.0
    """Weight of the optical flow error (pixels) in the loss of warp."""
    in_channels: Literal[1, 3] = 1
    """Input channels of the stack network; the grey frame is repeated. Must be equal to that of `detector`."""
    detector: Path | None = None
    """best.ckpt of the detector whose backbone initialises the stack network. None: the default run, if there is
    one."""
    init_from: str | None = None
    """Weights from which warp starts: best.ckpt of a warp run of equal size_px, width, attention and hidden, or
    lander-navigator (the installed navigator). None: random weights."""
    precision: Precision = "auto"
    """Arithmetic: auto (bfloat16 if the hardware supports it), bf16 or float32."""
    device: Device = "auto"
    """Where to compute: auto (the GPU if there is one), cpu or cuda."""
    checkpoint_minutes: Annotated[float, Field(ge=0, le=100_000)] = 10.0
    """Minutes between saves of the training state within an epoch; 0: after every step. It is always saved after an
    epoch."""
    workers: Annotated[int, Field(ge=0, le=64)] = 0
    """Worker processes that prepare sequences; 0 prepares them in the training process, which is best on few cores."""
    stream: StreamConfig | None = None
    """Training sequences rendered while training, for `fusion=warp` and `workers=0`; null for those of the dataset
    alone. Unlike `detect.stream`, which reads a dataset."""
    warp: FusionConfig
    """Network with the second frame warped by the nominal motion and stacked in channels; the default navigator."""
    stack: FusionConfig
    """The paper's network, with the pair stacked in height; the explanations use it."""

    @model_validator(mode="after")
    def _can_stream(self) -> "NavigateConfig":
        if self.stream is not None and (self.fusion != "warp" or self.workers > 0):
            raise ValueError("fusion=warp and workers=0, since stream is given")
        return self

    @model_validator(mode="after")
    def _only_stack(self) -> "NavigateConfig":
        if self.stack.views and self.stack.target != "pose":
            raise ValueError("stack.target=pose, since stack.views is given")
        for name in ("target", "pool", "stages", "dropout", "views", "view_spread", "backbone_factor"):
            default = FusionConfig.model_fields[name].default
            if getattr(self.warp, name) != default:
                raise ValueError(f"warp.{name}={default}, since only stack has another")
        return self
