"""Every command with a new folder refuses one that is not empty, and replaces it with `--overwrite`."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

import perilune_render.cli.main
import perilune_shared.cli.main
import perilune_train.cli.main
from tests.helpers import in_process
from tests.hostile.commands import USES, Use, make_inputs, use
from tests.test_command_lines import COMMANDS

MAINS: dict[str, Callable[[], None]] = {
    "perilune-manifest": perilune_shared.cli.main.main,
    "perilune-render": perilune_render.cli.main.main,
    "perilune-train": perilune_train.cli.main.main,
}
RESUMED = {
    "perilune-render dataset", "perilune-render develop", "perilune-render survey", "perilune-render counterfactual",
    "perilune-render frames", "perilune-render detectability",
}  # fmt: skip
"""The same command resumes, or leaves a finished dataset unchanged."""
RUNS = {
    "perilune-train detect train", "perilune-train navigate train", "perilune-train explain", "perilune-train causal",
}  # fmt: skip
"""Here --out holds all runs; `--overwrite` replaces one."""
OWN_FILES = {
    "perilune-render regenerate", "perilune-render preview", "perilune-render ground", "perilune-render spice",
    "perilune-manifest card", "perilune-train detect evaluate", "perilune-train detect compare",
    "perilune-train detect weights", "perilune-train detect benchmark", "perilune-train navigate evaluate",
    "perilune-train navigate compare", "perilune-train navigate benchmark", "perilune-train report",
}  # fmt: skip
"""The files that the command names are written again; others stay."""
DEPENDS_ON_TIMING = "detector-int8.onnx"
"""Kept only if int8 is faster than floating point when `detect deploy` measures it."""
MORE = tuple(
    use("perilune-manifest export", f"data/nav --format {name} --out {name}")
    for name in ("yolo", "tum", "kitti", "mcap")
)
ALL = (*USES, *MORE)


def test_every_command_with_an_output_is_of_one_kind():
    with_output, replacing = set(), set()
    for name, command in COMMANDS:
        options = {option for parameter in command.params for option in parameter.opts}
        with_output |= {name} if "--out" in options else set()
        replacing |= {name} if "--overwrite" in options else set()
    assert replacing & (RESUMED | OWN_FILES) == set() and replacing >= RUNS
    assert with_output == RESUMED | OWN_FILES | replacing
    assert {each.command for each in USES} >= replacing


def run(each: Use, *more: str):
    program, *words = each.words
    return in_process.call(MAINS[program], *words, *more)


def content_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder, before = tmp_path_factory.mktemp("overwritten"), Path.cwd()
    make_inputs(folder)
    os.chdir(folder)
    yield folder
    os.chdir(before)


@pytest.fixture(scope="module")
def used():
    """Numbers of the uses that this process has run: a use reads what earlier ones wrote, in any process."""
    return set()


@pytest.mark.parametrize("number", range(len(ALL)), ids=[f"{n:02d} {each.command}" for n, each in enumerate(ALL)])
def test_a_second_time(place, used, number):
    replaced = {name for name, _ in COMMANDS} - RESUMED - RUNS - OWN_FILES
    each = ALL[number]
    if each.code == 130:
        pytest.skip("the server writes nothing")
    for earlier in range(number):
        if earlier not in used and ALL[earlier].code == 0:
            done = run(ALL[earlier])
            assert done.returncode == 0, done.stderr[-2000:]
            used.add(earlier)
    used.add(number)
    done = run(each)
    assert done.returncode == each.code, done.stderr[-2000:]
    if each.code or "--out" not in each.arguments or each.command not in replaced:
        return
    out = place / each.arguments[each.arguments.index("--out") + 1]
    (out / "stale.txt").write_text("of the first time")
    before = content_of(out)
    refused = run(each)
    (line,) = refused.stderr.strip().splitlines()
    assert refused.returncode == 2 and line.endswith("expected a new or empty folder; --overwrite replaces it")
    assert content_of(out) == before
    done = run(each, "--overwrite")
    assert done.returncode == 0, done.stderr[-2000:]
    assert content_of(out).keys() - {DEPENDS_ON_TIMING} == before.keys() - {DEPENDS_ON_TIMING, "stale.txt"}
    assert "Traceback" not in done.stderr and ".new" not in done.stderr + done.stdout
    assert [path.name for path in place.glob(f".{out.name}.*")] == []
