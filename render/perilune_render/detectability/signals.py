"""The expected images of frames with and without single craters.

The ground is generated again without a batch of craters (`removals`), and only the parts of the frames around these
craters are rendered again, by the engine `heightfield`. The rays of both renderings are the same, so the images differ
only by the crater.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.detectability.removals import SIGNAL_RADII
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.heightfield.engine import HeightfieldEngine
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.sensor import expected, expose
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import Ellipses
from perilune_shared.geometry.frames import Array

_MARGIN_PX = 4.0
"""Width of the border around a window, for the point spread, pixels."""


@dataclass(frozen=True, slots=True)
class ExpectedFrame:
    """The expected image of a frame with all craters."""

    shot: Shot
    """Pose, velocity and random seed."""
    radiance: Radiance
    """Rendering by the engine's camera: radiance factors and depths."""
    exposure_time_s: float
    """Exposure time, seconds."""
    mean: np.ndarray
    """Expected grey value of each pixel, DN (h, w) float32."""
    noise: np.ndarray
    """Standard deviation of the sensor noise of each pixel, DN (h, w) float32."""


@dataclass(frozen=True, slots=True)
class Removal:
    """A crater in a frame, and the expected image around it without this crater."""

    crater_id: int
    """Id of the crater in its scene."""
    centre_px: tuple[float, float]
    """x and y of the centre of the crater's ellipse in the window, pixels."""
    axes_px: Array
    """Map from offsets in the rim's plane to pixels (2, 2), as in `frame_labels.shading_axes`."""
    rows: slice
    """Rows of the window in the image."""
    columns: slice
    """Columns of the window in the image."""
    inside: np.ndarray
    """Whether each pixel of the window is within SIGNAL_RADII of the crater's centre (h, w) bool."""
    without: np.ndarray
    """Expected grey values of the window without the crater, DN (h, w) float32."""

    def background(self, mean: np.ndarray) -> np.ndarray:
        """Expected image of the window without the crater (h, w), DN, from the frame's expected image with it."""
        return np.where(self.inside, self.without, mean[self.rows, self.columns])

    def signal(self, mean: np.ndarray) -> np.ndarray:
        """Change of the expected image by the crater (h, w) in the window, DN; 0 outside `inside`."""
        return np.where(self.inside, mean[self.rows, self.columns] - self.without, 0)


def heightfield_settings(config: DatasetConfig) -> DatasetConfig:
    """The settings with the engine `heightfield`, which renders no light from other ground and from the Earth."""
    render = config.render.model_copy(update={"engine": "heightfield", "threads": 1})
    light = config.light.model_copy(update={"bounce": False, "earthshine": False})
    return config.model_copy(update={"render": render, "light": light})


class RemovalRenderer:
    """Renders the frames of one camera over one lit scene, with all craters and without some."""

    def __init__(self, scene: Scene, config: DatasetConfig, cameras: tuple[Camera, Camera], sun: Array):
        """`cameras` are the camera of the frames and the camera of the engine; `sun` (3,) is in O_L."""
        self._config, self._cameras, self._sun = heightfield_settings(config), cameras, sun
        self._source, _ = self._source_over(scene)

    def _source_over(self, scene: Scene) -> tuple[FrameSource, HeightfieldEngine]:
        camera, engine_camera = self._cameras
        engine = HeightfieldEngine(scene, self._config, engine_camera, self._sun)
        return FrameSource.of(engine, self._config, camera, RimCircles.of_scene(scene)), engine

    def frame(self, shot: Shot) -> ExpectedFrame:
        """The expected image of a shot with all craters."""
        radiance = self._source.render(shot)
        exposure = self._source.develop(shot, radiance).exposure
        mean, noise = expected(exposure, self._config.sensor)
        # Only the radiance and the depth are needed again, and a scene may have many frames.
        radiance = replace(radiance, normal=np.empty((0, 0, 3)), sunlit=np.empty((0, 0), bool), blurred=None)
        return ExpectedFrame(shot, radiance, exposure.time_s, mean, noise)

    def without(
        self, scene: Scene, frames: list[tuple[ExpectedFrame, np.ndarray, Ellipses]]
    ) -> Iterator[list[Removal]]:
        """For each of `frames`, the removals of some craters over a scene that lacks them.

        A frame comes with the ids of these craters (N,) and with their ellipses in the image.
        """
        source, engine = self._source_over(scene)
        for frame, crater_id, ellipses in frames:
            windows = [_window(ellipses, k, frame.mean.shape) for k in range(len(crater_id))]
            mean = self._expected_again(source, engine, frame, windows)
            axes = self._source.shading_axes(frame.shot, crater_id)
            yield [
                Removal(
                    int(crater_id[k]),
                    (float(ellipses.cx_px[k] - columns.start), float(ellipses.cy_px[k] - rows.start)),
                    axes[k],
                    rows,
                    columns,
                    inside,
                    mean[rows, columns].copy(),
                )
                for k, (rows, columns, inside) in enumerate(windows)
            ]

    def _expected_again(
        self,
        source: FrameSource,
        engine: HeightfieldEngine,
        frame: ExpectedFrame,
        windows: list[tuple[slice, slice, np.ndarray]],
    ) -> np.ndarray:
        """The expected image over the ground of `source`, with the exposure time of the frame with all craters."""
        shot, sensor = frame.shot, self._config.sensor
        camera, engine_camera = self._cameras
        blurs = sensor.motion_blur and sensor.blur_poses > 1
        if camera == engine_camera and not (shot.moves and (sensor.row_time_s or blurs)):
            wanted = np.zeros(frame.mean.shape, bool)
            margin = int(_MARGIN_PX)
            for rows, columns, _ in windows:
                first_row, first_column = max(rows.start - margin, 0), max(columns.start - margin, 0)
                wanted[first_row : rows.stop + margin, first_column : columns.stop + margin] = True
            radiance = engine.render_again(frame.radiance, wanted, *shot.pose, shot.render_seed)
        else:
            radiance = source.render(shot)
        fixed = sensor.model_copy(update={"exposure": "fixed", "exposure_time_s": frame.exposure_time_s})
        velocity = shot.rotation_camera_from_site @ shot.velocity_mps
        radiance = replace(radiance, depth_m=frame.radiance.depth_m)
        exposure = expose(radiance, fixed, camera, engine_camera, velocity, shot.angular_velocity_radps)
        return expected(exposure, fixed)[0]


def _window(ellipses: Ellipses, k: int, shape: tuple[int, ...]) -> tuple[slice, slice, np.ndarray]:
    """Rows and columns of the window of an ellipse, and which of its pixels are within SIGNAL_RADII."""
    height, width = shape
    cx, cy, theta = ellipses.cx_px[k], ellipses.cy_px[k], ellipses.theta_rad[k]
    a, b = SIGNAL_RADII * ellipses.a_px[k], SIGNAL_RADII * ellipses.b_px[k]
    cos, sin = np.cos(theta), np.sin(theta)
    half_x, half_y = np.hypot(a * cos, b * sin), np.hypot(a * sin, b * cos)
    columns = slice(max(int(np.floor(cx - half_x)), 0), min(int(np.ceil(cx + half_x)), width))
    rows = slice(max(int(np.floor(cy - half_y)), 0), min(int(np.ceil(cy + half_y)), height))
    y, x = np.mgrid[rows, columns] + 0.5
    dx, dy = x - cx, y - cy
    inside = ((dx * cos + dy * sin) / a) ** 2 + ((dy * cos - dx * sin) / b) ** 2 <= 1
    return rows, columns, inside
