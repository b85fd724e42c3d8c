"""What is known of judged frames beside their labels: place, altitude, Sun. Real images may lack any of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_train.data.frames import FrameStore

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrameFacts:
    """One entry a frame."""

    name: list[str]
    """For titles (N)."""
    sizes_px: NDArray[np.int64]
    """Width and height (N, 2)."""
    scene: list[str]
    """Terrain, the unit over which intervals are drawn (spread.py); "" where not known (N)."""
    descent: list[str]
    """Descent over it, of a name of its own; "" where not known (N)."""
    altitude_m: Array
    """Of the camera over the site's ground plane; NaN where not known (N,)."""
    sun_elevation_deg: Array
    """Above the site's ground plane; NaN where not known (N,)."""

    def __len__(self) -> int:
        return len(self.name)


def unknown_facts(name: list[str], sizes_px: NDArray) -> FrameFacts:
    """Facts of images of which nothing but name and width and height (N, 2) is known."""
    nothing = np.full(len(name), np.nan)
    return FrameFacts(name, np.asarray(sizes_px), [""] * len(name), [""] * len(name), nothing, nothing)


def facts_of(frames: FrameStore) -> FrameFacts:
    """Facts of a dataset's frames."""
    table = frames.table
    height, width = frames.images.shape[1:]
    sun = np.stack([np.asarray(direction, np.float64) for direction in table["sun_direction"]])
    position = np.stack([np.asarray(place, np.float64) for place in table["position_m"]])
    scene = table["scene_id"].tolist()
    return FrameFacts(
        table["frame_id"].tolist(),
        np.tile([width, height], (len(table), 1)),
        scene,
        [f"{a}/{b}" for a, b in zip(scene, table["trajectory_id"], strict=True)],
        position[:, 2],
        np.degrees(np.arcsin(np.clip(sun[:, 2] / np.linalg.norm(sun, axis=1), -1, 1))),
    )
