"""A dataset rendered by the command line itself, shared by all tests that read one."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings

from tests.helpers.s3_server import new_bucket, s3_server

# Set by pytest-xdist in each of the processes of `make test`.
WORKER = "PYTEST_XDIST_WORKER" in os.environ
if WORKER:
    # One thread each, before numpy or torch is imported.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A busy machine is no reason to fail.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")
# Scenes are grown anew by the tests, once for all processes, and the user's own cache is left alone.
if not WORKER:
    _cache = tempfile.TemporaryDirectory(prefix="perilune-test-cache-")
    os.environ["PERILUNE_CACHE"] = _cache.name

LONGEST_FIRST = (
    "test_data_manifests.py",
    "test_regenerate.py",
    "test_processes.py",
    "test_develop.py",
    "test_renderer.py",
    "test_levels.py",
    "test_run.py",
    "test_deploy.py",
    "test_every_byte.py",
    "test_stream.py",
    "test_streamed.py",
    "test_population.py",
    "test_ray.py",
    "test_render.py",
    "test_hostile_rows.py",
    "test_facets.py",
    "test_transfer.py",
    "test_hostile_bombs.py",
    "test_card.py",
    "test_other_processor.py",
    "test_local.py",
    "test_chains.py",
    "test_evaluate.py",
    "test_rooms.py",
)
"""Files by the CPU time of their tests; handed out last, one of them would keep a process busy alone at the end.

Of the first two, only the second needs `tiny`: no process waits for another to render it.
"""

# No test cuts the power: what is written need not be on the disk. test_files.py counts the calls by its own means.
os.fsync = lambda descriptor: None

# A shell that starts the tests in the background lets them, and all that they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Several processes start with the longest files; one alone keeps the order of the files."""
    if WORKER:
        items.sort(key=lambda item: LONGEST_FIRST.index(item.path.name) if item.path.name in LONGEST_FIRST else 99)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    """Folder with the `tiny` preset's datasets `detect` and `nav`. Read only: copy before a change."""
    return _rendered(tmp_path_factory, "tiny", "dataset", "--preset", "tiny")


@pytest.fixture(scope="session")
def tiny_survey(tiny, tmp_path_factory) -> Path:
    """A survey of `tiny`'s scene for navigation, with coarse pixels. Read only."""
    return _rendered(tmp_path_factory, "tiny-survey", "survey", "--manifest", str(tiny / "nav"), "--pixel-m", "3")


def _rendered(tmp_path_factory, name: str, *arguments: str) -> Path:
    """The folder that a command of `perilune-render` makes, once for all processes of a run."""
    pytest.importorskip("perilune_render", reason="needs a rendered dataset")
    own = tmp_path_factory.getbasetemp()
    # The parent of a worker's folder is the whole run's. The second worker to come finds the dataset complete.
    folder = (own.parent if WORKER else own) / name
    program = str(Path(sys.executable).parent / "perilune-render")
    # In the command's own process, so that Blender is loaded once.
    command = [program, *arguments, "--out", str(folder), "--workers", "0"]
    with FileLock(f"{folder}.lock"):
        if not Path(f"{folder}.made").exists():
            subprocess.run(command, check=True, capture_output=True, text=True)
            Path(f"{folder}.made").touch()
    return folder


@pytest.fixture(scope="session")
def s3_environment() -> Iterator[dict[str, str]]:
    """The variables by which clients find an S3 server on this machine; also set in this process."""
    pytest.importorskip("s3fs")
    with s3_server() as environment, pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        yield environment


@pytest.fixture
def s3_bucket(s3_environment) -> str:
    """The address of an empty bucket, s3://name, on an S3 server on this machine."""
    return new_bucket()


@pytest.fixture
def no_credentials(monkeypatch, tmp_path) -> Iterator[None]:
    """No credentials for an object store in the environment, and none in the home folder."""
    import s3fs

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    s3fs.S3FileSystem.clear_instance_cache()
    yield
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def tiny_detect(tiny, tmp_path) -> Path:
    """A copy of the tiny detection dataset that a test may damage."""
    return Path(shutil.copytree(tiny / "detect", tmp_path / "detect"))
