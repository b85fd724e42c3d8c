"""Ctrl-C: delayed once, not twice, and not where it is ignored."""

import os
import signal
import subprocess
import sys

import pytest

from perilune_shared.interrupts import interrupts_held

TWICE = """
import os, signal, time
from perilune_shared.interrupts import interrupts_held
with interrupts_held():
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
    print("went on")
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
