"""`perilune-train navigate compare`: compare runs or evaluations."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.terminal import console
from perilune_train.cli_options import AllowOverlap


def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs, or of evaluations.")],
    out: Annotated[Path, typer.Option(help="Folder to write into.")] = Path("runs/navigate/compare"),
    allow_overlap: AllowOverlap = False,
) -> None:
    """Compare runs or evaluations: writes compare.md (a table) and errors.png."""
    # matplotlib takes seconds to load.
    from perilune_train.navigate.compare_runs import compare_folders

    console.print(compare_folders(folders, out, allow_overlap), markup=False, highlight=False, soft_wrap=True)
    console.print(f"{out}: compare.md, errors.png")
