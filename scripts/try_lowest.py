"""Import every module of perilune-shared and perilune-train, train one epoch of `tiny`, and find craters.

    python scripts/try_lowest.py FOLDER

FOLDER is an empty folder for datasets and runs. scripts/test-lowest and scripts/test-wheels use this program.
"""

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path
from typing import Annotated

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import typer

import perilune_shared
import perilune_train
from perilune_shared.console.command_line import one_command, run_command_line

ROOT = Path(__file__).resolve().parents[1]
_OPTIONAL = {"rasterio", "onnx", "onnxruntime", "openvino", "datasets"}


def import_all() -> int:
    """Import every module; returns the number of modules. A missing optional dependency is ignored."""
    count = 0
    for package in (perilune_shared, perilune_train):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            try:
                importlib.import_module(module.name)
            except ImportError as error:
                if error.name not in _OPTIONAL:
                    raise
            count += 1
    return count


def main(
    folder: Annotated[Path, typer.Argument(help="Empty folder for datasets and runs.", show_default=False)],
) -> None:
    """Import every module, train one epoch of `tiny`, and find craters; raise if a step fails."""
    print(f"imported {import_all()} modules")
    sys.path.insert(0, str(ROOT))
    from tests.helpers.drawn_dataset import build_dataset

    splits = {"train": 1, "val": 1, "test": 1}
    build_dataset(folder / "detect", "detect", splits=splits)
    build_dataset(folder / "nav", "nav", splits=splits, scenes=1)
    program = str(Path(sys.executable).with_name("perilune-train"))
    common = ["--preset", "tiny", "--out", str(folder / "runs")]
    for command in (
        ["detect", "train", *common, "--dataset", str(folder / "detect"), "--set", "detect.epochs=1"],
        ["navigate", "train", *common, "--dataset", str(folder / "nav"), "--set", "navigate.warp.fine_epochs=0"],
    ):
        # In a process group of its own, so that at Ctrl-C only this program prints a line.
        subprocess.run([program, *command], check=True, process_group=0)
    picture = next((folder / "detect" / "frames").rglob("*.png"))
    run = ["--run", str(folder / "runs" / "detect" / "tiny")]
    command = [program, "detect", "predict", str(picture), *run, "--out", str(folder / "craters")]
    subprocess.run(command, check=True, process_group=0)


if __name__ == "__main__":
    run_command_line(one_command(main))
