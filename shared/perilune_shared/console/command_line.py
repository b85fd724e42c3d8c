"""Create and run command lines: common options, threads, one-line errors and exit codes."""

import atexit
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from perilune_shared.console.interrupts import ended_by_interrupt, ends_at_interrupt
from perilune_shared.console.terminal import answer, say
from perilune_shared.errors import DISK_FAULTS, EXIT_INTERRUPTED, EXIT_USER_ERROR, STOPPED, UserError, one_line
from perilune_shared.threads import described_settings, set_up_program


def _describe_threads(verbose: bool) -> None:
    if verbose:
        print(described_settings(), file=sys.stderr)


Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", callback=_describe_threads, help="Print the usable cores and the thread variables."
    ),
]
"""Option of every program, written before the command: `perilune-train -v detect train`."""

OverwriteFolder = Annotated[
    bool, typer.Option("--overwrite", help="Replace the folder of --out, if an earlier run of this command wrote it.")
]
"""Option of commands that write a new folder; pass its value to `storage.replacement.replaceable`."""


def new_program(name: str, version: str, summary: str) -> typer.Typer:
    """Create a program with -h, --verbose, --version and shell completion, but without commands."""
    app = typer.Typer(
        name=name,
        help=summary,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )

    def print_version(asked: bool) -> None:
        if asked:
            answer(f"{name} {version}")
            raise typer.Exit

    @app.callback()
    def program(
        verbose: Verbose = False,
        version: Annotated[
            bool, typer.Option("--version", callback=print_version, is_eager=True, help="Print the version and end.")
        ] = False,
    ) -> None:
        pass

    return app


def add_renamed(app: typer.Typer, old: str, new: str, command: Callable[..., None]) -> None:
    """Keep the old name of a renamed command. Help does not list it; using it prints the new name."""

    @wraps(command)
    def renamed(*arguments: Any, **options: Any) -> None:
        say(f"{old}: renamed to {new}")
        command(*arguments, **options)

    app.command(old, hidden=True)(renamed)


def one_command(function: Callable[..., None]) -> typer.Typer:
    """Create a program whose only command is `function`, without shell completion."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(function)
    return app


_UsageError: Any = typer.BadParameter.__base__
"""Error class for wrong options: Click's in older versions of Typer, Typer's own copy in newer ones."""

_UNTRACKED = {
    "DO_NOT_TRACK": "1",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "ORT_DISABLE_TELEMETRY": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
}
"""Environment variables that switch off the telemetry of libraries; values set by the user are kept."""


def _check_arguments() -> None:
    """Raise UserError on an argument that is not UTF-8: tables, pages and some libraries cannot store it."""
    for argument in sys.argv[1:]:
        if any("\ud800" <= sign <= "\udfff" for sign in argument):
            raise UserError("command line", "argument", argument, "text or a path in UTF-8")


def run_command_line(app: Callable[[], object], *, ended_after_s: float = 1.5) -> None:
    """Run a command line. On a wrong option, user error or disk error, print a line and exit with code 2.

    First sets the threads of the numerical libraries (`threads.set_up_program`) and switches off the telemetry of
    libraries. The numerical libraries must not be imported yet.

    Ctrl-C ends the command with one line and exit code 130. If the command is still running `ended_after_s` seconds
    after Ctrl-C, the process is ended together with its child processes. Ctrl-C is ignored once all work is done.
    """
    with ended_by_interrupt(after_s=ended_after_s, at_end=_end_children):
        message = _error_of(app)
    if message is None:
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        return
    print(message, file=sys.stderr)
    sys.exit(EXIT_INTERRUPTED if message == STOPPED else EXIT_USER_ERROR)


def _error_of(app: Callable[[], object]) -> str | None:
    """Run a command line; return the line to print after an error or Ctrl-C, or None after success."""
    interrupted: list[bool] = []
    try:
        # Entered inside the `try`: from the first instruction of this block on, Ctrl-C raises KeyboardInterrupt.
        with _interrupts(interrupted):
            _check_arguments()
            set_up_program()
            for name, value in (_UNTRACKED | _matplotlib_folder()).items():
                os.environ.setdefault(name, value)
            _run(app)
    except UserError as error:
        return STOPPED if interrupted else f"error: {error}"
    except _UsageError as error:
        # Imported here so that correct commands start faster.
        from perilune_shared.console.usage import usage_line

        return STOPPED if interrupted else f"error: {usage_line(error)}"
    except SystemExit as stop:
        # Typer turns Ctrl-C into SystemExit with exit code 130.
        if interrupted or stop.code == EXIT_INTERRUPTED:
            return STOPPED
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        raise
    except BaseException as error:
        # An interrupt during an import, or in C code, may surface as another error.
        if interrupted or isinstance(error, KeyboardInterrupt):
            return STOPPED
        if isinstance(error, OSError) and error.errno in DISK_FAULTS:
            return (
                f"error: {one_line(error.filename or 'output')}: {os.strerror(error.errno)}; finished files stay valid"
            )
        raise
    return None


def _run(app: Callable[[], object]) -> None:
    """Call a command line. Typer raises the error of a wrong option instead of printing it in a box."""
    if not isinstance(app, typer.Typer):
        app()
        return
    try:
        code = app(standalone_mode=False)
    except _UsageError as error:
        # The program was called without arguments and has printed its help.
        if type(error).__name__ == "NoArgsIsHelpError":
            raise SystemExit(EXIT_USER_ERROR) from None
        raise
    raise SystemExit(code if type(code) is int else 0)


def _matplotlib_folder() -> dict[str, str]:
    """Return the environment variable that puts Matplotlib's font list into perilune's cache.

    The result is empty without a home folder.
    """
    configured = Path(os.environ.get("XDG_CACHE_HOME", ""))
    home = Path(os.environ.get("HOME", ""))
    if not configured.is_absolute() and not (home.is_absolute() and home.is_dir()):
        return {}
    cache = configured if configured.is_absolute() else home / ".cache"
    return {"MPLCONFIGDIR": str(cache / "perilune" / "matplotlib")}


@contextlib.contextmanager
def _interrupts(pressed: list[bool]) -> Iterator[None]:
    """On Ctrl-C, append to `pressed` and raise KeyboardInterrupt. No effect if Ctrl-C is ignored."""
    before = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or (before is not signal.default_int_handler and not ends_at_interrupt()):
        yield
        return

    def press(*_: object) -> None:
        pressed.append(True)
        raise KeyboardInterrupt

    def ignored(unraisable: Any) -> None:
        # Python discards an interrupt raised in a destructor or a callback; `ended_by_interrupt` then ends the process.
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            hook(unraisable)

    def printed(kind: Any, error: Any, traceback: Any) -> None:
        # C code prints errors of its imports and callbacks, for example with PyErr_Print.
        if not pressed:
            print_error(kind, error, traceback)

    hook, print_error = sys.unraisablehook, sys.excepthook
    signal.signal(signal.SIGINT, press)
    sys.unraisablehook, sys.excepthook = ignored, printed
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook, sys.excepthook = hook, print_error


def _end_children() -> None:
    """Send SIGTERM to all child processes (Linux)."""
    for path in Path("/proc/self/task").glob("*/children"):
        for child in path.read_text(encoding="ascii").split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(child), signal.SIGTERM)
