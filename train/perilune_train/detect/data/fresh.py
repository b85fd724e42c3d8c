"""Training frames over scenes that are not in the dataset, rendered by an image server during training.

A visit is a number of consecutive rendered frames of one scene. All frames of a visit have one Sun: its azimuth is
uniform, its elevation comes from a random training frame. A rendered frame has the pose and the velocity of the
training frame that it replaces, turned about the vertical through the site as one rigid body, by the quarter turn that
brings the azimuth of the Sun relative to the camera nearest to the training frame's. Ground is square and fits the
training frames, so after another turn the corners of a high frame would be beyond its edge.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.client import SceneClient
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.schema import ANGULAR_VELOCITY
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import (
    Array,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
)
from perilune_train.data.ahead import Ahead
from perilune_train.data.image_server import ImageServer, resumable
from perilune_train.detect.config import DetectConfig, FreshConfig
from perilune_train.detect.data.batches import Key, Sample, TrainingFrames
from perilune_train.detect.data.ignored import CRATER_COLUMNS, Craters, craters_of
from perilune_train.detect.data.labels import LABEL_COLUMNS, FrameLabels, LabelLimits, frame_labels
from perilune_train.detect.data.split import DetectSplit

_MIN_AHEAD = 8
"""Smallest number of rendered frames that may wait in memory; otherwise two batches may wait."""
_INDICES = 2**30
_VISITS, _FRAMES = 1, 2
"""Numbers of the random streams of the Suns and of the noise."""
_MOTION = ("frame_id", "velocity_mps", *ANGULAR_VELOCITY)


class FreshServer(ImageServer):
    """The image server of a detection run.

    Raises UserError if the server does not answer or does not fit the dataset, also in the image size.
    """

    settings: FreshConfig

    def __init__(self, settings: FreshConfig, dataset: Dataset):
        super().__init__(settings, dataset, "detect.fresh")
        served, expected = ((c.width_px, c.height_px) for c in (self.served.camera, dataset.camera))
        if served != expected:
            expected_size = f"{expected[0]} x {expected[1]} px, as in the dataset"
            raise UserError(settings.address, "image size", f"{served[0]} x {served[1]} px", expected_size)


@dataclass(frozen=True, slots=True)
class FreshView:
    """Pose, motion, light and noise of a rendered frame."""

    position_m: Array
    """Position, O_L, metres (3,)."""
    rotation_camera_from_site: Array
    """Rotation matrix (3, 3)."""
    velocity_mps: Array
    """Velocity, O_L, metres per second (3,)."""
    angular_velocity_radps: Array
    """Angular velocity, O_C, radians per second (3,)."""
    sun_deg: tuple[float, float]
    """Azimuth of the Sun, clockwise from north, and its elevation, degrees."""
    index: int
    """Number that selects the noise."""


class FreshFrames(TrainingFrames):
    """The frames of one process's share of the training split, some of them replaced by rendered frames.

    The random seed, the epoch and the frame's position in the order of the epoch determine whether a frame is rendered,
    and its scene, pose, Sun and noise. A key has this position as its third number. Call `close` at the end.
    """

    def __init__(self, split: DetectSplit, config: DetectConfig, dataset: Dataset, server: FreshServer):
        super().__init__(split, config)
        self.server, self.epochs = server, config.epochs
        self.limits = LabelLimits(config.labels, split.radius_px, config.augment.scale)
        table = dataset.table("frames", [*_MOTION, "sun_direction"], split="train").to_pandas().set_index("frame_id")
        # The order of rows in the files does not matter.
        up = np.clip([direction[2] for direction in table["sun_direction"]], -1, 1)
        self._sun_elevation_deg = np.sort(np.degrees(np.arcsin(up)))
        own = table.loc[split.frames.table["frame_id"]]
        self._velocity_mps = np.array(own["velocity_mps"].tolist())
        self._angular_velocity_radps = own[list(ANGULAR_VELOCITY)].to_numpy(np.float64, na_value=0.0)
        # Batches use no more frames than this, so that all processes have equally many.
        fewest = split.n_frames // split.share.processes
        self._n_used = -(-fewest // config.batch_size) * config.batch_size
        n_ahead = max(_MIN_AHEAD, 2 * config.batch_size)
        self._ahead: Ahead[Key, Sample] = Ahead(self._render, self._following, n_ahead)

    def keys(self, epoch: int) -> list[Key]:
        """Keys of the share's frames in the order of an epoch."""
        numbers, positions = self.order(epoch)
        return [(epoch, int(number), int(position)) for number, position in zip(numbers, positions, strict=True)]

    def __getitem__(self, key: Key) -> Sample:
        return self._ahead.take(key) if self.server.is_rendered(key[2]) else super().__getitem__(key)

    def close(self) -> None:
        """Stop the thread that sends requests to the server."""
        self._ahead.close()

    def visit_of(self, key: Key) -> int:
        """Number of the visit in which a frame is rendered."""
        before = self.server.n_before(key[0], key[2], self.split.n_frames)
        return before // self.server.settings.frames_per_scene

    def view(self, key: Key) -> FreshView:
        """Pose, motion, light and noise of a rendered frame."""
        epoch, number, position = key
        row, seed = self.split.frames.table.iloc[number], self.server.settings.seed
        drawn = np.random.default_rng([seed, _VISITS, self.visit_of(key)])
        azimuth_deg, elevation_deg = drawn.uniform(0, 360), drawn.choice(self._sun_elevation_deg)
        sun = row["sun_direction"]
        turn_rad = np.arctan2(-sun[0], -sun[1]) - np.radians(azimuth_deg)
        quarter_turn_rad = np.pi / 2 * np.round(turn_rad / (np.pi / 2))
        turn = matrix_from_rotation_vector(np.array([0.0, 0.0, quarter_turn_rad]))
        noise = np.random.default_rng([seed, _FRAMES, epoch, position])
        return FreshView(
            turn @ row["position_m"],
            matrix_from_quaternion(row["rotation_wxyz"]) @ turn.T,
            turn @ self._velocity_mps[number],
            self._angular_velocity_radps[number],
            (float(azimuth_deg), float(elevation_deg)),
            int(noise.integers(_INDICES)),
        )

    def _following(self, key: Key) -> Iterator[Key]:
        """Keys of the rendered frames of this process, from `key` to the end of the training, in order."""
        for epoch in range(key[0], self.epochs):
            keys = self.keys(epoch)[: self._n_used]
            for each in keys[keys.index(key) :] if epoch == key[0] else keys:
                if self.server.is_rendered(each[2]):
                    yield each

    def _render(self, keys: Iterator[Key]) -> Iterator[tuple[Key, Sample]]:
        """Render and augment frames. Raises DataLost if the server fails."""
        with resumable(), self.server.client() as client:
            visit, craters = -1, None
            for key in keys:
                scene = self.server.scene_of(self.visit_of(key))
                if craters is None or visit != self.visit_of(key):
                    visit, craters = self.visit_of(key), self._begin_visit(client, scene)
                image, labels = self._frame(client, scene, self.view(key), craters)
                yield key, self.augmented(key, image, labels)

    def _begin_visit(self, client: SceneClient, scene: int) -> Craters:
        """Record the terrain of a scene and return its craters; meanwhile the server generates the following scene."""
        self.server.record(client, scene)
        columns = client.craters(scene)
        following = self.server.following(scene)
        if following is not None:
            client.ground(following, wait=False)
        return craters_of(self._table(f"craters of scene {scene}", columns, CRATER_COLUMNS))

    def _frame(
        self, client: SceneClient, scene: int, view: FreshView, craters: Craters
    ) -> tuple[NDArray[np.uint8], FrameLabels]:
        """Render a frame of a scene. Raises UserError if the server fails or sends invalid labels."""
        rotation_wxyz = quaternion_from_matrix(view.rotation_camera_from_site)
        frame = client.frame(
            view.position_m,
            rotation_wxyz,
            velocity_mps=view.velocity_mps,
            angular_velocity_radps=view.angular_velocity_radps,
            sun_deg=view.sun_deg,
            index=view.index,
            labels=True,
            scene=scene,
        )
        labels = self._table(f"labels of scene {scene}", frame.labels or {}, LABEL_COLUMNS)
        row = {"frame_id": f"scene {scene}", "position_m": view.position_m, "rotation_wxyz": rotation_wxyz}
        camera, where = self.server.served.camera, self.server.settings.address
        return self.server.checked(frame.image), frame_labels(where, camera, row, labels, craters, self.limits)

    def _table(self, field: str, columns: Mapping[str, NDArray], names: list[str]) -> pa.Table:
        """Columns of a reply as a table. Raises UserError if a column is missing, or has a wrong length or type."""
        sizes = {columns[name].shape for name in names if name in columns}
        for name in names:
            kind = "i" if name == "crater_id" else "f"
            if name not in columns or columns[name].dtype.kind != kind or len(sizes) != 1 or columns[name].ndim != 1:
                got = f"{columns[name].dtype} {columns[name].shape}" if name in columns else "no such column"
                expected = "a column of equal length with numbers, as of `perilune-render serve` of this version"
                raise UserError(self.server.settings.address, f"{field}: {name}", got, expected)
        return pa.table({name: columns[name] for name in names})
