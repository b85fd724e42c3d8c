"""Random streams derived from one seed by name, so that each frame can be regenerated alone."""

import hashlib

import numpy as np


def derived_seed(seed: int, *names: object) -> int:
    """A 63-bit seed that depends only on `seed` and the names."""
    text = "\x1f".join(str(part) for part in (seed, *names))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def stream(seed: int, *names: object) -> np.random.Generator:
    """The random generator of a named stream, for example `stream(scene.seed, "craters")`."""
    return np.random.default_rng(derived_seed(seed, *names))


def camera_seed(seed: int, camera: str | None) -> int:
    """Random seed of the frames or the sensor of one of several cameras.

    `camera` is None for a dataset with a single camera, which uses `seed` itself.
    """
    return seed if camera is None else derived_seed(seed, "camera", camera)
