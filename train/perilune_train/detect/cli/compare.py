"""`perilune-train detect compare`: compare runs or evaluations."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.terminal import say, say_page
from perilune_train.cli_options import AllowOverlap


def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs, or of evaluations.")],
    out: Annotated[Path, typer.Option(help="Folder to write into.")] = Path("runs/detect/compare"),
    allow_overlap: AllowOverlap = False,
) -> None:
    """Compare runs or evaluations: writes compare.md (a table) and precision_recall.png."""
    # matplotlib and torch take seconds to load.
    from perilune_train.detect.compare_runs import compare_folders

    say_page(compare_folders(folders, out, allow_overlap))
    say(f"{out}: compare.md, precision_recall.png")
