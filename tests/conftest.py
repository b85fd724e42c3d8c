"""Datasets rendered by the command line itself, shared by all tests that read one."""

import importlib.util
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests.helpers.rendered import QUICK, in_a_process, in_this_process, rendered_once
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

# No test cuts the power: what is written need not be on the disk. test_files.py counts the calls by its own means.
os.fsync = lambda descriptor: None

# A shell that starts the tests in the background lets them, and all that they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory) -> Path:
    """A folder that all processes of a run share."""
    own = tmp_path_factory.getbasetemp()
    # The parent of a worker's folder is the whole run's.
    return own.parent if WORKER else own


@pytest.fixture(scope="session")
def tiny(shared_folder) -> Path:
    """Folder with the `tiny` preset's datasets `detect` and `nav`, rendered by Blender. Read only.

    For tests whose subject is what Blender renders, which are skipped without it; the others use `quick`.
    """
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("Blender's module is not installed")
    return rendered_once(shared_folder / "tiny", in_a_process, "dataset", "--preset", "tiny")


@pytest.fixture(scope="session")
def quick(shared_folder) -> Path:
    """Folder with datasets of the scenes and poses of `tiny`, rendered without Blender on coarser ground. Read only."""
    return rendered_once(shared_folder / "quick", in_this_process, "dataset", "--preset", "tiny", *QUICK)


@pytest.fixture(scope="session")
def quick_survey(quick, shared_folder) -> Path:
    """A survey of the scene of `quick` for navigation, with coarse pixels. Read only."""
    arguments = ("survey", "--manifest", str(quick / "nav"), "--pixel-m", "3")
    return rendered_once(shared_folder / "quick-survey", in_this_process, *arguments)


@pytest.fixture
def quick_detect(quick, tmp_path) -> Path:
    """A copy of the detection dataset of `quick` that a test may damage."""
    return Path(shutil.copytree(quick / "detect", tmp_path / "detect"))


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
