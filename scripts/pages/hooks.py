"""Hooks of MkDocs: generate pages of the documentation from the code when the site is built.

Generated pages are not committed, so they cannot differ from the code.
"""

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files
from scripts.pages.column_page import column_page
from scripts.pages.command_page import command_page
from scripts.pages.configuration_page import configuration_page
from scripts.pages.notebook_page import notebook_page
from scripts.pages.pangu_page import pangu_page

from perilune_render.cli.main import app as render
from perilune_render.config.dataset import DatasetConfig
from perilune_shared.cli.main import app as manifest
from perilune_train.cli.main import SECTIONS
from perilune_train.cli.main import app as train

DOCS = Path(__file__).parent.parent.parent / "docs"
PROGRAMS = {"perilune-render": render, "perilune-manifest": manifest, "perilune-train": train}


def generated_pages() -> dict[str, str]:
    """Return the text of every generated page, by its path in the documentation folder."""
    pages = {f"reference/commands/{name}.md": command_page(name, app) for name, app in PROGRAMS.items()}
    pages["reference/configuration/render.md"] = configuration_page(
        "Settings of the renderer", "perilune_render", {"dataset": DatasetConfig}
    )
    pages["reference/configuration/train.md"] = configuration_page(
        "Settings of the trainer", "perilune_train", SECTIONS
    )
    pages["reference/columns.md"] = column_page()
    pages["reference/pangu-messages.md"] = pangu_page()
    return pages


SEARCH = {
    "how-to/": {"boost": 2},
    "tutorials/": {"boost": 2},
    "reference/python/": {"boost": 0.5},
    "reference/configuration/": {"boost": 0.5},
    "notebook/": {"exclude": True},
}
"""Rank of a folder's pages in the site's search. Recipes come first; the notebook, a record of earlier states, is
excluded. The pages do not state their rank in their front matter, because the repository's web view would show it."""


def on_config(config: Any) -> Any:
    """Append the pages of the notebook (docs/notebook) to the navigation, the latest page first."""
    dated = [f"notebook/{path.name}" for path in sorted((DOCS / "notebook").glob("2*.md"), reverse=True)]
    config.nav = [*config.nav, {"Notebook": ["notebook/index.md", *dated]}]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages and the records of results, and replace each Jupyter notebook by a page."""
    for path, text in generated_pages().items():
        files.append(File.generated(config, path, content=text))
    for record in sorted((DOCS.parent / "results").glob("*.json")):
        files.append(File.generated(config, f"results/{record.name}", abs_src_path=str(record)))
    for notebook in [each for each in files if each.src_uri.endswith(".ipynb")]:
        files.remove(notebook)
        text, pictures = notebook_page(Path(notebook.abs_src_path))
        folder = notebook.src_uri.rpartition("/")[0]
        files.append(File.generated(config, notebook.src_uri.removesuffix(".ipynb") + ".md", content=text))
        for name, picture in pictures.items():
            files.append(File.generated(config, f"{folder}/{name}", content=picture))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Rank the page in the search, hide the navigation of top pages, and correct links to moved files."""
    for folder, rank in SEARCH.items():
        if page.file.src_uri.startswith(folder):
            page.meta.setdefault("search", rank)
    if "/" not in page.file.src_uri:
        # The home page and the results have no neighbours to list.
        page.meta.setdefault("hide", ["navigation"])
    # Notebooks become pages; the records of results are outside the folder of the documentation.
    markdown = markdown.replace(".ipynb)", ".md)").replace("](../results/", "](results/")
    return markdown.replace("](../../results/", "](../results/")
