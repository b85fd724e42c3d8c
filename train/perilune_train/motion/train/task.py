"""Train the navigation networks."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import lightning
import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from perilune_train.data.epochs import EpochBatches, batch_loader
from perilune_train.data.shares import ALONE, Share
from perilune_train.models.navigator import WarpNavigator
from perilune_train.motion.config import FusionConfig, NavigateConfig, Target
from perilune_train.motion.data.epochs import TrainingSequences
from perilune_train.motion.data.sequences import Jitter
from perilune_train.motion.data.stream import Stream
from perilune_train.motion.data.streamed import StreamedSequences
from perilune_train.motion.data.trajectories import Motion, Pose, Trajectory, own_trajectories
from perilune_train.motion.geometry import euler_from_rotation
from perilune_train.motion.metrics.errors import motion_errors, pose_errors, summary
from perilune_train.motion.network import (
    Batch,
    Collate,
    Fusion,
    Scales,
    build,
    decoded_rotation,
    network_output,
    predict,
)
from perilune_train.motion.pose import predict_pose
from perilune_train.motion.train.stored import stored_features
from perilune_train.motion.train.views import other_views
from perilune_train.motion.train.windows import OutputUnits, WindowPlaces, Windows, collated
from perilune_train.records.provenance import Provenance
from perilune_train.training.runs import choose_bf16, choose_device

_OF_STACK = ("target", "pool", "stages", "dropout", "sequence_pairs")
"""Settings that the architecture of a stack network stores."""
_VALIDATIONS = 10
"""Approximate number of validations in a coarse stage on stored features, where an epoch takes a second or less."""
_WARM_STEPS = 50


def learning_rate_factor(
    step: int, coarse_steps: int, fine_steps: int, cycles: int, coarse: float | None = None
) -> float:
    """Factor on the learning rate: a short warm-up, then the cosines that `FusionConfig.cycles` describes.

    `coarse` is the factor at the peak of the coarse stage. If it is given, each stage has a separate warm-up and
    separate cosines.
    """
    if coarse is not None:
        if step < coarse_steps:
            return coarse * learning_rate_factor(step, 0, coarse_steps, 1)
        fine_step = step - coarse_steps
        return min((fine_step + 1) / _WARM_STEPS, learning_rate_factor(fine_step, 0, fine_steps, cycles))
    total = max(1, coarse_steps + fine_steps)
    warm = (step + 1) / max(1, min(_WARM_STEPS, total // 10))
    done = min(step / total, 1.0)
    if cycles > 1:
        turns = cycles * (step - coarse_steps) / max(1, fine_steps)
        done = 0.0 if turns < 0 else 1.0 if turns >= cycles else turns % 1.0
    return min(warm, 0.5 * (1 + math.cos(math.pi * done)))


def axis_weights(scales: Scales, target: Target) -> Tensor:
    """Weights (3,) of the standardised position errors along the axes in the loss.

    Positions spread over hundreds of metres along the descent and over a few metres across it. Equal weights on
    standardised errors would leave the positions along the descent inaccurate. Equal weights on errors in metres would
    leave the positions across it inaccurate. The weights are the geometric mean of both choices.
    """
    if target == "motion":
        return torch.ones(3)
    spread_m = torch.tensor(scales.spread_m)
    return (spread_m / spread_m.square().mean().sqrt()).sqrt()


@dataclass(frozen=True, slots=True)
class Initial:
    """Initial weights and scales, used in place of random weights and measured scales."""

    backbone: dict[str, Tensor] | None = None
    """Weights of a detector's backbone, by name."""
    scales: Scales | None = None
    """Scales of the network whose weights are loaded later."""


RANDOM = Initial()
"""Random weights; scales measured on the training trajectories."""


