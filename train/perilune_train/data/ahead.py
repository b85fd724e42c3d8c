"""Compute items in advance in a background thread, in a known order."""

import queue
import threading
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")
_STOP_S = 5.0
_POLL_S = 0.1


class Ahead(Generic[Key, Item]):
    """Computes items in a background thread, before they are needed.

    At most `n_ahead` finished items wait. `make(keys)` runs in the thread and yields (key, item) for each of `keys`.
    `following(key)` yields `key` and the keys that are needed after it. If `take` is called with a key other than the
    expected one, the thread restarts at that key.
    """

    def __init__(
        self,
        make: Callable[[Iterator[Key]], Iterator[tuple[Key, Item]]],
        following: Callable[[Key], Iterator[Key]],
        n_ahead: int,
    ):
        self._make, self._following, self._n_ahead = make, following, n_ahead
        self._expected: Iterator[Key] = iter(())
        self._results: queue.Queue[tuple[Key, Item] | BaseException] = queue.Queue()
        self._stop, self._thread = threading.Event(), threading.Thread()

    def take(self, key: Key) -> Item:
        """Wait for the item of a key. Raises the error that computing it raised."""
        if next(self._expected, None) != key:
            self._begin(key)
        result = self._results.get()
        if isinstance(result, BaseException):
            self._expected = iter(())
            raise result
        return result[1]

    def close(self) -> None:
        """Stop the thread; wait up to _STOP_S seconds if it is computing an item."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(_STOP_S)

    def _begin(self, key: Key) -> None:
        self.close()
        self._expected = self._following(key)
        next(self._expected)
        self._results, self._stop = queue.Queue(self._n_ahead), threading.Event()
        arguments = (self._following(key), self._results, self._stop)
        # A daemon thread, so that a process that ends with an error does not wait for it.
        self._thread = threading.Thread(target=self._run, args=arguments, name="ahead", daemon=True)
        self._thread.start()

    def _run(self, keys: Iterator[Key], results: queue.Queue, stop: threading.Event) -> None:
        def put(result: tuple[Key, Item] | BaseException) -> None:
            while not stop.is_set():
                try:
                    results.put(result, timeout=_POLL_S)
                    return
                except queue.Full:
                    continue

        def keys_until_stopped() -> Iterator[Key]:
            for key in keys:
                if stop.is_set():
                    return
                yield key

        try:
            for item in self._make(keys_until_stopped()):
                put(item)
        except BaseException as error:
            put(error)
