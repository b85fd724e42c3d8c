"""metrics.json: the metrics of a run or an evaluation, with flat keys."""

import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from perilune_shared.errors import UserError
from perilune_shared.run_record import run_record
from perilune_shared.storage.files import write_text
from perilune_train import __version__

METRICS_FILE = "metrics.json"
_MAX_BYTES = 10_000_000
Metrics = dict[str, float | int | str | None]


def write_metrics(folder: Path, metrics: Mapping[str, float | int | str | None], name: str = METRICS_FILE) -> None:
    """Write metrics.json, or the file `name`. Values that are not finite become null.

    Adds entries with the prefix run/: commit, hardware, load, command, date, GPU and versions.
    """
    # Imported here, so that reading metrics does not require torch.
    import numpy as np
    import torch

    plain = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in metrics.items()
    }
    plain |= {f"run/{key}": value for key, value in asdict(run_record()).items()}
    plain["run/gpu"] = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    packages = {"perilune_train": __version__, "torch": torch.__version__, "numpy": np.__version__}
    packages["Python"] = platform.python_version()
    plain["run/versions"] = ", ".join(f"{package} {version}" for package, version in packages.items())
    write_text(folder / name, json.dumps(plain, indent=2, allow_nan=False) + "\n")


def read_metrics(folder: Path, name: str = METRICS_FILE) -> Metrics:
    """Read metrics.json, or the file `name`, of a run or an evaluation.

    Raises UserError if the file is missing or is not a flat JSON object.
    """
    path = folder / name
    if not path.is_file():
        expected = "the metrics of a finished run; resume it with the command that started it"
        raise UserError(path, "metrics", "no such file", expected)
    if path.stat().st_size > _MAX_BYTES:
        raise UserError(path, "metrics", f"{path.stat().st_size} bytes", f"at most {_MAX_BYTES}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise UserError(path, "metrics", error, "JSON") from None
    plain = (float, int, str, type(None))
    if not isinstance(content, dict) or not all(isinstance(value, plain) for value in content.values()):
        raise UserError(path, "metrics", "another structure", "a flat JSON object of numbers and texts")
    return content


def has_metrics(folder: Path, name: str = METRICS_FILE) -> bool:
    """Whether a folder has a complete metrics.json; False if the file is missing, empty or truncated."""
    try:
        return bool(read_metrics(folder, name))
    except UserError:
        return False
