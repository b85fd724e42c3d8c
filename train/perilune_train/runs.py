"""A run's folder, its weights, and the training loop that all tasks share."""

import io
import json
import logging
import math
import os
import pickle
import shutil
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from torch import nn

from perilune_shared.config import Section, to_yaml
from perilune_shared.errors import UserError
from perilune_shared.files import write_bytes, write_text
from perilune_shared.progress import progress_bar
from perilune_train.config import Precision

_STEPS_BETWEEN_LOOKS = 20


@dataclass(frozen=True)
class RunFolder:
    """`<runs>/<task>/<name>/`: everything that one run leaves behind."""

    root: Path
    """The folder."""

    @property
    def config(self) -> Path:
        """The resolved configuration."""
        return self.root / "config.yaml"

    @property
    def metrics(self) -> Path:
        """The figures, written last: a run that has them is finished."""
        return self.root / "metrics.json"

    @property
    def best(self) -> Path:
        """Weights with the best validation figure, as `save_weights` writes them."""
        return self.root / "checkpoints" / "best.ckpt"

    @property
    def last(self) -> Path:
        """The whole state when it was last kept, from which a run is resumed."""
        return self.root / "checkpoints" / "last.ckpt"

    @property
    def finished(self) -> bool:
        """Whether the run came to its end."""
        return self.metrics.is_file()


def is_first_process() -> bool:
    """Whether this process writes files and says things: the only one, or of several that train together the first."""
    return int(rank_zero_only.rank) == 0


def start_run(runs: Path, task: str, name: str, config: Section, resume: bool) -> RunFolder:
    """The folder of a run about to start, with its config.yaml; an older run of that name is replaced.

    With `resume` an older run is kept, if there is one. Raises UserError where it had another configuration, and
    where the folder holds something that is no run.
    """
    run = RunFolder(runs / task / name)
    text = to_yaml(task, config)
    if run.root.is_dir() and any(run.root.iterdir()):
        if not run.config.is_file():
            raise UserError(run.root, "--name", "a folder that is no run (no config.yaml)", "another name")
        if resume:
            if run.config.read_text(encoding="utf-8") != text:
                raise UserError(run.config, "--resume", "another configuration", "the settings the run began with")
            return run
        shutil.rmtree(run.root)
    write_text(run.config, text)
    return run


def write_metrics(run: RunFolder, metrics: Mapping[str, float | int | str | None]) -> None:
    """Write metrics.json: flat keys; what is not finite becomes null."""
    plain = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in metrics.items()
    }
    write_text(run.metrics, json.dumps(plain, indent=2, allow_nan=False) + "\n")


def save_weights(path: Path, architecture: Mapping[str, Any], network: nn.Module) -> None:
    """Write a network's weights beside the plain settings (`architecture`) that build it again."""
    # Through memory: torch's own writer hides a full disk behind a RuntimeError.
    content = io.BytesIO()
    torch.save({"architecture": dict(architecture), "state_dict": network.state_dict()}, content)
    write_bytes(path, content.getvalue())


def load_weights(path: Path) -> dict[str, Any]:
    """`{"architecture": settings, "state_dict": tensors}` of a file that `save_weights` wrote, on the CPU.

    Raises UserError where the file is missing, damaged, or anything but plain weights.
    """
    if not path.is_file():
        raise UserError(path, "checkpoint", "no such file", "checkpoints/best.ckpt of a finished run")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, OSError, ValueError, KeyError) as error:
        said = str(error) or type(error).__name__
        raise UserError(path, "checkpoint", said, "checkpoints/best.ckpt of a run") from None
    if not isinstance(content, dict) or not {"architecture", "state_dict"} <= content.keys():
        raise UserError(path, "checkpoint", "no architecture and state_dict", "checkpoints/best.ckpt of a run")
    return content


def check_architecture(path: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raise UserError naming the first setting of `wanted` in which a checkpoint's architecture differs."""
    for key, value in wanted.items():
        if found.get(key) != value:
            raise UserError(path, key, found.get(key), f"{value}; the checkpoint is of another architecture")


def fill(network: nn.Module, state: Mapping[str, torch.Tensor], path: Path) -> None:
    """Load all weights into a network. Raises UserError naming the first tensor that is missing, extra or misshapen."""
    own = network.state_dict()
    for key in sorted(own.keys() | state.keys()):
        found = tuple(state[key].shape) if key in state else "nothing"
        wanted = str(tuple(own[key].shape)) if key in own else "no such tensor"
        if str(found) != wanted:
            raise UserError(path, key, found, f"{wanted}; the checkpoint is of another architecture")
    network.load_state_dict(dict(state))


def choose_device(device: str) -> str:
    """`auto` is the GPU where there is one. Raises UserError where `cuda` is asked for in vain."""
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("settings", "device", "cuda", "cpu or auto: torch finds no GPU")
    return ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device


def choose_bf16(precision: Precision, device: str) -> bool:
    """Whether to compute in bfloat16: as asked, and with `auto` where the hardware has it."""
    if precision != "auto":
        return precision == "bf16"
    if device == "cuda":
        return torch.cuda.is_bf16_supported()
    return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)())


