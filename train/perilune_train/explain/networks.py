"""Load the networks to explain and their images, and check whether the networks were fitted to the terrain."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perilune_shared.dataset.manifest import open_single
from perilune_shared.storage.store import Address
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.inference.detector import Detector, open_detector
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.inputs import (
    LabelledFrames,
    Pairs,
    consecutive_pairs,
    first_descent,
    frames_of,
    labelled_frames,
    pairs_of_descent,
)
from perilune_train.models.navigator import StackNavigator
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.network import load_navigator
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.provenance import check_terrain, protocol_of, read_provenance
from perilune_train.training.runs import choose_device, load_weights


def folder_of(checkpoint: Path) -> Path:
    """The folder with a checkpoint's config.yaml: of the run, or of the installed network."""
    return checkpoint.parent.parent if checkpoint.parent.name == "checkpoints" else checkpoint.parent


def open_single_scale(checkpoint: Path, config: DetectConfig, settings: ExplainConfig) -> Detector:
    """Load a detector on the device of `settings`, at scale 1 only.

    Other scales of its configuration are ignored, because an attention mask belongs to one scale.
    """
    evaluation = config.evaluation.model_copy(update={"scales": (1.0,)})
    return open_detector(checkpoint, config.model_copy(update={"evaluation": evaluation, "device": settings.device}))


def terrain_marks(
    networks: Mapping[str, tuple[Path, Address]], allow_overlap: bool, split: str = "test"
) -> tuple[dict[str, str], Metrics]:
    """Check the terrain that each network was fitted to; returns marks by network, and entries of metrics.json.

    `networks` has the checkpoint and the dataset by name. A mark is a text for all output of the network; it is empty
    if the network's terrain is disjoint from the terrain of `split`, or shared by protocol. Raises UserError if a
    network was fitted to the terrain of `split` (unless `allow_overlap`).
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


@dataclass(frozen=True)
class ExplainedDetector:
    """A detector and its frames."""

    checkpoint: Path
    """File of the weights."""
    detector: Detector
    """The network, at scale 1."""
    config: DetectConfig
    """Configuration of the training run."""
    split: DetectSplit
    """The whole test split."""
    frames: LabelledFrames
    """Test frames that are explained."""
    known_frames: LabelledFrames
    """Validation frames, on which the signs of correlations and the gate whose pixels are removed are chosen."""
    descent: LabelledFrames
    """All frames of the first test descent."""


@dataclass(frozen=True)
class ExplainedNavigator:
    """A stack navigator and its pairs of frames."""

    checkpoint: Path
    """File of the weights."""
    network: StackNavigator
    """The network on its device."""
    architecture: dict[str, Any]
    """Architecture settings stored in the checkpoint."""
    pairs: Pairs
    """Test pairs that are explained."""
    known_pairs: Pairs
    """Validation pairs, on which the gate whose pixels are removed is chosen."""
    flight: Pairs
    """Pairs of the first test descent, from high to low."""


def open_detection(checkpoint: Path, data: Address, settings: ExplainConfig) -> ExplainedDetector:
    """Load a detector, and its test and validation frames. Raises UserError if a file is missing or invalid."""
    config = config_of_run(folder_of(checkpoint), ())
    detector, dataset = open_single_scale(checkpoint, config, settings), open_single(data)
    frames, split = labelled_frames(dataset, "test", config, settings.n_frames, settings.ring_factors)
    known_frames, _ = labelled_frames(dataset, "val", config, settings.n_validation, settings.ring_factors)
    descent = frames_of(split, first_descent(split), settings.ring_factors)
    return ExplainedDetector(checkpoint, detector, config, split, frames, known_frames, descent)


def open_navigation(checkpoint: Path, data: Address, settings: ExplainConfig) -> ExplainedNavigator:
    """Load a stack navigator, and its test and validation pairs. Raises UserError if a file is missing or invalid."""
    stack, architecture = load_navigator(checkpoint, "stack")
    network, dataset = stack.to(choose_device(settings.device)), open_single(data)
    descents = load_split(dataset, "test")
    pairs, flight = consecutive_pairs(descents, settings.n_pairs), pairs_of_descent(descents[0], settings.n_drawn)
    known_pairs = consecutive_pairs(load_split(dataset, "val"), settings.n_validation)
    return ExplainedNavigator(checkpoint, network, architecture, pairs, known_pairs, flight)
