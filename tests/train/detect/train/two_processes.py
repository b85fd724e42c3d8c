"""What each of two processes trained on and ended with; started by torchrun in test_processes.py."""

import sys
from pathlib import Path

import torch

from perilune_shared.config.resolve import resolve
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data import batches
from perilune_train.detect.evaluate import report
from perilune_train.detect.train import task
from perilune_train.detect.train.detect_run import run_detect
from perilune_train.training import runs


def main(dataset: Path, out: Path, *settings: str) -> None:
    seen: list[tuple[int, int]] = []
    last: list[task.DetectTask] = []

    class Recorded(batches.TrainingFrames):
        def __getitem__(self, key):
            seen.append((key[0], self.split.share.of(self.split.n_frames)[key[1]]))
            return super().__getitem__(key)

    batches.TrainingFrames = Recorded  # type: ignore[misc]
    for name in ("draw_bins", "draw_curves", "draw_frames"):
        setattr(report, name, lambda *_, **__: None)
    task.DetectTask.on_train_end = lambda self: last.append(self)  # type: ignore[method-assign]
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, settings)
    run_detect(config, dataset, out if runs.is_first_process() else out / "other", "two")
    state = {"seen": seen, "val_ap50": last[0].trainer.callback_metrics["val/ap50_paper"], **last[0].state_dict()}
    torch.save(state, out / f"{last[0].process[0]}.pt")
    assert runs.is_first_process() == (last[0].process[0] == 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
