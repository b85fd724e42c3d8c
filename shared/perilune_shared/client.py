"""A client of `perilune-render serve`: frames at any pose, as arrays.

Needs ZeroMQ: `pip install 'perilune-shared[client]'`.

    from perilune_shared.client import SceneClient

    with SceneClient("tcp://127.0.0.1:10364") as scene:
        frame = scene.frame((0.0, 0.0, 800.0), (0.0, 1.0, 0.0, 0.0), labels=True)
        print(frame.image.shape, len(frame.labels["crater_id"]))

Clients in other languages need only a ZeroMQ library and a JSON library. A request is a ZeroMQ message with one part, a
JSON object. A reply has several parts: a head (a JSON object), then the bytes of each array that the head lists, in C
order. Two members of the head ask the client to repeat the request later: `"ready": false` means that the scene is not
generated yet, `"busy": true` that the server has too many clients. In any other head, `"error"` says what is wrong with
the request.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.lens_models import PARAMETERS

PORT = 10364
"""Default TCP port of the server for this client."""
CRATER_COLUMNS = (
    "crater_id", "x_m", "y_m", "z_m", "normal_x", "normal_y", "normal_z", "diameter_m", "depth_m", "latitude_deg",
    "longitude_deg",
)  # fmt: skip
"""Columns of the craters of a scene, as in the table `craters` of a manifest."""
_TYPES = ("|u1", "<u2", "<f4", "<f8", "<i8")
"""NumPy types that arrays of a reply may have."""
_MAX_BYTES = 2_000_000_000
_GROUND = {
    "dataset": str,
    "sun_azimuth_deg": float,
    "sun_elevation_deg": float,
    "dem_source": str,
    "content_sha256": str,
}
_POLL_S = 0.2
_GENERATION_S = 600.0
"""Longest time to wait for a scene to be generated, seconds."""


@dataclass(frozen=True, slots=True)
class ServedFrame:
    """A frame rendered by the server."""

    image: np.ndarray
    """Grey values (h, w), DN: uint8, or uint16 for a sensor of more than 8 bits."""
    depth_m: np.ndarray | None
    """Depth (h, w) along the camera's axis, metres, float32; infinite for the sky; None if not requested.

    If the lens distorts, depth and normals have the pixels of an undistorted camera that covers the whole view. With a
    lens model, the depth is the distance along the ray."""
    normal: np.ndarray | None
    """Unit normals (h, w, 3), O_L, float32, in the pixels of `depth_m`; None if not requested."""
    labels: dict[str, np.ndarray] | None
    """Columns of the table `labels` (N,); None if not requested."""


@dataclass(frozen=True, slots=True)
class ServedScene:
    """Camera, site, Sun and number of scenes of a server."""

    camera: Camera
    """Camera of the frames."""
    latitude_deg: float
    """Latitude of the site, degrees."""
    longitude_deg: float
    """Longitude of the site, degrees."""
    extent_m: float
    """Side of the square of ground, centred on the site, metres."""
    sun_azimuth_deg: float
    """Azimuth of the Sun unless a request states another, clockwise from north, degrees."""
    sun_elevation_deg: float
    """Elevation of the Sun unless a request states another, degrees."""
    n_scenes: int = 1
    """Number of scenes (`perilune-render serve --scenes`); the other fields describe scene 0."""


@dataclass(frozen=True, slots=True)
class ServedGround:
    """Terrain and Sun of one scene of a server."""

    dataset: str
    """Value of `dataset.name` in the server's configuration."""
    sun_azimuth_deg: float
    """Azimuth of the Sun unless a request states another, clockwise from north, degrees."""
    sun_elevation_deg: float
    """Elevation of the Sun unless a request states another, degrees."""
    dem_source: str
    """Name and SHA-256 of the elevation model, or 'procedural', as in the table `scenes` of a manifest."""
    content_sha256: str
    """Content hash of the terrain, as in the table `scenes` of a manifest."""


