"""Render a small dataset with the engine `heightfield`, serve one frame of its scene, and ask for the engine `cycles`.

    python scripts/try_render.py FOLDER

FOLDER is an empty folder. scripts/test-wheels uses this program in environments without Blender's module.
"""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import typer

from perilune_shared.client import SceneClient
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.validation.validate import validate

_SMALL = [
    "--preset", "tiny", "--set=dataset.terrain.spacing_px=2", "--set=dataset.render.samples=1",
    "--set=dataset.detect.n_scenes=1", "--set=dataset.detect.n_frames=3",
]  # fmt: skip
_HEIGHTFIELD = "--set=dataset.render.engine=heightfield"


def main(folder: Annotated[Path, typer.Argument(help="Empty folder for the dataset.", show_default=False)]) -> None:
    """Render a small dataset, serve one frame of its scene, and ask for the engine `cycles`."""
    render(folder / "dataset")
    serve()
    refuse(folder / "cycles")


def render(folder: Path) -> None:
    """Render a dataset and validate it."""
    command = [_program(), "dataset", *_SMALL, _HEIGHTFIELD, "--kind", "detect", "--out", folder]
    # In a process group of its own, so that at Ctrl-C only this program prints a line.
    subprocess.run(command, check=True, process_group=0)
    made = open_dataset(folder / "detect")
    if (faults := validate(made)) or made.info.counts.frames < 3 or not made.info.counts.labels:
        raise RuntimeError(f"{made.info.counts}, faults: {faults}")


def serve() -> None:
    """Start the image server and request a frame."""
    command = [_program(), "serve", *_SMALL, "--engine", "heightfield", "--native-port", "0", "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, process_group=0) as server:
        try:
            assert server.stderr is not None
            address = next(word for line in server.stderr for word in line.split() if word.startswith("tcp://"))
            with SceneClient(address) as scene:
                frame = scene.frame((0.0, 0.0, 600.0), (0.0, 1.0, 0.0, 0.0), labels=True)
        finally:
            server.terminate()
    print(
        f"served a frame of {frame.image.shape}, mean {frame.image.mean():.1f}, {len(frame.labels['crater_id'])} labels"
    )
    if frame.image.std() < 5 or not len(frame.labels["crater_id"]):
        raise RuntimeError("the frame shows no ground")


def refuse(folder: Path) -> None:
    """Check that the engine `cycles` is refused in one line, and that nothing is written."""
    command = [_program(), "dataset", *_SMALL, "--out", folder]
    done = subprocess.run(command, capture_output=True, text=True, process_group=0)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    print(*errors, sep="\n")
    if done.returncode != 2 or len(errors) != 1 or "Traceback" in done.stderr or folder.exists():
        raise RuntimeError(f"exit code {done.returncode}: {done.stderr}")


def _program() -> str:
    return str(Path(sys.executable).with_name("perilune-render"))


if __name__ == "__main__":
    run_command_line(one_command(main))
