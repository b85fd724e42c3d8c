"""Delay Ctrl-C until a step is finished."""

import contextlib
import os
import signal
import threading
from collections.abc import Iterator

_NOTICE = b"\nstopping after this step; press Ctrl-C again to end at once\n"


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Delay KeyboardInterrupt until the block ends. A second Ctrl-C ends the process at once.

    Without the delay, Cycles' Python callback discards the interrupt and rendering continues, and Numba may crash if it
    is interrupted while it loads compiled code. If Ctrl-C is ignored, as in a process that a shell started in the
    background, it stays ignored.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN or threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = []

    def delay(*_: object) -> None:
        asked.append(True)
        # The operating system handles the second one, even while no Python code runs.
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
