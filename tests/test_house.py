"""The rules of the house: who may import whom, and what stands in no file."""

import ast
import re
import tomllib
import warnings
from pathlib import Path

import pytest

import perilune
import perilune_render
import perilune_shared
import perilune_train

ROOT = Path(__file__).parent.parent
MAY_IMPORT = {
    "shared": {"perilune_shared"},
    "render": {"perilune_shared", "perilune_render"},
    "train": {"perilune_shared", "perilune_train"},
    "perilune": {"perilune", "perilune_shared", "perilune_render", "perilune_train"},
}
BLENDER = {"bpy", "bmesh", "mathutils", "gpu"}


def imported(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names


def sources() -> list[tuple[str, Path]]:
    found = [
        (house, path) for house in MAY_IMPORT for path in (ROOT / house).rglob("*.py") if "build" not in path.parts
    ]
    assert len(found) > 40
    return found


def test_distributions_import_only_what_they_may():
    for house, path in sources():
        ours = {name for name in imported(path) if name.startswith("perilune")}
        assert ours <= MAY_IMPORT[house], path


def test_blender_is_imported_in_one_folder_only():
    paths = [path for _, path in sources()]
    for folder in ("benchmarks", "scripts", "tests"):
        paths += (ROOT / folder).rglob("*.py")
    users = [path for path in paths if imported(path) & BLENDER]
    assert users
    assert all(path.is_relative_to(ROOT / "render/perilune_render/engines/blender") for path in users), users


def test_no_file_imports_torchvision_or_agpl():
    for _, path in sources():
        assert not imported(path) & {"torchvision", "ultralytics"}, path


def test_imports_have_no_circle():
    modules = {
        ".".join(path.relative_to(ROOT / house).with_suffix("").parts).removesuffix(".__init__"): path
        for house, path in sources()
    }
    edges = {}
    for name, path in modules.items():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        targets = set()
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module:
                targets |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
        edges[name] = {target for target in targets if target in modules and target != name}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail, name))
        if name not in done:
            for target in edges[name]:
                visit(target, (*trail, name))
            done.add(name)

    for name in edges:
        visit(name, ())


def test_licences_are_as_promised():
    expected = {"shared": "Apache-2.0", "render": "GPL-3.0-or-later", "train": "Apache-2.0", "perilune": "Apache-2.0"}
    for house, licence in expected.items():
        content = tomllib.loads((ROOT / house / "pyproject.toml").read_text())
        # An SPDX expression, which setuptools reads from version 77 on.
        assert content["project"]["license"] == licence
        assert content["project"]["license-files"] == ["LICENSE"]
        assert content["build-system"]["requires"] == ["setuptools>=77"]
        assert (ROOT / house / "LICENSE").is_file()


def test_the_distributions_have_one_version():
    """Each is built from its own `__version__`, and requires the sibling of the same."""
    versions = {package.__version__ for package in (perilune, perilune_shared, perilune_render, perilune_train)}
    assert len(versions) == 1
    (version,) = versions
    for house in ("render", "train"):
        project = tomllib.loads((ROOT / house / "pyproject.toml").read_text())["project"]
        assert f"perilune-shared=={version}" in project["dependencies"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {version}\n" in citation


BYPASSES = {
    r"(?<![\w.])print|\.print|typer\.echo|click\.echo|Console|std(out|err)\.write": {
        "shared/perilune_shared/console/terminal.py",
        # Before a program's imports.
        "shared/perilune_shared/console/command_line.py",
    },
    r"\.to_csv|csv\.writer|DictWriter": {"shared/perilune_shared/export/foreign_text.py"},
    r"\.to_html|\.to_markdown|\.savefig": {
        "train/perilune_train/records/pictures.py",
        "train/perilune_train/report/pictures.py",
        # Its texts are our own.
        "shared/perilune_shared/export/card_pictures.py",
    },
}
"""Calls that print, or write tables and figures, and the files whose functions make other people's text safe."""
PAGE = re.compile(r"\.md\b|\bPAGE\b|\bREADME\b|\bSUMMARY\b|_PAGE\b")


def test_text_reaches_terminals_pages_and_tables_through_one_function_each():
    found = []
    for _, path in sources():
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            for pattern, allowed in BYPASSES.items():
                if re.search(f"(?:{pattern})$", called) and name not in allowed:
                    found.append(f"{name}:{node.lineno}: {called}")
            page = node.args and PAGE.search(ast.unparse(node.args[0]))
            if called.endswith("write_text") and page and name not in MARKDOWN_WRITERS:
                found.append(f"{name}:{node.lineno}: {called} of a page")
    assert not found, found


MARKDOWN_WRITERS = {
    "train/perilune_train/records/markdown.py",
    # Both pages put every text into code spans, and have a comment or a head that is not Markdown.
    "shared/perilune_shared/export/hugging_face.py",
    "shared/perilune_shared/export/card.py",
    # The page of HTML, which Jinja2 escapes.
    "train/perilune_train/report/page.py",
}
"""Files that write pages without `write_markdown`."""

OWN_MODULES = [
    "perilune_shared.config.resolve",
    "perilune_render.cli.main",
    "perilune_train.detect.train.detect_run",
    "tests.test_house",
]
OWN_MODULES += [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in (ROOT / "benchmarks").rglob("*.py")]


@pytest.mark.parametrize("kind", [DeprecationWarning, PendingDeprecationWarning, FutureWarning])
def test_deprecated_calls_of_our_own_modules_are_errors(kind):
    """As pytest is configured for every test; those of other packages are left to them."""
    for module in OWN_MODULES:
        with pytest.raises(kind):
            warnings.warn_explicit("old", kind, "a.py", 1, module=module)
    for module in ("rasterio.transform", "torch.nn", "labelsmith"):
        warnings.warn_explicit("old", kind, "a.py", 1, module=module)


def test_every_direct_dependency_is_pinned():
    pinned = {
        re.split(r"==", line)[0].lower().replace("_", "-") for line in (ROOT / "constraints.txt").read_text().split()
    }
    for house in MAY_IMPORT:
        project = tomllib.loads((ROOT / house / "pyproject.toml").read_text())["project"]
        extras = [name for extra in project.get("optional-dependencies", {}).values() for name in extra]
        for requirement in project["dependencies"] + extras:
            name = re.split(r"[<>=!~ \[]", requirement)[0].lower()
            assert name in pinned or name.startswith("perilune-"), name
