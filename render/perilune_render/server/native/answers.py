"""The native interface over ZeroMQ: requests in JSON, replies in JSON with raw arrays (`perilune_shared.client`)."""

import json
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from perilune_render.config.scene import SceneConfig
from perilune_render.dataset.tables import ground_tables, label_table
from perilune_render.flight.lens import camera_of
from perilune_render.poses.plan import trajectory_seed
from perilune_render.server.grounds import Grounds
from perilune_render.server.simulation import SimulatedScene, View
from perilune_shared.client import CRATER_COLUMNS
from perilune_shared.config.errors import expected_of, got_of
from perilune_shared.config.resolve import Section
from perilune_shared.dataset.metadata import fields_of
from perilune_shared.errors import UserError, one_line
from perilune_shared.geometry.frames import matrix_from_quaternion, sun_direction

_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
_Three = tuple[_Number, _Number, _Number]


class _OfScene(Section):
    """A request about one scene."""

    scene: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Number of the scene."""


class SceneRequest(Section):
    """Request: describe what the server renders."""

    request: Literal["scene"]


class HealthRequest(Section):
    """Request: check that all interfaces answer."""

    request: Literal["health"]


class GroundRequest(_OfScene):
    """Request: describe a scene, or start to generate it if it is not in memory."""

    request: Literal["ground"]


class FrameRequest(_OfScene):
    """Request: render a frame; `perilune_shared.client.SceneClient.frame` describes the fields."""

    request: Literal["frame"]
    position_m: _Three
    rotation_wxyz: tuple[_Number, _Number, _Number, _Number]
    velocity_mps: _Three = (0.0, 0.0, 0.0)
    angular_velocity_radps: _Three = (0.0, 0.0, 0.0)
    sun_deg: tuple[_Number, Annotated[float, Field(gt=0, le=90)]] | None = None
    index: Annotated[int, Field(ge=0, lt=2**31)] = 0
    depth: bool = False
    labels: bool = False


class CratersRequest(_OfScene):
    """Request: list the craters of the ground."""

    request: Literal["craters"]


class HeightsRequest(_OfScene):
    """Request: compute heights of the surface at points."""

    request: Literal["heights"]
    x_m: Annotated[tuple[_Number, ...], Field(max_length=100_000)]
    y_m: Annotated[tuple[_Number, ...], Field(max_length=100_000)]
    boulders: bool = True


_REQUESTS: dict[str, type[Section]] = {
    "scene": SceneRequest,
    "health": HealthRequest,
    "ground": GroundRequest,
    "frame": FrameRequest,
    "craters": CratersRequest,
    "heights": HeightsRequest,
}
_LENGTH_TOLERANCE = 0.01
ANSWERED_BY_CONNECTIONS: list[bytes] = []
"""Returned by `answer` for a health request; the thread of the connections makes the reply."""


def answer(grounds: Grounds, content: bytes, client: object) -> list[bytes]:
    """The parts of the reply to a request. Called in the thread that renders.

    An invalid request gets a reply with an error message. If the scene of the request is not in memory, the reply is
    `"ready": false` without arrays, and the scene is queued. `client` identifies the client in the queue.
    """
    try:
        request = _parsed(content)
        if isinstance(request, HealthRequest):
            return ANSWERED_BY_CONNECTIONS
        simulated = grounds.simulated(request.scene, client) if isinstance(request, _OfScene) else grounds.first
        if simulated is None:
            return _reply({"ready": False}, {})
        if isinstance(request, SceneRequest):
            return _reply(_about(grounds), {})
        return _answer(simulated, request)
    except UserError as error:
        return refusal(str(error))


def refusal(text: str, *, busy: bool = False) -> list[bytes]:
    """A reply with an error message; `busy` tells the client to send the request again later."""
    head: dict[str, Any] = {"error": one_line(text)[:900]}
    return [json.dumps(head | {"busy": True} if busy else head).encode()]


def _parsed(content: bytes) -> Section:
    """Parse a request. Raises UserError that names a wrong field."""
    try:
        plain = json.loads(content)
    except (ValueError, RecursionError):
        raise UserError("request", "JSON", "invalid JSON", "a JSON object") from None
    kind = plain.get("request") if isinstance(plain, dict) else None
    if not isinstance(kind, str) or kind not in _REQUESTS:
        raise UserError("request", "request", kind, f"one of {', '.join(_REQUESTS)}")
    try:
        return _REQUESTS[kind].model_validate_json(content)
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        field = ".".join(map(str, fault["loc"])) or kind
        raise UserError("request", field, got_of(fault), expected_of(fault)) from None


def _answer(simulated: SimulatedScene, request: Section) -> list[bytes]:
    if isinstance(request, FrameRequest):
        return _reply({}, _frame(simulated, request))
    if isinstance(request, HeightsRequest):
        if len(request.x_m) != len(request.y_m):
            raise UserError("request", "y_m", f"{len(request.y_m)} numbers", f"{len(request.x_m)}, as many as in x_m")
        heights = simulated.heights_m(np.array(request.x_m), np.array(request.y_m), boulders=request.boulders)
        return _reply({}, {"height_m": heights})
    if isinstance(request, CratersRequest):
        table = ground_tables("scene", simulated.scene)["craters"]
        return _reply({}, {name: table[name].to_numpy() for name in CRATER_COLUMNS})
    stated = simulated.config.scene or SceneConfig()
    about = {
        "dataset": simulated.config.name,
        "sun_azimuth_deg": stated.sun_azimuth_deg,
        "sun_elevation_deg": stated.sun_elevation_deg,
        "dem_source": simulated.scene.dem_source,
        "content_sha256": simulated.content_sha256,
    }
    return _reply({"ready": True, "ground": about}, {})


def _about(grounds: Grounds) -> dict[str, Any]:
    """The reply to a request `scene`: position and Sun of scene 0, camera, number of scenes."""
    config, scene = grounds.first.config, grounds.first.scene
    stated = config.scene or SceneConfig()
    about = {
        "latitude_deg": scene.latitude_deg,
        "longitude_deg": scene.longitude_deg,
        "extent_m": scene.grid.extent_m,
        "sun_azimuth_deg": stated.sun_azimuth_deg,
        "sun_elevation_deg": stated.sun_elevation_deg,
    }
    return {"scene": about, "camera": fields_of(camera_of(config.camera)), "n_scenes": grounds.n_scenes}


def _frame(simulated: SimulatedScene, request: FrameRequest) -> dict[str, np.ndarray]:
    """The arrays of a frame. `perilune-render frames` gives the same frame for the same pose and index."""
    quaternion = np.array(request.rotation_wxyz)
    length = np.linalg.norm(quaternion)
    if abs(length - 1) > _LENGTH_TOLERANCE:
        raise UserError("request", "rotation_wxyz", f"length {length:.4g}", "a unit quaternion w, x, y, z")
    quaternion = quaternion / length
    stated = simulated.config.scene or SceneConfig()
    sun = sun_direction(*(request.sun_deg or (stated.sun_azimuth_deg, stated.sun_elevation_deg)))
    rotation = matrix_from_quaternion(-quaternion if quaternion[0] < 0 else quaternion)
    view = View(np.array(request.position_m), rotation, camera_of(simulated.config.camera), sun)
    seed, moves = trajectory_seed(simulated.scene.seed, 0), (request.velocity_mps, request.angular_velocity_radps)
    frame = simulated.frame(view, seed, request.index, *(np.array(motion) for motion in moves))
    arrays = {"image": frame.image}
    if request.depth:
        arrays |= {"depth_m": frame.radiance.depth_m, "normal": frame.radiance.normal}
    if request.labels:
        table = label_table("frame", simulated.labels(view, frame)).drop_columns("frame_id")
        arrays |= {f"labels.{name}": table[name].to_numpy() for name in table.column_names}
    return arrays


def _reply(head: dict[str, Any], arrays: dict[str, np.ndarray]) -> list[bytes]:
    """The parts of a reply: a head in JSON that lists the arrays, then the bytes of each array."""
    plain = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
    listed = [{"name": name, "dtype": value.dtype.str, "shape": value.shape} for name, value in plain.items()]
    return [json.dumps({**head, "arrays": listed}).encode(), *(value.tobytes() for value in plain.values())]
