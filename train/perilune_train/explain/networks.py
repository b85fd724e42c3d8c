"""The networks that are explained: loading, and the terrain that they were fitted to."""

from collections.abc import Mapping
from pathlib import Path

from perilune_shared.dataset.manifest import open_single
from perilune_shared.storage.store import Address
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.inference.detector import Detector, open_detector
from perilune_train.evaluation.metrics_file import Metrics
from perilune_train.evaluation.provenance import check_terrain, protocol_of, read_provenance
from perilune_train.explain.config import ExplainConfig
from perilune_train.training.runs import load_weights


def folder_of(checkpoint: Path) -> Path:
    """The folder with config.yaml of a checkpoint: its run's, or that of an installed network's weights."""
    return checkpoint.parent.parent if checkpoint.parent.name == "checkpoints" else checkpoint.parent


def open_single_scale(checkpoint: Path, config: DetectConfig, settings: ExplainConfig) -> Detector:
    """Load a detector that runs at scale 1 only, since masks belong to one scale, on the device of `settings`."""
    evaluation = config.evaluation.model_copy(update={"scales": (1.0,)})
    return open_detector(checkpoint, config.model_copy(update={"evaluation": evaluation, "device": settings.device}))


def terrain_marks(
    networks: Mapping[str, tuple[Path, Address]], allow_overlap: bool, split: str = "test"
) -> tuple[dict[str, str], Metrics]:
    """Marks and entries of metrics.json by network, from each network's checkpoint and dataset.

    Raises UserError if a network was fitted to terrain of its dataset's frames of `split`, unless `allow_overlap`.
    """
    marks: dict[str, str] = {}
    metrics: Metrics = {}
    for part, (checkpoint, address) in networks.items():
        dataset = open_single(address)
        check = check_terrain(read_provenance(load_weights(checkpoint), checkpoint), dataset, split, allow_overlap)
        marks[part] = check.mark
        figures = {"dataset/protocol": protocol_of(dataset.info), **check.metrics()}
        metrics |= {f"{part}/{key}": value for key, value in figures.items()}
    return marks, metrics
