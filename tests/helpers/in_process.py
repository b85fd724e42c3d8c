"""Run a command line in the process of the test, which saves the time to start Python and import modules."""

import contextlib
import io
import subprocess
import sys
from collections.abc import Callable
from unittest import mock


def call(main: Callable[[], None], *arguments: object, program: str = "command") -> subprocess.CompletedProcess:
    """Run `main` with these arguments; return exit code, standard output and standard error."""
    given = [str(argument) for argument in arguments]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", [program, *given]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return subprocess.CompletedProcess(given, code, out.getvalue(), err.getvalue())
