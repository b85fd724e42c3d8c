"""Errors that a user can cause, printed in one line, and their exit code."""

import atexit
import errno
import os
import signal
import sys
from collections.abc import Callable

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130
STOPPED = "stopped; finished files stay valid; run the same command again to resume"
"""What a command prints last after Ctrl-C."""
_DISK_FAULTS = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOTDIR,
    errno.ENOENT,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENAMETOOLONG,
    errno.ELOOP,
)


class UserError(Exception):
    """An error in the user's input: file or place, field, value found, and value expected."""

    def __init__(self, where: object, field: str, found: object, expected: str):
        # These texts may come from untrusted files and may be of any length.
        self.where = shortened(where, 4200)
        self.field, self.found, self.expected = shortened(field), shortened(found), shortened(expected, 500)
        super().__init__(one_line(f"{self.where}: {self.field}: got {self.found}, expected {self.expected}"))

    def __reduce__(self) -> tuple:
        """Pickle by the constructor's arguments, so that another process can send it."""
        return UserError, (self.where, self.field, self.found, self.expected)


def ends_run(error: BaseException) -> bool:
    """Whether an error would repeat with everything that is left to do: one of the user's, or a full or closed disk."""
    # A file that is missing may have been removed by another process.
    return isinstance(error, UserError) or (
        isinstance(error, OSError) and error.errno in _DISK_FAULTS and error.errno != errno.ENOENT
    )


def one_line(text: object) -> str:
    """Return text on one line, with terminal control characters replaced by question marks."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(str(text).split()))


def shortened(value: object, max_length: int = 120) -> str:
    """Return a value as text of at most `max_length` characters."""
    text = str(value)
    return text if len(text) <= max_length else text[: max_length - 3] + "..."


def run_command_line(app: Callable[[], object]) -> None:
    """Run a command line; print user errors and disk errors in one line and exit with code 2.

    Ctrl-C at the end of the process, when all work is done, is ignored.
    """
    try:
        app()
    except UserError as error:
        message = f"error: {error}"
    except OSError as error:
        if error.errno not in _DISK_FAULTS:
            raise
        message = f"error: {error.filename or 'output'}: {os.strerror(error.errno)}; finished files stay valid"
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
