"""Pages agree with the code: examples run; links, commands, options, settings and files that they name exist."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat
import pytest
import yaml
from nbclient import NotebookClient
from scripts.pages.command_page import commands
from scripts.pages.hooks import PROGRAMS, generated_pages, on_config
from scripts.pages.notebook_page import notebook_page

from perilune_render.config.dataset import DatasetConfig
from perilune_shared.config.page import annotated_yaml, keys
from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.schema import TABLES
from perilune_train.cli.main import SECTIONS, main
from tests.helpers import in_process

TOP = Path(__file__).parent.parent
DOCS = TOP / "docs"
NOTEBOOKS = sorted(DOCS.rglob("*.ipynb"))
PAGES = [*sorted(DOCS.rglob("*.md")), *sorted(TOP.glob("*.md")), TOP / "data_manifests/README.md"]
CURRENT = [page for page in PAGES if "notebook" not in page.parts and page.name != "CHANGELOG.md"]
"""Pages that describe the current code. The dated notebook and the changelog describe earlier states."""
BLOCKS = [
    (page.relative_to(TOP).as_posix(), block)
    for page in sorted(DOCS.rglob("*.md"))
    for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
]
COMMANDS = {name: command for program, app in PROGRAMS.items() for name, command in commands(program, app).items()}
OPTIONS = {option for each in COMMANDS.values() for p in each.params for option in (*p.opts, *p.secondary_opts)}
FOREIGN = {
    "--help",
    *("--nproc-per-node", "--nnodes"),  # torchrun
    "--strict",  # mkdocs
    *("--rm", "--userns", "--build-arg", "--shm-size", "--gpus"),  # docker and podman
}
"""Options of other programs that pages name."""
GENERATED = generated_pages()
CONFIGS = {"dataset": (DatasetConfig, "perilune_render"), **{n: (m, "perilune_train") for n, m in SECTIONS.items()}}
KEYS = {key.name for n, (model, package) in CONFIGS.items() for key in keys(n, resolve(model, n, package, "small"))}
GROUPS = {name.rsplit(".", n)[0] for name in KEYS for n in range(1, name.count(".") + 1)}
FOLDERS = r"(?:benchmarks|configs|scripts|tests|(?:shared|render|train)/perilune_\w+|docs|data_manifests|results)"


def texts() -> list[tuple[str, str]]:
    """Every current page with its text, the notebooks too."""
    pages = [(page.relative_to(TOP).as_posix(), page.read_text(encoding="utf-8")) for page in CURRENT]
    return pages + [(each.relative_to(TOP).as_posix(), notebook_page(each)[0]) for each in NOTEBOOKS]


def code(text: str) -> tuple[list[str], list[str]]:
    """Return the lines of the code blocks of a page, with continued lines joined, and its inline code."""
    fenced = re.findall(r"^```.*?\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    fenced += re.findall(r"(?:^    .*\n)+", text, re.MULTILINE)
    inline = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
    return [line.strip() for block in fenced for line in block.replace("\\\n", " ").splitlines()], inline


def words(line: str) -> list[str]:
    return shlex.split(line.replace("[--", "--").replace("]", " ") if "[--" in line else line, comments=True)


def fault(line: str, *, complete: bool) -> str | None:
    """Return what is wrong with a command line, or None. A complete one has every required option and argument."""
    given = words(line[line.index("perilune-") :])
    name = next((" ".join(given[:n]) for n in (3, 2) if " ".join(given[:n]) in COMMANDS), None)
    if name is None:
        groups = {word for known in COMMANDS for word in (known.split()[0], " ".join(known.split()[:2]))}
        plain = " ".join(word for word in given if word not in ("...", "--help"))
        return None if plain in groups and not complete else "no such command"
    command, rest = COMMANDS[name], given[len(name.split()) :]
    known = {option: p for p in command.params for option in (*p.opts, *p.secondary_opts) if option.startswith("--")}
    used = [word.split("=")[0] for word in rest if word.startswith("--")]
    if unknown := [option for option in used if option not in {*known, "--help"}]:
        return f"no option {unknown}"
    expected = [p for p in command.params if p.required and complete]
    if missing := [p.opts for p in expected if p.param_type_name == "option" and not set(p.opts) & set(used)]:
        return f"without {missing}"
    n_arguments = sum(p.param_type_name == "argument" for p in expected)
    if n_arguments and (not rest or rest[0].startswith("--")):
        return "without its argument"
    return None


@pytest.mark.parametrize(("page", "block"), BLOCKS)
def test_example_runs(page, block, quick, tmp_path, monkeypatch):
    """In a folder where `make dataset PRESET=tiny` was run."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data/tiny").symlink_to(quick)
    monkeypatch.chdir(tmp_path)
    if '"descent"' in block:
        words = ("--dataset", "data/tiny/nav", "--trajectory", "scene-0000/trajectory-0000", "--out", "descent")
        assert in_process.call(main, "navigate", "descent", *words).returncode == 0
    exec(compile(block.replace("data/small", "data/tiny"), page, "exec"), {})  # noqa: S102 - our own page


