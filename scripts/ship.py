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
    card = _card(name, content, metrics, figures, manifest, sha256_of(locked), size)
    write_text(folder / CARD, card)
    write_text(ROOT / "docs/reference/models" / f"{name}.md", card)
    return folder


def _card(name: str, content: dict, metrics: dict, figures: dict, manifest: str, sha256: str, size_mb: float) -> str:
    """The model card, from the figures."""

    def figure(key: str) -> str:
        value, low, high = (figures.get(f"{key}{end}") for end in ("", "_low", "_high"))
        if not isinstance(value, int | float):
            return "not measured"
        limits = f" ({low:.3f} to {high:.3f})" if isinstance(low, float) and isinstance(high, float) else ""
        return f"{value:.3f}{limits}"

    architecture = content["architecture"]
    rows = [
        f"| {rule} | {account} | {figure(f'{rule}/{prefix}ap50_paper')} | {figure(f'{rule}/{prefix}f1')} |"
        for rule in ("visible", "paper")
        for account, prefix in (("usual", ""), ("edge", "edge/"), ("strict", "strict/"))
    ]
    bins = [
        f"| {key.removeprefix('visible/').removesuffix('/ap50_paper').replace('_', ' ')} | {value:.3f} |"
        for key, value in figures.items()
        if key.startswith(("visible/radius_", "visible/sun_", "visible/altitude_")) and key.endswith("/ap50_paper")
    ]
    network = (
        f"attention-YOLOv3, width {architecture['width']:g}, {architecture['in_channels']} channel, attention "
        f"`{architecture['attention']}`, strides {' '.join(map(str, architecture['strides']))}"
    )
    commit = str(metrics.get("run/commit", "unknown"))[:7]
    return "\n".join(
        [
            f"# {name}",
            "",
            "Finds lunar craters in camera images seen from above. `perilune-train detect predict` loads it if `--run` "
            "is not given.",
            "",
            "| | |",
            "|---|---|",
            f"| Network | {network} |",
            f"| Weights | {size_mb:.1f} MB, half precision, safetensors |",
            f"| Training data | manifest `{manifest}`, SHA-256 of dataset.json {sha256[:16]}; rendered frames only |",
            f"| Trained at | commit {commit}, {metrics.get('run/hardware', 'unknown hardware')} |",
            f"| Threshold | {figures.get('threshold', 0):.3f}, chosen on validation scenes |",
            "| Licence | Apache-2.0 |",
            "",
            "## Locked benchmark",
            "",
            f"**AP {figures['headline/ap50_paper']:.3f}, F1 {figures['headline/f1']:.3f}** by the least favourable "
            "account.",
            "",
            "| labels | account | AP | F1 |",
            "|---|---|---|---|",
            *rows,
            "",
            "In brackets: 95 % intervals over scenes.",
            "",
            "| bin, labels by `visible`, usual account | AP |",
            "|---|---|",
            *bins,
            "",
            "## Limits",
            "",
            "- It was trained on rendered frames of 256 x 256 pixels over 50 degrees; real images differ.",
            "- It looks for craters of about 2 to 80 pixels radius. Cut or shrink images with larger ones (`--scale`).",
            "- A view far from straight down was not trained.",
            "- One training; no spread over seeds.",
            "",
        ]
    )


def main(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    name: Annotated[str, typer.Option(help="Name of the shipped network.")] = "crater-detector",
    benchmark: Annotated[Path, typer.Option(help="benchmark.json of the run.")] = Path("benchmark.json"),
    manifest: Annotated[str, typer.Option(help="Shared manifest of the training data.")] = "shipped-detect",
) -> None:
    """Write the folder of a shipped network."""
    print(ship(run, name, benchmark, manifest))


if __name__ == "__main__":
    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    app.command()(main)
    run_command_line(app)
