"""Training of the detector as a Lightning module."""

import copy
import math
from typing import Any

import lightning
import torch
from torch import Tensor, nn

from perilune_train.data.frames import FrameStore, normalised
from perilune_train.detect.boxes import suppress
from perilune_train.detect.config import DetectConfig, EvaluationSettings
from perilune_train.detect.data import Batch, DetectSplit, EvaluationFrames, TrainingFrames, loader, network_input
from perilune_train.detect.distill import Teacher, distill_loss
from perilune_train.detect.loss import detection_loss
from perilune_train.detect.matching import Detections, match_split
from perilune_train.detect.metrics import at_threshold, curve
from perilune_train.models.yolo import YOLOv3

_FINAL_RATE = 0.01


def learning_rate_factor(step: int, warmup_steps: int, total_steps: int) -> float:
    """Linear from nearly 0 to 1 over the warm-up, then half a cosine to a hundredth at the last step."""
    warmup = min(warmup_steps, total_steps // 2)
    if step < warmup:
        return (step + 1) / warmup
    progress = (step - warmup) / max(total_steps - warmup, 1)
    return _FINAL_RATE + (1 - _FINAL_RATE) * (1 + math.cos(math.pi * min(progress, 1.0))) / 2


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Move an average of weights and batch statistics towards the network by 1 - decay; counters are copied."""
    for old, new in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if old.is_floating_point():
            old.lerp_(new, 1 - decay)
        else:
            old.copy_(new)


def detections_of(boxes: Tensor, scores: Tensor, settings: EvaluationSettings) -> Detections:
    """Detections of one frame from all predictors' boxes (K, 4) and scores (K,)."""
    strong = scores >= settings.min_score
    some_boxes, some_scores = boxes[strong].double().cpu().numpy(), scores[strong].double().cpu().numpy()
    kept = suppress(some_boxes, some_scores, settings.nms_iou, settings.max_detections)
    return Detections(some_boxes[kept], some_scores[kept])


class DetectTask(lightning.LightningModule):
    """AdamW, warm-up and cosine, a moving average of the weights that is judged instead of them.

    While frozen, the backbone keeps its weights and batch statistics, and only its attention gates learn.
    """

    def __init__(
        self,
        network: YOLOv3,
        config: DetectConfig,
        train: DetectSplit,
        val: DetectSplit,
        frozen_epochs: int,
        teacher: Teacher | None = None,
    ):
        super().__init__()
        self.config, self.frozen_epochs, self.teacher = config, frozen_epochs, teacher
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.evaluated = copy.deepcopy(self.network).eval().requires_grad_(False)
        self.architecture = {
            "in_channels": config.in_channels,
            "width": config.width,
            "attention": config.attention,
            "strides": list(config.strides),
        }
        self.splits = {"train": train, "val": val}
        self.judged: list[Detections] = []
        self.images_seen = 0

    def train_dataloader(self) -> Any:
        frames = TrainingFrames(self.splits["train"], self.config.augment, self.config.seed, self.current_epoch)
        return loader(frames, self.config)

    def val_dataloader(self) -> Any:
        return loader(EvaluationFrames(self.splits["val"]), self.config)

    def configure_optimizers(self) -> Any:
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        plain = [p for p in self.network.parameters() if p.ndim <= 1]
        optimizer = torch.optim.AdamW(
            [{"params": decayed, "weight_decay": self.config.weight_decay}, {"params": plain, "weight_decay": 0.0}],
            lr=self.config.learning_rate,
        )
        total = int(self.trainer.estimated_stepping_batches)
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: learning_rate_factor(step, self.config.warmup_steps, total)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_train_epoch_start(self) -> None:
        frozen = self.current_epoch < self.frozen_epochs
        self.evaluated.eval()
        backbone = self.network.backbone
        for part in (backbone.stem, backbone.downs, backbone.units):
            part.requires_grad_(not frozen)
            part.train(not frozen)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        images, targets = batch
        self.images_seen += len(images)
        outputs = self.network(images)
        settings = self.config.loss
        box, confidence = detection_loss(
            outputs, targets, self.network.anchors, self.network.strides, self.config.anchor_ratio, settings
        )
        self.log_dict({"train/ciou": box, "train/objectness": confidence}, batch_size=len(images))
        loss = settings.lambda_iou * box + settings.lambda_obj * confidence
        if self.teacher is not None:
            told = self.teacher(images)
            box, confidence = distill_loss(outputs, told, self.network.anchors, self.network.strides)
            self.log_dict({"train/teacher_ciou": box, "train/teacher_objectness": confidence}, batch_size=len(images))
            loss = loss + settings.lambda_teacher * (settings.lambda_iou * box + settings.lambda_obj * confidence)
        return loss

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        # Early on the average forgets faster, or it would carry the random start through a short training.
        decay = min(self.config.ema_decay, (1 + self.global_step) / (10 + self.global_step))
        update_average(self.evaluated, self.network, decay)

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        return batch[0].to(device), batch[1].to(device)

    def on_validation_epoch_start(self) -> None:
        self.judged = []

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        boxes, scores = self.evaluated.detect(batch[0])
        self.judged += [detections_of(b, s, self.config.evaluation) for b, s in zip(boxes, scores, strict=True)]

    def on_validation_epoch_end(self) -> None:
        split = self.splits["val"]
        height, width = split.frames.images.shape[1:]
        matches = match_split(
            self.judged, split.labels, (width, height), self.config.evaluation.match_iou, split.radius_px
        )
        points = curve(matches)
        _, recall, f1 = at_threshold(matches, points.best_threshold())
        self.log_dict({"val/ap50": points.average_precision(), "val/f1": f1, "val/recall": recall})


@torch.no_grad()
def detect_frames(
    network: YOLOv3, frames: FrameStore, config: DetectConfig, device: str, bf16: bool, advance: Any = None
) -> list[Detections]:
    """Detections of all frames, one entry a frame; `advance(n)` is called after n more frames."""
    network = network.to(device).eval()
    found: list[Detections] = []
    for start in range(0, len(frames), config.batch_size):
        images = network_input(normalised(frames.images[start : start + config.batch_size]), config.in_channels)
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            boxes, scores = network.detect(images.to(device))
        found += [detections_of(b, s, config.evaluation) for b, s in zip(boxes, scores, strict=True)]
        if advance is not None:
            advance(len(images))
    return found
