"""Ctrl-C where it must wait."""

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Answer Ctrl-C at the end of what is done within.

    Cycles' own Python callback would swallow it, and the rendering would go on; Numba, loading compiled code, may end
    the process with a fault.
    """
    asked = []
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: asked.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if asked:
        raise KeyboardInterrupt
