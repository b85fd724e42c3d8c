"""What a form of attention gates costs, and how much its masks vary: several detect runs on the validation split.

`python -m benchmarks.train.gates DATASET RUN...` takes the dataset of the runs and folders of finished detect runs. For
each run: AP on the validation split (from its metrics.json), and for each gate the standard deviation of its mask over
pixels and validation frames. For each form: mean AP over its runs, and the gain in strict AP over the form of the first
run. Writes gates.json and gates.png.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer
from matplotlib.figure import Figure

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.errors import UserError
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.inference.detector import open_detector
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.inputs import labelled_frames
from perilune_train.explain.maps.masks import detector_masks
from perilune_train.explain.page.claims import MIN_DEVIATION
from perilune_train.records.pictures import save_figure
from perilune_train.training.runs import RunFolder

_KEYS = {"ap": "val/ap50_paper", "ap_strict": "val/strict/ap50_paper"}
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")


def point(dataset: Dataset, root: Path, n_frames: int) -> dict[str, Any]:
    """Form, seed, AP and deviations of the gates of one run."""
    config = config_of_run(root, ())
    metrics = json.loads((root / "metrics.json").read_text(encoding="utf-8"))
    try:
        found = {name: float(metrics[key]) for name, key in _KEYS.items()}
    except (KeyError, TypeError, ValueError):
        expected = "the metrics of a finished run with a validation split"
        raise UserError(root / "metrics.json", "val", "no number", expected) from None
    form = config.attention + (", guided" if config.loss.lambda_guide > 0 else "")
    own = {"run": root.name, "form": form, "seed": config.seed, **found}
    if config.attention == "none":
        return own | {"deviations": {}, "constant": 0, "least_deviation": None}
    frames, _ = labelled_frames(dataset, "val", config, n_frames, ExplainConfig().ring_factors)
    detector = open_detector(RunFolder(root).best, config)
    masks = detector_masks(detector.network, frames.images, RunFolder(root).best)
    deviations = {block: round(float(mask.std()), 5) for block, mask in masks.items()}
    constant = sum(value < MIN_DEVIATION for value in deviations.values())
    return own | {"deviations": deviations, "constant": constant, "least_deviation": min(deviations.values())}


def by_form(points: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean AP over the runs of each form, its smallest and largest value, and the constant gates of the worst run."""
    result = {}
    for form, own in pd.DataFrame(points).groupby("form", sort=False):
        result[str(form)] = {"runs": float(len(own)), "constant_worst": float(own["constant"].max())}
        for name in _KEYS:
            values = own[name].to_numpy(np.float64)
            ends = {"": values.mean(), "_least": values.min(), "_most": values.max()}
            result[str(form)] |= {f"{name}{end}": float(value) for end, value in ends.items()}
    return result


def draw(points: list[dict[str, Any]], path: Path) -> None:
    """Plot strict AP against the number of constant gates, and the deviation of each gate of each run."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 2))
    blocks = list(dict.fromkeys(sorted(block for one in points for block in one["deviations"])))
    forms = list(dict.fromkeys(one["form"] for one in points))
    for form, colour in zip(forms, _COLOURS, strict=False):
        own = [one for one in points if one["form"] == form]
        left.plot([one["constant"] for one in own], [one["ap_strict"] for one in own], "o", color=colour, label=form)
        for one in own:
            place = [blocks.index(block) for block in one["deviations"]]
            right.plot(place, list(one["deviations"].values()), ".-", color=colour, linewidth=0.8)
    left.set(xlabel="constant gates, of 23", ylabel="AP, strict scoring rule, validation split")
    left.legend(fontsize=8)
    right.axhline(MIN_DEVIATION, color="black", linestyle="--", linewidth=0.8)
    right.set_yscale("symlog", linthresh=MIN_DEVIATION)
    right.set(ylabel="standard deviation of the mask", ylim=(0, None))
    right.set_xticks(range(len(blocks)), blocks)
    right.tick_params(axis="x", rotation=60)
    for axis in (left, right):
        axis.grid(alpha=0.3)
    save_figure(path, figure)


def main(
    dataset: str,
    runs: Annotated[list[Path], typer.Argument(help="Folders of finished detect runs.")],
    n_frames: Annotated[int, typer.Option(help="Validation frames, evenly spaced.", min=2)] = 32,
    out: Path = Path("runs/bench"),
) -> None:
    """Compare forms of attention gates."""
    opened = open_dataset(dataset)
    points = [point(opened, root, n_frames) for root in runs]
    draw(points, out / "gates.png")
    forms = by_form(points)
    first = next(iter(forms.values()))
    gain = {form: own["ap_strict"] - first["ap_strict"] for form, own in forms.items()}
    write_figures(out / "gates.json", {"runs": points, "forms": forms, "gain": gain, "limit": MIN_DEVIATION})


if __name__ == "__main__":
    run_command_line(one_command(main))
