"""Usable cores, variables of threads, and the work of other processes."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from perilune_shared import cgroups, threads
from perilune_shared.errors import UserError

PROGRAMS = ("perilune_shared.cli.main", "perilune_render.cli.main", "perilune_train.cli.main")


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine of 64 cores whose files on cgroups a test writes; returns the folder of the cgroups."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(64)))
    monkeypatch.setattr(cgroups, "_ROOT", tmp_path / "cgroup")
    monkeypatch.setattr(cgroups, "_MEMBERSHIP", tmp_path / "own")
    (tmp_path / "cgroup").mkdir()
    return tmp_path / "cgroup"


@pytest.fixture
def environment(monkeypatch):
    """The environment without variables of threads; restored after the test."""
    for name in threads._PATTERNS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(threads, "_set_by_program", set())
    with monkeypatch.context():
        before = dict(os.environ)
        yield os.environ
        os.environ.clear()
        os.environ.update(before)


def unified(machine: Path, path: str, limit: str) -> None:
    folder = machine / path
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cpu.max").write_text(f"{limit}\n")


def legacy(machine: Path, path: str, quota: object, period: object = 100000) -> None:
    folder = machine / path
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cpu.cfs_quota_us").write_text(f"{quota}\n")
    (folder / "cpu.cfs_period_us").write_text(f"{period}\n")


def own(machine: Path, *lines: str) -> None:
    (machine.parent / "own").write_text("\n".join(lines) + "\n")


def test_without_cgroups_the_affinity_counts(machine):
    assert threads.usable_cores() == 64
    assert cgroups.processor_quota() is None


@pytest.mark.parametrize(("limit", "cores"), [("200000 100000", 2), ("150000 100000", 2), ("50000 100000", 1)])
def test_a_quota_of_a_container(machine, limit, cores):
    own(machine, "0::/")
    unified(machine, ".", limit)
    assert threads.usable_cores() == cores


def test_the_least_quota_of_nested_groups_counts(machine):
    own(machine, "0::/slurm/job/step")
    unified(machine, "slurm", "300000 100000")
    unified(machine, "slurm/job", "max 100000")
    unified(machine, "slurm/job/step", "900000 100000")
    assert threads.usable_cores() == 3


def test_quotas_of_version_1(machine):
    own(machine, "5:memory:/a", "4:cpu,cpuacct:/a/b", "1:name=systemd:/")
    legacy(machine, "cpu,cpuacct/a", 400000)
    legacy(machine, "cpu,cpuacct/a/b", -1)
    assert threads.usable_cores() == 4


def test_a_container_that_sees_only_its_own_group(machine):
    own(machine, "3:cpu:/docker/0123", "0::/docker/0123")
    legacy(machine, "cpu", 250000)
    assert threads.usable_cores() == 3


@pytest.mark.parametrize("limit", ["", "max", "a b", "1 0", "-5 100000", "100000", "\xff\xfe"])
def test_a_quota_that_cannot_be_read_is_no_limit(machine, limit):
    own(machine, "0::/", "garbage", "::", "7:cpu")
    unified(machine, ".", limit)
    assert threads.usable_cores() == 64


def test_a_quota_above_the_cores_is_no_limit(machine):
    own(machine, "0::/")
    unified(machine, ".", "9900000 100000")
    assert threads.usable_cores() == 64


@pytest.mark.parametrize(
    ("names", "unlimited"),
    [
        (("memory.max", "memory.current"), "max"),
        (("memory.limit_in_bytes", "memory.usage_in_bytes"), str(2**63 - 4096)),
    ],
)
def test_memory_left_in_nested_groups(machine, names, unlimited):
    own(machine, "4:memory:/job/step", "0::/job/step")
    assert cgroups.memory_left_bytes() is None
    root = machine if names[0] == "memory.max" else machine / "memory"
    for path, limit, used in ((".", unlimited, 9000), ("job", "8000", 3000), ("job/step", "7000", 1000)):
        (root / path).mkdir(parents=True, exist_ok=True)
        (root / path / names[0]).write_text(f"{limit}\n")
        (root / path / names[1]).write_text(f"{used}\n")
    assert cgroups.memory_left_bytes() == 5000
    (root / "job" / names[0]).write_text("unreadable\n")
    assert cgroups.memory_left_bytes() == 6000


def test_a_program_spins_less_on_a_crowded_machine(machine, environment, monkeypatch):
    monkeypatch.setattr(os, "getloadavg", lambda: (64.5, 0.0, 0.0))
    threads.set_up_program()
    assert environment["GOMP_SPINCOUNT"] == str(threads.CROWDED_SPIN_COUNT)


def test_a_program_limits_spinning(machine, environment):
    threads.set_up_program()
    assert environment["GOMP_SPINCOUNT"] == str(threads.SPIN_COUNT)
    assert not any(name in environment for name in threads.NUMBERS_OF_THREADS)
    assert threads.described_settings().endswith(f"cores; GOMP_SPINCOUNT={threads.SPIN_COUNT}")


def test_a_program_in_a_container_has_as_many_threads_as_cores(machine, environment):
    own(machine, "0::/")
    unified(machine, ".", "200000 100000")
    environment["OPENBLAS_NUM_THREADS"] = "7"
    threads.set_up_program()
    assert environment["OMP_NUM_THREADS"] == environment["MKL_NUM_THREADS"] == "2"
    assert environment["OPENBLAS_NUM_THREADS"] == "7"
    assert threads.chosen_by_user("OPENBLAS_NUM_THREADS")
    assert not threads.chosen_by_user("OMP_NUM_THREADS")
    described = threads.described_settings()
    assert "quota of 2 cores" in described
    assert "OPENBLAS_NUM_THREADS=7 (from the environment)" in described


@pytest.mark.parametrize(("name", "value"), [("GOMP_SPINCOUNT", "7"), ("OMP_WAIT_POLICY", "active")])
def test_settings_of_the_user_win(machine, environment, name, value):
    environment[name] = value
    threads.set_up_program()
    assert environment[name] == value
    assert sum(other in environment for other in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("OMP_NUM_THREADS", "abc"),
        ("OMP_NUM_THREADS", "0"),
        ("OMP_NUM_THREADS", "-4"),
        ("OMP_NUM_THREADS", "2.5"),
        ("OMP_NUM_THREADS", "4,0"),
        ("OPENBLAS_NUM_THREADS", "1000000"),
        ("NUMBA_NUM_THREADS", "many"),
        ("OPENCV_FOR_THREADS_NUM", "-1"),
        ("GOMP_SPINCOUNT", "long"),
        ("OMP_WAIT_POLICY", "sometimes"),
    ],
)
def test_nonsensical_settings_are_refused(environment, name, value):
    environment[name] = value
    with pytest.raises(UserError, match=f"environment: {name}: got {value}, expected"):
        threads.set_up_program()


@pytest.mark.parametrize("value", ["1", "4,2", "64", ""])
def test_settings_that_the_libraries_read_are_accepted(environment, value):
    environment["OMP_NUM_THREADS"] = value
    threads.set_up_program()
    assert environment["OMP_NUM_THREADS"] == value


@pytest.mark.parametrize("module", PROGRAMS)
def test_a_program_sets_its_threads_before_it_loads_a_numerical_library(module):
    pytest.importorskip(module.split(".")[0])
    code = f"""
