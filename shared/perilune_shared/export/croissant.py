"""Export to Croissant: describe files, tables and columns in JSON-LD for dataset search and ML tools.

Format: Croissant 1.1 (https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html). The file must be in the
dataset's folder, since its paths are relative. mlcroissant reads records from the local files:

    dataset = mlcroissant.Dataset("data/small/detect/croissant.json")
    for record in dataset.records("labels"):
        print(record["labels/radius_px"])
"""

import json
import os
from collections.abc import Mapping
from typing import Any

import pyarrow as pa

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import NOT_STATED
from perilune_shared.dataset.parts import Part
from perilune_shared.dataset.schema import KEYS, MAY_BE_ABSENT, OPTIONAL_TABLES, TABLES
from perilune_shared.errors import UserError
from perilune_shared.export.added_files import Target, add_files, check_index
from perilune_shared.export.citation import citation_of, table_hashes

CROISSANT_NAME = "croissant.json"
# mlcroissant does not support the registered media type, application/vnd.apache.parquet.
_PARQUET = "application/x-parquet"
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"},
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isArray": "cr:isArray",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "name": {"@container": "@language"},
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_DATA_TYPES = {
    pa.string(): "sc:Text",
    pa.int64(): "cr:Int64",
    pa.float32(): "cr:Float32",
    pa.float64(): "cr:Float64",
}


def export_croissant(
    dataset: Dataset, out: str | os.PathLike[str] | None = None, progress: Progress = NO_PROGRESS
) -> str:
    """Write croissant.json, or the file `out`, into the dataset and add it to the index.

    Returns the path or address of the file. Raises UserError if `out` is outside the dataset, or if the dataset is
    incomplete or differs from its index.
    """
    target = Target.of(dataset, out, CROISSANT_NAME)
    if target.store is not dataset.store or not target.name.endswith(".json"):
        raise UserError(
            target.address,
            "--out",
            "a file in another folder or of another type",
            f"a .json file in {dataset.store}, since its paths are relative",
        )
    if target.name == INFO_NAME:
        raise UserError(target.address, "--out", INFO_NAME, "another name")
    if not dataset.info.complete:
        raise UserError(dataset.store, "complete", "false", "a finished dataset")
    info = check_index(dataset, [target], progress)
    text = json.dumps(metadata_of(dataset), indent=1, allow_nan=False) + "\n"
    add_files(dataset, {target: text.encode()}, info)
    return target.address


def metadata_of(dataset: Dataset) -> dict[str, Any]:
    """Return the description of a dataset as a JSON-LD object.

    A table that is one file (part) is a FileObject with a hash. A table of several files is a FileSet without a hash;
    the index has the hashes of its parts. dataset.json is a FileSet too, since the description cannot contain its hash:
    dataset.json contains the hash of the index, and the index contains the hash of the description.
    """
    info, hashes = dataset.info, table_hashes(dataset)
    distribution: list[dict[str, Any]] = [
        {
            "@type": "cr:FileSet",
            "@id": INFO_NAME,
            "name": INFO_NAME,
            "description": "metadata: camera, splits, recipes, edits since rendering, hash of the index of files",
            "encodingFormat": "application/json",
            "includes": INFO_NAME,
        }
    ]
    record_sets = []
    for table, schema in TABLES.items():
        if table in OPTIONAL_TABLES and not dataset.parts(table):
            continue
        distribution.append(_distribution(dataset, table, hashes))
        # Omit optional columns that a file lacks: mlcroissant would not find them.
        missing = {
            name
            for name in MAY_BE_ABSENT.get(table, ())
            for part in dataset.parts(table)
            if name not in Part(dataset.store, part, table).found.names
        }
        record_sets.append(
            {
                "@type": "cr:RecordSet",
                "@id": table,
                "name": table,
                "key": [{"@id": f"{table}/{column}"} for column in KEYS[table]],
                "field": [_field(table, column, distribution[-1]) for column in schema if column.name not in missing],
            }
        )
    if info.images in ("files", "packed"):
        distribution.append(_images(packed=info.images == "packed"))
        record_sets.append(_image_records(packed=info.images == "packed"))
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": info.name,
        "description": _description(dataset),
        **_licence(info.licence),
        # Datasets have no version number: use the number of edits since rendering.
        "version": f"1.0.{len(info.history)}",
        "citeAs": citation_of(dataset),
        "keywords": ["Moon", "craters", "lunar landing", "synthetic images", info.kind],
        "distribution": distribution,
        "recordSet": record_sets,
    }


