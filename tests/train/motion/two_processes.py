"""What each of two processes trained on and ended with; started by test_processes.py."""

import sys
from pathlib import Path

import torch

from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.data.epochs import TrainingSequences
from perilune_train.motion.train import navigate_run as run
from perilune_train.motion.train.task import NavigationTask
from perilune_train.motion.train.windows import WindowPlaces
from perilune_train.training import runs
from perilune_train.training.runs import NamedRun


def main(dataset: Path, out: Path, name: str, settings: str, stop: str) -> None:
    seen: dict[str, list[tuple[int, ...]]] = {"stack": [], "warp": []}
    ended: dict[str, dict] = {}
    step = NavigationTask.training_step
    loads = {"warp": TrainingSequences.__getitem__, "stack": WindowPlaces.__getitem__}

    def recorded(self, key):
        fusion = "warp" if self.warp else "stack"
        seen[fusion].append(key)
        return loads[fusion](self, key)

    def stopped(self, batch, batch_idx):
        if stop == f"{self.fusion} {self.current_epoch}":
            raise KeyboardInterrupt
        return step(self, batch, batch_idx)

    def on_train_end(self):
        figures = {key: value for key, value in self.trainer.callback_metrics.items() if key.startswith("val/")}
        ended[self.fusion] = {"seen": seen[self.fusion], "figures": figures, "state": self.state_dict()}

    for own in (TrainingSequences, WindowPlaces):
        own.__getitem__ = recorded  # type: ignore[method-assign]
    NavigationTask.training_step = stopped  # type: ignore[method-assign]
    NavigationTask.on_train_end = on_train_end  # type: ignore[method-assign]
    for drawing in ("draw_trajectory", "draw_errors"):
        setattr(run, drawing, lambda *_, **__: None)
    config = NavigateConfig.model_validate_json(settings)
    run.navigate_run(config, dataset, NamedRun(out, name), None)
    process = torch.distributed.get_rank()
    torch.save(ended, out / f"{name}.{process}.pt")
    assert runs.is_first_process() == (process == 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
