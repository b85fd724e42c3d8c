"""The examples in the pages run."""

import re
from pathlib import Path

import pytest

from perilune_shared.dataset.schema import TABLES

TOP = Path(__file__).parent.parent
DOCS = TOP / "docs"
PAGES = [*sorted(DOCS.rglob("*.md")), *sorted(TOP.glob("*.md")), TOP / "data_manifests/README.md"]
BLOCKS = [
    (page.relative_to(TOP).as_posix(), block)
    for page in sorted(DOCS.rglob("*.md"))
    for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
]


@pytest.mark.parametrize(("page", "block"), BLOCKS)
def test_example_runs(page, block, tiny, tmp_path, monkeypatch):
    """In a folder where `make dataset PRESET=tiny` was run."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data/tiny").symlink_to(tiny)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, page, "exec"), {})  # noqa: S102 - our own page


def test_there_are_examples():
    assert any(page == "docs/reference/frames.md" for page, _ in BLOCKS)


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.relative_to(TOP)}: {target}"


def test_the_manifest_page_has_every_column_as_the_schema_has_it():
    page = (DOCS / "reference/manifest.md").read_text(encoding="utf-8")
    rows = {}
    for name, part in re.findall(r"### (\w+)\n(.*?)(?=\n##)", page, re.DOTALL):
        rows[name] = re.findall(r"^\| `(\w+)` \| ([^|]*) \| ([^|]*) \| ([^|]*) \|", part, re.MULTILINE)
    for name, schema in TABLES.items():
        told = [(column, unit.strip(), meaning, "or null" in kind) for column, kind, unit, meaning in rows[name]]
        wanted = [(f.name, f.metadata[b"unit"].decode(), f.metadata[b"meaning"].decode(), f.nullable) for f in schema]
        assert told == wanted, f"{name}: run scripts/describe_columns.py with a dataset"
