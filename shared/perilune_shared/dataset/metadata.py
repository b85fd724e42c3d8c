"""dataset.json: what a dataset is, what it was made by, what was done to it."""

import hashlib
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from perilune_shared.config_errors import expected_of, shown
from perilune_shared.dataset.schema import SCHEMA_VERSION, TABLES, ImageState, Kind, SplitUnit
from perilune_shared.errors import UserError, shortened
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.descent import ROTATION_CAMERA_FROM_BODY
from perilune_shared.storage import files

INFO_NAME = "dataset.json"
LARGEST_IMAGE_PX = 2**27
"""Pixels of an image that is unpacked at all."""
_FAR = 1e9
_ROTATION = 1e-6
_LARGEST_INFO_BYTES = 10_000_000
# Names reach tables, pages and shells: they are letters, digits and a few marks that mean nothing there.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+,:()/-]{0,199}$")]
_Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_Row = tuple[float, float, float]


def _printable(text: str) -> str:
    """As it is. Raises ValueError at what would steer a terminal, turn the line round or break it."""
    if not text.isprintable():
        raise ValueError("text should be printable")
    return text


_Line = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f<>&`$]{1,500}$"), AfterValidator(_printable)]


class _Info(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class CameraInfo(_Info):
    """The camera of all frames; pixels, metres and O_B."""

    width_px: Annotated[int, Field(gt=0, le=100_000)]
    """Image width, pixels."""
    height_px: Annotated[int, Field(gt=0, le=100_000)]
    """Image height, pixels."""
    fx_px: Annotated[float, Field(gt=0, le=_FAR)]
    """Focal length over the pixel's width, pixels."""
    fy_px: Annotated[float, Field(gt=0, le=_FAR)]
    """Focal length over the pixel's height, pixels."""
    cx_px: Annotated[float, Field(ge=-_FAR, le=_FAR)]
    """Principal point, pixels right of the left edge."""
    cy_px: Annotated[float, Field(ge=-_FAR, le=_FAR)]
    """Principal point, pixels below the top edge."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Brown-Conrady k1, k2, p1, p2, k3, on coordinates over the focal length."""
    rotation_camera_from_body: tuple[_Row, _Row, _Row]
    """Rows of the matrix (3, 3)."""
    position_in_body_m: _Row
    """Centre of projection in O_B, metres."""

    @model_validator(mode="after")
    def _as_a_camera_can_be(self) -> "CameraInfo":
        if self.width_px * self.height_px > LARGEST_IMAGE_PX:
            raise ValueError(f"width_px times height_px should be at most {LARGEST_IMAGE_PX}")
        rows = np.array(self.rotation_camera_from_body)
        if not (np.abs(rows @ rows.T - np.eye(3)) < _ROTATION).all() or np.linalg.det(rows) < 0:
            raise ValueError("rotation_camera_from_body should be a rotation")
        return self

    @classmethod
    def of(cls, camera: Camera) -> "CameraInfo":
        """A camera at the body's origin that looks down on a level flight."""
        x, y, z = ROTATION_CAMERA_FROM_BODY.tolist()
        rows = tuple(x), tuple(y), tuple(z)
        return cls(**asdict(camera), rotation_camera_from_body=rows, position_in_body_m=(0.0, 0.0, 0.0))

    def intrinsics(self) -> Camera:
        """The camera that projects, with its distortion."""
        return Camera(self.width_px, self.height_px, self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.distortion)


class Counts(_Info):
    """Rows in each table."""

    scenes: Annotated[int, Field(ge=0)] = 0
    """Terrains."""
    craters: Annotated[int, Field(ge=0)] = 0
    """Craters of all scenes."""
    boulders: Annotated[int, Field(ge=0)] = 0
    """Boulders of all scenes."""
    trajectories: Annotated[int, Field(ge=0)] = 0
    """Descents."""
    frames: Annotated[int, Field(ge=0)] = 0
    """Images."""
    labels: Annotated[int, Field(ge=0)] = 0
    """Craters in images."""


class Origin(_Info):
    """The dataset from whose EXRs another was developed."""

    name: Name
    """Its name."""
    sha256: _Sha256
    """Of its dataset.json."""
    camera_config: dict[str, Any] | None
    """Its section `dataset.camera`, which the ground and the EXRs were made for; null where that is not known."""


class Recipe(_Info):
    """All that scenes and frames follow from, beside their seeds: enough to make them again."""

    preset: Name
    """Where the settings began."""
    kind: Kind
    """Which of the preset's datasets."""
    seed: Annotated[int, Field(ge=0)]
    """From which every random stream is derived."""
    config: dict[str, Any]
    """The resolved `dataset` section."""
    versions: dict[Name, Name]
    """Packages and Blender."""
    developed_from: Origin | None = None
    """Where the frames were developed again from; null where they were rendered."""

    @property
    def key(self) -> str:
        """Names the recipe by its content."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


class DatasetInfo(_Info):
    """Content of dataset.json."""

    name: Name
    """For people."""
    kind: Kind
    """What it is for."""
    schema_version: str
    """Of tables and files."""
    complete: bool
    """False while the renderer is still at work, or was stopped."""
    images: ImageState
    """files under frames/, packed in images/*.parquet, absent (elsewhere), or planned (not even labels are here)."""
    split_by: SplitUnit
    """What no two splits share. Less than a scene means that splits share terrain."""
    camera: CameraInfo
    """Of all frames."""
    exr_camera: CameraInfo | None = None
    """Of the EXRs: a camera without distortion that sees all that `camera` sees; null where there are none."""
    recipes: dict[str, Recipe]
    """By key; each scene names its own."""
    history: tuple[_Line, ...] = ()
    """What was done since rendering, a line each."""
    counts: Counts
    """Rows in each table, once complete."""
    licence: Annotated[str, Field(pattern=r"^[A-Za-z0-9(][A-Za-z0-9 ._+:()-]{0,499}$")]
    """SPDX expression."""

    @property
    def leak(self) -> str:
        """What to say behind the split's unit where the splits share terrain; else nothing."""
        return "" if self.split_by == "scene" else ": splits share terrain, so that test figures flatter"

    def recipe(self) -> Recipe:
        """The only recipe of a dataset that was rendered at one go. Raises ValueError where there are more."""
        (recipe,) = self.recipes.values()
        return recipe

    def changed(self, line: str, **fields: Any) -> "DatasetInfo":
        """A copy with fields replaced and a line of history."""
        plain = "".join(c if c.isprintable() and c not in "<>&`$" else "?" for c in line)[:500]
        return self.model_copy(update={"history": (*self.history, plain), **fields})


