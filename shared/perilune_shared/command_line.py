"""Run a command line: threads, errors in one line, exit codes, and the option `--verbose` of all programs."""

import atexit
import os
import signal
import sys
from collections.abc import Callable
from typing import Annotated

import typer

from perilune_shared.errors import DISK_FAULTS, EXIT_INTERRUPTED, EXIT_USER_ERROR, STOPPED, UserError, one_line
from perilune_shared.threads import described_settings, set_up_program


def _describe_threads(verbose: bool) -> None:
    if verbose:
        print(described_settings(), file=sys.stderr)


Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", callback=_describe_threads, help="Print the usable cores and the variables of threads."
    ),
]
"""The option of a program, before the name of the command: `perilune-train -v detect train`."""


def _check_arguments() -> None:
    """Raise UserError on a path that is not UTF-8, which no table, page or library of ours can hold."""
    for argument in sys.argv[1:]:
        if any("\ud800" <= sign <= "\udfff" for sign in argument):
            raise UserError("command line", "argument", argument, "text or a path in UTF-8")


def run_command_line(app: Callable[[], object]) -> None:
    """Run a command line; print user errors and disk errors in one line and exit with code 2.

    First sets the threads of the numerical libraries (`threads.set_up_program`), which are not imported yet.

    Ctrl-C at the end of the process, when all work is done, is ignored.
    """
    try:
        _check_arguments()
        set_up_program()
        app()
    except UserError as error:
        message = f"error: {error}"
    except OSError as error:
        if error.errno not in DISK_FAULTS:
            raise
        place = one_line(error.filename or "output")
        message = f"error: {place}: {os.strerror(error.errno)}; finished files stay valid"
    except (KeyboardInterrupt, SystemExit) as stop:
        # Typer turns Ctrl-C into SystemExit with the shell's exit code for it.
        if isinstance(stop, SystemExit) and stop.code != EXIT_INTERRUPTED:
            atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
            raise
        print(STOPPED, file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)
    else:
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        return
    print(message, file=sys.stderr)
    sys.exit(EXIT_USER_ERROR)
