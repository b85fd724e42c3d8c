"""Put a trained network into the package, as the default of its commands; then write its card.

    python scripts/ship.py install runs/detect/shipped --name crater-detector
    python scripts/ship.py add-ellipses runs/detect/ellipses --name crater-detector
    make benchmark
    python scripts/ship.py card --name crater-detector --benchmark runs/benchmark/crater-detector/benchmark.json

`install` writes train/perilune_train/shipped/NAME/ with weights.safetensors, config.yaml, metrics.json and novelty.json
(features of the training frames; `perilune-train detect calibrate` adds it to a run without it). The weights are stored
in half precision, or with `--eight-bits` in half of this size; use `--eight-bits` only if the AP on the validation
split does not fall. `add-ellipses` adds the tower of ellipses that was trained on top of the installed network with
`detect.trained=ellipses`; boxes and scores stay as they are. The benchmark scores the weights as they are stored.
`card` adds benchmark.json and card.md to the folder, and writes docs/reference/models/NAME.md, a copy of the card, and
NAME-benchmark.md, the page of the benchmark.
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import torch
import typer
from model_card import Shipment, model_card

from perilune_shared.console.command_line import run_command_line
from perilune_shared.errors import UserError
from perilune_shared.storage.files import sha256_of, write_text
from perilune_train.detect.novelty import NOVELTY_FILE
from perilune_train.records.metrics_file import METRICS_FILE, read_metrics
from perilune_train.shipped.models import BENCHMARK, CARD, WEIGHTS
from perilune_train.training.half_weights import precision_of, write_bytewise, write_half
from perilune_train.training.runs import RunFolder, load_weights

ROOT = Path(__file__).resolve().parents[1]
SHIPPED, PAGES = ROOT / "train/perilune_train/shipped", ROOT / "docs/reference/models"
MAX_MIB = {"crater-detector": 8.0}
"""Largest size of the weights, MiB. Every clone and every wheel contains the weights."""
MANIFESTS = {"crater-detector": ("shipped-detect", "oblique-detect")}
"""Shared manifests of the training data; the second is only for ellipses."""

Name = Annotated[str, typer.Option(help="crater-detector.")]
app = typer.Typer(pretty_exceptions_enable=False, add_completion=False, no_args_is_help=True)


@app.command()
def install(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    name: Name,
    eight_bits: Annotated[bool, typer.Option("--eight-bits", help="Store 8 bits per weight.")] = False,
) -> None:
    """Write weights, configuration and metrics of a run into the package; the card of an earlier network is removed."""
    folder, source = _folder(name), RunFolder(run)
    content, metrics = load_weights(source.best), read_metrics(run)
    folder.mkdir(parents=True, exist_ok=True)
    for stale in (BENCHMARK, CARD, NOVELTY_FILE):
        (folder / stale).unlink(missing_ok=True)
    size = _write_weights(folder, content, eight_bits)
    # The command may contain paths of the machine on which the network was trained.
    public_metrics = {key: value for key, value in metrics.items() if not key.startswith("run/command")}
    write_text(folder / METRICS_FILE, json.dumps(public_metrics, indent=2) + "\n")
    shutil.copyfile(source.config, folder / "config.yaml")
    if (run / NOVELTY_FILE).is_file():
        shutil.copyfile(run / NOVELTY_FILE, folder / NOVELTY_FILE)
    print(f"{folder}: {size:.1f} MB; next: score it on the locked benchmark, then `ship.py card`")


@app.command()
def add_ellipses(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run with detect.trained=ellipses.")],
    name: Name,
) -> None:
    """Add the tower of ellipses of a run to the installed network from which the run started.

    Metrics of the run go into metrics.json with the prefix `ellipses/`.
    """
    folder, source = _folder(name), RunFolder(run)
    content, installed = load_weights(source.best), load_weights(folder / WEIGHTS)
    other = [
        key
        for key, value in content["state_dict"].items()
        if not key.startswith("ellipse_tower.") and not torch.equal(value, installed["state_dict"][key])
    ]
    if other or not content["architecture"].get("ellipses"):
        found = f"{len(other)} other weights changed" if other else "no ellipses"
        raise UserError(
            run, "weights", found, f"the weights of {name} and a tower of ellipses: detect.trained=ellipses"
        )
    size = _write_weights(folder, content, precision_of(folder / WEIGHTS) != "half precision")
    public = {
        f"ellipses/{key}": value
        for key, value in read_metrics(run).items()
        if key.startswith(("dataset/", "run/", "train/", "val/ellipse")) and not key.startswith("run/command")
    }
    write_text(folder / METRICS_FILE, json.dumps(read_metrics(folder) | public, indent=2) + "\n")
    config = (folder / "config.yaml").read_text(encoding="utf-8")
    if "  ellipses: true\n" not in config:
        write_text(folder / "config.yaml", config.rstrip("\n") + "\n  ellipses: true\n")
    for stale in (BENCHMARK, CARD):
        (folder / stale).unlink(missing_ok=True)
    print(f"{folder}: {size:.1f} MB; next: score it on the locked benchmark, then `ship.py card`")


def _write_weights(folder: Path, content: Mapping[str, Any], eight_bits: bool) -> float:
    """Write the weights of an installed network; returns their size, MB. Raises UserError if they are too large."""
    path, limit = folder / WEIGHTS, MAX_MIB[folder.name]
    (write_bytewise if eight_bits else write_half)(path, content)
    size = path.stat().st_size
    if size > limit * 2**20:
        path.unlink()
        expected = f"at most {limit:g} MiB; --eight-bits halves the size"
        raise UserError(path, "size", f"{size / 2**20:.2f} MiB", expected)
    return size / 1e6


@app.command()
def card(
    name: Name,
    benchmark: Annotated[Path, typer.Option(help="benchmark.json of the installed network.")],
    other: Annotated[
        list[Path] | None, typer.Option(help="benchmark.json of a run with another random seed. Repeatable.")
    ] = None,
    note: Annotated[
        list[str] | None, typer.Option(help="Caveat about the network or its benchmark. Repeatable.")
    ] = None,
) -> None:
    """Write the card of the installed network and the page of its benchmark, both with the notes."""
    folder = _folder(name)
    content, metrics = load_weights(folder / WEIGHTS), read_metrics(folder)
    manifests = MANIFESTS[name] if content["architecture"].get("ellipses") else MANIFESTS[name][:1]
    figures = read_metrics(benchmark.parent, benchmark.name)
    size = (folder / WEIGHTS).stat().st_size / 1e6
    hashes = {each: sha256_of(ROOT / "data_manifests" / each / "dataset.json") for each in manifests}
    others = tuple(read_metrics(path.parent, path.name) for path in other or [])
    precision = precision_of(folder / WEIGHTS)
    shipment = Shipment(name, content, metrics, figures, hashes, size, precision, others, tuple(note or []))
    text = model_card(shipment)
    write_text(folder / BENCHMARK, json.dumps(figures, indent=2) + "\n")
    write_text(folder / CARD, text)
    PAGES.mkdir(parents=True, exist_ok=True)
    write_text(PAGES / f"{name}.md", text)
    page = benchmark.with_suffix(".md").read_text(encoding="utf-8").rstrip("\n")
    write_text(PAGES / f"{name}-benchmark.md", "\n".join([page, *[f"\n{text}" for text in note or []], ""]))
    print(PAGES / f"{name}.md")


def _folder(name: str) -> Path:
    if name not in MAX_MIB:
        raise UserError("--name", "", name, "one of " + ", ".join(MAX_MIB))
    return SHIPPED / name


if __name__ == "__main__":
    run_command_line(app)
