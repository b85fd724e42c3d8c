"""Lines on what happens, passed on without ever blocking the caller."""

import contextlib
import queue
import threading
from collections.abc import Callable


class Notes:
    """Passes lines on to a function in a thread of its own.

    The function may block, for example on a pipe that nobody reads. Lines that come meanwhile wait; those beyond `most`
    are dropped.
    """

    def __init__(self, note: Callable[[str], object], most: int = 1000):
        self._note = note
        self._lines: queue.Queue[str | None] = queue.Queue(most)
        self._thread = threading.Thread(target=self._pass_on, name="notes", daemon=True)
        self._thread.start()

    def __call__(self, text: str) -> None:
        """Pass a line on, or drop it."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(text)

    def close(self, wait_s: float) -> None:
        """Pass on the lines that wait, for at most about `wait_s` seconds."""
        with contextlib.suppress(queue.Full):
            self._lines.put(None, timeout=wait_s)
            self._thread.join(wait_s)

    def _pass_on(self) -> None:
        while (text := self._lines.get()) is not None:
            # A closed pipe must end neither this thread nor the server.
            with contextlib.suppress(Exception):
                self._note(text)
