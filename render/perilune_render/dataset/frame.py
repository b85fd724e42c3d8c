"""Make one frame from a rendering: its PNG, EXR and labels. Used for new, regenerated and developed frames."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perilune_render.config import DatasetConfig
from perilune_render.dataset.output import file_columns, write_png
from perilune_render.flight.plan import TrajectoryPlan
from perilune_render.imaging.exr import write_exr
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.resampling import seen_by
from perilune_render.imaging.sensor import Exposure, FixedPattern, expected, expose, read_out
from perilune_render.labels.frame_labels import Labels, RimCircles, Shown, crater_index, label_frame, with_contrast
from perilune_render.streams import derived_seed, stream
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_quaternion


@dataclass(frozen=True, slots=True)
class Shot:
    """Pose, velocity and random seed of one frame."""

    frame_id: str
    """Id in the manifest; names the files."""
    frame_index: int
    """Index in the trajectory, from 0."""
    trajectory_seed: int
    """Random seed of the trajectory."""
    position_m: Array
    """Position of the camera, O_L, metres (3,)."""
    rotation_camera_from_site: Array
    """Rotation matrix (3, 3)."""
    velocity_mps: Array
    """Velocity of the camera, O_L, metres per second (3,)."""

    @classmethod
    def planned(cls, trajectory: TrajectoryPlan, place: int) -> "Shot":
        """The frame at index `place` of a planned trajectory's frames."""
        flight = trajectory.flight
        return cls(
            trajectory.frame_id(place),
            trajectory.frame_index[place],
            trajectory.seed,
            flight.position_m[place],
            flight.rotation_camera_from_site[place],
            flight.velocity_mps[place],
        )

    @classmethod
    def recorded(cls, row: dict[str, Any], trajectory_seed: int) -> "Shot":
        """The frame of a row of the manifest's table `frames`."""
        return cls(
            row["frame_id"],
            row["frame_index"],
            trajectory_seed,
            np.array(row["position_m"]),
            matrix_from_quaternion(row["rotation_wxyz"]),
            np.array(row["velocity_mps"]),
        )

    @property
    def render_seed(self) -> int:
        """Random seed of the renderer's samples."""
        return derived_seed(self.trajectory_seed, "frame", self.frame_index)


@dataclass(frozen=True, slots=True)
class Studio:
    """What all frames of one scene share."""

    config: DatasetConfig
    """Settings of sensor, labels and files."""
    camera: Camera
    """Camera of the PNGs and labels."""
    exr_camera: Camera
    """Camera of the rendering and the EXRs."""
    pattern: FixedPattern
    """Fixed pattern of the sensor."""
    circles: RimCircles
    """Rims of the scene's craters."""
    sun: Array
    """Unit vector towards the Sun, O_L (3,)."""

    def write_png(self, out: Path, shot: Shot, radiance: Radiance) -> tuple[dict[str, str | int], Exposure]:
        """Develop and write a frame's PNG; returns its columns png_* of the manifest, and its exposure."""
        image, exposure = self.take(shot, radiance)
        return write_png(out, shot.frame_id, image, self.config.sensor.bits), exposure

    def take(self, shot: Shot, radiance: Radiance) -> tuple[np.ndarray, Exposure]:
        """Grey values (h, w), DN, and exposure of a frame."""
        velocity = shot.rotation_camera_from_site @ shot.velocity_mps
        exposure = expose(radiance, self.config.sensor, self.camera, self.exr_camera, velocity)
        noise = stream(shot.trajectory_seed, "sensor", shot.frame_index)
        return read_out(exposure, self.config.sensor, self.pattern, noise), exposure

    def write_exr(self, out: Path, shot: Shot, radiance: Radiance) -> dict[str, str | int]:
        """Write a frame's EXR; returns its columns exr_* of the manifest."""
        path = f"frames/{shot.frame_id}.exr"
        pose = shot.position_m, shot.rotation_camera_from_site
        write_exr(out / path, radiance, crater_index(self.circles, self.exr_camera, *pose, radiance.depth_m))
        return file_columns(out, "exr", path)

    def label(self, shot: Shot, radiance: Radiance, exposure: Exposure) -> Labels:
        """Labels of a frame."""
        pose = shot.position_m, shot.rotation_camera_from_site
        seen = seen_by(radiance, self.camera, self.exr_camera)
        limits = self.config.labels.bounds_px(self.camera.width_px)
        return self.contrasted(label_frame(self.circles, self.camera, *pose, seen, *limits), shot, exposure)

    def contrasted(self, labels: Labels, shot: Shot, exposure: Exposure) -> Labels:
        """The labels with their contrast in this exposure."""
        shown = Shown(*expected(exposure, self.config.sensor), np.asarray(self.sun))
        pose = shot.position_m, shot.rotation_camera_from_site
        return with_contrast(labels, self.circles, self.camera, *pose, shown)
