"""Ctrl-C: delayed once, not twice, and not where it is ignored."""

import os
import signal
import subprocess
import sys
import time

import pytest

from perilune_shared.console.interrupts import ended_by_interrupt, interrupts_held

TWICE = """
import os, signal, time
from perilune_shared.console.interrupts import interrupts_held
with interrupts_held():
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
    print("went on")
"""

NATIVE = """
import hashlib, sys
from perilune_shared.console.command_line import run_command_line
from perilune_shared.console.interrupts import ended_by_interrupt
def command():
    with ended_by_interrupt(after_s=0.5, at_end=lambda: print("at end", flush=True)):
        print("begun", flush=True)
        hashlib.pbkdf2_hmac("sha256", b"", b"", int(sys.argv[1]))  # seconds in native code, without Python's lock
    print("went on")
run_command_line(command)
"""


def press():
    os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_waits_until_the_block_ends(capfd):
    before, done = signal.getsignal(signal.SIGINT), False
    with pytest.raises(KeyboardInterrupt), interrupts_held():
        press()
        done = True
    assert done and signal.getsignal(signal.SIGINT) is before and "Ctrl-C again" in capfd.readouterr().err


def test_a_second_ctrl_c_ends_the_process_at_once():
    done = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True)
    assert done.returncode == -signal.SIGINT and done.stdout == ""


def test_ctrl_c_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts_held():
            press()
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_what_a_block_has_started_is_ended_although_the_block_ends_at_once():
    """Ctrl-C may interrupt the code by which the block ends its processes."""
    ended = []
    with pytest.raises(KeyboardInterrupt), ended_by_interrupt(after_s=60, at_end=lambda: ended.append(True)):
        raise KeyboardInterrupt
    with ended_by_interrupt(after_s=60, at_end=lambda: ended.append(True)):
        pass
    assert ended == [True]


@pytest.mark.parametrize("ignored", [False, True], ids=["heard", "ignored"])
def test_ctrl_c_ends_a_command_that_is_in_native_code(ignored):
    before = signal.getsignal(signal.SIGINT)
    if ignored:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        n_rounds = 1_000_000 if ignored else 20_000_000
        command = [sys.executable, "-c", NATIVE, str(n_rounds)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)
    assert process.stdout.readline() == "begun\n"
    asked_s = time.monotonic()
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=60)
    if ignored:
        assert process.returncode == 0 and out == "went on\n" and error == ""
    else:
        assert time.monotonic() - asked_s < 3 and process.returncode == 130 and out == "at end\n"
        assert error == "stopped; finished files stay valid; run the same command again to resume\n"


PRINTED = """
import ctypes, time
from perilune_shared.console.command_line import run_command_line
code = b"import os, signal; os.kill(os.getpid(), signal.SIGINT); x = 1"
def command():
    ctypes.pythonapi.PyRun_SimpleString(code)  # calls PyErr_Print, as libraries do after a failed import
    time.sleep(60)
run_command_line(command, ended_after_s=0.2)
"""


def test_ctrl_c_in_an_import_from_c_prints_no_traceback():
    done = subprocess.run([sys.executable, "-c", PRINTED], capture_output=True, text=True, timeout=60)
    assert done.stderr == "stopped; finished files stay valid; run the same command again to resume\n"
    assert done.returncode == 130


LATE = """
import signal, sys, time
from perilune_shared.console.command_line import run_command_line
class Slow:
    def __del__(self, sleep=time.sleep, write=sys.stdout.write, flush=sys.stdout.flush):
        write("ending\\n"), flush(), sleep(1.0)
def command():
    sys.modules["slow"] = Slow()
    if sys.argv[1:]:
        sys.exit(0)
run_command_line(command)
"""


@pytest.mark.parametrize("exits", [[], ["by SystemExit, as typer does"]])
def test_ctrl_c_after_the_work_is_done_changes_nothing(exits):
    process = subprocess.Popen(
        [sys.executable, "-c", LATE, *exits], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ending\n"
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=60) == ("", "") and process.returncode == 0


def test_what_is_unfinished_is_removed_when_the_process_is_ended(tmp_path):
    """A block that Ctrl-C cannot interrupt is ended from outside, and leaves no folder, lock or temporary file."""
    code = f"""
import signal, sys, time
from pathlib import Path
from perilune_shared.console.interrupts import ended_by_interrupt
from perilune_shared.storage.files import new_folder, written_aside
folder = Path({str(tmp_path)!r})
with ended_by_interrupt(after_s=0.2), new_folder(folder / "out") as aside, written_aside(folder / "page.md") as page:
    (aside / "part").write_text("half")
    page.write_text("half")
    signal.signal(signal.SIGINT, lambda *_: None)  # as code that holds the interrupt
    print("begun", flush=True)
    time.sleep(60)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "begun\n"
    assert len(list(tmp_path.iterdir())) >= 3
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130 and errors.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
