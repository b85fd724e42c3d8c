"""The frame source makes a frame from a pose and a random seed, with any rendering engine.

    with Renderer(scene, config, exr_camera, sun) as engine:
        source = FrameSource.of(engine, config, camera, RimCircles.of_scene(scene))
        frame = source.take(Shot(position_m, rotation_camera_from_site, velocity_mps, seed))
        labels = source.labels(frame)

The engine renders the radiance. Sensor, labels, contrast and crater index are the same for all engines.
"""

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from perilune_render.config.dataset import DatasetConfig, LabelsConfig, SensorConfig
from perilune_render.flight.sub_poses import Pose, RowPoses, moved, row_times_s, sensor_rows
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.resampling import seen_by
from perilune_render.imaging.sensor import Exposure, FixedPattern, expected, expose, read_out, time_of_exposure_s
from perilune_render.labels.frame_labels import (
    GreyAndSun,
    Labels,
    RimCircles,
    crater_index,
    label_frame,
    shading_axes,
    with_contrast,
)
from perilune_render.streams import camera_seed, derived_seed, stream
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.rolling_shutter import Moving


@dataclass(frozen=True, slots=True)
class Shot:
    """Pose, velocity and random seed of one frame.

    The pose refers to the middle of the exposure of the middle row.
    """

    position_m: Array
    """Position of the camera, O_L, metres (3,)."""
    rotation_camera_from_site: Array
    """Rotation matrix (3, 3)."""
    velocity_mps: Array
    """Velocity of the camera, O_L, metres per second (3,); causes motion blur."""
    seed: int
    """Random seed of the sequence of frames; in a dataset, the seed of the trajectory."""
    index: int = 0
    """Index of the frame in the sequence. Frames that differ in seed or index have independent noise."""
    approach_deg: int = 0
    """Direction from which the trajectory comes (`NominalTrajectory.approach_deg`). It matters only if the ground is
    too large for one mesh (`perilune_render.terrain.levels`)."""
    angular_velocity_radps: Array = field(default_factory=lambda: np.zeros(3))
    """Angular velocity of the camera, O_C, radians per second (3,)."""

    @property
    def pose(self) -> tuple[Array, Array]:
        """Position and rotation."""
        return self.position_m, self.rotation_camera_from_site

    @property
    def render_seed(self) -> int:
        """Random seed of the engine's samples."""
        return derived_seed(self.seed, "frame", self.index)

    @property
    def moves(self) -> bool:
        """Whether the camera moves or turns."""
        return bool(np.any(self.velocity_mps) or np.any(self.angular_velocity_radps))

    def pose_at(self, time_s: float) -> Pose:
        """Position and rotation `time_s` seconds after the middle of the exposure of the middle row."""
        if time_s == 0:
            return self.pose
        return moved(self.pose, self.velocity_mps, self.angular_velocity_radps, time_s)


class Engine(Protocol):
    """A renderer of a lit scene, such as `perilune_render.engines.blender.renderer.Renderer`."""

    @property
    def camera(self) -> Camera:
        """Camera of the renderings, without distortion. It covers the view of the camera of the frames.

        If the camera of the frames has a lens model, both are equal.
        """

    @property
    def sun(self) -> Array:
        """Unit vector towards the Sun, O_L (3,)."""

    def render(self, position_m: Array, rotation_camera_from_site: Array, seed: int, approach_deg: int) -> Radiance:
        """Render the scene for `camera` from a position (3,), O_L, metres, with a rotation matrix (3, 3)."""

    def render_rows(self, poses: RowPoses, seed: int, approach_deg: int) -> Radiance:
        """Render the scene with a pose for each row of the sensor (rolling shutter)."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of a frame source."""

    shot: Shot
    """Pose, velocity and random seed."""
    radiance: Radiance
    """Rendering in the pixels of the engine's camera."""
    exposure: Exposure
    """Light on the sensor, without noise and fixed pattern."""
    image: np.ndarray
    """Grey values, DN (h, w): uint8, or uint16 above 8 bits."""


