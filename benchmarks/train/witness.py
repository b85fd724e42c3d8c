"""RT-DETRv2 (Lv et al. 2024, arXiv 2407.17140) from `transformers`, trained as a witness beside YOLOv3.

The witness sees the frames, augmentation, labels and evaluation of `detect train`, and starts from random weights. Its
differences from the published network:

- Strides 4, 8, 16 instead of 8, 16, 32, for craters of 2 px radius, and enough queries for all craters of a crowded
  frame.
- A query without a label is not penalised if its box overlaps an ignored label (`WitnessLoss`).
- Batch norms start at a weight of 1 and are trained: `transformers` draws their weights with a standard deviation of
  0.01 and freezes the batch norms of the backbone, which suits pretrained weights only.
"""

import math
from typing import Any

import lightning
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils import data as torch_data
from transformers import RTDetrResNetConfig, RTDetrV2Config, RTDetrV2ForObjectDetection
from transformers.loss.loss_rt_detr import RTDetrLoss

from perilune_train.config import Count
from perilune_train.data.epochs import EpochBatches, batch_loader
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import Sample, TrainingFrames, network_input, pinned
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.train.task import DetectTask
from perilune_train.models.boxes import iou

STRIDES = (4, 8, 16)
_HEADS = 8
_PRIOR = 0.01
_IGNORED_IOU = 0.5
"""A query whose box has at least this IoU with an ignored label is not penalised; the scoring rules use it too."""
_SPARE_QUERIES = 1.25

Target = dict[str, Tensor]
"""Labels of a frame: `boxes` (M, 4) as centre x, y, width, height in fractions of the frame; `class_labels` (M,), all
0; `ignored` (K, 4), x0, y0, x1, y1 in fractions of the frame."""


class WitnessConfig(DetectConfig):
    """Settings of the compared detector, with three settings of the witness.

    Settings of the architecture and the loss of YOLOv3 have no effect.
    """

    queries: Count
    """Largest number of detections in a frame."""
    channels: Count = 128
    """Channels of encoder and decoder; half as many in the first stage of the backbone."""
    decoder_layers: Count = 3
    """Number of layers of the decoder."""


