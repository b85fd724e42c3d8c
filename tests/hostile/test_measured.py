"""The measurement itself: memory, time, exit code and text of a command."""

import sys
import time

import pytest

from tests.hostile.measured import accepted, outcome, refused


def _large() -> None:
    block = b"x" * 300_000_000
    print(len(block))


def _refuses() -> None:
    print("error: file: field: got 1, expected 2", file=sys.stderr)
    sys.exit(2)


def _raises() -> None:
    raise ValueError("no line of ours")


def test_memory_and_text() -> None:
    ended = accepted("300 MB", _large, memory_mb=400)
    assert ended.memory_mb > 250 and "300000000" in ended.output
    with pytest.raises(AssertionError, match="MB"):
        accepted("300 MB", _large, memory_mb=100)


def test_refusals_are_one_line_with_code_2() -> None:
    assert refused("refused", _refuses, naming="expected 2").error.endswith("expected 2")
    with pytest.raises(AssertionError, match="exit code 1"):
        refused("traceback", _raises, naming="no line of ours")


def test_a_command_that_hangs_fails() -> None:
    with pytest.raises(AssertionError, match="still runs"):
        outcome("hangs", lambda: time.sleep(30), limit_s=0.5)
