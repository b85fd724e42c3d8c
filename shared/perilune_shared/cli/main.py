"""`perilune-manifest`: validate, inspect, edit and export datasets, without Blender and without torch.

Commands import their modules only when they run, so that `--help` does not load pandas and pyarrow.
"""

from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

import perilune_shared as ps
from perilune_shared.cli import edit, export
from perilune_shared.cli.edit import DatasetArgument
from perilune_shared.command_line import Verbose, run_command_line
from perilune_shared.errors import EXIT_USER_ERROR, one_line, shortened
from perilune_shared.terminal import progress_bar

app = typer.Typer(
    help="Validate, inspect, edit and export perilune datasets.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)


@app.callback()
def program(verbose: Verbose = False) -> None:
    pass


@app.command()
def validate(
    dataset: DatasetArgument, most: Annotated[int, typer.Option(min=1, help="Maximum number of faults to show.")] = 50
) -> None:
    """Check schema, ranges, keys, splits, labels and file hashes. Exit code 2 if there is a fault."""
    from perilune_shared.validation.validate import validate as find_faults

    with progress_bar() as progress:
        faults = find_faults(ps.open_dataset(dataset), progress)
    console = Console()
    if not faults:
        console.print(Text(f"{one_line(dataset)}: no fault"))
        return
    count = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
    table = Table("file", "row", "column", "got", "expected", title=Text(f"{one_line(dataset)}: {count}"))
    for fault in faults[:most]:
        row = "" if fault.row is None else str(fault.row)
        # Text, since a plain string would be parsed as markup; the values are untrusted.
        cells = (fault.file, row, fault.column, fault.found, fault.expected)
        table.add_row(*(Text(cell, overflow="fold") for cell in cells))
    console.print(table)
    raise typer.Exit(EXIT_USER_ERROR)


@app.command()
def stats(dataset: DatasetArgument) -> None:
    """Print counts, labels per frame and crater radii for each split."""
    from perilune_shared.export.stats import summary

    opened = ps.open_dataset(dataset)
    frame = summary(opened)
    info = opened.info
    state = "" if info.complete else ", not complete"
    table = Table(title=f"{info.name}{state}", caption=f"split by {info.split_by}{info.leak}")
    # One measure per row, so that the table fits a narrow terminal.
    measures = frame.set_index("split").astype(object).T
    table.add_column("")
    for split in measures.columns:
        table.add_column(Text(shortened(one_line(split))), justify="right")
    for name, values in measures.iterrows():
        table.add_row(str(name), *(str(value) for value in values))
    console = Console()
    console.print(table)
    counts = info.counts.model_dump()
    console.print(", ".join(f"{count} {name}" for name, count in counts.items()))


edit.add_to(app)
export.add_to(app)


def main() -> None:
    """Entry point of the command line."""
    run_command_line(app)
