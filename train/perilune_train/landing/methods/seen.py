"""Run a detector over the frames of descents."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.detect.finished_run import raw_threshold
from perilune_train.detect.images.predict import above
from perilune_train.detect.inference.detector import open_detector
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.fly.detections import flight_config
from perilune_train.landing.fly.run import sightings_of
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.training.runs import RunFolder

_BATCH = 4


@dataclass(frozen=True, slots=True)
class SeenDescent:
    """One descent of n frames."""

    ids: tuple[str, str]
    """scene_id and trajectory_id."""
    camera: Camera
    """Intrinsics, without distortion."""
    time_s: Array
    """Times of the frames (n,), seconds since the first frame."""
    true: list[Pose]
    """True poses of the camera (n)."""
    velocity_mps: Array
    """True velocity at the first frame (3,), O_L."""
    level_rotation_camera_from_site: Array
    """Attitude (3, 3) of the camera when the lander is level with heading 0."""
    sightings: list[Sightings]
    """Detected craters of each frame (n)."""
    sun_elevation_deg: float | None = None
    """Elevation of the Sun above the site, degrees; None if it is unknown."""


def seen_descents(dataset: Dataset, trajectories: list[Trajectory], run: Path) -> tuple[list[SeenDescent], float]:
    """Detect craters in all frames; returns the descents and the detection time, seconds per frame."""
    detector, threshold = open_detector(RunFolder(run).best, flight_config(run)), raw_threshold(run)
    scenes = dataset.table("scenes", ["scene_id", "sun_elevation_deg"]).to_pylist()
    sun_elevation_deg = {row["scene_id"]: row["sun_elevation_deg"] for row in scenes}
    descents, seconds = [], 0.0
    n_frames = sum(len(trajectory.images) for trajectory in trajectories)
    with progress_bar() as progress:
        bar = progress.add_task("detect", total=n_frames, unit="frames", note="")
        for trajectory in trajectories:
            sightings = []
            for start in range(0, len(trajectory.images), _BATCH):
                begun = time.perf_counter()
                for predicted in detect_at_scales(detector, trajectory.images[start : start + _BATCH]):
                    kept = above(predicted, threshold)
                    sightings.append(sightings_of(kept, trajectory.camera).strongest())
                seconds += time.perf_counter() - begun
                progress.advance(bar, len(trajectory.images[start : start + _BATCH]))
            rows = dataset.table("frames", ["time_s", "velocity_mps"], *trajectory.ids).sort_by("time_s")
            true = [
                Pose(*pose) for pose in zip(trajectory.position_m, trajectory.rotation_camera_from_site, strict=True)
            ]
            first = np.array(rows["velocity_mps"][0].as_py())
            level = trajectory.nominal_rotation_camera_from_site
            descents.append(
                SeenDescent(
                    trajectory.ids,
                    trajectory.camera,
                    rows["time_s"].to_numpy(),
                    true,
                    first,
                    level,
                    sightings,
                    sun_elevation_deg[trajectory.ids[0]],
                )
            )
    return descents, seconds / n_frames
