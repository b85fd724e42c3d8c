"""Settings of crater detection: the section `detect`."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from perilune_shared.config import Section
from perilune_shared.config_errors import nearest
from perilune_shared.dataset.selection import SELECTIONS, Selection
from perilune_train.config import Attention, Count, Device, Positive, Precision, Share, Strategy


class LabelSettings(Selection):
    """Which labels are craters to find. The others are ignored: neither wanted nor counted as false.

    A name gives all thresholds; single ones given beside it replace its own. What is resolved is what a run stores.
    """

    selection: str = "visible"
    """Name of a selection: all, paper (2 to 50 px, centre in the frame) or visible (what a frame shows)."""

    @model_validator(mode="before")
    @classmethod
    def _resolved(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        name = given.get("selection", "visible")
        if not isinstance(name, str):
            return given
        if name not in SELECTIONS:
            # As a fault of the name alone: the field's own check tells it.
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
    """Random changes of training frames; 0 turns one off."""

    flips_and_turns: bool = True
    """The eight flips and quarter turns of a square frame, each as likely."""
    scale: tuple[Annotated[float, Field(ge=0.25, le=4)], Annotated[float, Field(ge=0.25, le=4)]] = (1.0, 1.0)
    """Least and largest factor by which a frame is shrunk or enlarged, even in logarithm."""
    gain: Share = 0.3
    """Contrast and brightness change by up to this factor, up or down."""
    gamma: Share = 0.3
    """Exponent of the grey values, up to this far from 1 in logarithm."""
    stretch: Annotated[float, Field(ge=0, lt=0.5)] = 0.0
    """Largest share of a frame's darkest, and of its brightest, pixels that become black and white: published images
    are often stretched so."""
    blur_px: Annotated[float, Field(ge=0, le=5)] = 0.2
    """Largest standard deviation of a Gaussian blur, pixels. Rendered frames have the sensor's own: more than a little
    hides the smallest craters."""
    noise: Annotated[float, Field(ge=0, le=100)] = 1.0
    """Largest standard deviation of Gaussian noise, grey levels of 255, beside the sensor's own."""

    @model_validator(mode="after")
    def _ordered(self) -> "AugmentSettings":
        if self.scale[0] > self.scale[1]:
            raise ValueError("scale: least first, largest second")
        return self


class LossSettings(Section):
    """L = lambda_iou L_ciou + lambda_obj L_obj (paper, eq. "loss")."""

    aspect: Literal["circular", "standard"] = "circular"
    """Aspect term of CIoU: against a circle (the paper's), or against the label's own aspect ratio."""
    objectness: Literal["hard", "iou"] = "iou"
    """What the objectness of a predictor that answers for a label is to become: 1, or the IoU of its box with it."""
    lambda_iou: Positive = 0.05
    """Weight of L_ciou."""
    lambda_obj: Positive = 1.0
    """Weight of L_obj."""
    lambda_noobj: Positive = 1.0
    """Weight of empty predictors within L_obj."""
    lambda_teacher: Positive = 1.0
    """Weight of what the `teacher` says, in which box and objectness have the weights above."""


class EvaluationSettings(Section):
    """How detections are made of outputs, and judged."""

    scales: Annotated[tuple[Annotated[float, Field(ge=0.25, le=4)], ...], Field(min_length=1, max_length=4)] = (1.0,)
    """Factors by which frames are enlarged or shrunk before the network looks; what it sees at all of them is merged.
    2 beside 1 finds more of the smallest craters at five times the cost. Validation during training looks at 1
    alone."""
    match_iou: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """Least IoU of a detection with the label that it finds."""
    nms_iou: Annotated[float, Field(gt=0, lt=1)] = 0.45
    """Of two detections that overlap more than this, the weaker goes."""
    min_score: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """Detections below this score are dropped before anything else (the floor of the precision-recall curve)."""
    max_aspect: Annotated[float, Field(gt=1)] | None = None
    """Boxes whose longer side is more than this many times the shorter go before suppression: a box about two craters
    is longer than a crater seen from above. None keeps all."""
    max_detections: Count = 2000
    """Most detections kept in a frame; the usual 100 would truncate crowded frames."""
    min_precision: Annotated[float, Field(gt=0, lt=1)] | None = None
    """The score threshold is that of most recall at this precision on the validation split. None: of best F1."""


