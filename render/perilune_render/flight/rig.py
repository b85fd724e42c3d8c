"""The rig: the cameras on the body, and the poses of each camera along a trajectory of the body.

The body's pose is given as the pose of a camera with the default mounting: at the body's origin, looking along -Z_B.
The single camera of `dataset.camera` has this mounting.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from perilune_render.config.cameras import MountingConfig
from perilune_render.config.dataset import DatasetConfig, FlightConfig
from perilune_render.flight.lens import camera_of, check_engine
from perilune_render.flight.trajectories import Flight
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
from perilune_shared.geometry.frames import (
    Array,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
)

_LOWEST_RAY = 0.01
"""Smallest component along -Z_B of a unit ray through a corner of the image. With a smaller component, the image counts
as showing the horizon."""


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A camera on the body."""

    camera: Camera
    """Camera of the frames."""
    exr_camera: Camera
    """Camera of the renderings and EXRs: a pinhole that covers the view of `camera`, or `camera` with a lens model."""
    rotation_camera_from_body: Array
    """Rotation matrix (3, 3)."""
    position_in_body_m: Array
    """Centre of projection in O_B, metres (3,)."""

    def poses(self, position_m: Array, rotation_wxyz: Array) -> tuple[Array, Array]:
        """Positions (N, 3), O_L, metres, and rotation_camera_from_site (N, 4) for poses of the body."""
        body_from_site = ROTATION_CAMERA_FROM_BODY.T @ matrix_from_quaternion(rotation_wxyz)
        position = position_m + np.einsum("nji,j->ni", body_from_site, self.position_in_body_m)
        rotations = self.rotation_camera_from_body @ body_from_site
        return position, np.stack([quaternion_from_matrix(rotation) for rotation in rotations])

    def body_position(self, position_m: Array, rotation_wxyz: Array) -> Array:
        """Positions of the body (N, 3), O_L, metres, for poses of this camera."""
        body_from_site = self.rotation_camera_from_body.T @ matrix_from_quaternion(rotation_wxyz)
        return position_m - np.einsum("nji,j->ni", body_from_site, self.position_in_body_m)

    def flight_of(self, body: Flight) -> Flight:
        """The flight of this camera on a body.

        The velocity is the body's velocity plus the velocity from its rotation about the body's origin. `motion`
        remains the motion of the body.
        """
        position, rotation = self.poses(body.position_m, body.rotation_wxyz)
        seen = replace(body, position_m=position, rotation_wxyz=rotation)
        turn = body.angular_velocity_radps
        if turn is None:
            return seen
        # The angular velocity is given in the axes of the default mounting.
        in_site = np.einsum("nji,nj->ni", matrix_from_quaternion(body.rotation_wxyz), turn)
        velocity = body.velocity_mps + np.cross(in_site, position - body.position_m)
        turn = turn @ (self.rotation_camera_from_body @ ROTATION_CAMERA_FROM_BODY.T).T
        return replace(seen, velocity_mps=velocity, angular_velocity_radps=turn)

    def levelled(self) -> Camera:
        """A pinhole with the default mounting that sees all ground that this camera sees.

        Its focal length is so large that its pixels cover no more ground than the smallest pixel of this camera. Raises
        UserError if this camera could see the horizon while the body is level.
        """
        camera = self.exr_camera
        if camera.lens is None and np.array_equal(self.rotation_camera_from_body, ROTATION_CAMERA_FROM_BODY):
            return camera
        corners = np.array([[u, v] for u in (0, camera.width_px) for v in (0, camera.height_px)], np.float64)
        places = corners if camera.lens is None else camera.outline()
        rays = camera.border_rays(places) @ self.rotation_camera_from_body
        if (-rays[:, 2] < _LOWEST_RAY * np.linalg.norm(rays, axis=1)).any():
            expected = "a view of the ground alone, or given poses with dataset.scene.horizon=true"
            field = "dataset.cameras" if camera.lens is None else "dataset.camera.lens"
            expected = "a view of the ground alone" if camera.lens is None else expected
            raise UserError("configuration", field, "a view with the horizon", expected)
        half = float(np.abs(rays[:, :2] / rays[:, 2:]).max())
        # From this image to the level image, lengths grow by at most the square of the ratio of depths.
        focal = max(camera.fx_px, camera.fy_px) * max(1.0, float(-rays[:, 2].min())) ** 2
        if camera.lens is not None:
            focal = camera.scale_px
        side = int(np.ceil(2 * half * focal))
        return Camera(side, side, focal, focal, side / 2, side / 2)

    def flight_settings(self, flight: FlightConfig) -> FlightConfig:
        """Flight settings whose position spread includes the distance of the camera from the body's origin."""
        lever_m = float(np.linalg.norm(self.position_in_body_m))
        return flight.model_copy(update={"position_sigma_m": flight.position_sigma_m + lever_m / 3})


Rig = Mapping[str | None, MountedCamera]
"""Cameras by name, in the order of the names; a single camera without a name has the key None."""


def rig_of(config: DatasetConfig) -> dict[str | None, MountedCamera]:
    """The cameras of a configuration.

    Raises UserError if a distortion is too strong, or for a lens model that the engine does not render.
    """
    if not config.cameras:
        camera = camera_of(config.camera)
        check_engine(camera, config.render, "dataset.camera")
        return {None: mounted(camera)}
    rig: dict[str | None, MountedCamera] = {}
    for name, settings in config.cameras.items():
        camera, mounting = camera_of(settings, f"dataset.cameras.{name}"), settings.mounting
        check_engine(camera, config.render, f"dataset.cameras.{name}")
        position = np.array(mounting.position_in_body_m)
        rig[name] = MountedCamera(camera, camera.rendered(), _rotation(mounting), position)
    return rig


def mounted(camera: Camera) -> MountedCamera:
    """A camera with the default mounting."""
    return MountedCamera(camera, camera.rendered(), ROTATION_CAMERA_FROM_BODY, np.zeros(3))


def _rotation(mounting: MountingConfig) -> Array:
    """rotation_camera_from_body (3, 3)."""
    if mounting.rotation_camera_from_body_wxyz is not None:
        return matrix_from_quaternion(mounting.rotation_camera_from_body_wxyz)
    if not any(mounting.turned_deg):
        return ROTATION_CAMERA_FROM_BODY
    turned = np.eye(3)
    for axis, angle_deg in zip(np.eye(3), mounting.turned_deg, strict=True):
        turned = matrix_from_rotation_vector(np.radians(angle_deg) * axis) @ turned
    return ROTATION_CAMERA_FROM_BODY @ turned.T
