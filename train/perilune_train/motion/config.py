"""Settings of `perilune-train navigate train`."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from perilune_shared.config.resolve import Section
from perilune_train.config import Attention, Count, Device, Epochs, Precision, Rate, Seed, ServerConfig, Weight

_Few = Annotated[int, Field(ge=1, le=4096)]
Target = Literal["motion", "pose"]


class FusionConfig(Section):
    """One network and its training."""

    size_px: Annotated[int, Field(ge=32, le=4096, multiple_of=32)]
    """Width to which frames are shrunk for the network, pixels."""
    width: Annotated[float, Field(gt=0, le=2)]
    """Factor on the channel counts of the backbone; 1 is the paper's network."""
    attention: Attention = "cbam_identity"
    """Kind of the attention gates in the backbone."""
    hidden: Annotated[int, Field(ge=1, le=4096)]
    """Hidden size of each of the two LSTM layers; the paper uses 1000."""
    target: Target = "motion"
    """What stack estimates. motion: the motion from the earlier to the later frame. pose: position and attitude of the
    camera in O_L at the later frame. A pose network knows only the landing area of its training data, so the dataset
    must have exactly one scene."""
    pool: Literal[1, 2, 4] = 1
    """How stack averages the backbone's features. 1: over both frames together, as in the paper. 2 or 4: over each cell
    of a 2 x 2 or 4 x 4 grid on each frame; a linear layer then reduces them to at most 512 values for the LSTM."""
    stages: Literal[4, 5] = 5
    """Number of stages of stack's backbone. 5: as in the paper. 4: without the last stage."""
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Fraction of the inputs and outputs of stack's LSTM that a training step sets to 0."""
    sequence_pairs: _Few = 16
    """Pairs of frames in a training sequence; the paper's value."""
    batch_sequences: _Few = 8
    """Sequences in a batch; the paper's value."""
    accumulate: _Few = 1
    """Number of batches whose gradients are summed for one step. If memory is short, use batch_sequences=1 with
    accumulate=8. This equals the paper's batch, except that batch norms see one sequence at a time."""
    coarse_epochs: Epochs
    """Epochs of the coarse stage, with the loss L^(S1). A backbone that comes from a detector is frozen in this stage.
    If the whole backbone comes from a detector, its features are computed once, and the stage has about ten
    validations instead of one after every epoch."""
    fine_epochs: Epochs
    """Epochs of the fine stage, with the loss L^(S2). All weights are trained."""
    learning_rate: Rate
    """Peak learning rate; the paper uses 1e-4."""
    coarse_learning_rate: Rate | None = None
    """Peak learning rate of the coarse stage. If it is set, the learning rate of this stage falls to 0 by a separate
    cosine. None: both stages use `learning_rate`, with the schedule of `cycles`."""
    backbone_factor: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Factor on the learning rate of the backbone in the fine stage, if the backbone comes from a detector. AdamW's
    first steps are equally large for every weight, and their effects add up in a wide network. With 1, the fine stage
    can therefore lose what the coarse stage has learned."""
    cycles: Count = 1
    """Number of cosines of the learning rate. 1: one cosine over both stages. More (5 in the paper): a constant rate in
    the coarse stage, then this number of cosines in the fine stage, each from the peak down to 0."""
    jitter: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Standard deviation of a random motion that is added to each training pair of warp. It is a fraction of the spread
    of the true motions about the nominal motion in the training set. stack ignores this setting."""
    views: Annotated[int, Field(ge=0, le=64)] = 0
    """Number of further versions of each training trajectory for `target=pose`, seen from nearby poses. The frames are
    warped over the mean ground plane, and the nearby poses are the ground truth. Each training sequence uses one
    version, drawn at random. Validation and test frames are never warped."""
    view_spread: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Distance of the poses of `views` from the original poses. 1: as large as the deviations of the training
    trajectories from the mean pose of each frame."""


class StreamConfig(ServerConfig):
    """Settings of training sequences over scenes that are not in the dataset. `perilune-render serve` renders them
    during training."""

    pairs_per_scene: Count = 64
    """Number of consecutive pairs that are rendered over one scene before the next scene."""


class NavigateConfig(Section):
    """The section `navigate`."""

    seed: Seed = 0
    """Random seed of the initial weights, the order of the sequences, and the augmentation."""
    fusion: Literal["both", "warp", "stack"] = "both"
    """Which networks to train."""
    kappa: Weight = 1.0
    """Weight of the orientation error in the coarse loss. The errors of position and orientation are divided by their
    spreads, so 1 weighs them equally."""
    flow_weight: Annotated[float, Field(ge=0, le=1e6)] = 3.0
    """Weight of the optical flow error (pixels) in the loss of warp."""
    in_channels: Literal[1, 3] = 1
    """Number of input channels of the stack network, in which the grey frame is repeated. Must equal the detector's
    `in_channels`."""
    detector: Path | None = None
    """best.ckpt of the detector whose backbone initialises the stack network. None: the default run, if it exists."""
    init_from: str | None = None
    """Weights from which warp starts: best.ckpt of a warp run with equal size_px, width, attention and hidden. None:
    random weights."""
    precision: Precision = "auto"
    """Arithmetic: auto (bfloat16 if the hardware supports it), bf16 or float32."""
    device: Device = "auto"
    """Where to compute: auto (the GPU if there is one), cpu or cuda."""
    checkpoint_minutes: Annotated[float, Field(ge=0, le=100_000)] = 10.0
    """Minutes between saves of the training state within an epoch. 0: save after every step. The state is also saved
    after every epoch."""
    workers: Annotated[int, Field(ge=0, le=64)] = 0
    """Number of worker processes that prepare sequences. 0: the training process prepares them, which is best on few
    cores."""
    stream: StreamConfig | None = None
    """Training sequences that are rendered during training; requires `fusion=warp` and `workers=0`. null: sequences
    from the dataset only. The detector's counterpart is `detect.fresh`; `detect.stream` reads a dataset in portions."""
    warp: FusionConfig
    """Network with the later frame warped by the nominal motion and both frames stacked in channels."""
    stack: FusionConfig
    """The paper's network, with the two frames stacked in height; used by the explanations."""

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
                raise ValueError(f"warp.{name}={default}, since only stack has this setting")
        return self
