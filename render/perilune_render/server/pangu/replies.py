"""Replies of PANGU's protocol as bytes: errors, and numbers that may be invalid."""

import numpy as np

from perilune_render.server.pangu import messages as m
from perilune_render.server.pangu.wire import double_bytes, float_bytes, text_bytes, unsigned
from perilune_shared.geometry.frames import Array

REFUSED, FAULTY = 1, 2
"""Codes of errors: a request that this server does not serve, and one with impossible values."""


def error(code: int, text: str) -> bytes:
    """An error as a message."""
    return unsigned(m.ERROR, code) + text_bytes(text[:900] or "error")


def valid_floats(values: Array) -> bytes:
    """Floats, each with a bool that says whether it is valid (finite)."""
    good = np.isfinite(values)
    words = float_bytes(np.where(good, values, 0.0))
    return b"".join(words[4 * k : 4 * k + 4] + (b"\1" if good[k] else b"\0") for k in range(len(values)))


def valid_points(points: Array) -> bytes:
    """Points (N, 3), each with a bool that says whether it is valid (finite)."""
    good = np.isfinite(points).all(axis=1)
    words = float_bytes(np.where(good[:, None], points, 0.0).ravel())
    return b"".join(words[12 * k : 12 * k + 12] + (b"\1" if good[k] else b"\0") for k in range(len(points)))


def doubles(values: Array, *, valid: bool) -> bytes:
    """Doubles (N,), each with the same bool."""
    words = double_bytes(values)
    return b"".join(words[8 * k : 8 * k + 8] + (b"\1" if valid else b"\0") for k in range(len(values)))


def float_array(values: Array) -> bytes:
    """Floats (N,) as a message; those that are not finite are invalid."""
    return unsigned(m.FLOAT_ARRAY, len(values)) + valid_floats(values)
