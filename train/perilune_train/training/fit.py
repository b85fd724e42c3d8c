"""The training loop of all tasks, with Lightning: best weights, last state, progress bar, several processes."""

import logging
import math
import os
import time
import warnings
from dataclasses import dataclass
from typing import Any, Literal

import lightning
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from perilune_shared.console.terminal import progress_bar
from perilune_shared.errors import UserError
from perilune_shared.threads import warn_if_crowded
from perilune_train.config import Precision
from perilune_train.data.epochs import DataLost
from perilune_train.data.shares import Share
from perilune_train.training.fair_threads import FairThreads
from perilune_train.training.runs import (
    RunFolder,
    check_tensors,
    choose_bf16,
    choose_device,
    is_first_process,
    read_saved,
    save_weights,
)

_STEPS_BETWEEN_CHECKS = 20
_EARLY_STEPS, _DIVERGED, _MIN_FIRST_LOSS = 10, 1e3, 1e-3
"""Number of first steps whose loss is always checked. Training has diverged if the loss exceeds _DIVERGED times the
larger of the first loss and _MIN_FIRST_LOSS."""
_PROCESSES = "processes"
"""Key of the number of processes in last.ckpt. It must not change on resume: it determines the batches of a step."""
_STATE = {"pytorch-lightning_version", "state_dict", "loops", "optimizer_states", "lr_schedulers", "callbacks"}


class StopDiverged(Callback):
    """Stop training if the loss is not finite or far above the first loss; Adam does not recover from this.

    Raises UserError with the epoch, the loss and the setting to lower. The last saved state is kept.
    """

    def __init__(self, run: RunFolder, rate: str):
        self.run, self.rate = run, rate
        self.first: float | None = None

    def state_dict(self) -> dict[str, float | None]:
        return {"first": self.first}

    def load_state_dict(self, state_dict: dict[str, float | None]) -> None:
        self.first = state_dict["first"]

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        # Reading the loss makes the GPU wait, so do it rarely. Always check the last batch,
        # before validation runs and the state is saved.
        early = trainer.global_step <= _EARLY_STEPS
        if early or trainer.is_last_batch or batch_idx % _STEPS_BETWEEN_CHECKS == 0:
            loss = float(outputs["loss"]) * trainer.accumulate_grad_batches
            self.first = abs(loss) if self.first is None else self.first
            if not math.isfinite(loss) or abs(loss) > _DIVERGED * max(self.first, _MIN_FIRST_LOSS):
                self._stop(trainer, f"{loss:g}, the first was {self.first:g}")

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        # The last step may have ruined weights whose loss was still finite.
        state = pl_module.evaluated.state_dict().values()
        if not all(bool(torch.isfinite(tensor).all()) for tensor in state if tensor.is_floating_point()):
            self._stop(trainer, "weights that are not finite")

    def _stop(self, trainer: lightning.Trainer, loss_text: str) -> None:
        expected = f"a decreasing loss: lower {self.rate} and run again with --overwrite"
        raise UserError(self.run.root, f"loss in epoch {trainer.current_epoch + 1}", loss_text, expected)


class KeepBest(Callback):
    """Save the weights whenever the validation metric `monitor` improves; NaN is no improvement.

    The task has `architecture` and `evaluated`, the network to evaluate and save. It may have `terrain`, the record of
    its training terrain. `save_weights` describes `architecture` and `terrain`.
    """

    def __init__(self, run: RunFolder, monitor: str, mode: Literal["min", "max"]):
        self.run, self.monitor = run, monitor
        self.sign = 1.0 if mode == "max" else -1.0
        self.best = -math.inf

    def state_dict(self) -> dict[str, float]:
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        self.best = state_dict["best"]

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        value = self.sign * float(trainer.callback_metrics[self.monitor])
        if value > self.best or not self.run.best.is_file():
            self.best = value if math.isfinite(value) else self.best
            if is_first_process():
                save_weights(
                    self.run.best, pl_module.architecture, pl_module.evaluated, getattr(pl_module, "terrain", None)
                )


