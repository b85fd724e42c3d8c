"""Settings of crater detection: the section `detect`."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from perilune_shared.config.errors import nearest
from perilune_shared.config.resolve import Section
from perilune_shared.labels.thresholds import SELECTIONS, Selection
from perilune_train.config import (
    Attention,
    Count,
    Device,
    Epochs,
    Fraction,
    Precision,
    Rate,
    Seed,
    ServerConfig,
    Strategy,
    Weight,
)

_Stride = Annotated[int, Field(ge=1, le=1024)]
COARSEST_STRIDE = 32
"""The sides of the network's input are multiples of this number of pixels."""


MIN_COARSE_RADIUS_PX = 6.0
"""Minimum radius of a box at a coarse scale. The finer scale finds smaller craters better, and reduced images add false
positives of a few pixels. On rendered validation frames, 4 to 16 px have equal AP within 0.0005; from 20 px on, craters
above 20 px are lost (docs/notebook/2026-11-28-real-pictures.md)."""


class LabelSettings(Selection):
    """Selection of the craters to find.

    Labels that are not selected are ignored: they need not be found, and detections on them are not false positives.

    `selection` sets all thresholds; a threshold that is set explicitly overrides the selection's value. A run stores
    all values.
    """

    selection: str = "visible"
    """Name of a selection: all, paper (radius 2 to 50 px, centre in the frame) or visible (above a threshold of
    contrast)."""

    @model_validator(mode="before")
    @classmethod
    def _resolved(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        name = given.get("selection", "visible")
        if not isinstance(name, str):
            return given
        if name not in SELECTIONS:
            # Keep only the name, so that the validator of the name reports the error.
            return {"selection": name}
        limits = given.get("radius_px")
        if isinstance(limits, list):
            given = {**given, "radius_px": tuple(limits)}
        return {**SELECTIONS[name].model_dump(), **given}

    @field_validator("selection")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in SELECTIONS:
            raise ValueError(nearest(name, SELECTIONS))
        return name


class AugmentSettings(Section):
    """Random augmentation of training frames. 0 disables an effect; `scale` is disabled by 1 to 1."""

    flips_and_turns: bool = True
    """Apply one of the eight flips and quarter turns of a square frame, each equally likely."""
    scale: tuple[Annotated[float, Field(ge=0.25, le=4)], Annotated[float, Field(ge=0.25, le=4)]] = (1.0, 1.0)
    """Smallest and largest zoom factor of a frame. The logarithm of the factor is uniformly distributed."""
    gain: Fraction = 0.3
    """Largest change of brightness: grey values are multiplied by a factor between 1 / (1 + gain) and 1 + gain. The
    logarithm of the factor is uniformly distributed."""
    gamma: Fraction = 0.3
    """Largest change of tone: grey values between 0 and 1 are raised to a power between exp(-gamma) and exp(gamma)."""
    stretch: Annotated[float, Field(ge=0, lt=0.5)] = 0.0
    """Largest fraction of the pixels that become black, and largest fraction that become white. Published images are
    often stretched in this way."""
    blur_px: Annotated[float, Field(ge=0, le=5)] = 0.2
    """Largest standard deviation of a Gaussian blur, pixels. Rendered frames already contain the sensor's blur; a much
    larger value hides the smallest craters."""
    noise: Annotated[float, Field(ge=0, le=100)] = 1.0
    """Largest standard deviation of the added Gaussian noise, in grey levels of 0 to 255. Rendered frames already
    contain the sensor's noise."""
    levels: Fraction = 0.0
    """Fraction of the frames that are reduced to 12 to 64 grey levels, as in files that use a small part of their
    range. The logarithm of the number is uniformly distributed."""
    jpeg: Fraction = 0.0
    """Fraction of the frames that are compressed by JPEG, at a quality between 30 and 95."""

    @model_validator(mode="after")
    def _ordered(self) -> "AugmentSettings":
        if self.scale[0] > self.scale[1]:
            raise ValueError("scale: expected the smaller factor first")
        return self


class LossSettings(Section):
    """L = lambda_iou L_ciou + lambda_obj L_obj (paper, eq. "loss").

    With `ellipses`, lambda_ellipse L_ellipse + lambda_sigma L_sigma is added (detect/train/ellipse_loss.py).
    """

    aspect: Literal["circular", "standard"] = "circular"
    """Aspect ratio to which the aspect term of CIoU pulls a box. circular: 1 (the paper). standard: the label's."""
    objectness: Literal["hard", "iou"] = "iou"
    """Objectness target of a positive predictor. hard: 1. iou: the IoU of its box with its label."""
    reduction: Literal["means", "sums"] = "means"
    """means: average over the predictors of each scale, weight scales by 1 / stride. sums: plain sums (the paper)."""
    lambda_iou: Weight = 0.05
    """Weight of L_ciou."""
    lambda_obj: Weight = 1.0
    """Weight of L_obj."""
    lambda_noobj: Weight = 1.0
    """Weight of negative predictors within L_obj."""
    lambda_ellipse: Weight = 5.0
    """Weight of the loss of the ellipses' correlations, used with `ellipses`."""
    lambda_sigma: Weight = 0.05
    """Weight of the loss of the ellipses' standard deviations, used with `ellipses`."""
    lambda_teacher: Weight = 1.0
    """Weight of the distillation loss, used with `teacher`. lambda_iou and lambda_obj weight the two terms of the
    loss."""
    lambda_guide: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Weight of the guidance loss of attention gates: 1 - correlation of the gate's mask with the labelled craters. The
    loss covers the gates B_11, B_22 and B_38, the last gates of the stages up to stride 8. 0: gates learn from the
    detection loss alone (the paper). No effect without attention."""


class EvaluationSettings(Section):
    """Inference with a trained network, and evaluation of its detections."""

    scales: Annotated[tuple[Annotated[float, Field(ge=0.25, le=4)], ...], Field(min_length=1, max_length=4)] = (1.0,)
    """Factors by which frames are resized before inference; detections at all scales are merged. Scales 1 and 2
    together find more of the smallest craters but cost five times as much. Validation during training uses scale 1
    only."""
    min_coarse_radius_px: Annotated[float, Field(ge=0, le=1000)] = MIN_COARSE_RADIUS_PX
    """Minimum radius sqrt(w h) / 2 of a box in a frame that was reduced (scale below 1), in pixels of the reduced
    frame, if detection also runs at a finer scale."""
    match_iou: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """Minimum IoU of a detection and a label for a match."""
    nms_iou: Annotated[float, Field(gt=0, lt=1)] = 0.45
    """Of two detections with a larger IoU, non-maximum suppression removes the one with the lower score."""
    min_score: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Detections below this score are dropped before suppression. The precision-recall curve ends at this score."""
    max_aspect: Annotated[float, Field(gt=1, le=1000)] | None = None
    """Boxes are dropped before suppression if their longer side exceeds this multiple of the shorter side. A box around
    two craters is more elongated than a crater seen from above. None keeps all boxes."""
    max_detections: Annotated[int, Field(ge=1, le=100_000)] = 2000
    """Largest number of detections in a frame. COCO's limit of 100 would truncate crowded frames."""
    varied_frames: bool = False
    """Choose the score threshold on the validation frames and on copies of them with other contrast, blur and noise.
    Use this for a detector of images from unknown cameras."""
    min_precision: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Choose the score threshold that gives the highest recall at this precision on the validation split. None: choose
    the threshold of the highest F1."""


class FreshConfig(ServerConfig):
    """Settings of training frames over scenes that are not in the dataset. `perilune-render serve` renders and labels
    them during training."""

    frames_per_scene: Count = 64
    """Number of consecutive frames that are rendered over one scene, under one Sun, before the next scene."""


class DetectConfig(Section):
    """The section `detect`."""

    seed: Seed = 0
    """Random seed of weights, anchors, order of frames and augmentation."""
    width: Annotated[float, Field(ge=0.125, le=2)] = 1.0
    """Factor on all channel counts; 1 is the paper's network."""
    attention: Attention = "cbam"
    """none (the baseline), cbam (the paper's), cbam_identity (gates that start at exactly 1), cbam_centred (gates
    between 0.5 and 1.5 that cannot become constant), or cbam_last (centred gates, one in each stage)."""
    in_channels: Literal[1, 3] = 3
    """Input channels. 3: the grey frame three times, as in the paper's RGB network."""
    strides: tuple[_Stride, _Stride, _Stride] = (8, 16, 32)
    """Strides of the detection heads: 8 16 32 (the paper) or 4 8 16 (better for tiny craters)."""
    ellipses: bool = False
    """Predict the rim as an ellipse with standard deviations of centre and semi-axes, in addition to its box. False:
    boxes only (the paper)."""
    epochs: Count = 20
    """Passes over the training frames."""
    frozen_epochs: Epochs = 0
    """Number of epochs at the start in which the backbone, except its attention gates, is frozen. Used only with
    `init_from`; otherwise training starts unfrozen, because freezing random weights does not help."""
    init_from: str | None = None
    """Initial weights. best.ckpt of a detect run of equal width and in_channels, or crater-detector (the installed
    detector, width 0.40625), sets all weights if the strides are equal, otherwise the backbone only; ellipse outputs
    that it lacks keep their initial weights. A Darknet file needs width 1 and in_channels 3; darknet53.conv.74 sets the
    backbone, yolov3.weights also sets neck and heads."""
    init_layers: Literal["all", "from_second"] = "all"
    """Layers that `init_from` initialises: all, or all but the first convolution (the paper)."""
    plain_gates_before_frozen_layers: bool = False
    """Allow attention=cbam with frozen_epochs even if `init_from` has no gates (the paper). New plain gates scale their
    input by about 0.25, so the frozen layers get features on which they were not trained."""
    teacher: str | None = None
    """Teacher for distillation, in addition to the labels: best.ckpt of a detect run, usually of a wider network. Both
    networks must have equal strides and in_channels. This network uses the teacher's anchors."""
    trained: Literal["all", "ellipses"] = "all"
    """Weights to train: all, or only the layers that predict ellipses, on top of `init_from`. `ellipses` leaves boxes
    and scores as they are, and keeps the weights of the last epoch."""
    validate_every: Count = 1
    """Epochs between validations; `epochs` must be a multiple. The weights of the best validation are kept."""
    batch_size: Annotated[int, Field(ge=1, le=65_536)] = 8
    """Number of frames that each process uses in a training step."""
    learning_rate: Rate = 1e-3
    """Peak learning rate of AdamW. It rises linearly (warm-up), then falls as a cosine to a hundredth."""
    warmup_steps: Annotated[int, Field(ge=0, le=100_000_000)] = 100
    """Number of steps of the warm-up."""
    weight_decay: Annotated[float, Field(ge=0, le=1000)] = 0.01
    """Weight decay of AdamW; the learning rate multiplies it in each step."""
    gradient_clip: Annotated[float, Field(gt=0, le=1e9)] = 10.0
    """Largest norm of all gradients together. If the norm is larger, the gradients are scaled down to it."""
    ema_decay: Annotated[float, Field(ge=0, lt=1)] = 0.998
    """Decay per step of the moving average of the weights; the average is evaluated and saved. At step s the decay is
    at most (1 + s) / (10 + s), so that 0.998 holds from step 4490 on."""
    anchor_sampling: Literal["rare", "plain"] = "rare"
    """Weights of the label sizes from which anchors are clustered. rare: inverse square root of the frequency of the
    size, so that large craters get anchors. plain: equal weights (the paper)."""
    assignment: Literal["several", "one"] = "several"
    """Predictors that learn a label. several: every anchor within anchor_ratio, in the cell of the label's centre and
    in the two nearest cells. one: the anchor of the highest IoU, in the cell of the centre, as in YOLOv3 (the
    paper)."""
    anchor_ratio: Annotated[float, Field(gt=1, le=1000)] = 2.0
    """An anchor is assigned to a label if its width and its height differ from the label's by less than this factor."""
    labels: LabelSettings = LabelSettings()
    """Craters to find."""
    augment: AugmentSettings = AugmentSettings()
    """Random augmentation in training."""
    loss: LossSettings = LossSettings()
    """Training loss."""
    evaluation: EvaluationSettings = EvaluationSettings()
    """Detection and evaluation."""
    precision: Precision = "auto"
    """Arithmetic: auto (bfloat16 if the hardware supports it), bf16 or float32."""
    device: Device = "auto"
    """Where to compute: auto (the GPU if there is one), cpu or cuda."""
    devices: Annotated[int, Field(ge=1, le=1024)] = 1
    """Processes on each machine, each with its own GPU or part of the CPU; `torchrun --nproc-per-node` overrides it."""
    num_nodes: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Number of machines; `torchrun --nnodes` overrides it."""
    strategy: Strategy = "auto"
    """Lightning's strategy for several processes; auto selects a strategy that fits the other settings."""
    checkpoint_minutes: Annotated[float, Field(ge=0, le=100_000)] = 10.0
    """Minutes between saves of the training state within an epoch; 0 saves after every step. The state is always saved
    after an epoch."""
    workers: Annotated[int, Field(ge=0, le=64)] = 0
    """Worker processes that augment frames; 0 augments in the training process, which is best on few cores."""

    stream: bool = False
    """Read the training frames of a packed dataset as a stream instead of loading them into memory. The order of
    frames then also depends on `workers`, so do not change it before you resume a run."""
    fresh: FreshConfig | None = None
    """Training frames that are rendered during training; requires `stream=false` and `workers=0`. null: frames from the
    dataset only. `--stream-scenes` sets the address."""

    @model_validator(mode="after")
    def _check(self) -> "DetectConfig":
        if self.strides not in ((8, 16, 32), (4, 8, 16)):
            raise ValueError("strides 8, 16, 32 or 4, 8, 16")
        if self.frozen_epochs >= self.epochs:
            raise ValueError("frozen_epochs below epochs")
        if self.epochs % self.validate_every:
            raise ValueError("epochs a multiple of validate_every")
        if self.trained == "ellipses" and not (self.ellipses and self.init_from and not self.frozen_epochs):
            raise ValueError("trained=ellipses with ellipses=true, init_from and frozen_epochs=0")
        if self.fresh is not None and (self.stream or self.workers > 0):
            raise ValueError("stream=false and workers=0, since fresh is given")
        return self
