"""Content of dataset.json: what a dataset contains, how it was rendered, and how it was edited since."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from perilune_shared.dataset.names import CAMERA_PATTERN, ImageState, Kind, SplitUnit
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.lens_models import PARAMETERS, lens_of

NOT_STATED = "LicenseRef-not-stated"
"""Licence of a dataset whose author has not stated one. A merge keeps it as a term of the licence."""
LARGEST_IMAGE_PX = 2**27
"""Largest image that readers decompress, pixels."""
_LARGEST_INDEX_BYTES = 2**30
_FAR = 1e9
_ROTATION_TOLERANCE = 1e-6
# Names appear in tables, pages and quoted shell commands, so only characters that are safe there are valid.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+,:()/-]{0,199}$")]
_Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_CameraName = Annotated[str, Field(pattern=CAMERA_PATTERN)]
_Row = tuple[float, float, float]


def _printable(text: str) -> str:
    """Return `text`. Raises ValueError on unprintable characters, such as bidirectional marks."""
    if not text.isprintable():
        raise ValueError("printable text")
    return text


_Line = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f<>&`$]{1,500}$"), AfterValidator(_printable)]


class _Info(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


_OF_LENS = ("model", "parameters")


class CameraRecord(_Info):
    """Camera in dataset.json: the fields of `Camera` with limits, and the mounting on the lander (O_B)."""

    width_px: Annotated[int, Field(gt=0, le=100_000)]
    """Image width, pixels."""
    height_px: Annotated[int, Field(gt=0, le=100_000)]
    """Image height, pixels."""
    fx_px: Annotated[float, Field(gt=0, le=_FAR)]
    """Focal length divided by the pixel width, pixels."""
    fy_px: Annotated[float, Field(gt=0, le=_FAR)]
    """Focal length divided by the pixel height, pixels."""
    cx_px: Annotated[float, Field(ge=-_FAR, le=_FAR)]
    """Principal point, pixels right of the left edge."""
    cy_px: Annotated[float, Field(ge=-_FAR, le=_FAR)]
    """Principal point, pixels below the top edge."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Brown-Conrady k1, k2, p1, p2, k3, for coordinates divided by the focal length."""
    model: Annotated[str, Field(max_length=40)] = "pinhole"
    """pinhole, or the lens model: equidistant, kannala_brandt, unified, cahvor, cahvore (geometry.lens_models).

    Omitted for a pinhole."""
    parameters: dict[str, Annotated[float, Field(ge=-_FAR, le=_FAR)]] = {}
    """Parameters of the lens model by name; omitted for a pinhole."""
    rotation_camera_from_body: tuple[_Row, _Row, _Row]
    """Rotation matrix (3, 3), row by row."""
    position_in_body_m: _Row
    """Centre of projection in O_B, metres."""

    @model_validator(mode="after")
    def _possible(self) -> "CameraRecord":
        if self.width_px * self.height_px > LARGEST_IMAGE_PX:
            raise ValueError(f"width_px times height_px of at most {LARGEST_IMAGE_PX}")
        rows = np.array(self.rotation_camera_from_body)
        if not (np.abs(rows @ rows.T - np.eye(3)) < _ROTATION_TOLERANCE).all() or np.linalg.det(rows) < 0:
            raise ValueError("rotation_camera_from_body to be a rotation")
        if self.model != "pinhole" and self.model not in PARAMETERS:
            raise ValueError(f"model pinhole, {', '.join(PARAMETERS)}")
        names = PARAMETERS.get(self.model, ())
        if sorted(self.parameters) != sorted(names):
            raise ValueError(f"parameters {', '.join(names) or '{}'} of the model {self.model}")
        if self.model != "pinhole":
            lens_of(self.model, self._parameters())
        return self

    @model_serializer(mode="wrap")
    def _without_lens(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit `model` and `parameters` of a pinhole, so that its record keeps the older form."""
        values: dict[str, Any] = handler(self)
        return {key: value for key, value in values.items() if self.model != "pinhole" or key not in _OF_LENS}

    def _parameters(self) -> tuple[float, ...]:
        return tuple(self.parameters[name] for name in PARAMETERS.get(self.model, ()))

    @classmethod
    def of(
        cls,
        camera: Camera,
        rotation_camera_from_body: Array = ROTATION_CAMERA_FROM_BODY,
        position_in_body_m: _Row = (0.0, 0.0, 0.0),
    ) -> "CameraRecord":
        """Record a camera. By default it is at the origin of O_B and looks along -Z_B."""
        x, y, z = rotation_camera_from_body.tolist()
        rows = tuple(x), tuple(y), tuple(z)
        return cls(**fields_of(camera), rotation_camera_from_body=rows, position_in_body_m=position_in_body_m)

    def intrinsics(self) -> Camera:
        """Return the camera model, without the mounting."""
        size, focal = (self.width_px, self.height_px), (self.fx_px, self.fy_px)
        return Camera(*size, *focal, self.cx_px, self.cy_px, self.distortion, self.model, self._parameters())


def fields_of(camera: Camera) -> dict[str, Any]:
    """Return the fields of a camera as in its record, without the mounting; a lens model has named parameters."""
    fields = asdict(camera)
    if camera.model == "pinhole":
        return {name: value for name, value in fields.items() if name not in _OF_LENS}
    return fields | {"parameters": dict(zip(PARAMETERS[camera.model], camera.parameters, strict=True))}


_LATER_TABLES = ("star_tracker", "doppler_lidar")
"""Tables that were added after version 0.1.0."""


class Counts(_Info):
    """Number of rows of each table."""

    scenes: Annotated[int, Field(ge=0)] = 0
    """Number of scenes (terrains)."""
    craters: Annotated[int, Field(ge=0)] = 0
    """Number of craters in all scenes."""
    boulders: Annotated[int, Field(ge=0)] = 0
    """Number of boulders in all scenes."""
    trajectories: Annotated[int, Field(ge=0)] = 0
    """Number of trajectories."""
    frames: Annotated[int, Field(ge=0)] = 0
    """Number of frames."""
    labels: Annotated[int, Field(ge=0)] = 0
    """Number of labels, one per crater and frame."""
    inertial: Annotated[int, Field(ge=0)] = 0
    """Number of inertial measurements."""
    ranges: Annotated[int, Field(ge=0)] = 0
    """Number of altimeter measurements."""
    star_tracker: Annotated[int, Field(ge=0)] = 0
    """Number of attitudes of a star tracker."""
    doppler_lidar: Annotated[int, Field(ge=0)] = 0
    """Number of measurements of a Doppler lidar, one per beam and time."""

    @model_serializer(mode="wrap")
    def _without_later_tables(self, handler: SerializerFunctionWrapHandler) -> dict[str, int]:
        """The counts without empty tables that older versions do not know, so that these versions can read the file."""
        counts: dict[str, int] = handler(self)
        return {name: count for name, count in counts.items() if count or name not in _LATER_TABLES}


class Origin(_Info):
    """The dataset that provided the EXRs from which another dataset was developed."""

    name: Name
    """Name of that dataset."""
    sha256: _Sha256
    """SHA-256 of that dataset's dataset.json."""
    camera_config: dict[str, Any] | None
    """Section `dataset.camera` (or `dataset.cameras`) of that dataset's configuration; null if unknown.

    Terrain and EXRs were made for these cameras."""


class Recipe(_Info):
    """What scenes and frames were generated from: settings, random seed and versions.

    A recipe and the seeds in the tables determine scenes and frames completely.
    """

    preset: Name
    """Preset on which the settings are based."""
    kind: Kind
    """Purpose of the dataset, detect or nav; each preset has settings for both."""
    seed: Annotated[int, Field(ge=0)]
    """Random seed from which every random stream is derived."""
    config: dict[str, Any]
    """The resolved section `dataset` of the configuration."""
    versions: dict[Name, Name]
    """Versions of the packages and of Blender, by name."""
    developed_from: Origin | None = None
    """Dataset from whose EXRs the frames were developed; null if they were rendered."""

    @property
    def key(self) -> str:
        """Key of the recipe, computed from its content."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


class IndexPart(_Info):
    """Record of one part of the index of the dataset (perilune_shared.dataset.index)."""

    path: Annotated[str, Field(pattern=r"^index/[0-9a-f]{16}\.parquet$")]
    """Path relative to the dataset; the file name is the first 16 digits of the hash."""
    bytes: Annotated[int, Field(gt=0, le=_LARGEST_INDEX_BYTES)]
    """File size, bytes."""
    sha256: _Sha256
    """SHA-256 of the file."""


_OF_SEVERAL = ("cameras", "exr_cameras")


class DatasetInfo(_Info):
    """Content of dataset.json."""

    name: Name
    """Name of the dataset, for display."""
    kind: Kind
    """Purpose of the dataset: detect or nav."""
    schema_version: str
    """Schema version of tables and files."""
    complete: bool
    """False while rendering is in progress or was interrupted."""
    images: ImageState
    """Where the frames are: files (in frames/), packed (in shards/*.parquet), absent, or planned.

    A planned dataset has neither frames nor labels yet."""
    split_by: SplitUnit
    """What no split divides: scene, trajectory or frame. Unless it is scene, splits may share terrain."""
    camera: CameraRecord
    """Camera of all frames (PNG)."""
    exr_camera: CameraRecord | None = None
    """Camera of the EXRs, without distortion, with at least the view of `camera`; null without EXRs.

    With a lens model, it is equal to `camera`, and depths are distances along the rays."""
    cameras: dict[_CameraName, CameraRecord] | None = None
    """Cameras by name; null if there is only one camera.

    The column `camera` of the table `frames` contains the name. The field `camera` above is the first of these cameras.
    """
    exr_cameras: dict[_CameraName, CameraRecord] | None = None
    """Cameras of the EXRs by name; null without EXRs or if there is only one camera."""
    recipes: dict[str, Recipe]
    """Recipes by key; each scene refers to one recipe by the column `recipe`."""
    history: tuple[_Line, ...] = ()
    """Edits since rendering, one line each."""
    counts: Counts
    """Number of rows of each table; set when the dataset is complete."""
    licence: Annotated[str, Field(pattern=r"^[A-Za-z0-9(][A-Za-z0-9 ._+:()-]{0,499}$")]
    """Licence of the dataset, as an SPDX expression; `NOT_STATED` until the author states a licence."""
    index: tuple[IndexPart, ...] = ()
    """Parts of the index, which lists all other files; empty while the dataset is incomplete."""

    @model_validator(mode="after")
    def _names_agree(self) -> "DatasetInfo":
        names = list(self.cameras or {})
        if self.cameras is not None and (len(names) < 2 or self.cameras[names[0]] != self.camera):
            raise ValueError("two or more cameras, the first of them equal to camera")
        if self.exr_cameras is not None and list(self.exr_cameras) != names:
            raise ValueError("exr_cameras with the names of cameras")
        return self

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit `cameras` and `exr_cameras` if null: dataset.json of one camera keeps its older form."""
        values: dict[str, Any] = handler(self)
        return {key: value for key, value in values.items() if value is not None or key not in _OF_SEVERAL}

    @property
    def leak(self) -> str:
        """Warning to append to `split_by` if splits may share terrain; otherwise empty."""
        return "" if self.split_by == "scene" else ": splits share terrain, so test metrics are optimistic"

    def camera_of(self, name: str | None) -> CameraRecord:
        """Return the camera of frames whose column `camera` is `name`. Raises KeyError on an unknown name."""
        return self.camera if self.cameras is None or name is None else self.cameras[name]

    def exr_camera_of(self, name: str | None) -> CameraRecord:
        """Return the camera of the EXRs of frames whose column `camera` is `name`.

        Returns the camera of their PNGs if there are no EXRs. Raises KeyError on an unknown name.
        """
        if self.cameras is None or name is None:
            return self.exr_camera or self.camera
        return (self.exr_cameras or self.cameras)[name]

    def with_cameras(self, names: Iterable[str]) -> "DatasetInfo":
        """Return a copy with only the named cameras.

        With one name, the copy describes a dataset of one camera.
        """
        used = set(names)
        if self.cameras is None or not used & self.cameras.keys() or used >= self.cameras.keys():
            return self
        remaining = [name for name in self.cameras if name in used]
        fields: dict[str, Any] = {}
        for single, several in (("camera", "cameras"), ("exr_camera", "exr_cameras")):
            records = getattr(self, several)
            if records is not None:
                chosen = {name: records[name] for name in remaining}
                fields |= {single: chosen[remaining[0]], several: chosen if len(remaining) > 1 else None}
        return self.model_copy(update=fields)

    def recipe(self) -> Recipe:
        """Return the only recipe of the dataset. Raises ValueError if there are several."""
        (recipe,) = self.recipes.values()
        return recipe

    def row_time_s(self, recipe: object) -> float:
        """Return the row time of the rolling shutter, seconds, in the recipe with a key.

        Returns 0 without a rolling shutter.
        """
        known = self.recipes.get(str(recipe))
        sensor = known.config.get("sensor") if known is not None else None
        value = sensor.get("row_time_s", 0.0) if isinstance(sensor, dict) else 0.0
        return float(value) if isinstance(value, int | float) and 0 <= value < 1e3 else 0.0

    def changed(self, line: str, **fields: Any) -> "DatasetInfo":
        """Return a copy with fields replaced and a line added to the history."""
        plain = "".join(c if c.isprintable() and c not in "<>&`$" else "?" for c in line)[:500]
        return self.model_copy(update={"history": (*self.history, plain), **fields})


def recipes_of(*recipes: Recipe) -> dict[str, Recipe]:
    """Return a dict of recipes by key."""
    return {recipe.key: recipe for recipe in recipes}
