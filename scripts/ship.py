"""Put a trained run into the package, as the network that is installed by default.

    python scripts/ship.py RUN --name crater-detector --benchmark benchmark.json --manifest shipped-detect

Writes train/perilune_train/shipped/NAME/: weights.safetensors in half precision, config.yaml, metrics.json,
benchmark.json and card.md, and docs/reference/models/NAME.md, a copy of the card. The benchmark's figures must be those
of the half-precision weights or of the run itself; the card states which.
"""

import json
import shutil
from pathlib import Path
from typing import Annotated

import typer
from model_card import Shipment, model_card

from perilune_shared.errors import UserError, run_command_line
from perilune_shared.storage.files import sha256_of, write_text
from perilune_train.evaluation.metrics_file import METRICS_FILE, read_metrics
from perilune_train.shipped.models import BENCHMARK, CARD, WEIGHTS
from perilune_train.training.half_weights import write_half
from perilune_train.training.runs import RunFolder, load_weights

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "train/perilune_train/shipped"
MAX_MB = {"crater-detector": 16.0, "lander-navigator": 8.0}
"""Largest size of the weights, MB."""


def ship(run: Path, name: str, benchmark: Path, manifest: str) -> Path:
    """Write the folder of a shipped network; returns it."""
    if name not in MAX_MB:
        raise UserError("--name", "name", name, "one of " + ", ".join(MAX_MB))
    source, folder = RunFolder(run), SHIPPED / name
    content = load_weights(source.best)
    locked = ROOT / "data_manifests" / manifest / "dataset.json"
    if not locked.is_file():
        raise UserError(locked, "--manifest", "no such file", "the shared manifest of the training data")
    metrics, figures = read_metrics(run), read_metrics(benchmark.parent, benchmark.name)
    folder.mkdir(parents=True, exist_ok=True)
    write_half(folder / WEIGHTS, content)
    size = (folder / WEIGHTS).stat().st_size / 1e6
    if size > MAX_MB[name]:
        raise UserError(folder / WEIGHTS, "size", f"{size:.1f} MB", f"at most {MAX_MB[name]:g} MB")
    # Paths of the machine that trained it say nothing to others.
    kept = {key: value for key, value in metrics.items() if not key.startswith("run/command")}
    write_text(folder / METRICS_FILE, json.dumps(kept, indent=2) + "\n")
    write_text(folder / BENCHMARK, json.dumps(figures, indent=2) + "\n")
    shutil.copyfile(source.config, folder / "config.yaml")
    card = model_card(Shipment(name, content, metrics, figures, manifest, sha256_of(locked), size))
    write_text(folder / CARD, card)
    write_text(ROOT / "docs/reference/models" / f"{name}.md", card)
    return folder


def main(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    name: Annotated[str, typer.Option(help="crater-detector or lander-navigator.")] = "crater-detector",
    benchmark: Annotated[Path, typer.Option(help="benchmark.json of the run.")] = Path("benchmark.json"),
    manifest: Annotated[str, typer.Option(help="Shared manifest of the training data.")] = "shipped-detect",
) -> None:
    """Write the folder of a shipped network."""
    print(ship(run, name, benchmark, manifest))


if __name__ == "__main__":
    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    app.command()(main)
    run_command_line(app)