class KeepLast(Callback):
    """Save the whole state after every validated epoch and, if `minutes` is given, after every `minutes` of an epoch.

    If a run resumes within an epoch, Lightning skips the task's `on_train_epoch_start`; this callback calls it.
    """

    def __init__(self, run: RunFolder, minutes: float | None):
        self.run, self.minutes = run, minutes
        self.seconds_before_resume, self.began = 0.0, time.monotonic()

    @property
    def seconds(self) -> float:
        """Training time so far in seconds, including the time before a resume."""
        return self.seconds_before_resume + time.monotonic() - self.began

    def state_dict(self) -> dict[str, float]:
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        self.seconds_before_resume = state_dict["seconds"]

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self.saved = time.monotonic()
        if trainer.fit_loop.restarted_mid_epoch:
            pl_module.on_train_epoch_start()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        # Do not save after the last batch: the validation and the checkpoint of the epoch follow. Do not save between
        # the batches of one step: the state would lack the gradients summed so far.
        between = (batch_idx + 1) % trainer.accumulate_grad_batches != 0
        if self.minutes is None or trainer.is_last_batch or between:
            return
        # Several processes follow the clock of the first. The broadcast makes all of them wait, so do it rarely.
        if trainer.world_size == 1 or trainer.global_step % _STEPS_BETWEEN_CHECKS == 0:
            due = time.monotonic() - self.saved >= 60 * self.minutes
            if trainer.strategy.broadcast(due):
                self.save(trainer)

    def on_train_epoch_end(self, trainer, pl_module) -> None:
        # A task with many short epochs validates and saves only after some of them.
        if (trainer.current_epoch + 1) % trainer.check_val_every_n_epoch == 0:
            self.save(trainer)

    def on_exception(self, trainer, pl_module, exception) -> None:
        # Loaders raise DataLost between two batches, when the state is complete. With several processes, do not save,
        # because the others may still train. Before the first batch of an epoch, last.ckpt already has the state.
        done = trainer.fit_loop.epoch_loop.batch_progress.current
        between = done.ready == done.completed > 0 and done.completed % trainer.accumulate_grad_batches == 0
        if isinstance(exception, DataLost) and self.minutes is not None and trainer.world_size == 1 and between:
            self.save(trainer)

    def on_save_checkpoint(self, trainer, pl_module, checkpoint: dict[str, Any]) -> None:
        checkpoint[_PROCESSES] = trainer.world_size

    def save(self, trainer: lightning.Trainer) -> None:
        """Write last.ckpt atomically; the older file stays until the new one is complete."""
        trainer.save_checkpoint(self.run.last)
        self.saved = time.monotonic()


class FewerThreadsIfCrowded(Callback):
    """Adapt the number of threads on a CPU to other work on the machine (see `FairThreads`)."""

    def __init__(self, enabled: bool):
        # Validation steps take less time than training steps, so the two are timed separately.
        self.training, self.validation = FairThreads(enabled), FairThreads(enabled)

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        self.training.__enter__()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        self.training.__exit__()

    def on_validation_batch_start(self, trainer, pl_module, batch, batch_idx, dataloader_idx=0) -> None:
        self.validation.__enter__()

    def on_validation_batch_end(self, trainer, pl_module, outputs, batch, batch_idx, dataloader_idx=0) -> None:
        self.validation.__exit__()

    def on_exception(self, trainer, pl_module, exception) -> None:
        self.training.restore()


class Bar(Callback):
    """Progress bar with steps done, total steps, rate, time left and loss."""

    def __init__(self, label: str):
        self.label = label

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self.progress = progress_bar()
        total = int(trainer.estimated_stepping_batches)
        self.task = self.progress.add_task(
            self.label, total=total, completed=trainer.global_step, unit="steps", note=""
        )
        self.progress.start()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        self.progress.update(self.task, completed=trainer.global_step)
        # Reading the loss makes the GPU wait, so do it rarely.
        if batch_idx % _STEPS_BETWEEN_CHECKS == 0:
            note = f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}, loss {float(outputs['loss']):.3f}"
            self.progress.update(self.task, note=note)

    def on_train_end(self, trainer, pl_module) -> None:
        self.progress.stop()

    def on_exception(self, trainer, pl_module, exception) -> None:
        if hasattr(self, "progress"):
            self.progress.stop()


def process_layout(devices: int, num_nodes: int) -> tuple[int, int]:
    """Processes per machine and number of machines: under torchrun from its environment, else the arguments."""
    if torch.distributed.is_torchelastic_launched():
        local = int(os.environ["LOCAL_WORLD_SIZE"])
        return local, int(os.environ["WORLD_SIZE"]) // local
    return devices, num_nodes


def own_share(devices: int, num_nodes: int) -> Share:
    """The share of the data that this process trains on; also correct before training (see `is_first_process`)."""
    return Share(int(rank_zero_only.rank), math.prod(process_layout(devices, num_nodes)))


@dataclass(frozen=True, slots=True)
class Schedule:
    """How long to train, how to make a step, and when to validate and save."""

    epochs: int
    """Number of epochs."""
    monitor: str
    """Validation metric that selects the best weights."""
    mode: Literal["min", "max"]
    """Whether a smaller or a larger value of this metric is better."""
    validate_every: int = 1
    """Epochs from one validation to the next."""
    checkpoint_minutes: float | None = None
    """Minutes between saved states within an epoch; None to save after validations only."""
    accumulate: int = 1
    """Batches whose gradients are summed for one step."""
    gradient_clip: float = 10.0
    """Largest norm of the gradient of a step."""


