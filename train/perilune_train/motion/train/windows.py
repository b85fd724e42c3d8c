"""Training sequences of a stack network, gathered by index from frames, features and truths on the training device.

The loader prepares only the indices of a step's sequences, so that a GPU does not wait for it. With views
(motion/train/views.py), version v of trajectory i of n has the number v n + i; version 0 is the trajectory itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from perilune_train.motion.config import Target
from perilune_train.motion.data.epochs import Key, TrainingSequences
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.motion.geometry import euler_from_rotation
from perilune_train.motion.network import Scales
from perilune_train.motion.pose import normalised_frames, warped_frames
from perilune_train.motion.train.views import view_homographies

_MAX_SHARE = 0.25
"""Share of a GPU's free memory that frames may take; larger sets stay in main memory."""


@dataclass(frozen=True, slots=True)
class OutputUnits:
    """What a stack network outputs, and in which units."""

    target: Target
    """Motion of the camera, or pose at the later frame."""
    scales: Scales
    """Scales between standardised outputs and metres or radians."""


class WindowPlaces(TrainingSequences):
    """Indices of training sequences: number of the trajectory and first pair.

    With `views`, each sequence uses a random version of its trajectory.
    """

    views: int = 0
    """Number of versions in addition to the trajectories themselves."""

    def __getitem__(self, key: Key) -> tuple[int, int]:  # type: ignore[override]
        epoch, position, number, start = key
        if not self.views:
            return number, start
        version = int(np.random.default_rng([self.seed, epoch, position]).integers(self.views + 1))
        return version * len(self.trajectories) + number, start


def collated(places: list[tuple[int, int]]) -> Tensor:
    """Indices as a tensor (batch, 2)."""
    return torch.tensor(places)


class Windows:
    """Sequences of `n_pairs` consecutive pairs of the trajectories `numbers`, and of their views.

    `views` are further versions of all trajectories, from `other_views`. In the methods, `places` (batch, 2), on the
    device, hold for each sequence the numbers of its trajectory and of its first pair.
    """

    def __init__(
        self,
        trajectories: Sequence[Trajectory],
        numbers: Sequence[int],
        n_pairs: int,
        units: OutputUnits,
        device: torch.device,
        views: Sequence[Trajectory] = (),
    ):
        chosen = [trajectories[number] for number in numbers]
        count, versions = len(trajectories), 1 + len(views) // len(trajectories)
        self.images, self.device = [trajectory.images for trajectory in chosen], device
        self.frames: Tensor | None = None
        every = [*trajectories, *views]
        numbers = [version * count + number for version in range(versions) for number in numbers]
        truths = [truth(every[number], units) for number in numbers]
        self.position, self.angles = (torch.cat(parts).to(device) for parts in zip(*truths, strict=True))
        """Standardised truths (pairs of all versions of all trajectories, 3)."""
        self.steps = torch.arange(n_pairs + 1, device=device)
        before = np.zeros((len(every), 2), np.int64)
        sizes = [(every[number].n_pairs, every[number].n_pairs + 1) for number in numbers]
        before[numbers] = np.cumsum([(0, 0), *sizes], axis=0)[:-1]
        self.first_pair, self.first_frame = torch.from_numpy(before).to(device).unbind(1)
        self.n_frames = sum(trajectory.n_pairs + 1 for trajectory in chosen)
        self.homographies = (
            torch.cat([view_homographies(trajectories[number % count], every[number]) for number in numbers]).to(device)
            if views
            else None
        )
        """Homographies (frames, 3, 3) from all versions' frames to the trajectories' frames; None without views."""

    def pairs(self, places: Tensor) -> Tensor:
        """Indices (batch, pairs) of the sequences' pairs among the pairs of all trajectories."""
        return (self.first_pair[places[:, 0]] + places[:, 1])[:, None] + self.steps[:-1]

    def pictures(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Earlier and later frames (batch, pairs, height, width) of sequences, normalised."""
        if self.frames is None:
            self.frames = self._resident()
        index = (self.first_frame[places[:, 0]] + places[:, 1])[:, None] + self.steps
        original = (index % self.n_frames).to(self.frames.device)
        chosen = self.frames[original].to(self.device, non_blocking=True)
        if self.homographies is not None:
            warped = warped_frames(chosen.flatten(0, 1), self.homographies[index.flatten()])
            chosen = warped.unflatten(0, index.shape)
        frames = normalised_frames(chosen)
        return frames[:, :-1], frames[:, 1:]

    def _resident(self) -> Tensor:
        """All frames (frames, height, width), 8 bit, on the device if they are small enough."""
        frames = torch.from_numpy(np.concatenate(self.images))
        if self.device.type != "cuda" or frames.numel() > _MAX_SHARE * torch.cuda.mem_get_info(self.device)[0]:
            return frames
        return frames.to(self.device)


def truth(trajectory: Trajectory, units: OutputUnits) -> tuple[Tensor, Tensor]:
    """What a stack network should output for the pairs of a trajectory: positions and Euler angles (pairs, 3).

    Both are standardised: translations or positions by mean and spread, angles by `rotation_rad` of the scales.
    """
    scales = units.scales
    position_m, rotation = trajectory.pose if units.target == "pose" else trajectory.motion
    if scales.mean_rotation is not None:
        rotation = rotation @ np.array(scales.mean_rotation).T
    position = (torch.from_numpy(position_m) - torch.tensor(scales.mean_m)) / torch.tensor(scales.spread_m)
    return position.float(), (euler_from_rotation(torch.from_numpy(rotation)) / scales.rotation_rad).float()
