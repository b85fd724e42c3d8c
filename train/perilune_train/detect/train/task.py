"""Training of the detector as a Lightning module."""

import copy
import math
from typing import Any

import lightning
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn

from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.assign import Targets
from perilune_train.detect.data.batches import Batch, evaluation_loader, frames_loader, network_input, training_loader
from perilune_train.detect.data.fresh import FreshFrames
from perilune_train.detect.data.resident import ResidentFrames, fits, may_reside, resident_loader
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.data.streamed import StreamedSplit, streamed_loader
from perilune_train.detect.evaluate.matching import Detections, joined, match_split
from perilune_train.detect.evaluate.metrics import at_threshold, curve
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.detect.train.captured import CapturedStep
from perilune_train.detect.train.distill import Teacher, distill_loss
from perilune_train.detect.train.ellipse_loss import ellipse_loss
from perilune_train.detect.train.guide import guide_loss
from perilune_train.detect.train.loss import detection_loss
from perilune_train.detect.train.preview_images import preview_images
from perilune_train.models.yolo import YOLOv3
from perilune_train.records.provenance import RECORD, Provenance

_FINAL_RATE = 0.01
_EVERY_STEP_UNTIL = 100
_STEPS_BETWEEN_AVERAGES = 4
"""Number of steps between updates of the average. For a small network an update takes a twentieth of the time of a
step; updating at every fourth step gives equal results."""


def learning_rate_factor(step: int, warmup_steps: int, total_steps: int) -> float:
    """Factor on the learning rate: rises linearly to 1, then falls as half a cosine to a hundredth."""
    warmup = min(warmup_steps, total_steps // 2)
    if step < warmup:
        return (step + 1) / warmup
    progress = (step - warmup) / max(total_steps - warmup, 1)
    return _FINAL_RATE + (1 - _FINAL_RATE) * (1 + math.cos(math.pi * min(progress, 1.0))) / 2


TensorPairs = tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor]]


def paired_tensors(average: nn.Module, network: nn.Module) -> TensorPairs:
    """Tensors of average and network, in equal order: floats of each, then integer counters of each."""
    old, new = list(average.state_dict().values()), list(network.state_dict().values())
    floats = [value.is_floating_point() for value in old]
    return (
        [value for value, is_float in zip(old, floats, strict=True) if is_float],
        [value for value, is_float in zip(new, floats, strict=True) if is_float],
        [value for value, is_float in zip(old, floats, strict=True) if not is_float],
        [value for value, is_float in zip(new, floats, strict=True) if not is_float],
    )


@torch.no_grad()
def update_average(tensors: TensorPairs, decay: float) -> None:
    """Move an average of weights and batch statistics towards the network by 1 - decay; copy the counters.

    Lightning's EMAWeightAveraging is not used: its decay is constant, it copies the task including all frames, and its
    update takes about 20 times as long, because it updates tensor by tensor.
    """
    old, new, old_counters, new_counters = tensors
    torch._foreach_lerp_(old, new, 1 - decay)
    torch._foreach_copy_(old_counters, new_counters)


