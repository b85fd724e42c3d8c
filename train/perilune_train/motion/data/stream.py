"""An image server as a source of training data: check it, request frames, and record the terrain of its scenes."""

import threading
from dataclasses import astuple, replace

import numpy as np

from perilune_shared.client import SceneClient
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, quaternion_from_matrix
from perilune_train.motion.config import StreamConfig
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.motion.data.undistort import undistorted
from perilune_train.records.provenance import TerrainUse, served_terrain, split_terrain

_CAMERA_TOLERANCE = 1e-6
_EXTENT_TOLERANCE = 1e-3


class Stream:
    """The image server of a run.

    Raises UserError if the server does not answer or does not fit a navigation dataset. A scene is refused when it is
    first rendered if its terrain belongs to the validation or test split of the dataset.
    """

    def __init__(self, settings: StreamConfig, dataset: Dataset):
        self.settings = settings
        self._held_out = split_terrain(dataset, "val", "selected") | split_terrain(dataset, "test", "tested")
        self._velocities = _velocities(dataset)
        self._uses: dict[int, TerrainUse] = {}
        self._known: set[int] = set()
        self._lock = threading.Lock()
        with self.client() as client:
            self.served = client.scene()
        if self.served.n_scenes <= settings.n_scenes:
            expected = f"at least {settings.n_scenes + 1}, navigate.stream.n_scenes and scene 0"
            raise UserError(settings.address, "--scenes", self.served.n_scenes, expected)
        _check_camera(settings.address, self.served.camera, dataset.camera)
        extent = min(dataset.table("scenes", ["extent_m"])["extent_m"].to_pylist())
        if self.served.extent_m < (1 - _EXTENT_TOLERANCE) * extent:
            expected = f"at least {extent:.1f} m, as the dataset: serve its configuration"
            raise UserError(settings.address, "extent of the ground", f"{self.served.extent_m:.1f} m", expected)

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
        """Restore the record of an interrupted run."""
        with self._lock:
            self._uses |= {number: TerrainUse(*use) for number, *use in state}

    def velocities_mps(self, ids: tuple[str, str]) -> Array:
        """Velocities (n, 3), O_L, metres per second, of a training trajectory."""
        return self._velocities[ids]

    def rendered(
        self, client: SceneClient, scene: int, following: int | None, part: Trajectory, velocity: Array, index: int
    ) -> Trajectory:
        """Return the n poses of `part` with rendered images of a scene.

        `velocity` (n, 3) sets the motion blur of the images, and `index` sets their noise. Meanwhile the server
        generates the scene `following`. Raises UserError if the server fails or the terrain is held out.
        """
        self._record(client, scene)
        if following is not None:
            client.ground(following, wait=False)
        images = []
        for k, position in enumerate(part.position_m):
            rotation_wxyz = quaternion_from_matrix(part.rotation_camera_from_site[k])
            frame = client.frame(position, rotation_wxyz, velocity_mps=velocity[k], index=index + k, scene=scene)
            images.append(self._checked(frame.image))
        pixels, camera = undistorted(np.stack(images), self.served.camera)
        return replace(part, images=pixels, camera=camera)

    def _record(self, client: SceneClient, scene: int) -> None:
        """Record the terrain of a scene before its first frame is rendered in this process.

        Raises UserError if the terrain is held out, or differs from the terrain that the run used before.
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

    def _checked(self, image: np.ndarray) -> np.ndarray:
        size = (self.served.camera.height_px, self.served.camera.width_px)
        if image.dtype != np.uint8 or image.shape != size:
            got = f"{image.dtype} {image.shape}"
            raise UserError(self.settings.address, "image", got, f"uint8 {size}: dataset.sensor.bits 8")
        return image


def _velocities(dataset: Dataset) -> dict[tuple[str, str], Array]:
    """Velocities (n, 3) of each training trajectory, by scene_id and trajectory_id."""
    columns = ["scene_id", "trajectory_id", "frame_index", "velocity_mps"]
    table = dataset.table("frames", columns, split="train").to_pandas().sort_values(columns[:3])
    groups = table.groupby(["scene_id", "trajectory_id"])
    return {(str(key[0]), str(key[1])): np.array(rows["velocity_mps"].tolist()) for key, rows in groups}


def _check_camera(address: str, served: Camera, expected_camera: Camera) -> None:
    """Raise UserError unless both cameras have the same field of view; image sizes may differ."""
    sizes = (served.width_px, served.height_px), (expected_camera.width_px, expected_camera.height_px)
    views = [
        (c.fx_px / w, c.fy_px / h, c.cx_px / w, c.cy_px / h, w / h, *c.distortion)
        for c, (w, h) in zip((served, expected_camera), sizes, strict=True)
    ]
    if served.model != expected_camera.model or not np.allclose(views[0], views[1], rtol=0, atol=_CAMERA_TOLERANCE):
        expected = f"{expected_camera}, as in the dataset; another image size of the same view is allowed"
        raise UserError(address, "camera", served, expected)
