"""The trained networks that are installed with this package. `--run` options for their tasks accept their folders."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from perilune_shared.errors import UserError

Task = Literal["detect"]
WEIGHTS = "weights.safetensors"
BENCHMARK = "benchmark.json"
CARD = "card.md"
_FOLDER = Path(__file__).parent
_TASKS: dict[str, Task] = {"crater-detector": "detect"}


@dataclass(frozen=True)
class ShippedModel:
    """A trained network that is installed with this package."""

    name: str
    """Name of the network and of its folder."""
    task: Task
    """Task of the network: detect (craters)."""
    folder: Path
    """Folder with config.yaml, metrics.json, weights.safetensors, benchmark.json and card.md."""

    @property
    def megabytes(self) -> float:
        """Size of the file of weights, MB."""
        return (self.folder / WEIGHTS).stat().st_size / 1e6

    @property
    def headline(self) -> str:
        """The strictest figure of this network on the locked benchmark, as text."""
        path = self.folder / BENCHMARK
        if not path.is_file():
            return "not scored on the locked benchmark"
        figures = json.loads(path.read_text(encoding="utf-8"))
        return f"AP {figures['headline/ap50_paper']:.3f} ({figures['headline/ap50_paper_account']})"


def shipped_models() -> list[ShippedModel]:
    """All installed networks, sorted by name."""
    return [ShippedModel(n, t, _FOLDER / n) for n, t in _TASKS.items() if (_FOLDER / n / WEIGHTS).is_file()]


def weights_file(path_or_name: str | Path) -> Path:
    """The file of weights at a path, or of an installed network by its name (`crater-detector`)."""
    installed = {model.name: model.folder / WEIGHTS for model in shipped_models()}
    path = Path(path_or_name)
    return path if path.exists() else installed.get(str(path_or_name), path)


def shipped_run(task: Task) -> Path:
    """Folder of the installed network for a task. Raises UserError if there is no such network."""
    folders = [model.folder for model in shipped_models() if model.task == task]
    if not folders:
        raise UserError("--run", "", "not given, and no network is installed for this task", "the folder of a run")
    return folders[0]
