"""Loaded by every Python process that a test starts with this folder in PYTHONPATH: refuses and records connections."""

import os
import sys

LOCAL = ("127.", "::1", "localhost", "0.0.0.0", "::")


def _watch(event: str, arguments: tuple) -> None:
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        address = arguments[1]
        if not isinstance(address, tuple) or str(address[0]).startswith(LOCAL):
            return
    elif event in ("socket.getaddrinfo", "socket.gethostbyname"):
        address = arguments[0]
        name = address.decode() if isinstance(address, bytes) else str(address or "")
        if not name or name.startswith(LOCAL) or name in (os.uname().nodename, "None"):
            return
    else:
        return
    with open(os.environ["PERILUNE_TRAP"], "a", encoding="utf-8") as log:  # noqa: PTH123 - imports nothing
        log.write(f"{' '.join(sys.argv)}: {event} {address}\n")
    raise OSError(f"trapped: {event} {address}")


if "PERILUNE_TRAP" in os.environ:
    sys.addaudithook(_watch)

if "PERILUNE_CLOCK" in os.environ:
    import time

    _real = time.time

    def _jumping() -> float:
        """The time of day, which jumps by ten years back or forth every half second."""
        now_s = _real()
        return now_s + (-3e8, 0.0, 3e8)[int(2 * now_s) % 3]

    time.time = _jumping