class KeepBest(Callback):
    """Saves the weights whenever the validation figure `monitor` improves (NaN never does).

    The task has `architecture` (plain settings) and `evaluated` (the network whose weights are judged).
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
                save_weights(self.run.best, pl_module.architecture, pl_module.evaluated)


class KeepLast(Callback):
    """Saves the whole state after every epoch and, with `minutes`, within an epoch at this interval.

    A run that begins again within an epoch has its `on_train_epoch_start` called, which Lightning leaves out.
    """

    def __init__(self, run: RunFolder, minutes: float | None):
        self.run, self.minutes = run, minutes

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        self.saved = time.monotonic()
        if trainer.fit_loop.restarted_mid_epoch:
            pl_module.on_train_epoch_start()

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        # At the last batch the validation is still to come, and the epoch's own checkpoint after it.
        if self.minutes is None or trainer.is_last_batch:
            return
        # Several processes agree on the time by asking the first, which costs a wait.
        if trainer.world_size == 1 or trainer.global_step % _STEPS_BETWEEN_LOOKS == 0:
            due = time.monotonic() - self.saved >= 60 * self.minutes
            if trainer.strategy.broadcast(due):
                self.save(trainer)

    def on_train_epoch_end(self, trainer, pl_module) -> None:
        self.save(trainer)

    def save(self, trainer: lightning.Trainer) -> None:
        """Write last.ckpt; an older one stays whole until the new one is."""
        trainer.save_checkpoint(self.run.last)
        self.saved = time.monotonic()


class Bar(Callback):
    """The workspace's own progress bar: steps done and to do, rate, time left, loss."""

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
        self.progress.advance(self.task)
        # A look at the loss makes a GPU wait.
        if batch_idx % _STEPS_BETWEEN_LOOKS == 0:
            note = f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}, loss {float(outputs['loss']):.3f}"
            self.progress.update(self.task, note=note)

    def on_train_end(self, trainer, pl_module) -> None:
        self.progress.stop()

    def on_exception(self, trainer, pl_module, exception) -> None:
        if hasattr(self, "progress"):
            self.progress.stop()


def machines(devices: int, num_nodes: int) -> tuple[int, int]:
    """Processes on each machine and machines: what torchrun says in the environment, or else what is asked for."""
    if torch.distributed.is_torchelastic_launched():
        local = int(os.environ["LOCAL_WORLD_SIZE"])
        return local, int(os.environ["WORLD_SIZE"]) // local
    return devices, num_nodes


def fit(
    run: RunFolder,
    task: lightning.LightningModule,
    *,
    label: str,
    epochs: int,
    monitor: str,
    mode: Literal["min", "max"],
    resume: bool = False,
    gradient_clip: float = 10.0,
    precision: Precision = "auto",
    device: str = "auto",
    devices: int = 1,
    num_nodes: int = 1,
    strategy: str = "auto",
    checkpoint_minutes: float | None = None,
) -> None:
    """Train `task` for a fixed number of epochs, keeping the best weights and the last state in the run's folder.

    The task gives its own loaders, asked for anew before every epoch (so that order and augmentation can follow
    from seed and epoch alone; with several processes each gives its share), logs `monitor` in validation, and has
    `architecture` and `evaluated` (see KeepBest). With `resume` training goes on from last.ckpt, if the run has one,
    and repeats exactly what an uninterrupted run does. That is kept after every epoch, and with `checkpoint_minutes`
    within epochs too; then the task's training batches must go on where the checkpoint was made.
    """
    device = choose_device(device)
    devices, num_nodes = machines(devices, num_nodes)
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer = lightning.Trainer(
            default_root_dir=run.root,
            max_epochs=epochs,
            accelerator="gpu" if device == "cuda" else "cpu",
            devices=devices,
            num_nodes=num_nodes,
            strategy=strategy if devices * num_nodes > 1 else "auto",
            use_distributed_sampler=False,
            precision="bf16-mixed" if choose_bf16(precision, device) else "32-true",
            deterministic="warn",
            gradient_clip_val=gradient_clip,
            reload_dataloaders_every_n_epochs=1,
            num_sanity_val_steps=0,
            logger=TensorBoardLogger(run.root, name="", version=""),
            log_every_n_steps=10,
            enable_progress_bar=False,
            enable_model_summary=False,
            enable_checkpointing=False,
            callbacks=[
                *([Bar(label)] if is_first_process() else []),
                LearningRateMonitor("step"),
                KeepBest(run, monitor, mode),
                KeepLast(run, checkpoint_minutes),
            ],
        )
        resume_from = str(run.last) if resume and run.last.is_file() else None
        try:
            trainer.fit(task, ckpt_path=resume_from, weights_only=True)
        except SystemExit:
            # Lightning answers Ctrl-C with a bare exit; the command line has words for it.
            raise KeyboardInterrupt from None
