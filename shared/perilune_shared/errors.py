"""Errors that a user can cause, told in one line, and the exit code that goes with them."""

import errno
import os
import sys
from collections.abc import Callable

EXIT_USER_ERROR = 2
_EXIT_INTERRUPTED = 130
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
    """A fault in what the user gave: file or place, field, value found, and what would be right."""

    def __init__(self, where: object, field: str, found: object, wanted: str):
        # Any of them may come out of a stranger's file, in any length.
        self.field, self.found, self.wanted = shortened(field), shortened(found), shortened(wanted, 500)
        super().__init__(
            one_line(f"{shortened(where, 4200)}: {self.field}: got {self.found}, expected {self.wanted}"),
        )


def one_line(text: object) -> str:
    """Text on one line, with a question mark for what would steer a terminal."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(str(text).split()))


def shortened(value: object, most: int = 120) -> str:
    """A value as text of at most `most` characters."""
    text = str(value)
    return text if len(text) <= most else text[: most - 3] + "..."


def run_command_line(app: Callable[[], object]) -> None:
    """Run a command line; a user's fault or a failing disk ends it with one line and exit code 2."""
    try:
        app()
    except UserError as error:
        fail = f"error: {error}"
    except OSError as error:
        if error.errno not in _DISK_FAULTS:
            raise
        fail = f"error: {error.filename or 'output'}: {os.strerror(error.errno)}; what was finished stays valid"
    except (KeyboardInterrupt, SystemExit) as stop:
        # Typer itself turns Ctrl-C into a bare exit with the shell's code for it.
        if isinstance(stop, SystemExit) and stop.code != _EXIT_INTERRUPTED:
            raise
        print("stopped; what was finished stays valid and can be resumed", file=sys.stderr)
        sys.exit(_EXIT_INTERRUPTED)
    else:
        return
    print(fail, file=sys.stderr)
    sys.exit(EXIT_USER_ERROR)
