"""`perilune-manifest`: validate, inspect, edit and export datasets. Needs neither Blender nor torch.

Commands import their modules only when they run, so that `--help` does not load pandas and pyarrow.
"""

from typing import Annotated

import typer

import perilune_shared as ps
from perilune_shared.cli import edit, export
from perilune_shared.cli.edit import DatasetArgument
from perilune_shared.console.command_line import new_program, run_command_line
from perilune_shared.console.terminal import answer, answer_table, progress_bar
from perilune_shared.errors import EXIT_USER_ERROR, one_line, shortened

app = new_program(
    "perilune-manifest",
    ps.__version__,
    "Validate, inspect, edit and export perilune datasets.",
)


@app.command()
def validate(
    dataset: DatasetArgument, most: Annotated[int, typer.Option(min=1, help="Maximum number of faults to show.")] = 50
) -> None:
    """Check schema, ranges, keys, splits, labels and file hashes. The exit code is 2 if there is a fault."""
    from perilune_shared.validation.validate import validate as find_faults

    with progress_bar() as progress:
        faults = find_faults(ps.open_dataset(dataset), progress)
    if not faults:
        answer(f"{dataset}: no fault")
        return
    n_faults = sum(fault.n_faults for fault in faults)
    count = "1 fault" if n_faults == 1 else f"{n_faults} faults"
    caption = f"the first {most}; `--most` shows more" if len(faults) > most else ""
    rows = [
        (fault.file, "" if fault.row is None else fault.row, fault.column, fault.found, fault.expected)
        for fault in faults[:most]
    ]
    answer_table(("file", "row", "column", "got", "expected"), rows, title=f"{dataset}: {count}", caption=caption)
    raise typer.Exit(EXIT_USER_ERROR)


@app.command()
def stats(dataset: DatasetArgument) -> None:
    """Print counts, labels per frame and crater radii for each split."""
    from perilune_shared.export.stats import summary

    opened = ps.open_dataset(dataset)
    frame = summary(opened)
    info = opened.info
    state = "" if info.complete else ", not complete"
    # One quantity per row, so that the table fits a narrow terminal.
    measures = frame.set_index("split").astype(object).T
    head = ["", *(shortened(one_line(split)) for split in measures.columns)]
    rows = [[name, *values] for name, values in measures.iterrows()]
    title, caption = f"{info.name}{state}", f"split by {info.split_by}{info.leak}"
    answer_table(head, rows, title=title, caption=caption, numbers=True)
    counts = info.counts.model_dump()
    answer(", ".join(f"{count} {name}" for name, count in counts.items()))


edit.add_to(app)
export.add_to(app)


def main() -> None:
    """Entry point of the command line."""
    run_command_line(app)