def _description(dataset: Dataset) -> str:
    counts = dataset.info.counts
    return (
        "Rendered images of lunar landing trajectories with exact crater ellipses and camera poses: "
        f"{counts.scenes} scenes, {counts.trajectories} trajectories, {counts.frames} frames, {counts.labels} labels, "
        f"made by perilune. Splits share no {dataset.info.split_by}."
    )


def _licence(expression: str) -> dict[str, str]:
    """Return the licence entry: the address of SPDX's page for a single licence, or the expression.

    The result is empty if the licence is not stated.
    """
    if expression == NOT_STATED:
        return {}
    listed = " " not in expression and not expression.startswith("LicenseRef-")
    return {"license": f"https://spdx.org/licenses/{expression}.html" if listed else expression}


def _distribution(dataset: Dataset, table: str, hashes: Mapping[str, str]) -> dict[str, Any]:
    parts = dataset.parts(table)
    common = {"name": f"{table}-parquet", "encodingFormat": _PARQUET}
    if len(parts) == 1:
        url = parts[0]
        return {
            "@type": "cr:FileObject",
            "@id": f"{table}-parquet",
            **common,
            "contentUrl": url,
            "sha256": hashes[url],
        }
    return {
        "@type": "cr:FileSet",
        "@id": f"{table}-parquet",
        **common,
        "description": "parts of the table; the index (index/*.parquet) has their hashes",
        "includes": f"manifest/{table}/*.parquet",
    }


def _field(table: str, column: pa.Field, distribution: dict[str, Any]) -> dict[str, Any]:
    metadata = {key.decode(): value.decode() for key, value in (column.metadata or {}).items()}
    unit = f" [{metadata['unit']}]" if metadata.get("unit") else ""
    is_list = pa.types.is_fixed_size_list(column.type)
    field = {
        "@type": "cr:Field",
        "@id": f"{table}/{column.name}",
        "name": column.name,
        "description": metadata.get("meaning", "") + unit,
        "dataType": _DATA_TYPES[column.type.value_type if is_list else column.type],
        "source": _source(distribution, {"column": column.name}),
    }
    if is_list:
        field |= {"isArray": True, "arrayShape": str(column.type.list_size)}
    return field


def _source(distribution: dict[str, Any], extract: dict[str, str], **more: Any) -> dict[str, Any]:
    kind = "fileObject" if distribution["@type"] == "cr:FileObject" else "fileSet"
    return {kind: {"@id": distribution["@id"]}, "extract": extract, **more}


def _images(*, packed: bool) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": "image-files",
        "name": "image-files",
        "description": "packed frames" if packed else "frames; the table frames has their hashes",
        "encodingFormat": _PARQUET if packed else "image/png",
        "includes": "shards/*.parquet" if packed else "frames/*.png",
    }


def _image_records(*, packed: bool) -> dict[str, Any]:
    """Return the record set of the images; its key is frame_id for packed frames and png_path for files."""
    source = {"@type": "cr:FileSet", "@id": "image-files"}
    if packed:
        key, name = "frame_id", _source(source, {"column": "frame_id"})
        image = _source(source, {"column": "image"}, transform={"jsonPath": "bytes"})
    else:
        key, name = "png_path", _source(source, {"fileProperty": "fullpath"})
        image = _source(source, {"fileProperty": "content"})
    return {
        "@type": "cr:RecordSet",
        "@id": "images",
        "name": "images",
        "key": {"@id": f"images/{key}"},
        "field": [
            {"@type": "cr:Field", "@id": f"images/{key}", "name": key, "dataType": "sc:Text", "source": name},
            {
                "@type": "cr:Field",
                "@id": "images/image",
                "name": "image",
                "description": "the grey PNG",
                "dataType": "sc:ImageObject",
                "source": image,
            },
        ],
    }