def witness_config(config: DetectConfig, split: DetectSplit) -> WitnessConfig:
    """Settings of a witness of a detector with the settings `config`; `split` are its training frames.

    The number of queries is 1.25 times the largest number of selected labels in a training frame, at least 100.
    """
    most = max(int(labels.selected.sum()) for labels in split.labels)
    queries = max(100, 50 * math.ceil(_SPARE_QUERIES * most / 50))
    height, width = split.frames.images.shape[1:]
    queries = min(queries, sum((height // stride) * (width // stride) for stride in STRIDES))
    own = {"learning_rate": 5e-4, "weight_decay": 1e-4, "gradient_clip": 0.1, "attention": "none", "ellipses": False}
    return WitnessConfig(**{**config.model_dump(), **own}, queries=queries)


class Witness(nn.Module):
    """RT-DETRv2 on a ResNet of basic blocks, with the interface of `YOLOv3.detect_ellipses`."""

    ellipses = False

    def __init__(self, config: WitnessConfig):
        super().__init__()
        channels = config.channels
        sizes = [channels // 2, channels, 2 * channels]
        backbone = RTDetrResNetConfig(
            num_channels=config.in_channels,
            embedding_size=channels // 2,
            hidden_sizes=sizes,
            depths=[2, 2, 2],
            layer_type="basic",
            out_features=["stage1", "stage2", "stage3"],
        )
        self.settings = RTDetrV2Config(
            backbone_config=backbone,
            freeze_backbone_batch_norms=False,
            initializer_bias_prior_prob=_PRIOR,
            encoder_in_channels=sizes,
            feat_strides=list(STRIDES),
            encoder_hidden_dim=channels,
            encoder_ffn_dim=4 * channels,
            encoder_attention_heads=_HEADS,
            hidden_expansion=0.5,
            d_model=channels,
            decoder_in_channels=[channels] * len(STRIDES),
            decoder_ffn_dim=4 * channels,
            decoder_layers=config.decoder_layers,
            decoder_attention_heads=_HEADS,
            num_queries=config.queries,
            num_labels=1,
        )
        # The task head of `transformers` only adds a loss.
        self.network = RTDetrV2ForObjectDetection(self.settings).model
        for module in self.network.modules():
            if isinstance(module, nn.BatchNorm2d):
                nn.init.ones_(module.weight)

    def forward(self, images: Tensor, targets: list[Target] | None = None) -> Any:
        """Convert images (N, in_channels, H, W) to the network's outputs, in training with denoising queries."""
        return self.network(images, labels=targets)

    @torch.no_grad()
    def detect_ellipses(self, images: Tensor) -> tuple[Tensor, Tensor, None]:
        """Boxes (N, queries, 4), x0, y0, x1, y1 in pixels, and scores (N, queries); no shapes."""
        outputs = self(images)
        height, width = images.shape[2:]
        boxes = corners(outputs.intermediate_reference_points[:, -1].float())
        size = boxes.new_tensor([width, height, width, height])
        return boxes * size, outputs.intermediate_logits[:, -1, :, 0].float().sigmoid(), None


def corners(boxes: Tensor) -> Tensor:
    """Convert boxes (..., 4) from centre x, y, width, height to x0, y0, x1, y1."""
    centre, half = boxes[..., :2], boxes[..., 2:] / 2
    return torch.cat([centre - half, centre + half], dim=-1)


def target_of(outlines: NDArray[np.float64], selected: NDArray[np.bool_], width_px: int, height_px: int) -> Target:
    """Labels of a frame from its outlines (M, 5) and their selection (M,).

    Boxes are clipped to the frame: RT-DETR's boxes are in fractions of the frame from 0 to 1.
    """
    fractions = torch.as_tensor(outlines[:, :4] / [width_px, height_px, width_px, height_px], dtype=torch.float32)
    fractions = fractions.clamp(0, 1)
    chosen = torch.as_tensor(selected)
    low, high = fractions[chosen].split(2, dim=-1)
    return {
        "boxes": torch.cat([(low + high) / 2, high - low], dim=-1),
        "class_labels": torch.zeros(int(chosen.sum()), dtype=torch.long),
        "ignored": fractions[~chosen],
    }


def collate(samples: list[Sample]) -> tuple[Tensor, list[Target]]:
    """Make a batch of normalised frames (N, H, W) and their labels."""
    images = torch.as_tensor(np.stack([image for image, _, _ in samples]))
    height, width = images.shape[1:]
    return images, [target_of(outlines, selected, width, height) for _, outlines, selected in samples]


class WitnessLoss(RTDetrLoss):
    """The loss of RT-DETR, except that queries on ignored labels are not penalised."""

    def loss_labels_vfl(self, outputs, targets, indices, num_boxes, log=True) -> dict[str, Tensor]:
        """Varifocal loss of all queries, without unmatched queries whose boxes overlap an ignored label."""
        boxes, logits = corners(outputs["pred_boxes"].detach().float()), outputs["logits"][..., 0].float()
        frame, query = self._get_source_permutation_idx(indices)
        labels = torch.cat([target["boxes"][label] for target, (_, label) in zip(targets, indices, strict=True)])
        score, positive = torch.zeros_like(logits), torch.zeros_like(logits, dtype=torch.bool)
        score[frame, query], positive[frame, query] = iou(boxes[frame, query], corners(labels)), True
        weight = torch.where(positive, score, self.alpha * logits.detach().sigmoid() ** self.gamma)
        touched = torch.stack([on_ignored(own, target["ignored"]) for own, target in zip(boxes, targets, strict=True)])
        weight = weight.masked_fill(touched & ~positive, 0)
        loss = F.binary_cross_entropy_with_logits(logits, score, weight, reduction="sum") / num_boxes
        return {"loss_vfl": loss}


def on_ignored(boxes: Tensor, ignored: Tensor) -> Tensor:
    """Whether boxes (Q, 4) have an IoU of at least 0.5 with one of the ignored boxes (K, 4): (Q,) bool."""
    return (iou(boxes[:, None], ignored[None]) >= _IGNORED_IOU).any(1)


def witness_losses(criterion: WitnessLoss, outputs: Any, targets: list[Target]) -> dict[str, Tensor]:
    """Weighted losses of all decoder layers, of the encoder's queries and of the denoising queries."""
    logits, boxes = outputs.intermediate_logits, outputs.intermediate_reference_points
    arranged: dict[str, Any] = {}
    if outputs.denoising_meta_values is not None:
        counts = outputs.denoising_meta_values["dn_num_split"]
        (noisy_logits, logits), (noisy_boxes, boxes) = logits.split(counts, dim=2), boxes.split(counts, dim=2)
        arranged["dn_auxiliary_outputs"] = _by_layer(noisy_logits, noisy_boxes)
        arranged["denoising_meta_values"] = outputs.denoising_meta_values
    *earlier, last = _by_layer(logits, boxes)
    encoder = {"logits": outputs.enc_topk_logits, "pred_boxes": outputs.enc_topk_bboxes}
    return criterion({**last, "auxiliary_outputs": [*earlier, encoder], **arranged}, targets)


def _by_layer(logits: Tensor, boxes: Tensor) -> list[dict[str, Tensor]]:
    return [{"logits": a, "pred_boxes": b} for a, b in zip(logits.unbind(1), boxes.unbind(1), strict=True)]


def build_witness(config: WitnessConfig) -> Witness:
    """Build the network with random weights, which depend on `detect.seed`."""
    lightning.seed_everything(config.seed, verbose=False)
    return Witness(config)


class WitnessTask(DetectTask):
    """Training of the witness: schedule, moving average and validation of `DetectTask`, with RT-DETR's loss."""

    resides = False

    def __init__(self, network: Witness, config: WitnessConfig, train: DetectSplit, val: DetectSplit):
        super().__init__(network, config, train, val, 0)  # type: ignore[arg-type]
        self.architecture = config.model_dump(mode="json")
        self.criterion = WitnessLoss(network.settings)

    def train_dataloader(self) -> torch_data.DataLoader:
        epoch = self._trainer.fit_loop.epoch_progress.current.processed if self._trainer else 0
        resumed_epoch, batches = self.resumed
        frames = TrainingFrames(self.train_split, self.config)  # type: ignore[arg-type]
        start = batches if epoch == resumed_epoch else 0
        order = EpochBatches(frames.keys, len(self.train_split), self.config.batch_size, epoch, start)  # type: ignore[arg-type]
        return batch_loader(frames, order, collate, self.config.workers, pinned(self.config))

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        images, targets = batch
        moved = network_input(images.to(device), self.config.in_channels)
        return moved, [{name: part.to(device) for name, part in target.items()} for target in targets]

    def on_train_epoch_start(self) -> None:
        self.evaluated.eval()

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        pass

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        images, targets = batch
        self.images_seen += len(images)
        # `transformers` draws the noise of the denoising queries from the global generator. A resumed run draws the
        # same noise.
        with torch.random.fork_rng(devices=[self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(self.noise_seed(batch_idx))
            outputs = self.network(images, targets)
        losses = witness_losses(self.criterion, outputs, targets)
        for part in ("vfl", "bbox", "giou"):
            self.log(f"train/{part}", losses[f"loss_{part}"], batch_size=len(images))
        return torch.stack(list(losses.values())).sum()

    def noise_seed(self, batch_idx: int) -> int:
        """Seed of the denoising noise, from `detect.seed`, epoch and number of the batch."""
        epoch = self._trainer.current_epoch if self._trainer else 0
        return int(np.random.SeedSequence([self.config.seed, epoch, batch_idx]).generate_state(1)[0])
