"""A run's folder and weights; choice of device and precision."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_bytes
from perilune_train.config import Precision
from perilune_train.records.metrics_file import METRICS_FILE, has_metrics
from perilune_train.records.provenance import RECORD
from perilune_train.training.checkpoint_file import (
    MAX_STATE_BYTES,
    MAX_WEIGHT_BYTES,
    check_weights,
    is_whole,
    load_checked,
)
from perilune_train.training.half_weights import SUFFIX, read_half
from perilune_train.training.half_weights import is_whole as half_is_whole


@dataclass(frozen=True)
class RunFolder:
    """`<runs>/<task>/<name>/`: the folder of all output of one run."""

    root: Path
    """The folder."""

    @property
    def config(self) -> Path:
        """The resolved configuration."""
        return self.root / "config.yaml"

    @property
    def inputs(self) -> Path:
        """Hashes of the dataset and of the checkpoints that the run reads."""
        return self.root / "inputs.json"

    @property
    def metrics(self) -> Path:
        """The metrics, written last: a run that has them is finished."""
        return self.root / METRICS_FILE

    @property
    def best(self) -> Path:
        """The weights with the best validation metric.

        The file is weights.safetensors if it exists (in the folder of an installed model), otherwise
        checkpoints/best.ckpt, which `save_weights` writes.
        """
        shipped = self.root / ("weights" + SUFFIX)
        return shipped if shipped.is_file() else self.root / "checkpoints" / "best.ckpt"

    @property
    def last(self) -> Path:
        """The last saved training state, from which a run is resumed."""
        return self.root / "checkpoints" / "last.ckpt"

    @property
    def finished(self) -> bool:
        """Whether the run has metrics.json, and no file of metrics or weights is damaged."""
        return self.metrics.is_file() and self.damaged is None

    @property
    def damaged(self) -> Path | None:
        """The first damaged file: weights or metrics that are empty or truncated. None if no file is damaged."""
        if self.best.is_file() and not (half_is_whole if self.best.suffix == SUFFIX else is_whole)(self.best):
            return self.best
        if self.metrics.is_file() and not has_metrics(self.root):
            return self.metrics
        return None


@dataclass(frozen=True, slots=True)
class NamedRun:
    """A run to start, resume or replace."""

    runs: Path
    """Folder of all runs."""
    name: str
    """Name of the run."""
    overwrite: bool = False
    """Whether to replace an existing run."""

    def folder(self, task: str, ending: str = "") -> RunFolder:
        """The folder <runs>/<task>/<name><ending>."""
        return RunFolder(self.runs / task / f"{self.name}{ending}")


def is_first_process() -> bool:
    """Whether this process writes files and messages: the only process, or the first of several that train together.

    Also correct before training: the rank comes from an environment variable that Lightning or torchrun sets.
    """
    # Imported here, so that commands that do not train need not import Lightning.
    from lightning.pytorch.utilities import rank_zero_only

    return int(rank_zero_only.rank) == 0


def save_weights(
    path: Path, architecture: Mapping[str, Any], network: nn.Module, terrain: Mapping[str, Any] | None = None
) -> None:
    """Write a network's weights with the settings (`architecture`) that rebuild the network.

    `terrain` is the record of the terrain that the network was fitted to (`records.provenance.Provenance.plain`). With
    None, the file has no such record. Both consist of numbers, texts, lists and dictionaries only.
    """
    # Save to memory first: torch reports a full disk as a RuntimeError, not as an OSError.
    content = io.BytesIO()
    record = {} if terrain is None else {RECORD: dict(terrain)}
    torch.save({"architecture": dict(architecture), "state_dict": network.state_dict(), **record}, content)
    write_bytes(path, content.getvalue())


def load_weights(path: Path) -> dict[str, Any]:
    """Read a file that `save_weights` or `write_half` wrote: `{"architecture": settings, "state_dict": tensors}`.

    The tensors are on the CPU, and finite. The architecture is a dictionary of numbers, texts, lists and dictionaries;
    the loader of each kind of network checks them. The key `terrain` may be present (see `save_weights`).

    Raises UserError if the file is missing, is damaged or has other content.
    """
    if not path.is_file():
        raise UserError(path, "checkpoint", "no such file", "checkpoints/best.ckpt of a finished run")
    if path.suffix == SUFFIX:
        content = read_half(path)
    else:
        keys, expected = {"architecture", "state_dict"}, "checkpoints/best.ckpt of a run"
        content = read_saved(path, "checkpoint", keys, expected, MAX_WEIGHT_BYTES)
    if not isinstance(content["architecture"], dict):
        raise UserError(path, "architecture", type(content["architecture"]).__name__, "settings by name")
    check_weights(path, "weights", content["state_dict"])
    return content


def read_saved(
    path: Path, field: str, keys: set[str], expected: str, max_bytes: int = MAX_STATE_BYTES
) -> dict[str, Any]:
    """Read a dictionary saved by torch, on the CPU. Raises UserError if the file is damaged or lacks `keys`."""
    content = load_checked(path, field, expected, max_bytes)
    missing = keys - content.keys() if isinstance(content, dict) else keys
    if missing:
        raise UserError(path, field, f"no {', '.join(sorted(missing))}", expected)
    return content


def check_architecture(path: Path, got: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Raise UserError naming the first setting of `expected` that differs in a checkpoint's architecture."""
    for key, value in expected.items():
        if got.get(key) != value:
            raise UserError(path, key, got.get(key), f"{value}; the checkpoint has another architecture")


def load_state(network: nn.Module, state: Mapping[str, torch.Tensor], path: Path) -> None:
    """Load all weights into a network. Raises UserError like `check_tensors`."""
    check_tensors(path, state, network)
    network.load_state_dict(dict(state))


def check_tensors(path: Path, state: Mapping[str, torch.Tensor], network: nn.Module) -> None:
    """Raise UserError naming the first tensor of a checkpoint that is missing, extra or of the wrong shape."""
    tensors = network.state_dict()
    for key in sorted(tensors.keys() | state.keys()):
        got = tuple(state[key].shape) if key in state else "nothing"
        expected = str(tuple(tensors[key].shape)) if key in tensors else "no such tensor"
        if str(got) != expected:
            raise UserError(path, key, got, f"{expected}; the checkpoint has another architecture")


def choose_device(device: str) -> str:
    """Resolve `auto` to the GPU if there is one, else the CPU. Raises UserError if `cuda` is not available."""
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("settings", "device", "cuda", "cpu or auto: torch finds no GPU")
    return ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device


def choose_bf16(precision: Precision, device: str) -> bool:
    """Whether to compute in bfloat16. With `auto`, true if the hardware supports bfloat16."""
    if precision != "auto":
        return precision == "bf16"
    if device == "cuda":
        # Emulated bfloat16 is slower than float32.
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)())
