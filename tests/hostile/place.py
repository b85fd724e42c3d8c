"""A folder in which commands of the programs run, with a home folder and a temporary folder of its own."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from perilune_render.provenance.caches import machine_code_folder
from tests.hostile.commands import Use, make_inputs

BIN = Path(sys.executable).parent
TRAP = Path(__file__).parent / "trapped"
"""Folder of `sitecustomize.py`."""
LONGEST_S = 300
OWN = (".cache/perilune",)
"""What may be in the home folder."""


class Place:
    """Runs commands. `environment` may be changed."""

    def __init__(self, folder: Path):
        self.folder, self.home, self.temporary = folder / "work", folder / "home", folder / "tmp"
        for each in (self.folder, self.home, self.temporary):
            each.mkdir()
        make_inputs(self.folder)
        self.log = folder / "trapped.txt"
        """Where `sitecustomize.py` writes the connections that it has refused."""
        names = ("PATH", "LANG", "LD_LIBRARY_PATH", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        self.environment = {name: os.environ[name] for name in names if name in os.environ}
        self.environment |= {
            "HOME": str(self.home),
            "TMPDIR": str(self.temporary),
            # Compiled once by the other tests.
            "NUMBA_CACHE_DIR": str(machine_code_folder().parent),
            "PERILUNE_TRAP": str(self.log),
            "PYTHONPATH": os.pathsep.join([str(TRAP), os.environ.get("PYTHONPATH", "")]),
        }

    def written_at_home(self) -> list[str]:
        """Files in the home folder that are not perilune's own."""
        found = [str(path.relative_to(self.home)) for path in self.home.rglob("*") if not path.is_dir()]
        return sorted(path for path in found if not path.startswith(OWN))

    def run(
        self, one: Use, before: tuple[str, ...] = (), changed: dict[str, str | None] | None = None,
        preexec: Callable[[], object] | None = None,
    ) -> subprocess.CompletedProcess:  # fmt: skip
        """Run a command, after the words `before`; the server is interrupted once it listens."""
        program, *words = one.words
        environment = {k: v for k, v in (self.environment | (changed or {})).items() if v is not None}
        process = subprocess.Popen(
            [*before, str(BIN / program), *words],
            cwd=self.folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=preexec,
        )
        assert process.stderr is not None
        printed = ""
        if one.command.endswith(" serve"):
            for line in process.stderr:
                printed += line
                if "perilune_shared.client at" in line:
                    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text()
                    os.kill(int(children) if before else process.pid, signal.SIGINT)
                    break
        try:
            out, error = process.communicate(timeout=LONGEST_S)
        finally:
            process.kill()
        return subprocess.CompletedProcess(process.args, process.returncode, out, printed + error)