class DetectConfig(Section):
    """The section `detect`."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Of weights, anchors, order and augmentation."""
    width: Annotated[float, Field(ge=0.125, le=2)] = 1.0
    """Factor on all channel counts; 1 is the paper's network."""
    attention: Attention = "cbam"
    """none (the baseline), cbam (the paper's), or cbam_identity (gates that start at exactly 1)."""
    in_channels: Literal[1, 3] = 3
    """3: the grey frame three times over, as the paper's RGB network takes it."""
    strides: tuple[int, int, int] = (8, 16, 32)
    """Strides with heads: 8 16 32 (the paper's) or 4 8 16 (better for tiny craters)."""
    epochs: Count = 20
    """Passes over the training frames."""
    frozen_epochs: Annotated[int, Field(ge=0)] = 0
    """First epochs with the backbone frozen, its attention gates excepted. They count only with `init_from`: a
    backbone of random weights, frozen, teaches nothing, so without it training starts unfrozen."""
    init_from: str | None = None
    """best.ckpt of an earlier detect run of equal width and in_channels, to go on from: all of it where the strides
    are equal, else its backbone. Or a Darknet file: darknet53.conv.74 (the backbone) or yolov3.weights (neck and heads
    too); these need width 1 and in_channels 3."""
    teacher: str | None = None
    """best.ckpt of a detect run, usually wider, to learn from beside the labels; its strides, channels and anchors."""
    batch_size: Count = 8
    """Frames in a step."""
    learning_rate: Positive = 1e-3
    """Peak of AdamW's learning rate: linear warm-up, then a cosine down to a hundredth."""
    warmup_steps: Annotated[int, Field(ge=0)] = 100
    """Steps in which the learning rate rises."""
    weight_decay: Annotated[float, Field(ge=0)] = 0.01
    """AdamW's, per step and learning rate."""
    gradient_clip: Positive = 10.0
    """Largest norm of all gradients together; longer ones are shortened to it."""
    ema_decay: Annotated[float, Field(ge=0, lt=1)] = 0.998
    """Moving average of the weights, per step; the average is what is judged and kept. At step s it is at most
    (1 + s) / (10 + s), so that 0.998 holds from step 4490 on."""
    anchor_ratio: Annotated[float, Field(gt=1)] = 2.0
    """An anchor takes part in a label whose width and height are within this factor of its own."""
    labels: LabelSettings = LabelSettings()
    """What is to be found."""
    augment: AugmentSettings = AugmentSettings()
    """Random changes in training."""
    loss: LossSettings = LossSettings()
    """What training minimises."""
    evaluation: EvaluationSettings = EvaluationSettings()
    """How detections are judged."""
    precision: Precision = "auto"
    """Of the arithmetic."""
    device: Device = "auto"
    """Where it runs."""
    devices: Count = 1
    """Processes on each machine, each with its own GPU or share of the CPU; `torchrun --nproc-per-node` wins."""
    num_nodes: Count = 1
    """Machines; `torchrun --nnodes` wins."""
    strategy: Strategy = "auto"
    """How several processes train together, by Lightning's names: auto takes what the settings need."""
    checkpoint_minutes: Annotated[float, Field(ge=0)] = 10.0
    """Within an epoch the state is kept this often; 0: after every step. It always is after an epoch."""
    workers: Annotated[int, Field(ge=0, le=64)] = 0
    """Processes that augment frames beside the training; 0 does it in between, best on few cores."""

    @model_validator(mode="after")
    def _check(self) -> "DetectConfig":
        if self.strides not in ((8, 16, 32), (4, 8, 16)):
            raise ValueError("strides 8, 16, 32 or 4, 8, 16")
        if self.frozen_epochs >= self.epochs:
            raise ValueError("fewer frozen_epochs than epochs")
        return self
