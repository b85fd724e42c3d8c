"""`perilune-train`: train the detector and the navigators, and explain them."""

import typer

from perilune_shared.errors import run_command_line
from perilune_train.detect.cli.main import app as detect
from perilune_train.explain.command import explain
from perilune_train.navigate.command import navigate

app = typer.Typer(
    help="Crater detection, landing navigation and their explanation, from perilune datasets (see `perilune-render`).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(detect, name="detect")
app.command("navigate")(navigate)
app.command("explain")(explain)


def main() -> None:
    """Entry point of the command line."""
    run_command_line(app)


if __name__ == "__main__":
    main()