def recipes_of(*recipes: Recipe) -> dict[str, Recipe]:
    """Recipes by their keys."""
    return {recipe.key: recipe for recipe in recipes}


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file. Raises UserError where it is missing, too large or no JSON object."""
    if not path.exists() and not path.is_symlink():
        raise UserError(path.parent, path.name, "no such file", "the folder of a dataset (see `make dataset`)")
    n_bytes = files.check_plain_file(path)
    if n_bytes > _LARGEST_INFO_BYTES:
        raise UserError(path, "size", f"{n_bytes} bytes", f"at most {_LARGEST_INFO_BYTES}")
    try:
        content = json.loads(
            path.read_bytes(), object_pairs_hook=_each_once, parse_constant=_finite, parse_float=_finite
        )
    except (ValueError, RecursionError) as error:
        raise UserError(path, "content", error, "JSON") from None
    if not isinstance(content, dict):
        raise UserError(path, "content", type(content).__name__, "a JSON object")
    return content


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object's members; of two of the same name, two readers may take one each."""
    members: dict[str, Any] = {}
    for name, value in pairs:
        if name in members:
            raise ValueError(f"the member {shortened(name, 40)!r} twice")
        members[name] = value
    return members


def _finite(number: str) -> float:
    if not math.isfinite(float(number)):
        raise ValueError(f"the number {shortened(number, 40)}")
    return float(number)


def read_info(root: Path) -> DatasetInfo:
    """The dataset.json of a folder. Raises UserError where it is missing, damaged or of another schema version."""
    path = root / INFO_NAME
    content = read_object(path)
    for folder in (root / "manifest", root / "images", *(root / "manifest" / table for table in TABLES)):
        if folder.is_symlink():
            raise UserError(folder, "folder", "a link", "a folder of the dataset's own")
    version = content.get("schema_version")
    if version != SCHEMA_VERSION:
        raise UserError(path, "schema_version", version, f"{SCHEMA_VERSION}; see `perilune-manifest migrate`")
    return checked_info(content, path)


def checked_info(content: dict[str, Any], path: Path) -> DatasetInfo:
    """Plain data as a DatasetInfo. Raises UserError with the first field that is wrong."""
    try:
        info = DatasetInfo.model_validate_json(json.dumps(content))
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in fault["loc"])
        raise UserError(path, field or "content", shown(fault["input"]), expected_of(fault)) from None
    except RecursionError as error:
        raise UserError(path, "content", error, "JSON that is not nested so deep") from None
    _check_texts(info, path)
    for key, recipe in info.recipes.items():
        if recipe.key != key:
            raise UserError(path, f"recipes.{key}", "another content", f"the recipe that hashes to {recipe.key}")
    return info


def _check_texts(info: DatasetInfo, path: Path) -> None:
    """Settings are anybody's; pages and terminals show them."""
    for recipe in info.recipes.values():
        odd = _odd_text([recipe.config, recipe.developed_from.camera_config if recipe.developed_from else None])
        if odd is not None:
            raise UserError(path, "recipes", repr(odd), "plain text, without <, >, &, $, ` and control characters")


def _odd_text(tree: object) -> str | None:
    """A text in plain data, names of members too, that would steer a terminal or a page."""
    if isinstance(tree, str):
        return None if tree.isprintable() and not set(tree) & set("<>&`$") else tree
    if isinstance(tree, dict):
        tree = [*tree, *tree.values()]
    if isinstance(tree, list):
        return next((odd for odd in map(_odd_text, tree) if odd is not None), None)
    return None


def write_info(root: Path, info: DatasetInfo) -> None:
    """Write dataset.json, whole or not at all. Raises UserError where its recipe names things by odd characters."""
    _check_texts(info, root / INFO_NAME)
    files.write_text(root / INFO_NAME, info.model_dump_json(indent=2) + "\n")