class DetectTask(lightning.LightningModule):
    """Training with AdamW, warm-up and cosine schedule; a moving average of the weights is evaluated.

    While the backbone is frozen, its weights and batch statistics do not change, except the weights of its attention
    gates. With `detect.trained=ellipses`, nothing changes but the tower of the ellipses. `train` and `val` are this
    process's shares of the splits.
    """

    def __init__(
        self,
        network: YOLOv3,
        config: DetectConfig,
        train: DetectSplit | StreamedSplit | FreshFrames,
        val: DetectSplit,
        frozen_epochs: int,
        teacher: Teacher | None = None,
    ):
        super().__init__()
        self.config, self.frozen_epochs, self.teacher = config, frozen_epochs, teacher
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.evaluated = copy.deepcopy(self.network).eval().requires_grad_(False)
        if config.trained == "ellipses":
            self.network.requires_grad_(False)
            self.tower.requires_grad_(True)
        self.architecture = {
            "in_channels": config.in_channels,
            "width": config.width,
            "attention": config.attention,
            "strides": list(config.strides),
            "ellipses": config.ellipses,
        }
        self.train_split, self.val_split = train, val
        self.detections: list[Detections] = []
        self.images_seen = 0
        self.provenance: Provenance | None = None
        self.resumed = (0, 0)
        self.resident: ResidentFrames | None = None
        self.captured: CapturedStep | None = None
        self.replayable, self.replays = False, False

    @property
    def process(self) -> tuple[int, int]:
        """Rank of this process and number of processes that train together."""
        return (self._trainer.global_rank, self._trainer.world_size) if self._trainer else (0, 1)

    @property
    def tower(self) -> nn.Module:
        """The part of the network that predicts ellipses."""
        assert self.network.ellipse_tower is not None
        return self.network.ellipse_tower

    @property
    def terrain(self) -> dict[str, Any] | None:
        """The record of the training terrain as plain data, including all terrain that was rendered so far."""
        if self.provenance is None:
            return None
        fresh = self.train_split if isinstance(self.train_split, FreshFrames) else None
        return self.provenance.joined([Provenance(fresh.server.uses)] if fresh else []).plain()

    def close(self) -> None:
        """Stop the thread that renders frames."""
        if isinstance(self.train_split, FreshFrames):
            self.train_split.close()

    @property
    def resides(self) -> bool:
        """Whether the training frames are kept on the device, and steps are captured."""
        if self.device.type != "cuda" or not isinstance(self.train_split, DetectSplit):
            return False
        return may_reside(self.config) and fits(self.train_split, self.device)

    def train_dataloader(self) -> Any:
        # Do not use current_epoch: here it is one too low if the run is resumed after a whole epoch.
        epoch = self._trainer.fit_loop.epoch_progress.current.processed if self._trainer else 0
        resumed_epoch, batches = self.resumed
        start = batches if epoch == resumed_epoch else 0
        split, anchors = self.train_split, self.network.anchors
        if isinstance(split, StreamedSplit):
            return streamed_loader(split, self.config, anchors, epoch, start)
        if isinstance(split, FreshFrames):
            return frames_loader(split, self.config, anchors, epoch, start)
        if self.resides:
            return resident_loader(split, self.config, epoch, start)
        return training_loader(split, self.config, anchors, epoch, start)

    def val_dataloader(self) -> Any:
        return evaluation_loader(self.val_split, self.config)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["epoch_and_batches"] = [
            self.current_epoch,
            self.trainer.fit_loop.epoch_loop.batch_progress.current.processed,
        ]
        checkpoint["images_seen"] = self.images_seen
        if isinstance(self.train_split, StreamedSplit):
            checkpoint["stream"] = self.train_split.stream.state_dict()
        if isinstance(self.train_split, FreshFrames):
            self.train_split.server.join_records(self.process[1])
            checkpoint["fresh"] = self.train_split.server.state_dict()
        if self.terrain is not None:
            checkpoint[RECORD] = self.terrain

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        epoch, batches = checkpoint["epoch_and_batches"]
        self.resumed = (epoch, batches)
        if isinstance(self.train_split, StreamedSplit):
            self.train_split.stream.load_state_dict(checkpoint["stream"])
        if isinstance(self.train_split, FreshFrames):
            self.train_split.server.load_state_dict(checkpoint["fresh"])
        self.images_seen = checkpoint.get("images_seen", 0)

    def configure_optimizers(self) -> Any:
        # Layers of a frozen backbone are trained later; with `trained=ellipses`, the other weights never are.
        part = self.tower if self.config.trained == "ellipses" else self.network
        decayed = [p for p in part.parameters() if p.ndim > 1]
        plain = [p for p in part.parameters() if p.ndim <= 1]
        # A captured step reads the learning rate from the device, so make it a tensor.
        rate = self.config.learning_rate
        optimizer = torch.optim.AdamW(
            [{"params": decayed, "weight_decay": self.config.weight_decay}, {"params": plain, "weight_decay": 0.0}],
            lr=torch.tensor(rate, device=self.device) if self.resides else rate,
            fused=True,
            capturable=self.resides,
        )
        # Lightning's step count would load the batches of an epoch before the position of a resumed run is known.
        total = self.config.epochs * len(self.train_dataloader())
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: learning_rate_factor(step, self.config.warmup_steps, total)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_train_epoch_start(self) -> None:
        frozen = self.current_epoch < self.frozen_epochs
        self.evaluated.eval()
        if self.config.trained == "ellipses":
            self.network.eval()
            self.tower.train()
            return
        backbone = self.network.backbone
        for part in (backbone.stem, backbone.downs, backbone.units):
            part.requires_grad_(not frozen)
            part.train(not frozen)
        if self.resides and (self.captured is None or self.current_epoch == self.frozen_epochs):
            # Capture again after unfreezing: a captured step trains only the weights that were not frozen at capture.
            self.captured = CapturedStep(self.whole_step, self.config.batch_size, self.device)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        # The last batch of an epoch may be smaller than the captured batch.
        self.replayable = isinstance(batch, Tensor) and len(batch) == self.config.batch_size

    def training_step(self, batch: Batch | Tensor, batch_idx: int) -> Tensor:
        if self.replays and isinstance(batch, Tensor) and self.captured is not None:
            self.images_seen += len(batch)
            return self.weighted(self.captured(batch), len(batch))
        images, targets = self.resident_batch(batch) if isinstance(batch, Tensor) else batch
        self.images_seen += len(images) * self.process[1]
        settings, masks = self.config.loss, {}
        guided = settings.lambda_guide > 0 and self.config.attention != "none" and self.config.trained == "all"
        if guided:
            outputs, masks = self.network.outputs_and_masks(images)
        else:
            outputs = self.network(images)
        loss = self.weighted(self.losses(outputs, targets), len(images))
        if guided:
            guide = guide_loss(masks, targets, (images.shape[2], images.shape[3]))
            self.log("train/guide", guide, batch_size=len(images))
            loss = loss + settings.lambda_guide * guide
        if self.teacher is not None:
            teacher_outputs = self.teacher(images)
            box, confidence = distill_loss(outputs, teacher_outputs, self.network.anchors, self.network.strides)
            self.log_dict({"train/teacher_ciou": box, "train/teacher_objectness": confidence}, batch_size=len(images))
            loss = loss + settings.lambda_teacher * (settings.lambda_iou * box + settings.lambda_obj * confidence)
        return loss

    def losses(self, outputs: list[Tensor], targets: Targets) -> tuple[Tensor, ...]:
        """L_ciou and L_obj of the network's outputs; with ellipses also L_ellipse and L_sigma."""
        network, settings = self.network, self.config.loss
        losses = detection_loss(outputs, targets, network.anchors, network.strides, settings)
        if not network.ellipses:
            return losses
        return *losses, *ellipse_loss(outputs, targets, network.anchors, network.strides, settings)

    def weighted(self, losses: tuple[Tensor, ...], batch_size: int | None = None) -> Tensor:
        """Weighted sum of the result of `losses`; logs each loss if `batch_size` is given."""
        settings = self.config.loss
        weights = {
            "train/ciou": settings.lambda_iou,
            "train/objectness": settings.lambda_obj,
            "train/ellipse": settings.lambda_ellipse,
            "train/sigma": settings.lambda_sigma,
        }
        if batch_size is not None:
            self.log_dict(dict(zip(weights, losses, strict=False)), batch_size=batch_size)
        return torch.stack([weight * loss for weight, loss in zip(weights.values(), losses, strict=False)]).sum()

    def resident_batch(self, numbers: Tensor) -> Batch:
        """The batch of the resident frames with the numbers `numbers` (B,)."""
        assert self.resident is not None
        return self.resident.batch(numbers, self.config.in_channels)

    def whole_step(self, numbers: Tensor) -> tuple[Tensor, ...]:
        """Update the weights and return the losses of a batch of resident frames.

        Reads no tensor values on the CPU, so that the step can be captured.
        """
        optimizer: Any = self.optimizers(use_pl_optimizer=False)
        optimizer.zero_grad(set_to_none=True)
        # Disable the cache: it would keep casts of weights that the step changes.
        kind = self.device.type
        enabled, dtype = torch.is_autocast_enabled(kind), torch.get_autocast_dtype(kind)
        with torch.autocast(kind, dtype, enabled, cache_enabled=False):
            images, targets = self.resident_batch(numbers)
            losses = self.losses(self.network(images), targets)
            loss = self.weighted(losses)
        with torch.autocast(kind, enabled=False):
            loss.backward()
            self.configure_gradient_clipping(optimizer)
            optimizer.step()
        return tuple(loss.detach() for loss in losses)

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        if not self.replays:
            super().backward(loss, *args, **kwargs)

    def optimizer_zero_grad(self, *args: Any) -> None:
        if not self.replays:
            super().optimizer_zero_grad(*args)

    def configure_gradient_clipping(self, optimizer: Any, *_: Any, **__: Any) -> None:
        # Lightning's clipping refuses fused optimisers because of float16's scaled gradients, which are not used here.
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        norm = nn.utils.get_total_norm(gradients, foreach=True)
        # On a CPU, reading the norm costs nothing, and most steps then need no second pass over all gradients.
        if norm.is_cuda or norm > self.config.gradient_clip:
            nn.utils.clip_grads_with_norm_(self.network.parameters(), self.config.gradient_clip, norm, foreach=True)

    def on_train_start(self) -> None:
        self.tensors = paired_tensors(self.evaluated, self.network)
        if not self.resides:
            return
        assert isinstance(self.train_split, DetectSplit)
        self.resident = ResidentFrames.of(self.train_split, self.config, self.network.anchors, self.device)
        for group in self.optimizers(use_pl_optimizer=False).param_groups:
            # The learning rate of a resumed run was loaded to the CPU.
            group["lr"] = group["lr"].to(self.device)

    def optimizer_step(self, epoch: int, batch_idx: int, optimizer: Any, optimizer_closure: Any = None) -> None:
        self.replays = self.replayable
        if self.replays:
            optimizer_closure()
            self.replays = False
        else:
            super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        # Update the average here, not after the batch: a checkpoint saved in between would lack the update. The decay
        # is smaller in early steps; otherwise the random initial weights would dominate in a short training.
        steps = self.global_step + 1
        every = 1 if steps <= _EVERY_STEP_UNTIL else _STEPS_BETWEEN_AVERAGES
        if steps % every == 0:
            update_average(self.tensors, min(self.config.ema_decay, (1 + steps) / (10 + steps)) ** every)

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        if isinstance(batch, Tensor):
            return batch.to(device, non_blocking=True)
        images, targets = batch
        # The channels of a grey frame are equal, so copy one channel.
        moved = network_input(images.to(device, non_blocking=True), self.config.in_channels)
        return moved, [part.to(device) for part in targets]

    def on_validation_epoch_start(self) -> None:
        self.detections = []
        if isinstance(self.train_split, FreshFrames):
            self.train_split.server.join_records(self.process[1])
        if self.process[1] > 1:
            # Weights are equal in all processes, but batch statistics differ: use the statistics of the first process.
            for value in self.evaluated.buffers():
                torch.distributed.broadcast(value, 0)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        boxes, scores, shapes = self.evaluated.detect_ellipses(batch[0])
        self.detections += detections_of(boxes, scores, self.config.evaluation, shapes)

    def on_validation_epoch_end(self) -> None:
        split, processes = self.val_split, self.process[1]
        height, width = split.frames.images.shape[1:]
        match_iou = self.config.evaluation.match_iou
        matches = match_split(self.detections, split.labels, (width, height), match_iou, split.radius_px)
        if processes > 1:
            parts: list[Any] = [None] * processes
            torch.distributed.all_gather_object(parts, matches)
            matches = joined(parts)
        points = curve(matches)
        _, recall, f1 = at_threshold(matches, points.best_threshold())
        steps = float(self.global_step)
        self.log_dict({"val/ap50_paper": points.ap_paper(), "val/f1": f1, "val/recall": recall, "val/steps": steps})
        if isinstance(self.logger, TensorBoardLogger) and self.process[0] == 0:
            images = preview_images(split, self.detections, points.best_threshold())
            for name, image in images.items():
                self.logger.experiment.add_image(f"val/{name}", image, self.global_step, dataformats="HWC")
