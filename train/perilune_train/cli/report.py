"""`perilune-train report` writes the HTML report; `paper` writes the page of the paper's experiment."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from perilune_shared.console.terminal import say, say_page
from perilune_shared.errors import UserError
from perilune_shared.storage.files import is_plain

USUAL_MB = 15
"""Size limit of the page of `small`, MB (1e6 bytes); a larger page opens slowly."""
USUAL_ANSWERS = 12
"""Number of detections with answers in the report of a demo."""


def report(
    kind: Annotated[
        Literal["demo", "paper", "benchmark"],
        typer.Option(help="What to show: a demo, the paper's experiment, or scores on the locked benchmark."),
    ] = "demo",
    name: Annotated[
        str | None,
        typer.Option(help="Name of the runs and of the report. [default: small, paper or benchmark, by --kind]"),
    ] = None,
    dataset: Annotated[
        Path | None,
        typer.Option(help="Folder that holds the datasets. [default: data/<name>; for benchmark, data/benchmark]"),
    ] = None,
    runs: Annotated[
        Path | None, typer.Option(help="Folder that holds all runs. [default: runs; for paper, runs/<name>]")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the report. [default: runs/report/<name>]")] = None,
    answers: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=200,
            help="Number of detections in the viewer for which the page shows why they were found, and their effect on"
            " the position. Each takes seconds. [default: 12; 0 for --kind paper and benchmark]",
        ),
    ] = None,
    counterfactual: Annotated[
        str | None,
        typer.Option(help="Dataset of the detection frames without some craters, to show scores without them."),
    ] = None,
    shallower: Annotated[
        str | None,
        typer.Option(help="Dataset of the detection frames with shallower craters (`--depth-share 0.5`)."),
    ] = None,
    turned: Annotated[
        str | None, typer.Option(help="Dataset of the detection frames under another Sun, with all craters.")
    ] = None,
) -> None:
    """Write the report of a demo, a paper run or a benchmark as one HTML file, with a summary in Markdown.

    report.html needs no server and no network. It shows datasets, detection, navigation, explanation, the source of
    each figure, and a viewer of one descent. The report names each part whose files are missing.
    """
    # matplotlib and pandas take seconds to load.
    from perilune_train.report.page import SUMMARY, write_report
    from perilune_train.report.sources import AnswerInputs

    chosen = name or {"demo": "small", "paper": "paper", "benchmark": "benchmark"}[kind]
    if not is_plain(chosen) or "/" in chosen:
        raise UserError("--name", "", chosen, "a plain name, without folders")
    data = dataset or Path("data") / ("benchmark" if kind == "benchmark" else chosen)
    root = runs or (Path("runs") / chosen if kind == "paper" else Path("runs"))
    count = answers if answers is not None else USUAL_ANSWERS if kind == "demo" else 0
    inputs = AnswerInputs(count, counterfactual, shallower, turned)
    page = write_report(kind, chosen, data, root, out or Path("runs/report") / chosen, inputs)
    megabytes = page.stat().st_size / 1e6
    if megabytes > USUAL_MB:
        text = f"warning: {page}: size: got {megabytes:.1f} MB, expected below {USUAL_MB} MB; it opens slowly"
        say_page(text)
    say(f"{page}: {megabytes:.1f} MB, open it in a browser; {SUMMARY} has the tables")


def paper(
    runs: Annotated[Path, typer.Option(help="Folder of the experiment's runs, as `make paper` makes them.")] = Path(
        "runs/paper"
    ),
    dataset: Annotated[
        str, typer.Option(help="Detection dataset of the headline ground: a folder or an address.")
    ] = "data/paper/detect",
    about: Annotated[
        list[str] | None, typer.Option(help="A line of the page on how the experiment was made. Repeatable.")
    ] = None,
    headline_share: Annotated[
        str | None,
        typer.Option(
            help="Crater density (equilibrium_share) of the headline ground."
            " [default: the density on the curve whose AP is nearest to the paper's]"
        ),
    ] = None,
) -> None:
    """Write the page that compares the results of our experiment with the paper's.

    It shows the paper's tables and figures beside ours, and a verdict on each claim of the paper. The section of an
    unfinished run states that the run is unfinished.
    """
    # torch and matplotlib take seconds to load.
    from perilune_train.report.paper.page import write_page

    page = write_page(runs, dataset, tuple(about or ()), headline_share)
    say(f"{page}: tables, figures and verdicts; paper.json has the figures")