@dataclass(frozen=True, slots=True)
class FrameSource:
    """Renders and labels frames of one lit scene with one sensor. Create it with `FrameSource.of`."""

    engine: Engine
    """Renders the radiance."""
    camera: Camera
    """Camera of images and labels."""
    circles: RimCircles
    """Rims of the scene's craters."""
    sensor: SensorConfig
    """Settings of the sensor."""
    pattern: FixedPattern
    """Fixed pattern of the sensor."""
    bounds: LabelsConfig
    """Smallest and largest radius of labels."""

    @classmethod
    def of(
        cls, engine: Engine, config: DatasetConfig, camera: Camera, circles: RimCircles, name: str | None = None
    ) -> "FrameSource":
        """The frame source of a configuration.

        The random seed of the configuration determines the fixed pattern of the sensor. If there are several cameras,
        `name` is the name of `camera`, since each camera has its own pattern. Raises ValueError if the engine's camera
        does not cover the view of `camera`.
        """
        if not engine.camera.covers(camera):
            raise ValueError(f"camera of the engine: got {engine.camera}, expected a camera that covers {camera}")
        pattern = FixedPattern.draw(config.sensor, camera, camera_seed(config.seed, name))
        return cls(engine, camera, circles, config.sensor, pattern, config.labels)

    def take(self, shot: Shot) -> Frame:
        """Render and develop one frame.

        Raises the engine's errors, for example OSError if Blender wrote no frame.
        """
        return self.develop(shot, self.render(shot))

    def render(self, shot: Shot) -> Radiance:
        """The engine's rendering of a shot, in the pixels of the engine's camera. Raises the engine's errors.

        With motion blur, a moving camera and `sensor.blur_poses` above 1, `Radiance.blurred` is the mean of this number
        of renderings during the exposure.
        """
        middle = self._render_at(shot, 0.0, shot.render_seed)
        n = self.sensor.blur_poses
        if not (self.sensor.motion_blur and n > 1 and shot.moves):
            return middle
        exposure_s = time_of_exposure_s(middle, self.sensor, self.camera, self.engine.camera)
        total = np.zeros(middle.radiance_factor.shape)
        for k in range(n):
            seed = derived_seed(shot.render_seed, "exposure", k)
            total += self._render_at(shot, ((k + 0.5) / n - 0.5) * exposure_s, seed).radiance_factor
        return replace(middle, blurred=(total / n).astype(np.float32))

    def _render_at(self, shot: Shot, time_s: float, seed: int) -> Radiance:
        """The rendering `time_s` seconds after the middle of the exposure."""
        if not self._rolls(shot):
            return self.engine.render(*shot.pose_at(time_s), seed, shot.approach_deg)
        return self.engine.render_rows(self._row_poses(shot, time_s), seed, shot.approach_deg)

    def _rolls(self, shot: Shot) -> bool:
        """Whether the rows of a shot have different poses."""
        return bool(self.sensor.row_time_s) and shot.moves

    def _row_poses(self, shot: Shot, time_s: float = 0.0) -> RowPoses:
        """Poses of the rows of a shot, `time_s` seconds after the middle of the exposure."""
        times_s = row_times_s(self.camera.height_px, self.sensor.row_time_s)
        return RowPoses(sensor_rows(self.camera, self.engine.camera), times_s, lambda t: shot.pose_at(time_s + t))

    def places_m(self, frame: Frame) -> Array:
        """Points (h, w, 3), O_L, metres, that the pixels of the engine's camera show; NaN for sky.

        With a rolling shutter, each row of pixels has its own pose.
        """
        shot, camera, depth_m = frame.shot, self.engine.camera, frame.radiance.depth_m.astype(np.float64)
        depth_m = np.where(np.isfinite(depth_m), depth_m, np.nan)[..., None]
        rays = camera.rays(camera.pixel_centres())
        if camera.lens is not None:
            rays, depth_m = camera.points(camera.pixel_centres(), depth_m[..., 0]), np.ones_like(depth_m)
        if not self._rolls(shot):
            return depth_m * (rays @ shot.rotation_camera_from_site) + shot.position_m
        rows = self._row_poses(shot)
        position, rotation = (np.array(each) for each in zip(*map(rows.pose_at, rows.time_s.tolist()), strict=True))
        turned = [sum(rays[..., i] * rotation[rows.row, i, j] for i in range(3)) for j in range(3)]
        return depth_m * np.stack(turned, axis=-1) + position[rows.row]

    def develop(self, shot: Shot, radiance: Radiance) -> Frame:
        """Apply the sensor model to the rendering of a shot.

        Another thread may do this while the engine renders the next shot.
        """
        velocity = shot.rotation_camera_from_site @ shot.velocity_mps
        turn = shot.angular_velocity_radps
        exposure = expose(radiance, self.sensor, self.camera, self.engine.camera, velocity, turn)
        noise = stream(shot.seed, "sensor", shot.index)
        return Frame(shot, radiance, exposure, read_out(exposure, self.sensor, self.pattern, noise))

    def labels(self, frame: Frame) -> Labels:
        """Labels of a frame, in the pixels of its image."""
        seen = seen_by(frame.radiance, self.camera, self.engine.camera)
        limits = self.bounds.bounds_px(self.camera.width_px)
        circles = self._seen_circles(frame.shot)
        return self.with_contrast(label_frame(circles, self.camera, *frame.shot.pose, seen, limits), frame)

    def with_contrast(self, labels: Labels, frame: Frame) -> Labels:
        """The labels with their contrast, computed from the frame's exposure."""
        grey = GreyAndSun(*expected(frame.exposure, self.sensor), self.engine.sun)
        return with_contrast(labels, self._seen_circles(frame.shot), self.camera, *frame.shot.pose, grey)

    def shading_axes(self, shot: Shot, crater_id: np.ndarray) -> Array:
        """The map from the rim planes of craters (N,) to pixels (N, 2, 2) (`labels.frame_labels.shading_axes`)."""
        return shading_axes(crater_id, self._seen_circles(shot), self.camera, *shot.pose, self.engine.sun)

    def crater_index(self, frame: Frame) -> np.ndarray:
        """Id of the smallest crater in each pixel of the frame's radiance (h, w) float32; -1 without a crater."""
        circles = self._seen_circles(frame.shot)
        return crater_index(circles, self.engine.camera, *frame.shot.pose, frame.radiance.depth_m)

    def _seen_circles(self, shot: Shot) -> RimCircles:
        """The rims, moved to correct for a rolling shutter.

        A real rim is seen from the pose of the row that shows the rim's centre. From the shot's pose, the moved rim has
        the same image.
        """
        if not self._rolls(shot):
            return self.circles
        moving = Moving(*(each[None] for each in (*shot.pose, shot.velocity_mps, shot.angular_velocity_radps)))
        time = moving.row_times_s(self.circles.centre_m, self.camera, self.sensor.row_time_s)
        position, rotation = shot.pose
        centre = moving.seen_at(self.circles.centre_m, time) @ rotation + position
        normal = np.einsum("nij,nj->ni", moving.rotations_at(time), self.circles.normal) @ rotation
        return replace(self.circles, centre_m=centre, normal=normal)
