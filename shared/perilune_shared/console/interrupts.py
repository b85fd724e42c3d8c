"""Handle Ctrl-C: end a program with one line, or delay the interrupt until a step ends.

This module imports as little as possible: Python prints a traceback at Ctrl-C until `end_at_interrupt` is called.
"""

import atexit
import contextlib
import importlib
import os
import select
import signal
import threading
from collections.abc import Callable, Iterator

from perilune_shared.errors import EXIT_INTERRUPTED, STOPPED

_BELOW_BAR = "\n\x1b[?25h"
"""Line feed, and the control sequence that shows the cursor again."""
_UNFINISHED: dict[str, None] = {}
"""Paths to remove if Ctrl-C ends the process before the code that wrote them can remove them."""
_NOTICE = b"\nstopping after this step; press Ctrl-C again to end at once\n"


def start(module: str) -> None:
    """Import a module and call its `main`; Ctrl-C during the import ends the process with one line."""
    end_at_interrupt()
    importlib.import_module(module).main()


def end_at_interrupt() -> None:
    """Make Ctrl-C end the process at once with one line and exit code 130.

    No effect if Ctrl-C is ignored or has another handler. Call this function in a script before large imports and
    before anything is written. `run_command_line` later installs a handler that lets the command clean up.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
        # When Python exits, all work is done.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


def ends_at_interrupt() -> bool:
    """Whether `end_at_interrupt` is in effect."""
    return signal.getsignal(signal.SIGINT) is _end


def _end(*_: object) -> None:
    # No exception is raised: partly imported modules and C code would turn it into other errors.
    os.write(2, f"{STOPPED}\n".encode())
    os._exit(EXIT_INTERRUPTED)


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Delay KeyboardInterrupt until the block ends. A second Ctrl-C ends the process at once.

    Two libraries need the delay. Cycles calls Python and discards an interrupt in that call, so rendering would
    continue. Numba may crash if it is interrupted while it loads compiled code. If Ctrl-C is ignored, for example in a
    background process of a shell, it stays ignored.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN or threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = []

    def delay(*_: object) -> None:
        asked.append(True)
        # The operating system handles the second Ctrl-C, even while no Python code runs.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        with contextlib.suppress(OSError):
            os.write(2, _NOTICE)

    signal.signal(signal.SIGINT, delay)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if asked:
        raise KeyboardInterrupt


@contextlib.contextmanager
def unfinished(*paths: os.PathLike[str]) -> Iterator[None]:
    """Remove these files and folders if `ended_by_interrupt` ends the process within the block."""
    names = [os.fspath(path) for path in paths]
    _UNFINISHED.update(dict.fromkeys(names))
    try:
        yield
    finally:
        for name in names:
            _UNFINISHED.pop(name, None)


def _remove_unfinished() -> None:
    # Imported here because the import is slow.
    import shutil
    from pathlib import Path

    for name in list(_UNFINISHED):
        with contextlib.suppress(OSError):
            Path(name).unlink()
        shutil.rmtree(name, ignore_errors=True)


@contextlib.contextmanager
def ended_by_interrupt(*, after_s: float, at_end: Callable[[], object] = lambda: None) -> Iterator[None]:
    """End the process with exit code 130 if the block still runs `after_s` seconds after Ctrl-C.

    Python raises KeyboardInterrupt only between two Python instructions, and one call of Blender or NumPy may take
    longer than `after_s`. Use this function only in commands whose output survives SIGKILL.

    Before the process ends, `at_end` is called in another thread, for example to end child processes of the block. Then
    files and folders passed to `unfinished` are removed, and one line is printed. If the block itself ends with
    KeyboardInterrupt, `at_end` is called in the block's thread, since the interrupt may have stopped the code that ends
    the child processes. No effect if Ctrl-C is ignored or outside the main thread.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN or threading.current_thread() is not threading.main_thread():
        yield
        return
    # Python's C signal handler writes the signal number into this pipe at once, even while native code runs.
    (asked, signalled), (ended, end) = os.pipe(), os.pipe()
    os.set_blocking(signalled, False)
    before = signal.set_wakeup_fd(signalled, warn_on_full_buffer=False)
    watcher = threading.Thread(target=_end_late, args=(asked, ended, after_s, at_end), daemon=True)
    watcher.start()
    try:
        yield
    except KeyboardInterrupt:
        at_end()
        raise
    finally:
        signal.set_wakeup_fd(before)
        os.close(end)
        watcher.join()
        for descriptor in (asked, signalled, ended):
            os.close(descriptor)


def _end_late(asked: int, ended: int, after_s: float, at_end: Callable[[], object]) -> None:
    """Wait for Ctrl-C (pipe `asked`), then for the end of the block (pipe `ended`), at most `after_s`."""
    while True:
        ready, _, _ = select.select([asked, ended], [], [])
        if ended in ready:
            return
        if signal.SIGINT in os.read(asked, 100) and not select.select([ended], [], [], after_s)[0]:
            with contextlib.suppress(Exception):
                at_end()
            _remove_unfinished()
            with contextlib.suppress(OSError):
                # A progress bar hides the cursor.
                os.write(2, f"{_BELOW_BAR if os.isatty(2) else ''}{STOPPED}\n".encode())
            os._exit(EXIT_INTERRUPTED)
