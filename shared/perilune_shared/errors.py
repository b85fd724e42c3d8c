"""Errors that a user can correct, each reported in one line, and the exit codes of the command lines."""

import errno

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130
STOPPED = "stopped; finished files stay valid; run the same command again to resume"
"""Last line that a command prints after Ctrl-C."""
DISK_FAULTS = (
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
    errno.EMFILE,
    errno.ENFILE,
)
"""Disk and file errors that a user can correct, such as a full disk or a missing permission."""


class UserError(Exception):
    """An error that the user can correct; its text is "where: field: got ..., expected ..." on one line.

    `where` is the file or option, `field` the part of it, or "" if there is none.
    """

    def __init__(self, where: object, field: str, found: object, expected: str):
        # These texts may come from untrusted files and have any length.
        self.where = shortened(where, 4200)
        self.field, self.found, self.expected = shortened(field), shortened(found), shortened(expected, 500)
        # A field may repeat its option: `--camera-axes` and `camera axes`.
        repeated = self.where.startswith("--") and self.where[2:].replace("-", " ") == self.field
        place = f"{self.where}: {self.field}" if self.field and not repeated else self.where
        super().__init__(one_line(f"{place}: got {self.found}, expected {self.expected}"))

    def __reduce__(self) -> tuple:
        """Pickle the constructor's arguments, so that a worker process can send the error."""
        return UserError, (self.where, self.field, self.found, self.expected)


def ends_run(error: BaseException) -> bool:
    """Whether all further work would fail too: a user error, or a full or inaccessible disk."""
    # Another process may have removed a missing file, so it does not end the run.
    return isinstance(error, UserError) or (
        isinstance(error, OSError) and error.errno in DISK_FAULTS and error.errno != errno.ENOENT
    )


def one_line(text: object) -> str:
    """Return text on one line, with terminal control characters replaced by question marks."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(str(text).split()))


def shortened(value: object, max_length: int = 120) -> str:
    """Return a value as text of at most `max_length` characters."""
    text = str(value)
    return text if len(text) <= max_length else text[: max_length - 3] + "..."
