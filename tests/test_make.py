"""Values given to make reach the commands as one argument each, whatever they hold."""

import itertools
import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
AWKWARD = 'a dir/it\'s "here" ; `x` (1) *.yaml'


def make(*arguments: str, check: bool = True) -> subprocess.CompletedProcess:
    """Run make in the repository without what an outer make hands down."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    return subprocess.run(["make", "-C", ROOT, *arguments], capture_output=True, text=True, env=own, check=check)


def words(target: str, program: str, *variables: str) -> list[str]:
    """Arguments of the command that make would run, as the shell splits them."""
    done = make("-n", target, *variables)
    (line,) = (line for line in done.stdout.replace("\\\n", " ").splitlines() if f"/{program} " in line)
    return shlex.split(line)


def values(arguments: list[str], option: str) -> list[str]:
    return [value for name, value in itertools.pairwise(arguments) if name == option]


def test_settings_are_shell_words():
    settings = [
        "dataset.seed=7",
        'dataset.terrain.dem=it\'s "a" $x',
        "dataset.detect.sun.elevation_deg={low: 0, high: 1}",
    ]
    given = shlex.join(settings).replace("$", "$$")
    assert values(words("dataset", "perilune-render", f"SET={given}"), "--set") == settings
    plain = "SET=dataset.seed=7 detect.strides=[4,8,16]"
    assert values(words("dataset", "perilune-render", plain), "--set") == ["dataset.seed=7", "detect.strides=[4,8,16]"]
    assert values(words("dataset", "perilune-render"), "--set") == []


def test_the_example_of_make_help_works():
    example = next(line for line in make("help").stdout.splitlines() if line.startswith("  make dataset SET="))
    found = values(words("dataset", "perilune-render", shlex.split(example)[2]), "--set")
    assert found == ["dataset.seed=7", "dataset.detect.sun.elevation_deg={low: 5, high: 9}"]
    assert example.strip() in (ROOT / "docs/how-to/settings.md").read_text()


def test_paths_may_hold_anything():
    variables = [f"{name}={AWKWARD}" for name in ("CONFIG", "DEM", "CATALOGUE", "OUT")]
    arguments = words("dataset", "perilune-render", *variables)
    for option in ("--config", "--dem", "--catalogue", "--out"):
        assert values(arguments, option) == [AWKWARD]
    arguments = words("train-detect-baseline", "perilune-train", "OUT=my runs", f"CONFIG={AWKWARD}", "NAME=a")
    assert values(arguments, "--out") == ["my runs"] and values(arguments, "--config") == [AWKWARD]


@pytest.mark.parametrize("given", ["detect.augment.scale={low: 0}", "detect.seed='7", "seed"])
def test_settings_that_are_no_words_are_told(given):
    done = make("-n", "dataset", f"SET={given}", check=False)
    assert done.returncode == 2 and "SET: got" in done.stderr and "expected shell words" in done.stderr
    assert "perilune-render" not in done.stdout


def test_the_image_installs_from_what_make_setup_reads():
    """The Dockerfile copies these files before the rest, so that a change of the code installs nothing again."""
    read = re.search(r"^\$\(VENV\)/\.ready: (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert read is not None
    before_setup, _ = (ROOT / "Dockerfile").read_text().split("RUN make setup")
    for name in ["requirements-dev.txt", *read.group(1).split()]:
        assert re.search(rf"^COPY .*\b{re.escape(name)}\b", before_setup, re.MULTILINE), name


def test_train_without_a_task_says_what_to_type():
    done = make("train", check=False)
    assert done.returncode == 2 and "make train-detect" in done.stderr and "make train-nav" in done.stderr


def test_an_environment_of_another_python_is_named(tmp_path):
    """As the README's first command makes it with Python 3.12 or 3.10."""
    python = tmp_path / ".venv/bin/python"
    python.parent.mkdir(parents=True)
    python.write_text('#!/bin/sh\n[ "$1" = -V ] && echo Python 3.12.1 && exit 0\nexit 1\n')
    python.chmod(0o755)
    done = make("setup", f"VENV={python.parents[1]}", "PYTHON=sh", check=False)
    assert done.returncode == 2
    assert "got Python 3.12.1, expected Python 3.11" in done.stderr
    cure = f"mv {python.parents[1]} {python.parents[1]}-old  and then  make setup PYTHON=python3.11"
    assert cure in done.stderr and len(done.stderr.splitlines()) == 2  # make adds a line of its own


def test_help_shows_few_targets_in_groups_and_bench_shows_the_rest():
    lines = make("help").stdout.splitlines()
    targets = [line.split()[0] for line in lines if re.match(r"  [a-z]", line) and not line.startswith("  make ")]
    groups = [line for line in lines if re.fullmatch(r"[A-Z][a-z' ]+", line)]
    assert 20 <= len(targets) <= 30 and len(groups) >= 4 and "train-detect" in targets
    assert not [name for name in targets if name.startswith("bench-")]
    names = [line.split()[0] for line in make("bench").stdout.splitlines() if line.startswith("  ")]
    defined = re.findall(r"^bench-([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert sorted(names) == sorted(defined) and len(names) > 30


@pytest.mark.parametrize(("name", "module"), [("labels", "benchmarks.scene.labels"), ("nac", "benchmarks.nac.compare")])
def test_a_benchmark_by_its_name_and_by_its_former_target(name, module):
    former = {"labels": "bench-labels", "nac": "compare-nac"}[name]
    new, old = words_of_module(module, "bench", f"NAME={name}"), words_of_module(module, former)
    assert new == old and module in new


def words_of_module(module: str, *arguments: str) -> list[str]:
    (line,) = (line for line in make("-n", *arguments).stdout.splitlines() if f"-m {module}" in line)
    return shlex.split(line)


def test_a_benchmark_uses_the_runs_of_the_preset():
    assert "runs/detect/tiny" in words_of_module("benchmarks.train.contrast", "bench", "NAME=contrast", "PRESET=tiny")


@pytest.mark.parametrize("name", ["nothing", "it's", "."])
def test_an_unknown_benchmark_is_told(name):
    done = make("bench", f"NAME={name}", check=False)
    assert done.returncode == 2 and f"NAME: got {name}, expected a name that make bench lists" in done.stderr


@pytest.mark.parametrize("target", ["navigate", "navigate-monte-carlo"])
def test_finished_results_stay_unless_they_are_to_be_replaced(target):
    assert "--overwrite" not in make("-n", target).stdout
    assert "--overwrite" in make("-n", target, "OVERWRITE=1").stdout
