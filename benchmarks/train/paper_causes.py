"""Why short trainings of the paper's detector failed: ground, reduction of the loss, and gates, one change at a time.

Trains YOLOv3 at width 0.25 from random weights on 600 frames of our usual ground and of the sparse one, 490 steps of 8,
labels by the paper's rule, with the settings of configs/paper_protocol.yaml and the changes of each row. One training
each; AP at IoU 0.75 is of the test frames, the rest of the validation frames. A finished row is kept, so the same
command resumes.

    python -m benchmarks.train.paper_causes --data data/paper-causes --runs runs/paper-causes

Writes runs/paper/paper-causes.json, from which the page of the experiment takes its tables.
"""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import run_command_line

PROTOCOL = Path("configs/paper_protocol.yaml")
_COLUMNS = {
    "AP, validation": "val/ap50_paper",
    "precision": "val/precision",
    "recall": "val/recall",
    "AP at IoU 0.75, test": "test/ap75_paper",
}
"""Columns of the table, and their keys in metrics.json."""


@dataclass(frozen=True)
class Row:
    """One training."""

    name: str
    """Name of its run."""
    words: str
    """What it changes, for the table."""
    causes: tuple[str, ...]
    """The tables that have it: loss, gates, ground."""
    settings: dict[str, str] = field(default_factory=dict)
    """Settings of the detector over the protocol's."""

    @property
    def ground(self) -> str:
        """lunar or sparse."""
        return self.name.partition("-")[0]


_SUMS = {"loss.reduction": "sums"}
_BOXES = _SUMS | {"loss.lambda_iou": "1"}
_SEVERAL = {"assignment": "several", "loss.objectness": "iou"}
ROWS = (
    Row("lunar-sums", "plain sums", ("loss", "ground"), _SUMS),
    Row("sparse-sums", "plain sums", ("loss", "ground"), _SUMS),
    Row("lunar-sums-box-1", "plain sums, weight of the boxes 1 in place of 0.05", ("loss",), _BOXES),
    Row("lunar-means", "means", ("loss", "ground")),
    Row("sparse-means", "means", ("loss", "gates", "ground")),
    Row("lunar-means-several", "means, several predictors a label, IoU as target", ("loss",), _SEVERAL),
    Row("lunar-cbam-sums", "plain CBAM, plain sums", ("gates",), _SUMS | {"attention": "cbam"}),
    Row("sparse-cbam-means", "plain CBAM, means", ("gates",), {"attention": "cbam"}),
    Row("sparse-identity-means", "gates from identity, means", ("gates",), {"attention": "cbam_identity"}),
)


def render(ground: str, data: Path, frames: int) -> None:
    """Render a ground unless it is there."""
    out = data / ground
    if (out / "detect" / "dataset.json").is_file():
        return
    trajectories = max(1, frames // 60)
    settings = [
        f"dataset.detect.trajectories_per_scene={trajectories}",
        f"dataset.detect.n_frames={frames // trajectories}",
    ]
    if ground == "lunar":
        settings += [
            "dataset.terrain.craters={profile: fassett_thomson, surface_age_gyr: 3.5}",
            "dataset.terrain.craters.equilibrium_share={low: 0.9, high: 1.7}",
            "dataset.terrain.relief={rms_slope_deg: {low: 2.0, high: 4.5}}",
        ]
    else:
        settings += ["dataset.terrain.craters.equilibrium_share={low: 0.1, high: 0.1}"]
    _run("perilune-render", "dataset", "--kind", "detect", settings, "--out", str(out))


def train(row: Row, data: Path, runs: Path, steps: int) -> None:
    """Train a row unless it is finished."""
    if (runs / "detect" / row.name / "metrics.json").is_file():
        return
    # 480 training frames, batches of 8: 60 steps an epoch.
    epochs = max(1, round(steps / 60))
    settings = {"width": "0.25", "attention": "none", "batch_size": "8", "epochs": str(epochs), "warmup_steps": "50"}
    settings |= {"workers": "0", "validate_every": str(epochs), **row.settings}
    sets = [f"detect.{key}={value}" for key, value in settings.items()]
    dataset, out = str(data / row.ground / "detect"), str(runs)
    _run("perilune-train", "detect", "train", sets, "--dataset", dataset, "--out", out, "--name", row.name)


def _run(program: str, *words: str | list[str]) -> None:
    """Run a command with the protocol's settings and these."""
    command = [str(Path(sys.executable).parent / program)]
    for word in words:
        command += [part for text in word for part in ("--set", text)] if isinstance(word, list) else [word]
    command += ["--preset", "paper", "--config", str(PROTOCOL)]
    threads = {"OMP_NUM_THREADS": "1"} if program == "perilune-train" else {}
    subprocess.run(command, check=True, env=os.environ | threads)


def figures(runs: Path) -> dict[str, object]:
    """Figures of all rows by <cause>/<row>/<column>."""
    found: dict[str, object] = {}
    for row in ROWS:
        metrics = json.loads((runs / "detect" / row.name / "metrics.json").read_text(encoding="utf-8"))
        ground = {"lunar": "our usual ground", "sparse": "sparse ground"}[row.ground]
        for cause in row.causes:
            found |= {f"{cause}/{row.words}, {ground}/{name}": metrics[key] for name, key in _COLUMNS.items()}
    return found


def main(
    data: Annotated[Path, typer.Option(help="Folder of the two datasets.")] = Path("data/paper-causes"),
    runs: Annotated[Path, typer.Option(help="Folder of the runs.")] = Path("runs/paper-causes"),
    frames: Annotated[int, typer.Option(help="Frames over each ground.")] = 600,
    steps: Annotated[int, typer.Option(help="Steps of each training.")] = 490,
    out: Annotated[Path, typer.Option(help="JSON file with the figures, for the page.")] = Path(
        "runs/paper/paper-causes.json"
    ),
) -> None:
    """Render, train and write the table; two trainings at a time, each on one core."""
    for ground in ("lunar", "sparse"):
        render(ground, data, frames)
    with ThreadPoolExecutor(max(1, len(os.sched_getaffinity(0)))) as pool:
        list(pool.map(lambda row: train(row, data, runs, steps), ROWS))
    write_figures(out, figures(runs))


if __name__ == "__main__":
    app = typer.Typer(pretty_exceptions_enable=False, add_completion=False)
    app.command()(main)
    run_command_line(app)