def test_there_are_examples():
    assert any(page == "docs/reference/frames.md" for page, _ in BLOCKS)


def shown(notebook: Any) -> list[list[str]]:
    """The texts that each cell of code shows, without progress, pictures and addresses in memory."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    return [
        [
            output.get("text") or output.data["text/plain"]
            for output in cell.outputs
            if output.get("name") != "stderr" and "image/png" not in output.get("data", {})
        ]
        for cell in cells
    ]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_shows_what_it_has_saved(path, tiny, tmp_path):
    """Beside the datasets of `perilune-render dataset --preset tiny`. Saved outputs hold no paths of a machine."""
    folder = tmp_path / path.parent.relative_to(TOP)
    folder.mkdir(parents=True)
    (tmp_path / "data").mkdir()
    (tmp_path / "data/tiny").symlink_to(tiny)
    notebook = nbformat.read(path, as_version=4)
    assert all(cell.outputs for cell in notebook.cells if cell.cell_type == "code")
    assert not re.search(r"/(home|root|work|tmp|Users)/", nbformat.writes(notebook))
    saved = shown(notebook)
    client = NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}})
    client.execute()
    assert shown(notebook) == saved


def test_links_between_pages_lead_somewhere():
    made = {DOCS / path for path in GENERATED}
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            path = (page.parent / target).resolve()
            assert path.exists() or path in made, f"{page.relative_to(TOP)}: {target}"


@pytest.mark.parametrize(("page", "text"), texts(), ids=lambda value: value if value.endswith(("md", "ipynb")) else "")
def test_commands_options_settings_and_files_exist(page, text):
    lines, inline = code(text)
    shown = [(line, True) for line in lines if re.match(r"(\$ |time |\S*bin/)?perilune-\w+ \w", line)]
    shown += [(line, False) for line in inline if re.match(r"perilune-\w+ \w", line)]
    wrong = [f"{line}: {why}" for line, whole in shown if (why := fault(line, complete=whole))]
    for line in inline:
        option = re.match(r"--[a-z0-9-]+", line)
        if option and option[0] not in OPTIONS | FOREIGN:
            wrong.append(f"{line}: no command has this option")
        path = re.fullmatch(rf"{FOLDERS}/[\w./*-]+", line)
        if path and not list(TOP.glob(path[0].rstrip("/"))):
            wrong.append(f"{line}: no such file")
    settings = re.findall(r"""(?:--set |SET="|SET=)['"]?((?:dataset|detect|navigate|explain)\.[\w.]+)=""", text)
    settings += [
        line.split("=")[0] for line in inline if re.fullmatch(r"(detect|navigate|explain)\.\w[\w.]*(=.*)?", line)
    ]
    wrong += [f"{name}: no such setting" for name in settings if name not in KEYS | GROUPS]
    assert not wrong


def test_example_settings_are_valid(tmp_path):
    blocks = [block for _, text in texts() for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)]
    assert blocks
    for block in blocks:
        path = tmp_path / "own.yaml"
        path.write_text(block)
        for name, (model, package) in CONFIGS.items():
            resolve(model, name, package, "tiny", path)


def leaves(nav: Any) -> Iterator[str]:
    """Yield the pages of a navigation tree of mkdocs.yml."""
    if isinstance(nav, str):
        yield nav
    else:
        for each in nav.values() if isinstance(nav, dict) else nav:
            yield from leaves(each)


NOT_KEPT = re.compile(
    r"\bprovisional\b|\bscripts?( and trial code)? (that|which) (is|are|was|were) not kept|\bearlier scripts?, which"
    r"|, not kept\b|\bby (a|an own|some) script\b|\bplugin that is not kept|\bare not kept;"
)
"""Wording of a figure that no command makes."""


def attributed_to_no_command(text: str) -> list[str]:
    """Phrases of a page that attribute a figure to a script that is not kept."""
    return [found.group() for found in NOT_KEPT.finditer(re.sub(r"\s+", " ", text))]


@pytest.mark.parametrize(
    "text",
    [
        "By a script that is\nnot kept, the median is 3.",
        "**These figures are provisional** until a kept command",
        "scripts that are not kept called the functions",
        "(a script that calls the same functions, not kept)",
    ],
)
def test_a_figure_without_a_command_is_recognised(text):
    assert attributed_to_no_command(text)
    assert not attributed_to_no_command("The script `scripts/results.py` is kept. Frames are not kept in memory.")


@pytest.mark.parametrize("folder", ["explanation", "how-to", "reference", "tutorials"])
def test_no_figure_of_a_current_page_rests_on_a_script_that_is_not_kept(folder):
    pages = [page for page in PAGES if page.parent.name == folder or folder in page.parent.parts]
    assert pages
    wrong = {page.name: attributed_to_no_command(page.read_text(encoding="utf-8")) for page in pages}
    assert {name: found for name, found in wrong.items() if found} == {}


def test_a_notebook_page_says_once_which_figures_have_no_command():
    for page in sorted((DOCS / "notebook").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        stated = text.count("*Figures without a kept command*: ")
        assert stated == bool(attributed_to_no_command(text)), page.name


def test_every_picture_is_shown():
    """A page without it leaves a file that every clone carries."""
    pages = [page.read_text(encoding="utf-8") for page in [*PAGES, DOCS.parent / "mkdocs.yml"]]
    pictures = [path for path in (DOCS / "pictures").rglob("*") if path.is_file()]
    unused = [path.name for path in pictures if not any(path.name in text for text in pages)]
    assert pictures and not unused, f"delete {', '.join(unused)}"


def test_every_record_is_named():
    """By a row of the results, a page, or code that reads it."""
    folders = ("benchmarks", "scripts", "tests", "train")
    code = [path.read_text(encoding="utf-8") for folder in folders for path in (TOP / folder).rglob("*.py")]
    named = "\n".join([*(page.read_text(encoding="utf-8") for page in PAGES), *code])
    rows = re.findall(r'^record = "([^"]+)"', (TOP / "results/headline.toml").read_text(encoding="utf-8"), re.MULTILINE)
    records = [path for path in (TOP / "results").iterdir() if path.suffix != ".toml"]
    unused = [path.name for path in records if path.stem not in rows and path.name not in named]
    assert records and not unused, f"delete {', '.join(unused)}"


def test_pictures_are_small():
    """In kilobytes, of 1024 bytes: JPEGs of quality 70, PNGs with few colours."""
    large = {path.name: path.stat().st_size // 1024 for path in (DOCS / "pictures").rglob("*.*")}
    assert {name: size for name, size in large.items() if size > 320} == {}


def test_every_page_is_in_the_navigation_once():
    nav = yaml.safe_load((TOP / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    listed = sorted(leaves(on_config(SimpleNamespace(nav=nav)).nav))
    pages = [path.relative_to(DOCS).with_suffix(".md").as_posix() for path in (*DOCS.rglob("*.md"), *NOTEBOOKS)]
    assert listed == sorted([*pages, *GENERATED])


def test_every_folder_of_the_packages_is_in_contributing():
    page = (TOP / "CONTRIBUTING.md").read_text(encoding="utf-8")
    folders = [path.parent.relative_to(TOP).as_posix() for path in TOP.glob("*/perilune_*/*/__init__.py")]
    assert len(folders) > 15
    assert [folder for folder in folders if f"| `{folder}` |" not in page] == []


def test_no_docstring_has_the_double_colon_of_another_markup():
    """Docstrings are Markdown, which shows both colons."""
    files = [path for house in ("shared", "render", "train") for path in (TOP / house).glob("perilune_*/**/*.py")]
    assert len(files) > 100
    wrong = [path.name for path in files if re.search(r"\w::$", path.read_text(encoding="utf-8"), re.MULTILINE)]
    assert not wrong


def test_targets_of_make_exist():
    known = set(re.findall(r"^([a-z-]+):", (TOP / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for page, text in texts():
        lines, inline = code(text)
        named = [found[1] for line in (*lines, *inline) if (found := re.match(r"(?:\$ |time )?make ([a-z-]+)", line))]
        assert set(named) <= known, page


def test_generated_pages_have_every_command_column_and_key():
    for program in PROGRAMS:
        page = GENERATED[f"reference/commands/{program}.md"]
        for name, command in COMMANDS.items():
            if name.startswith(program):
                section = page.split(f"## {name}\n")[1].split("\n## ")[0]
                assert all(option in section for p in command.params for option in p.opts if option.startswith("--"))
    columns = GENERATED["reference/columns.md"]
    for name, schema in TABLES.items():
        section = columns.split(f"## {name}\n")[1].split("\n## ")[0]
        reported = re.findall(r"^\| `(\w+)` \| ([^|]*) \| ([^|]*) \| ([^|]*) \|", section, re.MULTILINE)
        expected = [(f.name, f.metadata[b"unit"].decode(), f.metadata[b"meaning"].decode(), f.nullable) for f in schema]
        assert [(column, unit, meaning, "or null" in kind) for column, kind, unit, meaning in reported] == expected
    for name, (model, package) in CONFIGS.items():
        page = GENERATED[f"reference/configuration/{package.removeprefix('perilune_')}.md"]
        shown = annotated_yaml(name, resolve(model, name, package, "small"))
        assert set(re.findall(r"^ *(\w+): \S", shown, re.MULTILINE)) <= set(
            re.findall(r"^\| `(\w+)` ", page, re.MULTILINE)
        )


def test_every_source_of_terrain_and_light_is_in_the_table():
    table = (DOCS / "reference/sources.md").read_text(encoding="utf-8")
    folders = TOP / "render/perilune_render/terrain", TOP / "shared/perilune_shared/photometry.py"
    files = [path for each in folders for path in ([each] if each.is_file() else each.rglob("*.py"))]
    cited = {doi for path in files for doi in re.findall(r"doi (10\.[\w./()-]+)", path.read_text(encoding="utf-8"))}
    assert len(cited) >= 7 and {doi for doi in cited if doi.rstrip(").") not in table} == set()
