"""`perilune-train paper`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.terminal import say


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
            help="equilibrium_share of the headline ground. Default: on the curve, the AP nearest to the paper's."
        ),
    ] = None,
) -> None:
    """Write the page of the paper's experiment: its tables and figures beside ours, and a verdict on each claim.

    Sections of runs that are not finished say so.
    """
    # torch and matplotlib take seconds to load.
    from perilune_train.paper.page import write_page

    page = write_page(runs, dataset, tuple(about or ()), headline_share)
    say(f"{page}: tables, figures and verdicts; paper.json has the figures")
