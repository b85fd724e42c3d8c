"""An image server as a source of training data: check it, record the terrain of its scenes, choose what it renders."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple
from math import floor

import numpy as np
import pyarrow.compute as pc
import torch

from perilune_shared.client import SceneClient
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_train.config import ServerConfig
from perilune_train.data.epochs import DataLost
from perilune_train.records.provenance import TerrainUse, served_terrain, split_terrain

_CAMERA_TOLERANCE = 1e-6
_EXTENT_TOLERANCE = 1e-3


class ImageServer:
    """The image server of a run.

    `section` is the name of `settings` in messages, such as navigate.stream. The server renders one frame, so that an
    unsuitable sensor or ground is found before training. Raises UserError if the server does not answer or does not fit
    the dataset. A scene is refused when it is first used if its terrain belongs to the validation or test split.
    """

    def __init__(self, settings: ServerConfig, dataset: Dataset, section: str):
        self.settings = settings
        self._held_out = split_terrain(dataset, "val", "selected") | split_terrain(dataset, "test", "tested")
        self._uses: dict[int, TerrainUse] = {}
        self._known: set[int] = set()
        self._lock = threading.Lock()
        with self.client() as client:
            self.served = client.scene()
            if self.served.n_scenes <= settings.n_scenes:
                expected = f"at least {settings.n_scenes + 1}, {section}.n_scenes and scene 0"
                raise UserError(settings.address, "--scenes", self.served.n_scenes, expected)
            _check_camera(settings.address, self.served.camera, dataset.camera)
            extent = min(dataset.table("scenes", ["extent_m"])["extent_m"].to_pylist())
            if self.served.extent_m < (1 - _EXTENT_TOLERANCE) * extent:
                expected = f"at least {extent:.1f} m, as the dataset: serve its configuration and its --kind"
                raise UserError(settings.address, "extent of the ground", f"{self.served.extent_m:.1f} m", expected)
            self.checked(client.frame(*_highest_pose(dataset), index=0).image)

    def client(self) -> SceneClient:
        """Open a connection. Use it in one thread only."""
        return SceneClient(self.settings.address, self.settings.timeout_s)

    @property
    def uses(self) -> frozenset[TerrainUse]:
        """The terrain that was rendered so far; in a resumed run also the terrain from before the interruption."""
        with self._lock:
            return frozenset(self._uses.values())

    def state_dict(self) -> list[list]:
        """Numbers and terrain of the scenes that were rendered so far, as plain data."""
        with self._lock:
            return [[number, *astuple(use)] for number, use in self._uses.items()]

    def load_state_dict(self, state: list[list]) -> None:
        """Add the record of an interrupted run or of another process."""
        with self._lock:
            self._uses |= {number: TerrainUse(*use) for number, *use in state}

    def join_records(self, processes: int) -> None:
        """Join the records of all processes that train together; all of them must call this."""
        if processes == 1:
            return
        parts: list[list[list]] = [[] for _ in range(processes)]
        torch.distributed.all_gather_object(parts, self.state_dict())
        for part in parts:
            self.load_state_dict(part)

    def is_rendered(self, position: int) -> bool:
        """Whether the sample at a position of an epoch's order is rendered. Rendered samples are spread evenly."""
        share = self.settings.share
        return floor((position + 1) * share) > floor(position * share)

    def n_before(self, epoch: int, position: int, n_samples: int) -> int:
        """Number of rendered samples before a position of an epoch; an epoch has `n_samples` samples."""
        return epoch * floor(n_samples * self.settings.share) + floor(position * self.settings.share)

    def scene_of(self, visit: int) -> int:
        """Number, from 1, of the scene of a visit. After the last scene comes the first again."""
        return 1 + visit % self.settings.n_scenes

    def following(self, scene: int) -> int | None:
        """Number of the scene after a scene; None if there is only one."""
        return scene % self.settings.n_scenes + 1 if self.settings.n_scenes > 1 else None

    def record(self, client: SceneClient, scene: int) -> None:
        """Record the terrain of a scene before its first frame is rendered in this process.

        Raises UserError if the server fails, if the terrain is held out, or if it differs from the terrain that the run
        used before.
        """
        if scene in self._known:
            return
        ground, where = client.ground(scene), self.settings.address
        if ground is None:
            raise UserError(where, f"scene {scene}", "none", "a scene of the server")
        use = served_terrain(where, ground.dataset, scene, ground.dem_source, ground.content_sha256)
        for other in sorted(self._held_out):
            if other.sha256 == use.sha256:
                got = f"the terrain of {other.scene_id} of the dataset ({other.use})"
                raise UserError(where, f"scene {scene}", got, "terrain of no validation or test scene")
        with self._lock:
            before = self._uses.setdefault(scene, use)
        if before != use:
            expected = f"{before.sha256[:12]} of {before.dataset}, as before: serve the same configuration"
            raise UserError(where, f"scene {scene}", f"terrain {use.sha256[:12]} of {use.dataset}", expected)
        self._known.add(scene)

    def checked(self, image: np.ndarray) -> np.ndarray:
        """Return an image of the server. Raises UserError unless it has 8 bits and the size of the camera."""
        size = (self.served.camera.height_px, self.served.camera.width_px)
        if image.dtype != np.uint8 or image.shape != size:
            got = f"{image.dtype} {image.shape}"
            raise UserError(self.settings.address, "image", got, f"uint8 {size}: dataset.sensor.bits 8")
        return image


@contextmanager
def resumable() -> Iterator[None]:
    """Raise an error of the server within the block as DataLost, so that the run saves its state and ends."""
    try:
        yield
    except UserError as error:
        expected = f"{error.expected}; then run the same command again to resume"
        raise DataLost(error.where, error.field, error.found, expected) from None


def _highest_pose(dataset: Dataset) -> tuple[list[float], list[float]]:
    """Position, metres, and rotation_wxyz of the highest training frame. Raises UserError without training frames."""
    table = dataset.table("frames", ["position_m", "rotation_wxyz"], split="train")
    if len(table) == 0:
        raise UserError(dataset.store, "split", "no train frames", "a dataset with frames in train, val and test")
    height = pc.list_element(table["position_m"], 2)
    (row,) = table.take(pc.array_sort_indices(height.combine_chunks(), order="descending")[:1]).to_pylist()
    return row["position_m"], row["rotation_wxyz"]


def _check_camera(address: str, served: Camera, expected_camera: Camera) -> None:
    """Raise UserError unless both cameras have the same field of view; image sizes may differ."""
    sizes = (served.width_px, served.height_px), (expected_camera.width_px, expected_camera.height_px)
    views = [
        (c.fx_px / w, c.fy_px / h, c.cx_px / w, c.cy_px / h, w / h, *c.distortion)
        for c, (w, h) in zip((served, expected_camera), sizes, strict=True)
    ]
    same_lens = served.model == expected_camera.model and served.parameters == expected_camera.parameters
    if not same_lens or not np.allclose(views[0], views[1], rtol=0, atol=_CAMERA_TOLERANCE):
        expected = f"{expected_camera}, as in the dataset; another image size of the same view is allowed"
        raise UserError(address, "camera", served, expected)
