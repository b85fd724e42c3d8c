"""Cases besides SIGKILL: full disk, other processor, other code, faulty and vanished object store."""

import contextlib
import os
import random
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.helpers.faulty_proxy import FaultyProxy
from tests.helpers.other_processor import OTHER_PROCESSOR

import perilune_render
from benchmarks.kill.rendering import Record, Rendering, Undisturbed, finished, phase
from benchmarks.kill.trials import killed

_ONE = ("--workers", "1")
_CONSTANT = "_STRETCH = 1.5"
"""A constant of the sensor model. A version with another digit has another fingerprint."""
_RENDER_PACKAGE = Path(perilune_render.__file__).parent


def full_disk(out: str, whole: Undisturbed, draw: random.Random) -> Record:
    """A disk that is full at a random share of the dataset's bytes; then resume on a larger one. Needs root."""
    n_bytes = sum(map(len, whole.files.values()))
    share = draw.uniform(0.05, 1.0)
    with _small_disk(Path(out), int(n_bytes * share)):
        run = Rendering(out, *_ONE)
        code = run.wait()
        moment = {"moment_s": run.age_s, "phase": phase(out), "disturbed": code != 0, "disk_share": share}
        moment |= _refused(run, code, "No space left on device")
        subprocess.run(["mount", "-o", "remount,size=1g", out], check=True)
        return {"moments": [moment], **finished(out, whole, 1, *_ONE)}


def other_processor(out: str, whole: Undisturbed, draw: random.Random) -> Record:
    """SIGKILL to the command; resumed with the settings of a processor without AVX2 and FMA, and two threads."""
    moment = killed(Rendering(out, *_ONE), whole, draw)
    with tempfile.TemporaryDirectory() as cache:
        environment = {**OTHER_PROCESSOR, "PERILUNE_CACHE": cache}
        return {"moments": [moment], **finished(out, whole, 1, *_ONE, "--threads", "2", environment=environment)}


def other_code(out: str, whole: Undisturbed, draw: random.Random) -> Record:
    """SIGKILL to the command; a changed sensor model is refused; then resume with the code of the beginning."""
    moment = killed(Rendering(out, *_ONE), whole, draw)
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(_RENDER_PACKAGE, Path(folder) / "perilune_render", ignore=shutil.ignore_patterns("__pycache__"))
        changed = Path(folder) / "perilune_render/imaging/sensor.py"
        text = changed.read_text(encoding="utf-8")
        assert text.count(_CONSTANT) == 1
        changed.write_text(text.replace(_CONSTANT, f"{_CONSTANT}1"), encoding="utf-8")
        path = os.pathsep.join([folder, *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
        # Before dataset.json is written, any code may begin.
        if moment["phase"] not in ("start", "complete"):
            run = Rendering(out, *_ONE, environment={"PYTHONPATH": path})
            moment |= _refused(run, run.wait(), "versions")
    return {"moments": [moment], **finished(out, whole, 1, *_ONE)}


def faulty_store(out: str, whole: Undisturbed, draw: random.Random) -> Record:
    """Render through a proxy that fails one request in twenty, and answers another one up to two seconds late."""
    with _proxy(draw.randrange(2**31)) as proxy:
        record = finished(out, whole, 0, "--workers", "2")
        return {"moments": [], **record, "requests": dict(proxy.counts)}


def vanished_store(out: str, whole: Undisturbed, draw: random.Random) -> Record:
    """The store vanishes at a random moment; then it comes back, and the rendering is resumed."""
    with _proxy(draw.randrange(2**31), fault_share=0.0, late_share=0.0) as proxy:
        run = Rendering(out, "--workers", "2")
        whole.moment(draw, resumed=False).wait(run)
        moment: Record = {"moment_s": run.age_s, "phase": phase(out)}
        proxy.vanish()
        code = run.wait()
        proxy.come_back()
        moment["disturbed"] = code != 0
        moment |= _refused(run, code, "run the same command again to resume") if code else {}
        return {"moments": [moment], **finished(out, whole, 1, "--workers", "2")}


def _refused(run: Rendering, code: int, words: str) -> Record:
    """Whether a run ended with code 2 and one line with some words; if not, what it wrote."""
    errors = [line for line in run.stderr.splitlines() if line.startswith("error: ")]
    one_line = code == 2 and len(errors) == 1 and words in errors[0] and "Traceback" not in run.stderr
    return {"one_line": one_line, "line" if one_line else "stderr": errors[0] if one_line else run.stderr[-2000:]}


@contextlib.contextmanager
def _small_disk(folder: Path, n_bytes: int) -> Iterator[None]:
    """A disk of its own, in memory, mounted at a new folder."""
    folder.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={n_bytes}", "perilune", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextlib.contextmanager
def _proxy(seed: int, **shares: float) -> Iterator[FaultyProxy]:
    """A proxy before the S3 server of this process's environment, used by all clients while the block runs."""
    server = os.environ["AWS_ENDPOINT_URL"]
    with FaultyProxy(server, seed, **shares) as proxy:
        os.environ["AWS_ENDPOINT_URL"] = proxy.address
        try:
            yield proxy
        finally:
            os.environ["AWS_ENDPOINT_URL"] = server
