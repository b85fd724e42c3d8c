"""Relative motion under noise, blur and wrong prior knowledge: the classical methods, and a `warp` network.

    python -m benchmarks.train.motion data/shipped/nav [--split val] [--run runs/navigate/small]

Frames and prior knowledge of all descents of a split are changed, one thing at a time, and every method estimates the
motions again. Also the time of a pair on one thread. Writes runs/bench/motion.json and motion.png.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
import typer
from matplotlib.figure import Figure

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import open_dataset
from perilune_train.motion.classical.alignment import aligned_trajectory
from perilune_train.motion.classical.klt import klt_trajectory
from perilune_train.motion.data.trajectories import Motion, Trajectory, load_split
from perilune_train.motion.metrics.errors import motion_errors, summary
from perilune_train.motion.network import load_navigator, predict
from perilune_train.records.markdown import table
from perilune_train.records.pictures import save_figure
from perilune_train.training.runs import RunFolder

Change = Callable[[Trajectory, np.random.Generator], Trajectory]


def noisy(levels: float) -> Change:
    """Normal noise of so many grey levels on every pixel."""

    def change(one: Trajectory, rng: np.random.Generator) -> Trajectory:
        images = one.images + levels * rng.normal(size=one.images.shape)
        return replace(one, images=np.clip(np.rint(images), 0, 255).astype(np.uint8))

    return change


def blurred(sigma_px: float) -> Change:
    """Gaussian blur."""

    def change(one: Trajectory, _: np.random.Generator) -> Trajectory:
        return replace(one, images=np.stack([cv2.GaussianBlur(image, (0, 0), sigma_px) for image in one.images]))

    return change


def scaled(factor: float) -> Change:
    """Nominal curve, and altitude at the start, that are larger than the true ones by a factor."""

    def change(one: Trajectory, _: np.random.Generator) -> Trajectory:
        return replace(one, position_m=factor * one.position_m, nominal_position_m=factor * one.nominal_position_m)

    return change


CHANGES: dict[str, Change] = {
    "nothing": lambda one, _: one,
    "noise of 4 grey levels": noisy(4),
    "noise of 10 grey levels": noisy(10),
    "blur of 1 px": blurred(1),
    "blur of 2 px": blurred(2),
    "scale of the prior 3 % too large": scaled(1.03),
    "scale of the prior 10 % too large": scaled(1.1),
}


def main(
    dataset: Annotated[Path, typer.Argument(help="Dataset of descents.")],
    split: Annotated[str, typer.Option(help="train, val or test.")] = "val",
    run: Annotated[Path | None, typer.Option(help="Folder of a warp run, to compare.")] = None,
    out: Path = Path("runs/bench"),
) -> None:
    """Estimate all motions under every change."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    trajectories = load_split(open_dataset(str(dataset)), split)
    methods: dict[str, Callable[[Trajectory], Motion]] = {
        "klt": lambda one: klt_trajectory(one).motion,
        "alignment": lambda one: aligned_trajectory(one).motion,
    }
    if run is not None:
        network, architecture = load_navigator(RunFolder(run).best, "warp")
        methods = {"warp": lambda one: predict(network, architecture, one), **methods}
    figures: dict[str, float] = {}
    seconds = dict.fromkeys(methods, 0.0)
    with progress_bar() as progress:
        bar = progress.add_task("motions", total=len(CHANGES) * len(methods), unit="runs", note="")
        for change_name, change in CHANGES.items():
            changed = [change(one, np.random.default_rng(place)) for place, one in enumerate(trajectories)]
            for name, method in methods.items():
                begun = time.process_time()
                motions = [method(one) for one in changed]
                seconds[name] += time.process_time() - begun
                found = summary(motion_errors(trajectories, motions))
                figures[f"{change_name}/{name}/position_rmse_vector_m"] = found["position_rmse_vector_m"]
                progress.advance(bar)
    n_pairs = len(CHANGES) * sum(one.n_pairs for one in trajectories)
    figures |= {f"seconds_per_pair/{name}": value / n_pairs for name, value in seconds.items()}
    rows = [
        [name, *(f"{figures[f'{name}/{method}/position_rmse_vector_m']:.2f}" for method in methods)] for name in CHANGES
    ]
    rows.append(["processor time of a pair (s)", *(f"{figures[f'seconds_per_pair/{name}']:.3f}" for name in methods)])
    print("\n".join(table(["changed", *methods], rows)))
    draw(out / "motion.png", figures, list(methods))
    write_figures(out / "motion.json", {"split": split, "pairs": n_pairs // len(CHANGES), **figures})


def draw(path: Path, figures: dict[str, float], methods: list[str]) -> None:
    """Bars of the errors, by change and method."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    axis = figure.subplots()
    height = 0.8 / len(methods)
    for k, method in enumerate(methods):
        values = [figures[f"{name}/{method}/position_rmse_vector_m"] for name in CHANGES]
        axis.barh(np.arange(len(CHANGES)) + k * height, values, height, label=method)
    axis.set_yticks(np.arange(len(CHANGES)) + 0.4 - height / 2, list(CHANGES))
    axis.set(xlabel="position error of a step, RMSE of the vector (m)")
    axis.invert_yaxis()
    axis.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_figure(path, figure)


if __name__ == "__main__":
    run_command_line(one_command(main))
