"""A command line run within the test's own process, which saves the seconds of starting Python and its imports."""

import contextlib
import io
import subprocess
import sys
from collections.abc import Callable
from unittest import mock


def call(main: Callable[[], None], *arguments: object) -> subprocess.CompletedProcess:
    """Exit code, standard output and standard error of `main` with these arguments."""
    given = [str(argument) for argument in arguments]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", ["command", *given]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return subprocess.CompletedProcess(given, code, out.getvalue(), err.getvalue())
