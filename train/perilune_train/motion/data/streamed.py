"""Training sequences over scenes that are not in the dataset, rendered by an image server during training.

A rendered sequence shows a scene of the server along the path of a training trajectory. The positions are rotated about
the vertical through the site by a random angle. The attitudes in O_L stay unchanged, because they do not depend on the
azimuth of a descent. So positions, motions and attitudes are distributed as in the training trajectories, except for
the azimuth, which is uniform.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from perilune_train.data.ahead import Ahead
from perilune_train.data.image_server import resumable
from perilune_train.motion.data.epochs import Key, TrainingSequences
from perilune_train.motion.data.sequences import Sequence
from perilune_train.motion.data.stream import Stream
from perilune_train.motion.data.trajectories import Trajectory

_AHEAD = 8
"""Largest number of rendered sequences that wait in memory."""
_INDICES = 2**30


class StreamedSequences(TrainingSequences):
    """Training sequences, some of them rendered by a server; the others come from the trajectories.

    The seeds, the epoch and the sequence's position in the epoch determine whether a sequence is rendered, and its
    scene, poses and noise. `size_px` is the width to which frames are shrunk. Call `close` at the end.
    """

    def __init__(self, stream: Stream, size_px: int, *arguments: Any, **named: Any):
        super().__init__(*arguments, **named)
        self.stream, self.size_px = stream, size_px
        self._ahead: Ahead[Key, Sequence] = Ahead(self._render, self._following, _AHEAD)

    def __getitem__(self, key: Key) -> Sequence:
        return self._ahead.take(key) if self.is_rendered(key) else super().__getitem__(key)

    def close(self) -> None:
        """Stop the thread that sends requests to the server."""
        self._ahead.close()

    def is_rendered(self, key: Key) -> bool:
        """Whether a sequence is rendered. Rendered sequences are spread evenly over an epoch."""
        return self.stream.is_rendered(key[1])

    def scene_of(self, key: Key) -> int:
        """Number, from 1, of the server's scene that a rendered sequence shows.

        The scene changes after about `pairs_per_scene` pairs; after the last scene comes the first again.
        """
        before = self.stream.n_before(key[0], key[1], sum(self.counts))
        return self.stream.scene_of(before * self.n_pairs // self.stream.settings.pairs_per_scene)

    def poses(self, key: Key) -> tuple[Trajectory, np.ndarray, int]:
        """Poses of a rendered sequence, without images; velocities (n, 3), m/s, O_L; first index of the noise."""
        epoch, position, number, start = key
        rng = np.random.default_rng([self.stream.settings.seed, epoch, position])
        angle, index = rng.uniform(0, 2 * np.pi), int(rng.integers(_INDICES))
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        whole, frames = self.trajectories[number], slice(start, start + self.n_pairs + 1)
        part = replace(
            whole,
            images=whole.images[:0],
            position_m=whole.position_m[frames] @ turn.T,
            rotation_camera_from_site=whole.rotation_camera_from_site[frames],
            nominal_position_m=whole.nominal_position_m[frames] @ turn.T,
        )
        return part, self.stream.velocities_mps(whole.ids)[frames] @ turn.T, index

    def _following(self, key: Key) -> Iterator[Key]:
        """Endless keys of the rendered sequences of this process, from `key` on, in training order."""
        epoch, keys = key[0], self.keys(key[0])
        keys = keys[keys.index(key) :]
        while True:
            yield from filter(self.is_rendered, keys)
            epoch += 1
            keys = self.keys(epoch)

    def _render(self, keys: Iterator[Key]) -> Iterator[tuple[Key, Sequence]]:
        """Render sequences. Raises DataLost if the server fails."""
        with resumable(), self.stream.client() as client:
            for key in keys:
                part, velocity, index = self.poses(key)
                rendered = self.stream.rendered(client, self.scene_of(key), part, velocity, index)
                yield key, self.augmented_sequence(key, rendered.shrunk(self.size_px), 0)