class SceneClient:
    """A connection to a server. Use it as a context manager, in one thread.

    Every method raises UserError if the server refuses the request, or if it does not answer or is busy for longer than
    `timeout_s`.
    """

    def __init__(self, address: str = f"tcp://127.0.0.1:{PORT}", timeout_s: float = 60.0):
        try:
            import zmq
        except ModuleNotFoundError:
            raise UserError("client", "pyzmq", "not installed", "pip install 'perilune-shared[client]'") from None
        self._zmq, self.address, self._timeout_ms = zmq, address, int(1000 * timeout_s)
        self._context = zmq.Context()
        self._next_index = 0
        self._connect()

    def _connect(self) -> None:
        self._socket = self._context.socket(self._zmq.REQ)
        self._socket.setsockopt(self._zmq.LINGER, 0)
        self._socket.setsockopt(self._zmq.IPV6, 1)
        try:
            self._socket.connect(self.address)
        except self._zmq.ZMQError as error:
            # Garbage collection would wait forever for a context with an open socket.
            self.close()
            raise UserError("client", "address", f"{self.address} ({error})", "tcp://host:port") from None

    def __enter__(self) -> "SceneClient":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection."""
        self._socket.close()
        self._context.term()

    def scene(self) -> ServedScene:
        """Return camera, site, Sun and number of scenes of the server."""
        head, _ = self._ask({"request": "scene"})
        camera = dict(head["camera"])
        camera["distortion"] = tuple(camera["distortion"])
        if "parameters" in camera:
            camera["parameters"] = tuple(camera["parameters"][name] for name in PARAMETERS[camera["model"]])
        return ServedScene(**{**head["scene"], "camera": Camera(**camera), "n_scenes": head.get("n_scenes", 1)})

    def health(self) -> dict[str, str]:
        """Check that every interface of the server answers; return the address (host:port) of each, by name.

        The server connects to each of its interfaces before it replies. It first answers earlier requests of other
        clients, so the reply also shows that frames are rendered. The UserError names an interface that does not
        answer.
        """
        head, _ = self._ask({"request": "health"})
        try:
            return {str(name): str(address) for name, address in head["interfaces"].items()}
        except (KeyError, AttributeError):
            raise UserError(self.address, "interfaces", "none", "a reply of `perilune-render serve`") from None

    def ground(self, scene: int, *, wait: bool = True) -> ServedGround | None:
        """Return the description of a scene; first wait until the server has generated the scene.

        Without `wait`, return None at once if the scene is not generated yet.
        """
        head, _ = self._ask({"request": "ground", "scene": scene}, wait=wait)
        if head.get("ready") is False:
            return None
        try:
            return ServedGround(**{name: kind(head["ground"][name]) for name, kind in _GROUND.items()})
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(self.address, "ground", repr(error), "a reply of `perilune-render serve`") from None

    def frame(
        self,
        position_m: Sequence[float] | Array,
        rotation_wxyz: Sequence[float] | Array,
        *,
        velocity_mps: Sequence[float] | Array = (0.0, 0.0, 0.0),
        angular_velocity_radps: Sequence[float] | Array | None = None,
        sun_deg: tuple[float, float] | None = None,
        index: int | None = None,
        depth: bool = False,
        labels: bool = False,
        scene: int = 0,
    ) -> ServedFrame:
        """Render a frame.

        - `position_m` (3,): position of the camera, O_L, metres.
        - `rotation_wxyz` (4,): rotation_camera_from_site as a quaternion, as in a manifest.
        - `velocity_mps` (3,), O_L, and `angular_velocity_radps` (3,), O_C: velocities that blur the frame.
        - `sun_deg`: azimuth and elevation of the Sun, degrees; by default as in the scene.
        - `index`: number that selects the noise; by default the number of frames received before.
        - `depth`, `labels`: whether to return depth and normals, and labels.
        - `scene`: number of the scene; the call waits until the scene is in the server's memory.
        """
        request: dict[str, Any] = {
            "request": "frame",
            "position_m": [float(value) for value in position_m],
            "rotation_wxyz": [float(value) for value in rotation_wxyz],
            "velocity_mps": [float(value) for value in velocity_mps],
            "index": self._next_index if index is None else index,
            "depth": depth,
            "labels": labels,
        } | _scene_field(scene)
        if angular_velocity_radps is not None:
            request["angular_velocity_radps"] = [float(value) for value in angular_velocity_radps]
        if sun_deg is not None:
            request["sun_deg"] = [float(value) for value in sun_deg]
        _, arrays = self._ask(request)
        if "image" not in arrays:
            raise UserError(self.address, "image", "none", "a reply of `perilune-render serve`")
        if index is None:
            self._next_index += 1
        columns = {name.partition(".")[2]: value for name, value in arrays.items() if name.startswith("labels.")}
        return ServedFrame(arrays["image"], arrays.get("depth_m"), arrays.get("normal"), columns if labels else None)

    def craters(self, scene: int = 0) -> dict[str, np.ndarray]:
        """Return all craters of a scene: the columns CRATER_COLUMNS, each (N,)."""
        return self._ask({"request": "craters"} | _scene_field(scene))[1]

    def heights(
        self, x_m: Sequence[float] | Array, y_m: Sequence[float] | Array, *, boulders: bool = True, scene: int = 0
    ) -> Array:
        """Return the heights (N,) of the surface at points (N,), O_L, metres; NaN outside the scene's ground."""
        coordinates = [[float(value) for value in values] for values in (x_m, y_m)]
        request = {"request": "heights", "x_m": coordinates[0], "y_m": coordinates[1], "boulders": boulders}
        return self._ask(request | _scene_field(scene))[1]["height_m"]

    def _ask(self, request: dict[str, Any], wait: bool = True) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Send a request; with `wait`, repeat it until the scene is generated.

        Returns the head of the reply and its arrays by name.
        """
        end = time.monotonic() + _GENERATION_S
        while True:
            head, arrays = self._ask_until_answered(request)
            if head.get("ready") is not False or not wait:
                return head, arrays
            if time.monotonic() > end:
                found = f"not generated in {_GENERATION_S:g} s"
                raise UserError(self.address, f"scene {request.get('scene', 0)}", found, "a server with a lower load")
            time.sleep(_POLL_S)

    def _ask_until_answered(self, request: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Send a request, repeatedly while the server is busy.

        Returns the head of the reply and its arrays by name.
        """
        end = time.monotonic() + self._timeout_ms / 1000
        while True:
            head, arrays = self._ask_once(request)
            if "error" not in head:
                return head, arrays
            if head.get("busy") is not True or time.monotonic() > end:
                expected = "a request that the server can answer"
                raise UserError(self.address, str(request["request"]), head["error"], expected)
            time.sleep(_POLL_S)

    def _ask_once(self, request: dict[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Send a request; returns the head of the reply and its arrays by name."""
        self._socket.send(json.dumps(request, allow_nan=True).encode())
        if not self._socket.poll(self._timeout_ms):
            self._socket.close()
            self._connect()
            expected = "`perilune-render serve` at this address"
            raise UserError(self.address, "reply", f"none in {self._timeout_ms / 1000:g} s", expected)
        head_bytes, *parts = self._socket.recv_multipart()
        try:
            head = json.loads(head_bytes)
            arrays = head.get("arrays", [])
            if len(arrays) != len(parts):
                raise ValueError(f"{len(parts)} arrays")
            arrays_by_name = {
                description["name"]: _array(description, part) for description, part in zip(arrays, parts, strict=True)
            }
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UserError(self.address, "reply", error, "a reply of `perilune-render serve`") from None
        return head, arrays_by_name


def _scene_field(scene: int) -> dict[str, int]:
    """Return the field `scene` of a request; omitted for scene 0, which every server has."""
    return {"scene": scene} if scene else {}


def _array(stated: dict[str, Any], content: bytes) -> np.ndarray:
    """Return an array of a reply. Raises ValueError on an unknown type or a wrong number of bytes."""
    if stated["dtype"] not in _TYPES:
        raise ValueError(f"type {stated['dtype']!r}")
    shape = tuple(int(side) for side in stated["shape"])
    kind = np.dtype(stated["dtype"])
    n_bytes = kind.itemsize * int(np.prod(shape, dtype=np.float64)) if min(shape, default=0) >= 0 else -1
    if n_bytes != len(content) or n_bytes > _MAX_BYTES:
        raise ValueError(f"{len(content)} bytes for shape {shape}")
    return np.frombuffer(content, kind).reshape(shape)
