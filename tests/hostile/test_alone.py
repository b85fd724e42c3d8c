"""Every command of the three programs, with the network trapped and with an empty home folder.

Nothing but this machine is connected to, and nothing is written into the home folder but perilune's own cache.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from perilune_render.provenance.caches import machine_code_folder
from tests.hostile.commands import USES, Use, make_inputs
from tests.test_command_lines import COMMANDS

BIN = Path(sys.executable).parent
TRAP = Path(__file__).parent / "trapped"
LONGEST_S = 300
STRACE = shutil.which("strace")
REMOTE = re.compile(r"(connect|sendto|sendmsg|sendmmsg)\(.*?sa_family=AF_INET6?.*")
LOCAL = re.compile(r'inet_addr\("(127\.|0\.0\.0\.0)|inet_pton\(AF_INET6, "(::1|::|::ffff:127\.[\d.]+)"')
OWN = (".cache/perilune",)
"""What may be in the home folder."""


class Place:
    """A folder in which commands run, with a home folder and a temporary folder of its own."""

    def __init__(self, folder: Path):
        self.folder, self.home, self.temporary = folder / "work", folder / "home", folder / "tmp"
        for each in (self.folder, self.home, self.temporary):
            each.mkdir()
        self.log = folder / "trapped.txt"
        make_inputs(self.folder)
        names = ("PATH", "LANG", "LD_LIBRARY_PATH", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        self.environment = {name: os.environ[name] for name in names if name in os.environ}
        self.environment |= {
            "HOME": str(self.home),
            "TMPDIR": str(self.temporary),
            # Compiled once by the other tests.
            "NUMBA_CACHE_DIR": str(machine_code_folder().parent),
            "PERILUNE_TRAP": str(self.log),
            "PYTHONPATH": os.pathsep.join([str(TRAP), os.environ.get("PYTHONPATH", "")]),
        }

    def written_at_home(self) -> list[str]:
        """Files in the home folder that are not perilune's own."""
        found = [str(path.relative_to(self.home)) for path in self.home.rglob("*") if not path.is_dir()]
        return sorted(path for path in found if not path.startswith(OWN))


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    return Place(tmp_path_factory.mktemp("alone"))


def run(place: Place, one: Use, before: tuple[str, ...] = ()) -> subprocess.CompletedProcess:
    """Run a command; the server is interrupted once it listens."""
    program, *words = one.words
    command = [*before, str(BIN / program), *words]
    if not one.command.endswith(" serve"):
        return subprocess.run(
            command, cwd=place.folder, env=place.environment, capture_output=True, text=True, timeout=LONGEST_S
        )
    process = subprocess.Popen(command, cwd=place.folder, env=place.environment, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    printed = ""
    for line in process.stderr:
        printed += line
        if "perilune_shared.client at" in line:
            break
    server = process.pid if not before else int(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text())
    os.kill(server, signal.SIGINT)
    printed += process.communicate(timeout=30)[1]
    return subprocess.CompletedProcess(command, process.returncode, "", printed)


def test_every_command_is_used():
    leaves = {name for name, command in COMMANDS if not getattr(command, "commands", None)}
    assert leaves == {one.command for one in USES}


@pytest.mark.parametrize("one", USES, ids=[f"{n:02d} {one.command}" for n, one in enumerate(USES)])
def test_a_command_connects_to_nothing_and_writes_nothing_at_home(place, one):
    trace = place.temporary.parent / "trace.txt"
    before = (STRACE, "-f", "-qq", "--seccomp-bpf", "-e", "trace=network", "-o", str(trace)) if STRACE else ()
    done = run(place, one, before)
    assert done.returncode == one.code, f"{done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"
    assert "Traceback" not in done.stderr, done.stderr[-3000:]
    if place.log.exists():
        trapped = place.log.read_text()
        place.log.unlink()
        pytest.fail(trapped[:2000])
    if STRACE:
        lines = trace.read_text(errors="replace").splitlines()
        assert lines, "strace has seen no process"
        assert [line for line in lines if REMOTE.search(line) and not LOCAL.search(line)] == []
    assert place.written_at_home() == []


def test_the_trap_catches(place):
    """What the tests above rely on: a connection is refused and recorded, also by a process of a process."""
    inner = "import socket; socket.create_connection(('192.0.2.1', 80), timeout=1)"
    code = f"import subprocess, sys; sys.exit(subprocess.run([sys.executable, '-c', {inner!r}]).returncode)"
    done = subprocess.run([sys.executable, "-c", code], env=place.environment, capture_output=True, text=True)
    assert done.returncode == 1 and "trapped: socket.getaddrinfo" in done.stderr
    assert "192.0.2.1" in place.log.read_text()
    place.log.unlink()
