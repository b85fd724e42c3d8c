"""Attitudes as stated in a file, and other interpretations of the same numbers."""

from dataclasses import dataclass, replace

import numpy as np

from perilune_render.poses.axes import camera_axes
from perilune_shared.geometry.frames import Array, quaternion_from_matrix


@dataclass(frozen=True, slots=True)
class Attitudes:
    """Quaternions of N poses, and their meaning."""

    quaternion_wxyz: Array
    """Unit quaternions (N, 4) in the file, w first."""
    site_from_camera: bool
    """Whether the quaternions rotate from the camera to the site."""
    scalar_last: bool
    """Whether the file has w last."""
    axes: Array
    """Rotation (3, 3) from the camera's axes to right, down, forward."""

    @property
    def rotation_wxyz(self) -> Array:
        """rotation_camera_from_site, unit quaternions (N, 4) with w >= 0."""
        q = self.quaternion_wxyz * [1, -1, -1, -1] if self.site_from_camera else self.quaternion_wxyz
        if not np.array_equal(self.axes, np.eye(3)):
            q = _multiplied(quaternion_from_matrix(self.axes), q)
        return np.where(q[:, :1] < 0, -q, q) + 0.0

    def alternatives(self) -> list[list[tuple[str, "Attitudes"]]]:
        """Other interpretations of the numbers, each with a hint for the user.

        The first list differs from this interpretation in one way, the second list in two ways.
        """
        shift, order = (-1, "w first (qw qx qy qz)") if self.scalar_last else (1, "w last (qx qy qz qw)")
        reordered = replace(self, quaternion_wxyz=np.roll(self.quaternion_wxyz, shift, axis=1))
        is_default = np.array_equal(self.axes, np.eye(3))
        name = "blender" if is_default else "opencv"
        axes = f"--camera-axes {name}", camera_axes(name, name)
        direction = "camera_from_site" if self.site_from_camera else "site_from_camera"
        opposite = f"`# rotation: {direction}` in CSV", replace(self, site_from_camera=not self.site_from_camera)
        order = f"quaternions with {order}, if you reorder them"
        single = [(order, reordered), (axes[0], replace(self, axes=axes[1])), opposite]
        double = [
            (f"{opposite[0]} and {axes[0]}", replace(opposite[1], axes=axes[1])),
            (f"{order}, and {axes[0]}", replace(reordered, axes=axes[1])),
        ]
        return [single, double]


def _multiplied(left: Array, right: Array) -> Array:
    """Products (N, 4) of a quaternion (4,) and quaternions (N, 4): the rotation `right` is applied first."""
    a, b, c, d = left
    e, f, g, h = right.T
    return np.stack(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ],
        axis=1,
    )
