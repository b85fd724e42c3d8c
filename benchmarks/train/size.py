"""Average precision against multiply-adds of several detect runs.

Takes folders of finished runs; distilled runs are marked. Writes size.json and size.png.
"""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text, written_aside
from perilune_train.detect.deploy.export import load_trained
from perilune_train.detect.inference.scales import multiply_adds_of_a_frame

SIZE_PX = 256


def point(root: Path) -> dict[str, Any]:
    """Multiply-adds of a run for an image of 256 x 256 pixels, and its metrics on the test split."""
    trained = load_trained(root)
    metrics = json.loads((root / "metrics.json").read_text(encoding="utf-8"))
    try:
        found = {key: float(metrics[f"test/{key}"]) for key in ("ap50_paper", "f1")}
    except (KeyError, TypeError, ValueError):
        file = root / "metrics.json"
        raise UserError(file, "test/ap50_paper", "no number", "the metrics of a finished run") from None
    return {
        "run": root.name,
        "width": trained.config.width,
        "attention": trained.config.attention,
        "strides": list(trained.config.strides),
        "distilled": trained.config.teacher is not None,
        "parameters": sum(p.numel() for p in trained.network.parameters()),
        "scales": list(trained.config.evaluation.scales),
        "multiply_adds": multiply_adds_of_a_frame(trained.network, trained.config, SIZE_PX, SIZE_PX),
        **found,
    }


def draw(points: list[dict[str, Any]], path: Path) -> None:
    """Plot AP (the paper's sum) against multiply-adds; distilled runs have their own markers."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for distilled, marker, words in ((False, "o", "labels only"), (True, "s", "with a teacher")):
        some = sorted((p for p in points if p["distilled"] == distilled), key=lambda p: p["multiply_adds"])
        if not some:
            continue
        axes.plot([p["multiply_adds"] / 1e9 for p in some], [p["ap50_paper"] for p in some], marker, label=words)
        for p in some:
            place = (p["multiply_adds"] / 1e9, p["ap50_paper"])
            axes.annotate(p["run"], place, xytext=(4, 6 if distilled else -11), textcoords="offset points", fontsize=8)
    axes.set_xscale("log")
    sizes = sorted({round(p["multiply_adds"] / 1e9, 2) for p in points})
    axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axes.set_xticks([], minor=True)
    axes.margins(x=0.3, y=0.15)
    axes.set(
        xlabel=f"multiply-adds of an image of {SIZE_PX} x {SIZE_PX} px, 10$^9$", ylabel="AP at IoU 0.5, test split"
    )
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=130)


def main(
    runs: Annotated[list[Path], typer.Argument(help="Folders of finished runs.")],
    out: Path = Path("runs/bench"),
) -> None:
    """Plot size and precision of runs."""
    points = [point(root) for root in runs]
    write_text(out / "size.json", json.dumps(points, indent=1) + "\n")
    draw(points, out / "size.png")
    print(out / "size.png", json.dumps(points, indent=1))


if __name__ == "__main__":
    run_command_line(one_command(main))
