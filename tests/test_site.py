"""The site of the documentation: what its search finds first, and links that also work in the repository's own view."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from scripts.pages.hooks import DOCS, on_files, on_page_markdown


def page(address: str) -> SimpleNamespace:
    return SimpleNamespace(file=SimpleNamespace(src_uri=address), meta={})


@pytest.mark.parametrize(
    ("address", "rank"),
    [
        ("how-to/camera.md", {"boost": 2}),
        ("explanation/light.md", None),
        ("reference/python/train.md", {"boost": 0.5}),
        ("notebook/2026-11-27-records.md", {"exclude": True}),
    ],
)
def test_the_search_finds_recipes_before_the_interface_and_no_diaries(address, rank):
    shown = page(address)
    on_page_markdown("", page=shown)
    assert shown.meta.get("search") == rank


@pytest.mark.parametrize("name", ["index.md", "results.md", "../README.md"])
def test_links_of_the_first_pages_also_work_in_the_repository(name):
    """There, generated pages do not exist."""
    targets = re.findall(r"\]\(([^)#:]+)", (DOCS / name).read_text(encoding="utf-8"))
    assert len(targets) > 10
    assert [target for target in targets if not ((DOCS / name).parent / target).exists()] == []


def test_links_of_the_repository_lead_to_pages_of_the_site():
    text = on_page_markdown("[a](tutorials/manifest.ipynb), [b](../results/labels.json)", page=page("results.md"))
    assert text == "[a](tutorials/manifest.md), [b](results/labels.json)"


def test_the_site_has_the_records_that_the_results_link_to():
    config = MkDocsConfig()
    config.load_dict({"site_name": "a", "docs_dir": str(DOCS), "plugins": []})
    config.validate()
    config.plugins._current_plugin = "hooks"  # as MkDocs sets it while it calls a hook
    files = on_files(Files([]), config)
    record = files.get_file_from_path("results/labels.json")
    assert record is not None and Path(record.abs_src_path) == DOCS.parent / "results/labels.json"
