"""Every command explains itself, and none loads a library that it does not need for that."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator

import click
import pytest
import typer
from typer.testing import CliRunner

import perilune_render.cli.main
import perilune_shared
import perilune_shared.cli.main
import perilune_train.cli.main
from perilune_shared.console.command_line import run_command_line
from perilune_shared.errors import UserError
from tests.helpers import in_process

PROGRAMS = {
    "perilune-manifest": perilune_shared.cli.main.app,
    "perilune-render": perilune_render.cli.main.app,
    "perilune-train": perilune_train.cli.main.app,
}
HEAVY = {"pandas", "pyarrow", "numpy", "scipy", "matplotlib", "PIL", "cv2", "numba", "torch", "lightning", "bpy"}


def commands(name: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    """A command and all its subcommands, each with what a user types, without former names."""
    yield name, command
    for sub, found in getattr(command, "commands", {}).items():
        if not found.hidden:
            yield from commands(f"{name} {sub}", found)


COMMANDS = [pair for name, app in PROGRAMS.items() for pair in commands(name, typer.main.get_command(app))]


def test_there_are_commands():
    assert len(COMMANDS) > 25


@pytest.mark.parametrize(("typed", "command"), COMMANDS, ids=[typed for typed, _ in COMMANDS])
def test_every_command_explains_itself(typed, command):
    program, *words = typed.split()
    shown = CliRunner().invoke(PROGRAMS[program], [*words, "--help"], env={"COLUMNS": "200", "NO_COLOR": "1"})
    assert shown.exit_code == 0 and shown.exception is None
    assert "Usage:" in shown.output and "Traceback" not in shown.output
    summary = (command.help or "").strip().split("\n\n")[0]
    assert re.fullmatch(r"[A-Z`].{8,118}\.", summary), (
        f"one line of at most 120 characters, with a full stop: {summary}"
    )
    for parameter in command.params:
        if parameter.name not in ("help", "install_completion", "show_completion"):
            assert getattr(parameter, "help", None), f"{parameter.name} has no help"


def loaded(code: str) -> set[str]:
    """Top-level names of the modules that a new interpreter has loaded after `code`."""
    script = f"{code}\nimport json, sys\nprint(json.dumps(sorted({{name.split('.')[0] for name in sys.modules}})))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_the_package_loads_no_library():
    assert not loaded("import perilune_shared") & {"rich", "typer", "pydantic", *HEAVY}


def test_a_dataset_opens_without_a_command_line():
    """Also the check that `loaded` sees what is loaded."""
    found = loaded("import perilune_shared as ps; ps.open_dataset")
    assert {"pandas", "pyarrow"} <= found and not found & {"rich", "typer", "matplotlib", "torch"}


@pytest.mark.parametrize("module", ["perilune_shared.cli.main", "perilune_render.cli.main", "perilune_train.cli.main"])
def test_a_command_line_starts_without_heavy_libraries(module):
    assert not loaded(f"import {module}") & HEAVY


@pytest.mark.parametrize(
    ("typed", "renamed"),
    [
        ("perilune-render export", "ground"),
        ("perilune-train detect export", "deploy"),
        ("perilune-train navigate export", "deploy"),
        ("perilune-train navigate unpack", "descent"),
    ],
)
def test_a_former_name_takes_the_same_options_and_names_the_new_one(typed, renamed, tmp_path):
    program, *above, old = typed.split()

    def run(name: str, *words: object):
        shown = CliRunner().invoke(PROGRAMS[program], [*above, name, *map(str, words)], env={"COLUMNS": "200"})
        return shown, " ".join(shown.stdout.partition("[OPTIONS]")[2].split())

    listed = dict(commands(program, typer.main.get_command(PROGRAMS[program])))
    assert " ".join([program, *above, renamed]) in listed and typed not in listed
    assert run(old, "--help")[1] == run(renamed, "--help")[1] != ""
    words = {"ground": ("--out", tmp_path / "x.none"), "descent": ("--dataset", tmp_path, "--trajectory", "none")}
    words["deploy"] = ("--out", tmp_path / "new", "--run", tmp_path)
    (before, _), (after, _) = run(old, *words[renamed]), run(renamed, *words[renamed])
    assert isinstance(before.exception, UserError) and str(before.exception) == str(after.exception)
    assert before.stderr == f"{old}: renamed to {renamed}\n" and after.stderr == ""


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_tells_its_version_and_short_help(program):
    def printed(*words: str) -> str:
        shown = CliRunner().invoke(PROGRAMS[program], words, prog_name=program)
        assert shown.exit_code == 0 and shown.exception is None
        return shown.output

    assert printed("--version") == f"{program} {perilune_shared.__version__}\n"
    first = next(iter(typer.main.get_command(PROGRAMS[program]).commands))
    assert "Usage:" in printed("-h") and "Usage:" in printed(first, "-h")


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_shell_completes_commands(program):
    variable = f"_{program.upper().replace('-', '_')}_COMPLETE"
    line = {variable: "complete_bash", "COMP_WORDS": f"{program} con", "COMP_CWORD": "1"}
    line["COMP_WORDS"] = f"{program} val" if program == "perilune-manifest" else line["COMP_WORDS"]
    shown = CliRunner().invoke(PROGRAMS[program], [], prog_name=program, env=line)
    assert shown.output.split() == ["validate" if program == "perilune-manifest" else "config"]


def test_commands_about_one_dataset_share_one_kind_by_default():
    kinds = {
        name.split()[1]: (parameter.default, parameter.help)
        for name, command in COMMANDS
        for parameter in command.params
        if name.startswith("perilune-render ") and parameter.name == "kind"
    }
    one = kinds["plan"]
    assert one[0] == "detect" and kinds["preview"] == kinds["ground"] == one
    # `dataset` makes both datasets of a preset. Poses that a user or a client gives are a path, as of navigation.
    others = {name: kind[0] for name, kind in kinds.items() if kind != one}
    assert others == {"dataset": "both", "frames": "nav", "serve": "nav"}


MISTAKES = [
    ("perilune-manifest", "validate x --mst 3", "error: no such option --mst; did you mean --most?"),
    ("perilune-manifest", "validate x --most 0", "error: --most: got 0, expected at least 1"),
    ("perilune-manifest", "validate x --most=3.5", "error: --most: got 3.5, expected an integer"),
    ("perilune-manifest", "validate x --most", "error: --most: got nothing, expected a value"),
    ("perilune-manifest", "validate x --help=1", "error: --help: got a value, expected none"),
    (
        "perilune-manifest",
        "validate",
        "error: dataset: got nothing, expected a value; see `perilune-manifest validate --help`",
    ),
    ("perilune-manifest", "validate x y z", "error: validate: got y z, expected no further argument"),
    (
        "perilune-manifest",
        "export x --format foo",
        "error: --format: got foo, expected one of coco, yolo, tum, kitti, croissant, huggingface, mcap, rerun",
    ),
    ("perilune-manifest", "-x", "error: no such option -x; see `perilune-manifest --help`"),
    ("perilune-manifest", "valdate x", "error: no such command valdate; did you mean validate?"),
    ("perilune-render", "nothing", "error: no such command nothing; see `perilune-render --help`"),
    (
        "perilune-render",
        "develop --dataset x",
        "error: --out: got nothing, expected a value; see `perilune-render develop --help`",
    ),
    ("perilune-train", "detect --x", "error: no such option --x; see `perilune-train detect --help`"),
    ("perilune-train", "detect trian", "error: no such command trian; did you mean train?"),
    (
        "perilune-train",
        "explain --preset",
        "error: --preset: got nothing, expected a value",
    ),
]


@pytest.mark.parametrize(
    ("program", "words", "line"), MISTAKES, ids=[f"{mistake[0]} {mistake[1]}" for mistake in MISTAKES]
)
def test_a_wrong_option_prints_one_line(program, words, line, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    ended = in_process.call(lambda: run_command_line(PROGRAMS[program]), *words.split(), program=program)
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", line + "\n")


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_without_a_command_prints_its_help_once(program):
    ended = in_process.call(lambda: run_command_line(PROGRAMS[program]), program=program)
    # The exit code depends on Typer's version.
    assert ended.stderr == "" and ended.stdout.count("Usage:") == 1