@dataclass(frozen=True, slots=True)
class Hardware:
    """Devices and processes for training."""

    device: str = "auto"
    """auto, cuda or cpu."""
    devices: int = 1
    """Processes on each machine; torchrun's environment overrides it."""
    num_nodes: int = 1
    """Machines; torchrun's environment overrides it."""
    strategy: str = "auto"
    """Lightning's strategy for several processes."""
    precision: Precision = "auto"
    """Floating-point format of the computation."""


@dataclass(frozen=True, slots=True)
class Wording:
    """Names in the messages of training."""

    progress: str
    """Label of the progress bar."""
    learning_rate: str = "the learning rate"
    """The setting to lower if the loss diverges."""


def fit(
    run: RunFolder,
    task: lightning.LightningModule,
    schedule: Schedule,
    hardware: Hardware,
    wording: Wording,
    resume: bool = False,
) -> float:
    """Train `task` for a fixed number of epochs; keep the best weights and the last state in the run's folder.

    Returns the training time in seconds, including the time before a resume.

    The task creates its loaders once. Before each epoch, Lightning passes the epoch's number to `set_epoch` of the
    batch sampler's `sampler` (see data/epochs.py). Order and augmentation can thus depend on seed and epoch only. With
    several processes, each loader provides the batches of its own process. The task logs `schedule.monitor` in
    validation, and has `architecture` and `evaluated` (see KeepBest).

    With `resume`, training continues from last.ckpt, if the run has this file, and gives exactly the result of an
    uninterrupted run. The state is saved after every validation. With `schedule.checkpoint_minutes` it is also saved
    within epochs; the task's loader must then continue at the position of the checkpoint.

    Raises UserError if last.ckpt is damaged or belongs to another network or number of processes, if Lightning gives
    this process a rank other than the one in the environment, or if the loss diverges.
    """
    share = own_share(hardware.devices, hardware.num_nodes)
    devices, num_nodes = process_layout(hardware.devices, hardware.num_nodes)
    resume_from = run.last if resume and run.last.is_file() else None
    if resume_from is not None:
        expected = "the state of an interrupted run; --overwrite replaces it"
        state = read_saved(resume_from, "last state", _STATE, expected)
        check_tensors(resume_from, state["state_dict"], task)
        began = state.get(_PROCESSES, 1)
        if began != devices * num_nodes:
            expected = f"{began}, as in the existing run; --overwrite replaces the run"
            raise UserError(resume_from, "processes", devices * num_nodes, expected)
    keep_last = KeepLast(run, schedule.checkpoint_minutes)
    device = choose_device(hardware.device)
    # With several processes, Lightning divides the cores among them.
    threads = FewerThreadsIfCrowded(device == "cpu" and devices * num_nodes == 1)
    warn_if_crowded()
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # By default, deterministic algorithms fill new tensors with a value before use, which only costs time here.
    setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)  # noqa: B010
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer = lightning.Trainer(
            default_root_dir=run.root,
            max_epochs=schedule.epochs,
            accelerator="gpu" if device == "cuda" else "cpu",
            devices=devices,
            num_nodes=num_nodes,
            strategy=hardware.strategy if devices * num_nodes > 1 else "auto",
            use_distributed_sampler=False,
            precision="bf16-mixed" if choose_bf16(hardware.precision, device) else "32-true",
            deterministic="warn",
            gradient_clip_val=schedule.gradient_clip,
            accumulate_grad_batches=schedule.accumulate,
            num_sanity_val_steps=0,
            check_val_every_n_epoch=schedule.validate_every,
            logger=TensorBoardLogger(run.root, name="", version=""),
            log_every_n_steps=10,
            enable_progress_bar=False,
            enable_model_summary=False,
            enable_checkpointing=False,
            callbacks=[
                *([Bar(wording.progress)] if is_first_process() else []),
                LearningRateMonitor("step"),
                StopDiverged(run, wording.learning_rate),
                KeepBest(run, schedule.monitor, schedule.mode),
                keep_last,
                threads,
            ],
        )
        if trainer.global_rank != share.process:
            expected = (
                f"{share.process}, as in the environment; start training on several machines with torchrun or Slurm"
            )
            raise UserError("machines", "rank", trainer.global_rank, expected)
        try:
            trainer.fit(task, ckpt_path=resume_from, weights_only=True)
        except SystemExit:
            # On Ctrl-C, Lightning raises SystemExit; the command line prints a message for KeyboardInterrupt.
            raise KeyboardInterrupt from None
    return keep_last.seconds
