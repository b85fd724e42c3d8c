"""Every command of the three programs, with the network trapped and with an empty home folder.

Nothing but this machine is connected to, and nothing is written into the home folder but perilune's own cache.
"""

import re
import shutil
import subprocess
import sys

import pytest

from tests.hostile.commands import USES
from tests.hostile.place import Place
from tests.test_command_lines import COMMANDS

STRACE = shutil.which("strace")
REMOTE = re.compile(r"(connect|sendto|sendmsg|sendmmsg)\(.*?sa_family=AF_INET6?.*")
LOCAL = re.compile(r'inet_addr\("(127\.|0\.0\.0\.0)|inet_pton\(AF_INET6, "(::1|::|::ffff:127\.[\d.]+)"')


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Place:
    return Place(tmp_path_factory.mktemp("alone"))


def test_every_command_is_used():
    leaves = {name for name, command in COMMANDS if not getattr(command, "commands", None)}
    assert leaves == {one.command for one in USES}


@pytest.mark.parametrize("one", USES, ids=[f"{n:02d} {one.command}" for n, one in enumerate(USES)])
def test_a_command_connects_to_nothing_and_writes_nothing_at_home(place, one):
    trace = place.temporary.parent / "trace.txt"
    before = (STRACE, "-f", "--seccomp-bpf", "-e", "trace=network", "-o", str(trace)) if STRACE else ()
    done = place.run(one, before)
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
