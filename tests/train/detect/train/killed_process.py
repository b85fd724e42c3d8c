"""The trainer, killed when the third batch of the second epoch begins; started in test_processes.py."""

import os
import signal

from perilune_train.cli.main import main
from perilune_train.detect.train.task import DetectTask

KILLED_AT = (1, 2)
"""Epochs and batches of the epoch that are finished then."""


def kill(task: DetectTask, _: object, batch_index: int) -> None:
    """Hook of Lightning: end this process as the system does when memory runs out."""
    if (task.current_epoch, batch_index) == KILLED_AT:
        os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    DetectTask.on_train_batch_start = kill  # type: ignore[method-assign]
    main()
