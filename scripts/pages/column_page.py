"""Generate the reference page of the manifest's columns from the schema."""

import pyarrow as pa

from perilune_shared.dataset.schema import SCHEMA_VERSION, TABLES

HEAD = f"""# Columns of the manifest

A manifest has six tables, schema version {SCHEMA_VERSION}. Every Parquet file also stores unit and meaning of its
columns (field metadata `unit` and `meaning`). O_L and O_S are [frames of reference](frames.md). Columns in px use the
frame's image coordinates: origin at the outer corner of the top-left pixel, x right, y down.
"""
PACKED = """## shards

Only packed datasets have shards, such as `shards/<split>-00000-of-00012.parquet`, with one row per frame. A shard has
the columns of `frames`, then `image` and `labels`. `image` is a struct of `bytes` (the PNG file) and `path` (the
frame's `png_path`). `labels` is a list of structs with the columns of the table `labels` that are not in `frames`.
"""


def column_page() -> str:
    """Return one Markdown table for each table of a manifest."""
    pieces = [HEAD]
    for name, schema in TABLES.items():
        pieces.append(f"## {name}\n\n| Column | Type | Unit | Meaning |\n|---|---|---|---|")
        for field in schema:
            meaning, unit = (field.metadata[key].decode() for key in (b"meaning", b"unit"))
            pieces.append(f"| `{field.name}` | {_type(field)} | {unit} | {meaning} |")
        pieces.append("")
    return "\n".join([*pieces, PACKED])


def _type(field: pa.Field) -> str:
    kind = str(field.type)
    if pa.types.is_fixed_size_list(field.type):
        kind = f"double[{field.type.list_size}]"
    return kind + (" or null" if field.nullable else "")
