"""What each of two processes rendered and ended with; started by test_fresh_run.py."""

import sys
from pathlib import Path

import torch

from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.fresh import FreshFrames
from perilune_train.detect.train import detect_run
from perilune_train.detect.train.task import DetectTask


def main(dataset: Path, out: Path, settings: str) -> None:
    rendered: list[tuple[int, int]] = []
    last: list[DetectTask] = []
    take = FreshFrames.__getitem__

    def recorded(self, key):
        rendered.append((key[0], key[2]))
        return take(self, key)

    FreshFrames.__getitem__ = recorded  # type: ignore[method-assign]
    DetectTask.on_train_end = lambda self: last.append(self)  # type: ignore[method-assign]
    detect_run.evaluate = lambda *_: {}  # type: ignore[assignment]
    detect_run.run_detect(DetectConfig.model_validate_json(settings), dataset, out, "two")
    (task,) = last
    scenes = sorted(row[0] for row in task.train_split.server.state_dict())  # type: ignore[union-attr]
    torch.save({"rendered": rendered, "state": task.state_dict(), "scenes": scenes}, out / f"{task.process[0]}.pt")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
