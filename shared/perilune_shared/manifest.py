"""A dataset on disk: dataset.json, Parquet parts under manifest/, frames under frames/.

Parts are written once, aside and renamed, and never rewritten. Use::

    dataset = open_dataset("data/small/detect")
    labels = dataset.table("labels", columns=["frame_id", "radius_px"]).to_pandas()
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from perilune_shared import files
from perilune_shared.camera import Camera
from perilune_shared.descent import ROTATION_CAMERA_FROM_BODY
from perilune_shared.errors import UserError
from perilune_shared.schema import SCHEMA_VERSION, TABLES, Kind, SplitUnit

_LARGEST_INFO_BYTES = 10_000_000


class _Info(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class CameraInfo(_Info):
    """The camera of all frames; pixels, metres and O_B."""

    width_px: Annotated[int, Field(gt=0, le=100_000)]
    """Image width, pixels."""
    height_px: Annotated[int, Field(gt=0, le=100_000)]
    """Image height, pixels."""
    fx_px: Annotated[float, Field(gt=0)]
    """Focal length over the pixel's width, pixels."""
    fy_px: Annotated[float, Field(gt=0)]
    """Focal length over the pixel's height, pixels."""
    cx_px: float
    """Principal point, pixels right of the left edge."""
    cy_px: float
    """Principal point, pixels below the top edge."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Brown-Conrady k1, k2, p1, p2, k3, on coordinates over the focal length."""
    rotation_camera_from_body: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    """Rows of the matrix (3, 3)."""
    position_in_body_m: tuple[float, float, float]
    """Centre of projection in O_B, metres."""

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

    scenes: int = 0
    """Terrains."""
    craters: int = 0
    """Craters of all scenes."""
    boulders: int = 0
    """Boulders of all scenes."""
    trajectories: int = 0
    """Descents."""
    frames: int = 0
    """Images."""
    labels: int = 0
    """Craters in images."""


class Origin(_Info):
    """The dataset from whose EXRs another was developed."""

    name: str
    """Its name."""
    sha256: str
    """Of its dataset.json."""


class DatasetInfo(_Info):
    """Content of dataset.json."""

    name: str
    """For people."""
    kind: Kind
    """What it is for."""
    schema_version: str
    """Of tables and files."""
    complete: bool
    """False while the renderer is still at work, or was stopped."""
    split_by: SplitUnit
    """What no two splits share."""
    preset: str
    """Where the settings began."""
    config: dict[str, Any]
    """The resolved `dataset` section."""
    seed: int
    """From which every random stream is derived."""
    camera: CameraInfo
    """Of all frames."""
    exr_camera: CameraInfo | None = None
    """Of the EXRs: a camera without distortion that sees all that `camera` sees; null where there are none."""
    developed_from: Origin | None = None
    """Where the frames were developed again from; null where they were rendered."""
    versions: dict[str, str]
    """Packages and Blender."""
    counts: Counts
    """Rows in each table, once complete."""
    licence: str
    """SPDX name."""


class Dataset:
    """A dataset opened for reading."""

    def __init__(self, root: Path, info: DatasetInfo):
        self.root = root
        self.info = info

    def parts(self, table: str) -> list[Path]:
        """The table's part files, sorted by name."""
        return sorted(self.root.joinpath("manifest", table).glob("[A-Za-z0-9]*.parquet"))

    def table(
        self,
        table: str,
        columns: Sequence[str] | None = None,
        scene_id: str | None = None,
        split: str | None = None,
    ) -> pa.Table:
        """One table, whole or with chosen columns, of one scene or one split where the table has that column.

        Raises UserError where a part is truncated or of another schema.
        """
        wanted = list(columns) if columns is not None else TABLES[table].names
        keys = {"scene_id": scene_id, "split": split}
        keys = {name: value for name, value in keys.items() if value is not None}
        loaded = list(dict.fromkeys([*wanted, *keys]))
        schema = pa.schema([TABLES[table].field(name) for name in loaded])
        pieces = [read_part(part, table, loaded) for part in self.parts(table)]
        joined = pa.concat_tables([piece.cast(schema) for piece in pieces]) if pieces else schema.empty_table()
        for name, value in keys.items():
            joined = joined.filter(pc.field(name) == value)
        return joined.select(wanted)

    def file(self, relative: str) -> Path:
        """A frame's file, checked to lie inside the dataset."""
        return files.inside(self.root, relative)


def read_part(part: Path, table: str, columns: Sequence[str] | None = None) -> pa.Table:
    """One Parquet part. Raises UserError where it cannot be read or is of another table or schema version."""
    try:
        parquet = pq.ParquetFile(part)
        metadata = parquet.schema_arrow.metadata or {}
        version = metadata.get(b"perilune.schema_version", b"none").decode(errors="replace")
        if version != SCHEMA_VERSION:
            raise UserError(part, "schema_version", version, f"{SCHEMA_VERSION}; migrate the dataset")
        found = metadata.get(b"perilune.table", b"none").decode(errors="replace")
        if found != table:
            raise UserError(part, "perilune.table", found, table)
        missing = [name for name in columns or TABLES[table].names if name not in parquet.schema_arrow.names]
        if missing:
            raise UserError(part, "columns", f"no {missing[0]}", f"every column of schema version {SCHEMA_VERSION}")
        return parquet.read(columns=list(columns) if columns is not None else None)
    except (pa.ArrowException, OSError) as error:
        raise UserError(part, "content", error, "a whole Parquet file") from None


def open_dataset(root: str | Path) -> Dataset:
    """Open a dataset. Raises UserError where it is missing, damaged or of another schema version."""
    root = Path(root)
    path = root / "dataset.json"
    if not path.is_file():
        raise UserError(root, "dataset.json", "no such file", "the folder of a dataset (see `make dataset`)")
    if path.stat().st_size > _LARGEST_INFO_BYTES:
        raise UserError(path, "size", f"{path.stat().st_size} bytes", f"at most {_LARGEST_INFO_BYTES}")
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise UserError(path, "content", error, "JSON") from None
    if not isinstance(content, dict):
        raise UserError(path, "content", type(content).__name__, "a JSON object")
    version = content.get("schema_version")
    if version != SCHEMA_VERSION:
        raise UserError(path, "schema_version", version, f"{SCHEMA_VERSION}; migrate the dataset")
    try:
        return Dataset(root, DatasetInfo.model_validate_json(json.dumps(content)))
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in fault["loc"])
        raise UserError(path, field, repr(fault["input"]), fault["msg"]) from None


def write_info(root: Path, info: DatasetInfo) -> None:
    """Write dataset.json, whole or not at all."""
    files.write_text(root / "dataset.json", info.model_dump_json(indent=2) + "\n")


def write_part(root: Path, table: str, name: str, rows: pa.Table) -> Path:
    """Append one part `manifest/<table>/<name>.parquet`. A part that exists is never rewritten."""
    part = root / "manifest" / table / f"{name}.parquet"
    if part.exists():
        raise FileExistsError(part)
    with files.written_aside(part) as aside:
        pq.write_table(rows.cast(TABLES[table]), aside, compression="zstd")
    return part


def count_rows(dataset: Dataset) -> Counts:
    """Rows present in each table, read from the parts' footers."""
    return Counts(
        **{name: sum(pq.ParquetFile(part).metadata.num_rows for part in dataset.parts(name)) for name in TABLES}
    )
