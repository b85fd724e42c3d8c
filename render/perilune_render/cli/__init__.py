"""The program `perilune-render`."""

from perilune_shared.console.interrupts import start


def main() -> None:
    """Entry point: import the command line and run it."""
    start("perilune_render.cli.main")
