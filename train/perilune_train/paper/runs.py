"""The runs of the paper's experiment, by the names of their folders."""

from dataclasses import dataclass
from pathlib import Path

from perilune_train.evaluation.metrics_file import Metrics, read_metrics

DETECTORS = {"YOLOv3": "yolov3", "attention-YOLOv3": "attention-yolov3"}
"""Folders of the detect runs, by the paper's names."""
NAVIGATORS = {"Darknet53-LSTM": "darknet53-lstm", "attention-Darknet53-LSTM": "attention-darknet53-lstm"}
"""Names of the navigate runs; their folders end in -stack."""
EXPLAINED = "attention"
"""Name of the explain run."""


@dataclass(frozen=True)
class PaperRuns:
    """Folders and metrics of the experiment's runs."""

    root: Path
    """The folder that holds all of them, such as runs/paper."""

    def detector(self, network: str) -> Path:
        """Folder of a detect run."""
        return self.root / "detect" / DETECTORS[network]

    def navigator(self, network: str) -> Path:
        """Folder of a navigate run."""
        return self.root / "navigate" / f"{NAVIGATORS[network]}-stack"

    @property
    def explained(self) -> Path:
        """Folder of the explain run."""
        return self.root / "explain" / EXPLAINED

    def benchmark(self, network: str) -> Path:
        """Folder of a network's score on the locked benchmark."""
        names = DETECTORS | NAVIGATORS
        return self.root / "benchmark" / names[network]

    def detection(self) -> dict[str, Metrics]:
        """Metrics of both detectors. Raises UserError if a run is not finished."""
        return {network: read_metrics(self.detector(network)) for network in DETECTORS}

    def navigation(self) -> dict[str, Metrics]:
        """Metrics of both navigators. Raises UserError if a run is not finished."""
        return {network: read_metrics(self.navigator(network)) for network in NAVIGATORS}

    def explanation(self) -> Metrics:
        """Metrics of the explain run. Raises UserError if it is not finished."""
        return read_metrics(self.explained)

    def scored(self, network: str) -> Metrics | None:
        """Figures of a network on the locked benchmark; None if it was not scored."""
        folder = self.benchmark(network)
        return read_metrics(folder, "benchmark.json") if (folder / "benchmark.json").is_file() else None
