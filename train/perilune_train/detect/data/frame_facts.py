"""Metadata of evaluated frames: scene, trajectory, altitude, Sun elevation; unknown for real images."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_train.data.frames import FrameStore

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FrameFacts:
    """Metadata of N frames, one entry per frame."""

    name: list[str]
    """Name in titles (N)."""
    sizes_px: NDArray[np.int64]
    """Width and height (N, 2)."""
    scene: list[str]
    """Name of the terrain; "" if unknown (N). Bootstrap intervals resample whole scenes (records/spread.py)."""
    trajectory: list[str]
    """Name of the trajectory over the terrain, unique in the dataset; "" if unknown (N)."""
    altitude_m: Array
    """Altitude of the camera above the site's ground plane; NaN if unknown (N,)."""
    sun_elevation_deg: Array
    """Elevation of the Sun above the site's ground plane; NaN if unknown (N,)."""

    def __len__(self) -> int:
        return len(self.name)


def unknown_facts(name: list[str], sizes_px: NDArray) -> FrameFacts:
    """Metadata of images of which only the names and sizes (width and height, (N, 2)) are known."""
    nothing = np.full(len(name), np.nan)
    return FrameFacts(name, np.asarray(sizes_px), [""] * len(name), [""] * len(name), nothing, nothing)


def facts_of(frames: FrameStore) -> FrameFacts:
    """Metadata of a dataset's frames."""
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


def joined_facts(parts: Mapping[str, FrameFacts]) -> FrameFacts:
    """Join the metadata of several parts.

    The names of frames, scenes and trajectories then begin with the part's name.
    """

    def renamed(part: str, names: list[str]) -> list[str]:
        return [f"{part}/{name}" for name in names]

    all_facts = parts.values()
    return FrameFacts(
        [name for part, facts in parts.items() for name in renamed(part, facts.name)],
        np.concatenate([facts.sizes_px for facts in all_facts]),
        [name for part, facts in parts.items() for name in renamed(part, facts.scene)],
        [name for part, facts in parts.items() for name in renamed(part, facts.trajectory)],
        np.concatenate([facts.altitude_m for facts in all_facts]),
        np.concatenate([facts.sun_elevation_deg for facts in all_facts]),
    )
