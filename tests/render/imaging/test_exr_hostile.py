"""EXR files of ill will are refused by their header, before a pixel of theirs takes memory."""

import os
import resource
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from perilune_render.imaging.exr import CHANNELS, read_exr, read_radiance
from perilune_shared.errors import UserError

_HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def exr(path, width=32, height=24, names=CHANNELS):
    """A whole file."""
    channels = {name: np.ones((height, width), np.float32) for name in names}
    OpenEXR.File(_HEADER, channels).write(str(path))
    return path


def resized(path, width, height):
    """A file whose header says another size than it holds."""
    content = path.read_bytes()
    for window in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = content.index(window) + len(window) + 4
        content = content[:at] + struct.pack("<4i", 0, 0, width - 1, height - 1) + content[at + 16 :]
    path.write_bytes(content)


def sampled(path):
    """A file whose first channel has a value for every other pixel."""
    content = path.read_bytes()
    at = content.index(b"channels\0chlist\0") + 20
    at = content.index(b"\0", at) + 1 + 8
    path.write_bytes(content[:at] + struct.pack("<2i", 2, 2) + content[at + 8 :])


DAMAGES = {
    "60 000 x 60 000": (lambda path: resized(path, 60_000, 60_000), "60000 x 60000 pixels"),
    "2^31 - 1 wide": (lambda path: resized(path, 2**31 - 1, 1), "exr|size"),
    "as large as is read at all": (lambda path: resized(path, 2**14, 2**13), "16384 x 8192 pixels"),
    "another size": (lambda path: resized(path, 32, 25), "32 x 25 pixels"),
    "turned": (lambda path: resized(path, 24, 32), "24 x 32 pixels"),
    "no size": (lambda path: resized(path, 0, 0), "exr|size"),
    "a size below nothing": (lambda path: resized(path, -5, -5), "exr|size"),
    "sampled": (sampled, "exr|channels"),
    "a channel less": (lambda path: exr(path, names=CHANNELS[:-1]), "no crater"),
    "300 channels": (lambda path: exr(path, names=[f"c{k}" for k in range(300)]), "got 300"),
    "its half": (lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]), "undamaged EXR"),
    "its header alone": (lambda path: path.write_bytes(path.read_bytes()[:300]), "undamaged EXR"),
    "nothing": (lambda path: path.write_bytes(b""), "undamaged EXR"),
    "a PNG": (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100)), "undamaged EXR"),
    "noise": (lambda path: path.write_bytes(path.read_bytes()[:8] + np.random.default_rng(1).bytes(999)), "exr"),
    "a pipe": (lambda path: [path.unlink(), os.mkfifo(path)], "no such file"),
    "a folder": (lambda path: [path.unlink(), path.mkdir()], "no such file"),
    "a link to a device": (lambda path: [path.unlink(), path.symlink_to("/dev/zero")], "no such file"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_an_exr_of_ill_will_is_refused(name, tmp_path):
    damage, message = DAMAGES[name]
    path = exr(tmp_path / "a.exr")
    assert read_radiance(path, (32, 24)).depth_m.shape == (24, 32)
    damage(path)
    with pytest.raises(UserError, match=message) as error:
        read_radiance(path, (32, 24))
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_without_a_size_to_expect_there_is_still_a_limit(tmp_path):
    path = exr(tmp_path / "a.exr")
    assert set(read_exr(path)) == set(CHANNELS)
    resized(path, 60_000, 60_000)
    with pytest.raises(UserError, match="at most 134217728 pixels"):
        read_exr(path)


def test_a_bomb_takes_no_memory(tmp_path):
    path = exr(tmp_path / "a.exr")
    resized(path, 16_384, 8192)
    code = (
        "import resource, sys\nfrom pathlib import Path\nfrom perilune_render.imaging.exr import read_radiance\n"
        "from perilune_shared.errors import UserError\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try:\n    read_radiance(Path(sys.argv[1]), (32, 24))\nexcept UserError:\n"
        "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=Path(__file__).parent,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (4 * 2**30, 4 * 2**30)),
    )
    assert int(run.stdout) < 20_000, run.stdout
