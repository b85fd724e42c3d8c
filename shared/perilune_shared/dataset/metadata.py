"""dataset.json: what a dataset contains, how it was rendered, and how it was edited since."""

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
"""Largest image that is decompressed, pixels."""
_FAR = 1e9
_ROTATION = 1e-6
_LARGEST_INFO_BYTES = 10_000_000
# Names appear in tables, pages and shell commands: only letters, digits and characters without a meaning there.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+,:()/-]{0,199}$")]
_Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_Row = tuple[float, float, float]


def _printable(text: str) -> str:
    """Return `text` unchanged. Raises ValueError on unprintable characters, e.g. controls and bidirectional marks."""
    if not text.isprintable():
        raise ValueError("text should be printable")
    return text


_Line = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f<>&`$]{1,500}$"), AfterValidator(_printable)]


class _Info(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class CameraInfo(_Info):
    """The camera of all frames: intrinsics in pixels, mounting in O_B in metres."""

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
    rotation_camera_from_body: tuple[_Row, _Row, _Row]
    """Rotation matrix (3, 3), row by row."""
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
        """A camera at the body's origin that looks straight down while the body is level."""
        x, y, z = ROTATION_CAMERA_FROM_BODY.tolist()
        rows = tuple(x), tuple(y), tuple(z)
        return cls(**asdict(camera), rotation_camera_from_body=rows, position_in_body_m=(0.0, 0.0, 0.0))

    def intrinsics(self) -> Camera:
        """The camera model, including distortion."""
        return Camera(self.width_px, self.height_px, self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.distortion)


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


class Origin(_Info):
    """The dataset whose EXRs another dataset was developed from."""

    name: Name
    """Name of that dataset."""
    sha256: _Sha256
    """SHA-256 of its dataset.json."""
    camera_config: dict[str, Any] | None
    """Its section `dataset.camera`, for which terrain and EXRs were made; null if not known."""


class Recipe(_Info):
    """Everything besides their seeds that determines scenes and frames: enough to reproduce them."""

    preset: Name
    """Preset on which the settings are based."""
    kind: Kind
    """Which of the preset's datasets: detect or nav."""
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
    """Where the frames are: files (under frames/), packed (images/*.parquet), absent, or planned (no labels either)."""
    split_by: SplitUnit
    """Unit of the split; no unit is in two splits. If it is not scene, splits may share terrain."""
    camera: CameraInfo
    """Camera of all frames (PNG)."""
    exr_camera: CameraInfo | None = None
    """Camera of the EXRs: without distortion, covering the whole view of `camera`; null if there are no EXRs."""
    recipes: dict[str, Recipe]
    """Recipes by key; each scene refers to one."""
    history: tuple[_Line, ...] = ()
    """Edits since rendering, one line each."""
    counts: Counts
    """Number of rows of each table; set when the dataset is complete."""
    licence: Annotated[str, Field(pattern=r"^[A-Za-z0-9(][A-Za-z0-9 ._+:()-]{0,499}$")]
    """Licence of the dataset, as an SPDX expression."""

    @property
    def leak(self) -> str:
        """Warning to append to the split unit if splits share terrain; otherwise empty."""
        return "" if self.split_by == "scene" else ": splits share terrain, so that test figures flatter"

    def recipe(self) -> Recipe:
        """The recipe of a dataset with exactly one. Raises ValueError if there are more."""
        (recipe,) = self.recipes.values()
        return recipe

    def changed(self, line: str, **fields: Any) -> "DatasetInfo":
        """Return a copy with fields replaced and a line added to the history."""
        plain = "".join(c if c.isprintable() and c not in "<>&`$" else "?" for c in line)[:500]
        return self.model_copy(update={"history": (*self.history, plain), **fields})


def recipes_of(*recipes: Recipe) -> dict[str, Recipe]:
    """Return the recipes by their keys."""
    return {recipe.key: recipe for recipe in recipes}


def read_object(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file. Raises UserError if the file is missing, too large or not a JSON object."""
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
    """Build a dict from members; duplicate names are refused, since readers differ in which one they use."""
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
    """Read a folder's dataset.json. Raises UserError if it is missing, damaged or of another schema version."""
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
    """Validate plain data as a DatasetInfo. Raises UserError about the first wrong field."""
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
    """Check the texts of recipes, since settings are untrusted and are shown on pages and terminals."""
    for recipe in info.recipes.values():
        odd = _odd_text([recipe.config, recipe.developed_from.camera_config if recipe.developed_from else None])
        if odd is not None:
            raise UserError(path, "recipes", repr(odd), "plain text, without <, >, &, $, ` and control characters")


def _odd_text(tree: object) -> str | None:
    """Return the first text or member name in plain data that contains unsafe characters; None if there is none."""
    if isinstance(tree, str):
        return None if tree.isprintable() and not set(tree) & set("<>&`$") else tree
    if isinstance(tree, dict):
        tree = [*tree, *tree.values()]
    if isinstance(tree, list):
        return next((odd for odd in map(_odd_text, tree) if odd is not None), None)
    return None


def write_info(root: Path, info: DatasetInfo) -> None:
    """Write dataset.json atomically. Raises UserError if texts of its recipes contain unsafe characters."""
    _check_texts(info, root / INFO_NAME)
    files.write_text(root / INFO_NAME, info.model_dump_json(indent=2) + "\n")
