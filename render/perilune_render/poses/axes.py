"""Axes of a camera's frame: which axes point right, down and forward in the image."""

import numpy as np

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array

_AXES = {
    sign + name: (-1 if sign == "-" else 1) * np.eye(3)[k] for k, name in enumerate("xyz") for sign in ("", "+", "-")
}
NAMED_AXES = {"opencv": "x,y,z", "blender": "x,-y,-z"}
"""Conventions by name. In Blender and OpenGL y points up in the image and -z forward."""


def camera_axes(text: str, where: object) -> Array:
    """The rotation (3, 3) from a camera's axes to right, down, forward.

    `text` is a convention such as `blender`, or three axes such as `x,y,z`. Raises UserError that names `where`.
    """
    stated = text.strip().lower()
    names = [name.strip() for name in NAMED_AXES.get(stated, stated).split(",")]
    rows = np.array([_AXES[name] for name in names]) if all(name in _AXES for name in names) else np.zeros((1, 1))
    if rows.shape != (3, 3) or round(float(np.linalg.det(rows))) != 1:
        expected = f"three axes of a right-handed frame, such as x,y,z or -y,x,z, or {' or '.join(NAMED_AXES)}"
        raise UserError(where, "camera axes", text, expected)
    return rows
