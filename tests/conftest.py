"""A dataset rendered by the command line itself, shared by all tests that read one."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

# A busy machine is no reason to fail.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
# Scenes are grown anew by the tests, and the user's own cache is left alone.
_cache = tempfile.TemporaryDirectory(prefix="perilune-test-cache-")
os.environ["PERILUNE_CACHE"] = _cache.name


# A shell that starts the tests in the background lets them, and all that they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    """Folder with the `tiny` preset's datasets `detect` and `nav`. Read only: copy before a change."""
    folder = tmp_path_factory.mktemp("tiny")
    command = [
        str(Path(sys.executable).parent / "perilune-render"),
        "dataset",
        "--preset",
        "tiny",
        "--out",
        str(folder),
    ]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return folder


@pytest.fixture
def tiny_detect(tiny, tmp_path) -> Path:
    """A copy of the tiny detection dataset that a test may damage."""
    return Path(shutil.copytree(tiny / "detect", tmp_path / "detect"))