import sys
import {module} as program
loaded = {{"numpy", "torch", "cv2", "numba", "scipy"}} & set(sys.modules)
assert not loaded, loaded
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_nonsensical_setting_ends_a_command_with_one_line():
    program = [sys.executable, "-m", "perilune_shared.cli.main", "stats", "nowhere"]
    code = "from perilune_shared.cli.main import main; main()"
    ended = subprocess.run(
        [sys.executable, "-c", code, *program[3:]],
        env={**os.environ, "OMP_NUM_THREADS": "x"},
        capture_output=True,
        text=True,
    )
    expected = "error: environment: OMP_NUM_THREADS: got x, expected a number of threads from 1 to 1024\n"
    assert (ended.returncode, ended.stderr) == (2, expected)


def test_a_library_warns_once_of_a_crowded_machine(environment, monkeypatch):
    monkeypatch.setattr(threads, "_warned", False)
    monkeypatch.setattr(os, "getloadavg", lambda: (1000.0, 0.0, 0.0))
    with pytest.warns(RuntimeWarning, match="GOMP_SPINCOUNT"):
        threads.warn_if_crowded()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        threads.warn_if_crowded()
    assert "GOMP_SPINCOUNT" not in environment


def test_a_program_is_not_warned(environment, monkeypatch):
    monkeypatch.setattr(threads, "_warned", False)
    monkeypatch.setattr(os, "getloadavg", lambda: (1000.0, 0.0, 0.0))
    threads.set_up_program()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        threads.warn_if_crowded()


def test_the_work_of_others_excludes_our_own(tmp_path, monkeypatch):
    """Of two cores that were busy for 10 s each, this process used 4 s; a third is not among those it may use."""
    ticks = os.sysconf("SC_CLK_TCK")
    statistics = tmp_path / "stat"

    def at(busy_s: float, idle_s: float) -> None:
        line = f"{int(busy_s * ticks)} 0 0 {int(idle_s * ticks)} 0 0 0 0 0 0\n"
        statistics.write_text("cpu  1 1 1 1\n" + "".join(f"cpu{core} {line}" for core in range(3)) + "intr 5\n")

    used = [0.0]
    monkeypatch.setattr(threads, "_STATISTICS", statistics)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 2})
    monkeypatch.setattr(os, "times", lambda: os.times_result((used[0], 0.0, 0.0, 0.0, 0.0)))
    at(0, 0)
    others = threads.OtherWork()
    at(10, 10)
    used[0] = 4.0
    assert others.cores() == pytest.approx((20 - 4) / 20)
    at(10, 30)
    assert others.cores() == 0.0
    statistics.unlink()
    assert others.cores() == 0.0