class NavigationTask(lightning.LightningModule):
    """Training of one network: the paper's coarse stage, then its fine stage; AdamW, short warm-up, cosine to zero.

    The loss of the coarse stage is L^(S1) = |dP|^2 + kappa |dphi|^2. The loss of the fine stage is
    L^(S2) = e^-s_p |dP|^2 + e^-s_phi |dphi|^2 + s_p + s_phi with learnt s_p, s_phi. The errors are standardised: dP by
    the unit of the translation, dphi (Euler angles) by the spread of the rotation. Deviations from the paper: means
    over the pairs instead of sums; one cosine instead of five cycles, unless `cycles` is 5; the pairs of warp are
    mirrored and jittered (see data/sequences.py).

    If the whole backbone of a stack network is given, the coarse stage computes the backbone's features only once. This
    includes the features of further views of the training trajectories (`views`).

    The target `pose` replaces the motion by the pose in O_L at the later frame. P is then the position, and its axes
    have the weights of `axis_weights`.
    """

    def __init__(
        self,
        settings: NavigateConfig,
        fusion: Fusion,
        trajectories: list[Trajectory],
        share: Share = ALONE,
        stream: Stream | None = None,
        initial: Initial = RANDOM,
    ):
        super().__init__()
        self.settings, self.fusion, self.stream = settings, fusion, stream
        self.own: FusionConfig = getattr(settings, fusion)
        # Initial weights need the scales of the run that trained them.
        training = [trajectory for trajectory in trajectories if trajectory.split == "train"]
        self.scales = initial.scales or Scales.measured(training, fusion, self.own.target)
        self.architecture = {
            "fusion": fusion,
            "size_px": self.own.size_px,
            "width": self.own.width,
            "attention": self.own.attention,
            "hidden": self.own.hidden,
            "in_channels": settings.in_channels if fusion == "stack" else WarpNavigator.CHANNELS,
            "focal_over_width": trajectories[0].camera.fx_px / trajectories[0].camera.width_px,
            "scales": {key: value for key, value in asdict(self.scales).items() if value is not None},
        }
        if fusion == "stack":
            self.architecture |= {key: getattr(self.own, key) for key in _OF_STACK}
        network: Any = build(self.architecture)
        self.network = network.to(memory_format=torch.channels_last)
        self.axis_weights: Tensor
        self.register_buffer("axis_weights", axis_weights(self.scales, self.own.target), persistent=False)
        self.pretrained = frozenset(initial.backbone or ())
        if initial.backbone:
            self.network.backbone.load_state_dict(initial.backbone, strict=False)
        self.provenance: Provenance | None = None
        self.log_weights = nn.Parameter(torch.zeros(2))
        self.share = share
        self.training_trajectories = [trajectory.shrunk(self.own.size_px) for trajectory in training]
        self.views = other_views(self.training_trajectories, self.own.views, self.own.view_spread, settings.seed)
        self.validation_trajectories = [
            trajectory.shrunk(self.own.size_px) for trajectory in trajectories if trajectory.split == "val"
        ]
        all_pretrained = {name for name, _ in self.network.backbone.named_parameters()} <= self.pretrained
        self.stores = fusion == "stack" and all_pretrained and self.own.coarse_epochs > 0
        self.stored: dict[str, list[Tensor]] = {}
        self.windows: Windows | None = None
        self.resumed = (0, 0)
        self.validated = own_trajectories("val", len(self.validation_trajectories), share)
        jitter, scales = self.own.jitter, self.scales
        self.jitter = Jitter(jitter * np.array(scales.spread_m), jitter * scales.rotation_rad) if jitter else None
        self.sequences = self._sequences()

    def close(self) -> None:
        """Stop the thread that renders sequences."""
        if isinstance(self.sequences, StreamedSequences):
            self.sequences.close()

    @property
    def terrain(self) -> dict[str, Any] | None:
        """The record of the training terrain as plain data, including all terrain that was rendered so far."""
        if self.provenance is None:
            return None
        rendered = self.stream.uses if self.stream is not None else frozenset()
        return self.provenance.joined([Provenance(rendered)]).plain()

    @property
    def evaluated(self) -> nn.Module:
        """The network to evaluate and save."""
        return self.network

    @property
    def coarse(self) -> bool:
        """Whether the current epoch belongs to the coarse stage."""
        return self.current_epoch < self.own.coarse_epochs

    def _sequences(self) -> TrainingSequences:
        options: dict[str, Any] = {
            "warp": self.fusion == "warp",
            "jitter": self.jitter,
            "seed": self.settings.seed,
            "share": self.share,
        }
        trajectories_and_length = self.training_trajectories, self.own.sequence_pairs
        if self.fusion == "stack":
            places = WindowPlaces(*trajectories_and_length, **options)
            places.views = self.own.views
            return places
        if self.stream is None:
            return TrainingSequences(*trajectories_and_length, **options)
        return StreamedSequences(self.stream, self.own.size_px, *trajectories_and_length, **options)

    def train_dataloader(self) -> DataLoader:
        # In a resumed run, Lightning's current epoch is one too low at this point.
        epoch = self._trainer.fit_loop.epoch_progress.current.processed if self._trainer else 0
        resumed_epoch, done = self.resumed
        start = done if epoch == resumed_epoch else 0
        batches = EpochBatches(self.sequences.keys, self.sequences.fewest, self.own.batch_sequences, epoch, start)
        pinned = choose_device(self.settings.device) == "cuda"
        if self.fusion == "stack":
            # Use no workers, because they would have nothing to prepare.
            return batch_loader(self.sequences, batches, collated, 0, pinned)
        return batch_loader(self.sequences, batches, Collate(self.scales, self.fusion), self.settings.workers, pinned)

    def val_dataloader(self) -> DataLoader:
        trajectories = [self.validation_trajectories[number] for number in self.validated]
        return DataLoader(trajectories, batch_size=None)  # type: ignore[arg-type]

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        if isinstance(batch, Tensor):
            return batch.to(device, non_blocking=True)
        # In validation a batch is a trajectory; `predict` moves it to the device.
        return batch.to(device) if isinstance(batch, Batch) else batch

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        done = self.trainer.fit_loop.epoch_loop.batch_progress.current.processed
        checkpoint["epoch_and_batches"] = [self.current_epoch, done]
        if self.stream is not None:
            self.stream.join_records(self.share.processes)
            checkpoint["streamed"] = self.stream.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        epoch, done = checkpoint.get("epoch_and_batches", (0, 0))
        self.resumed = (epoch, done)
        if self.stream is not None:
            self.stream.load_state_dict(checkpoint.get("streamed", []))

    def on_train_epoch_start(self) -> None:
        for name, parameter in self.network.backbone.named_parameters():
            parameter.requires_grad_(not (self.coarse and name in self.pretrained))
        for name, module in self.network.backbone.named_modules():
            if isinstance(module, nn.BatchNorm2d):
                # Batch statistics would change the features by more than the spread of the features over the
                # trajectories, so a network for poses keeps the detector's statistics.
                keep_statistics = self.coarse or self.own.target == "pose"
                # Check the statistics, because the norms of some gates have statistics but no weight.
                module.train(not (keep_statistics and f"{name}.running_mean" in self.pretrained))
        if self.fusion == "stack" and self.windows is None:
            numbers = list(self.share.of(len(self.training_trajectories)))
            place = self.training_trajectories, numbers, self.sequences.n_pairs
            units = OutputUnits(self.own.target, self.scales)
            self.windows = Windows(*place, units, self.device, self.views)
        stores, last = self.coarse and self.stores, self.current_epoch + 1 == self.own.coarse_epochs
        if stores and not self.stored:
            self._store()
        # Lightning reads this setting after the last batch of every epoch.
        often = not stores or last
        self.trainer.check_val_every_n_epoch = 1 if often else max(1, self.own.coarse_epochs // _VALIDATIONS)

    def _store(self) -> None:
        """Compute the features of the frozen backbone."""
        count = len(self.training_trajectories)
        training = [self.training_trajectories[number] for number in self.share.of(count)]
        views = [self.views[v * count + number] for v in range(self.own.views) for number in self.share.of(count)]
        validation = [self.validation_trajectories[number] for number in self.validated]
        bf16 = choose_bf16(self.settings.precision, self.device.type)
        pooled = [
            stored_features(self.network, split_features, self.device, bf16, others)
            for split_features, others in ((training, views), (validation, ()))
        ]
        if self.network.standardised:
            self.network.measure(torch.cat(pooled[0]))
        train, val = (
            [self.network.scaled(pair_features) for pair_features in split_features] for split_features in pooled
        )
        self.stored = {"train": [torch.cat(train)], "val": val}

    def _loss(self, output: Tensor, true_position: Tensor, true_angles: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of the current stage, and the parts of this loss."""
        angles = euler_from_rotation(decoded_rotation(output, self.scales)) / self.scales.rotation_rad
        position = ((output[..., :3] - true_position) * self.axis_weights).square().sum(-1).mean()
        orientation = (angles - true_angles).square().sum(-1).mean()
        if self.coarse:
            loss = position + self.settings.kappa * orientation
        else:
            weighted = torch.stack([position, orientation]) * torch.exp(-self.log_weights)
            loss = (weighted + self.log_weights).sum()
        return loss, {"train/position": position, "train/orientation": orientation}

    def training_step(self, batch: Batch | Tensor, batch_idx: int) -> Tensor:
        if isinstance(batch, Tensor):
            return self._stack_step(batch, batch_idx)
        output, flow_px, _ = network_output(self.network, batch)
        loss, parts = self._loss(output, batch.translation, batch.angles)
        if flow_px is not None and batch.flow_px is not None:
            flow_error = (flow_px - batch.flow_px).square().sum(-1).add(1e-4).sqrt().mean()
            self.log("train/flow_px", flow_error, batch_size=len(batch.first))
            loss = loss + self.settings.flow_weight * flow_error
        self.log_dict({"train/loss": loss, **parts}, batch_size=len(batch.first))
        return loss

    def _stack_step(self, places: Tensor, batch_idx: int) -> Tensor:
        """A training step of a stack network on the sequences at `places` (see `Windows`)."""
        assert self.windows is not None
        if self.own.dropout:
            # Seed the dropout, so that a resumed run draws equal masks.
            seeds = [self.settings.seed, self.current_epoch, batch_idx, self.share.process]
            torch.manual_seed(int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0]))
        pairs = self.windows.pairs(places)
        if self.coarse and self.stores:
            output, _ = self.network.recurrent(self.stored["train"][0][pairs])
        else:
            output, _ = self.network(*self.windows.pictures(places))
        loss, parts = self._loss(output, self.windows.position[pairs], self.windows.angles[pairs])
        self.log_dict({"train/loss": loss, **parts}, batch_size=len(places))
        return loss

    def on_validation_epoch_start(self) -> None:
        self.validation_motions: list[Motion | Pose] = []
        if self.stream is not None:
            self.stream.join_records(self.share.processes)
        if self.share.processes > 1:
            # Weights are equal in all processes, but batch statistics differ. Use the statistics of the first process.
            for value in self.network.buffers():
                torch.distributed.broadcast(value, 0)

    def validation_step(self, batch: Trajectory, batch_idx: int) -> None:
        features = self.stored["val"][batch_idx] if self.coarse and self.stores else None
        predicted = predict_pose if self.own.target == "pose" else predict
        self.validation_motions.append(predicted(self.network, self.architecture, batch, features))

    def on_validation_epoch_end(self) -> None:
        motions, processes, count = self.validation_motions, self.share.processes, len(self.validation_trajectories)
        if processes > 1:
            parts: list[Any] = [None] * processes
            torch.distributed.all_gather_object(parts, motions)
            motions = [parts[i % processes][i // processes] for i in range(count)]
        errors = pose_errors if self.own.target == "pose" else motion_errors
        figures = summary(errors(self.validation_trajectories, motions))
        for key in ("position_rmse_vector_m", "orientation_rmse_angle_deg"):
            self.log(f"val/{key}", figures[key], batch_size=1)

    def configure_gradient_clipping(
        self, optimizer: Any, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        # Lightning refuses to clip for fused optimizers under mixed precision. The reason is the loss scaling of
        # float16, which this training does not use, so clip here.
        if gradient_clip_val:
            torch.nn.utils.clip_grad_norm_(self.parameters(), gradient_clip_val)

    def configure_optimizers(self) -> Any:
        steps = -(-len(self.train_dataloader()) // self.own.accumulate)
        # The two loss weights must change by about 1 during the run, so their learning rate does not depend on the
        # learning rate of the network.
        rate, factor = self.own.learning_rate, self.own.backbone_factor
        slower = {f"backbone.{name}" for name in self.pretrained} if factor < 1 else set()
        named = list(self.network.named_parameters())
        groups = [
            {"params": [value for name, value in named if name not in slower], "lr": rate, "weight_decay": 1e-3},
            {"params": [self.log_weights], "lr": 1e-2, "weight_decay": 0.0},
        ]
        if slower:
            own_values = [value for name, value in named if name in slower]
            groups.append({"params": own_values, "lr": factor * rate, "weight_decay": 1e-3})
        optimizer = torch.optim.AdamW(
            groups,
            # The fused optimizer passes over memory once and is ten times as fast on a CPU, where the optimizer takes
            # half the time of a step on stored features.
            fused=True,
        )
        settings = self.own
        coarse = settings.coarse_learning_rate and settings.coarse_learning_rate / settings.learning_rate
        stages = settings.coarse_epochs * steps, settings.fine_epochs * steps
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: learning_rate_factor(step, *stages, settings.cycles, coarse)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
