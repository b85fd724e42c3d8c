"""Write the column tables of docs/reference/manifest.md, between its marks: `describe_columns.py DATASET`.

Types, units and meanings come from the schema, examples from the dataset's first row.
"""

import sys
from pathlib import Path

import pyarrow as pa

from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.schema import TABLES
from perilune_shared.storage.files import write_text

PAGE = Path(__file__).parent.parent / "docs/reference/manifest.md"
BEGIN, END = "<!-- columns -->", "<!-- end of columns -->"


def describe(dataset: Dataset | None) -> str:
    """One Markdown table for each table, with examples where a dataset is given."""
    pieces = []
    for name, schema in TABLES.items():
        first = dataset.table(name).slice(0, 1).to_pylist() if dataset is not None else []
        pieces.append(f"### {name}\n\n| Column | Type | Unit | Meaning | Example |\n|---|---|---|---|---|")
        for field in schema:
            example = _example(first[0][field.name]) if first else ""
            meaning, unit = (field.metadata[key].decode() for key in (b"meaning", b"unit"))
            pieces.append(f"| `{field.name}` | {_type(field)} | {unit} | {meaning} | {example} |")
        pieces.append("")
    return "\n".join(pieces)


def _type(field: pa.Field) -> str:
    kind = str(field.type)
    if pa.types.is_fixed_size_list(field.type):
        kind = f"double[{field.type.list_size}]"
    return kind + (" or null" if field.nullable else "")


def _example(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return "[" + ", ".join(f"{each:.4g}" for each in value) + "]"
    text = "null" if value is None else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def main() -> None:
    """Replace the tables between the marks."""
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    after = rest.split(END)[1]
    write_text(PAGE, f"{before}{BEGIN}\n\n{describe(open_dataset(sys.argv[1]))}\n{END}{after}")


if __name__ == "__main__":
    main()
