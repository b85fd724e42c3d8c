"""Full and read-only disks in the commands that write: one line, exit code 2, and no output that looks whole."""

import ctypes
import os
import resource
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from perilune_render.cli.main import main as render
from perilune_shared.cli.main import main as manifest
from perilune_train.cli.main import main as train
from perilune_train.detect import evaluate_runs as _compare  # noqa: F401  (loaded before the commands are forked)
from perilune_train.detect.deploy import export as _export  # noqa: F401
from perilune_train.detect.images import predict as _predict  # noqa: F401
from tests.helpers.drawn_dataset import build_dataset
from tests.hostile.measured import Outcome, accepted, outcome
from tests.hostile.test_text import SHIPPED, run_folder

FULL_AT_BYTES = (0, 3000, 60_000)
"""Sizes at which files cannot grow: nothing is written, a small file is, most files are."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the inputs of all commands: a dataset, a second one, a run, an image."""
    folder = tmp_path_factory.mktemp("inputs")
    build_dataset(folder / "data", "detect", splits={"train": 1, "test": 1}, n_frames=2, side_px=64, craters=60)
    build_dataset(folder / "more", "detect", splits={"train": 1}, n_frames=2, side_px=64, craters=60, seed=8)
    grey = np.random.default_rng(0).normal(128, 30, (400, 400)).clip(0, 255).astype(np.uint8)
    (folder / "image.png").write_bytes(cv2.imencode(".png", grey)[1].tobytes())
    run_folder(folder, "evaluation", "a")
    shutil.copytree(SHIPPED / "crater-detector", folder / "run")
    return folder


# Blender started in a process that was forked from the tests' may wait without an end.
_HEIGHTFIELD = ("--set", "dataset.render.engine=heightfield")
COMMANDS: dict[str, tuple[Callable[[], object], list[str]]] = {
    "merge": (manifest, ["merge", "data", "more", "--out", "OUT"]),
    "subset": (manifest, ["subset", "data", "--out", "OUT", "--frames", "2"]),
    "split": (manifest, ["split", "data", "--out", "OUT", "--by", "frame"]),
    "pack": (manifest, ["pack", "data", "--out", "OUT"]),
    "coco": (manifest, ["export", "data", "--format", "coco", "--out", "OUT"]),
    "yolo": (manifest, ["export", "data", "--format", "yolo", "--out", "OUT"]),
    "hugging face": (manifest, ["export", "data", "--format", "huggingface", "--out", "OUT"]),
    "mcap": (manifest, ["export", "data", "--format", "mcap", "--out", "OUT"]),
    "predict": (train, ["detect", "predict", "image.png", "--run", "run", "--out", "OUT", "--threshold", "1e-6"]),
    "compare": (train, ["detect", "compare", "evaluation", "--out", "OUT"]),
    "export of a detector": (train, ["detect", "deploy", "--run", "run", "--out", "OUT", "--formats", "onnx"]),
    "preview": (render, ["preview", "--preset", "tiny", *_HEIGHTFIELD, "--out", "OUT.png"]),
    "plan": (render, ["plan", "--preset", "tiny", "--kind", "detect", "--out", "OUT"]),
    "ground": (render, ["ground", "--preset", "tiny", "--out", "OUT.ply"]),
}
"""Commands by name; OUT is their output."""


def full(main: Callable[[], object], most_bytes: int) -> Callable[[], object]:
    """The entry point on a disk where no file grows beyond `most_bytes`."""

    def limited() -> object:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
        return main()

    return limited


def unprivileged(main: Callable[[], object]) -> Callable[[], object]:
    """The entry point without root's right to write anywhere."""

    def limited() -> object:
        version, of_this_process = 0x20080522, 0
        header, none = (ctypes.c_uint32 * 2)(version, of_this_process), (ctypes.c_uint32 * 6)()
        assert ctypes.CDLL(None, use_errno=True).capset(header, none) == 0, os.strerror(ctypes.get_errno())
        return main()

    return limited


def check(ended: Outcome) -> None:
    """One line that says what is wrong, and code 2."""
    assert "Traceback" not in ended.output, ended.output[-3000:]
    assert ended.code == 2, (ended.code, ended.output[-2000:])
    assert ended.error, ended.output[-2000:]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk(name: str, place: Path, tmp_path: Path) -> None:
    main, arguments = COMMANDS[name]
    out = tmp_path / "out"
    given = [argument.replace("OUT", str(out)) for argument in arguments]
    refused, left = 0, {}
    for most_bytes in FULL_AT_BYTES:
        ended = outcome(f"{name}, full at {most_bytes}", full(main, most_bytes), *given, folder=place)
        if ended.code:
            check(ended)
            refused += 1
            assert any(words in ended.error for words in ("too large", "space", "Input/output")), ended.error
            left |= {path.relative_to(tmp_path): path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        for path in tmp_path.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert refused
    accepted(f"{name}, again", main, *given, folder=place, memory_mb=2000)
    # A file that is left is whole.
    for name_left, content in left.items():
        assert (tmp_path / name_left).read_bytes() == content, name_left


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_that_cannot_be_written(name: str, place: Path, tmp_path: Path) -> None:
    main, arguments = COMMANDS[name]
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    out = locked / "out"
    given = [argument.replace("OUT", str(out)) for argument in arguments]
    ended = outcome(f"{name}, read-only", unprivileged(main), *given, folder=place)
    check(ended)
    assert not [*locked.iterdir()]
