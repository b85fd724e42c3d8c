"""Export of a trained detector for flight: ONNX and OpenVINO files, checked against torch."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from perilune_shared.console.terminal import say, say_page
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.storage.files import new_folder, sha256_of, write_text
from perilune_shared.storage.store import Address
from perilune_train.data.frames import normalised
from perilune_train.detect.calibration import Calibration
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import network_input
from perilune_train.detect.data.split import load_split
from perilune_train.detect.deploy.engines import Array, Engine, onnxruntime_engine, openvino_engine, package
from perilune_train.detect.deploy.files import FlightDetector, write_onnx, write_openvino
from perilune_train.detect.deploy.int8 import Int8Verdict, try_int8
from perilune_train.detect.deploy.readme import readme
from perilune_train.detect.finished_run import calibration_of, config_of_run, raw_threshold
from perilune_train.detect.inference.detector import load_detector
from perilune_train.models.size import multiply_adds
from perilune_train.models.yolo import YOLOv3
from perilune_train.records.markdown import write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.provenance import (
    Provenance,
    TerrainCheck,
    check_calibration,
    read_provenance,
    split_terrain,
)
from perilune_train.training.runs import RunFolder, load_weights

MAX_DIFFERENCE_PX = 1e-3
"""Largest allowed difference of a compared box or standard deviation from torch's float32 result, pixels."""
MAX_DIFFERENCE_SCORE = 1e-3
"""Largest allowed difference of a score or a correlation from torch's float32 result."""
_CHECKED_BOXES = 100
_SHAPES = (
    "(n, K, 5) float32: correlation r of the ellipse in the box, and standard deviations of the centre's x and y, of "
    "the semi-major and of the semi-minor axis in pixels. With the half sides w and h of the box, the ellipse is "
    "x^T S^-1 x = 1 about the centre of the box, S = [[w^2, r w h], [r w h, h^2]]: the semi-axes are the square roots "
    "of the eigenvalues of S, and the semi-major axis has the direction atan2(2 r w h, w^2 - h^2) / 2 from x towards y"
)
FORMATS = ("onnx", "openvino")
_CHECKED_FRAMES = 8


@torch.no_grad()
def difference(network: YOLOv3, engine: Engine, images: Array, min_score: float) -> tuple[float, float]:
    """Largest differences of an engine from torch in float32: in pixels, and of numbers without a unit.

    The first is of box coordinates and standard deviations, the second of scores and correlations. Compares all scores.
    Compares a box and its ellipse only if its score is at least `min_score` or among the best 100 of its image. Both
    differences are infinite if the outputs have other sizes.
    """
    expected = [part.numpy() for part in network.detect_ellipses(torch.as_tensor(images)) if part is not None]
    got = engine(images)
    if [part.shape for part in got] != [part.shape for part in expected]:
        return float("inf"), float("inf")
    boxes, scores, *shapes = expected
    engine_boxes, engine_scores, *engine_shapes = got
    # Always compare some boxes, even if the network detects nothing in these frames.
    best = np.sort(scores, axis=1)[:, -_CHECKED_BOXES:, None].min(axis=1)
    compared = scores >= np.minimum(best, min_score)
    px, score = np.abs(engine_boxes - boxes)[compared].max(initial=0.0), np.abs(engine_scores - scores).max()
    for engine_part, part in zip(engine_shapes, shapes, strict=True):
        errors = np.abs(engine_part - part)[compared]
        px, score = max(px, errors[:, 1:].max(initial=0.0)), max(score, errors[:, 0].max(initial=0.0))
    return float(px), float(score)


def check(path: Path, name: str, network: YOLOv3, engine: Engine, images: Array, min_score: float) -> dict[str, float]:
    """Largest differences of a file's outputs from torch's. Raises UserError if one exceeds its limit."""
    px, score = difference(network, engine, images, min_score)
    if not (px <= MAX_DIFFERENCE_PX and score <= MAX_DIFFERENCE_SCORE):
        raise UserError(
            path.name,
            name,
            f"boxes {px:.2g} px and scores {score:.2g} from torch's",
            f"at most {MAX_DIFFERENCE_PX} px and {MAX_DIFFERENCE_SCORE}",
        )
    return {"frames": len(images), "largest_px": px, "largest_score": score}


def noise_frames(count: int, size_px: int) -> np.ndarray:
    """Grey frames (count, size_px, size_px) of seeded noise, for a comparison without real frames."""
    return np.random.default_rng(0).integers(0, 256, (count, size_px, size_px)).astype(np.uint8)


@dataclass(frozen=True)
class Trained:
    """A finished detection run."""

    network: YOLOv3
    """Network with the run's best weights, in evaluation mode, on the CPU."""
    config: DetectConfig
    """Settings of the run."""
    threshold: float
    """Threshold of the network's scores, before calibration, that the run chose on its validation split."""
    checkpoint: Path
    """File of the weights."""
    calibration: Calibration | None = None
    """Map from the network's scores to probabilities; None if the run has none."""


def load_trained(root: Path) -> Trained:
    """Load a finished run's network, settings and threshold.

    Raises UserError if the folder is not a finished run.
    """
    config, threshold, best = config_of_run(root), raw_threshold(root), RunFolder(root).best
    return Trained(load_detector(best), config, threshold, best, calibration_of(root))


def export_metadata(trained: Trained, size_px: int) -> dict[str, Any]:
    """Metadata of an export: all values that a user of the exported files needs."""
    network, settings = trained.network, trained.config.evaluation
    return {
        "input": {
            "name": "images",
            "shape": ["n", trained.config.in_channels, size_px, size_px],
            "type": "float32",
            "normalisation": "grey levels minus their mean over the image, divided by the larger of 1 and their "
            "standard deviation (levels of 0 to 255); every channel holds the same grey image",
        },
        "outputs": {
            "boxes": "(n, K, 4) float32: x0, y0, x1, y1 in pixels; 0, 0 is the image's upper left corner",
            "scores": "(n, K) float32 in 0..1",
            **({"shapes": _SHAPES} if network.ellipses else {}),
        },
        "score_threshold": trained.threshold,
        "score_calibration": None
        if trained.calibration is None
        else asdict(trained.calibration) | {"probability": trained.calibration.formula},
        "min_score": settings.min_score,
        "nms_iou": settings.nms_iou,
        "max_detections": settings.max_detections,
        "scales": list(settings.scales),
        "anchors_px": network.anchors.tolist(),
        "strides": list(network.strides),
        "width": trained.config.width,
        "attention": trained.config.attention,
        "parameters": sum(p.numel() for p in network.parameters()),
        "multiply_adds": multiply_adds(network, (1, trained.config.in_channels, size_px, size_px)),
        "checkpoint_sha256": sha256_of(trained.checkpoint),
    }


def _terrain(
    checkpoint: Path, calibration: Dataset | None, allow_overlap: bool
) -> tuple[Provenance, TerrainCheck | None]:
    """Terrain record of the exported network, and the check of the terrain used to calibrate int8.

    The record includes the calibration terrain. Without `calibration` the check is None.
    """
    provenance = read_provenance(load_weights(checkpoint), checkpoint)
    if calibration is None:
        return provenance, None
    calibrated = split_terrain(calibration, "train", "calibrated") | split_terrain(calibration, "val", "calibrated")
    check = check_calibration(provenance, calibrated, calibration, allow_overlap)
    return Provenance(provenance.uses | calibrated, provenance.known), check


@dataclass(frozen=True, slots=True)
class ExportedFiles:
    """Files to export."""

    formats: tuple[str, ...] = FORMATS
    """Names of the formats, from `FORMATS`."""
    size_px: int = 256
    """Width and height of the network's input, pixels."""
    int8: bool = False
    """Whether to try quantisation to 8-bit integers, which is kept only if it is faster and nearly as accurate."""


def export_run(
    root: Path,
    out: Path,
    files: ExportedFiles,
    dataset: Address | None = None,
    allow_overlap: bool = False,
) -> Int8Verdict | None:
    """Export a run's detector to the new folder `out`, and check the files.

    Writes detector.onnx, detector.xml and .bin (as selected), detector.json (metadata) and README.md. Also writes
    detector-int8.onnx if quantisation makes the network faster and loses little AP (`Int8Verdict.kept`).

    Compares the outputs of the files with torch's on frames of the dataset's validation split, or on noise without a
    dataset.

    Raises UserError, and writes nothing, if a file's output differs from torch's, if the dataset has frames of another
    size, or if int8 would be calibrated on terrain of a test split (of the run or of the dataset). `allow_overlap`
    allows such terrain, and marks detector.json and README.md.
    """
    formats, size_px, int8 = files.formats, files.size_px, files.int8
    for name in ("onnx", "onnxruntime", *formats, *(("openvino", "onnxruntime.quantization") if int8 else ())):
        package(name)
    trained = load_trained(root)
    channels = trained.config.in_channels
    opened = None if dataset is None else open_single(dataset)
    if opened is not None:
        camera = opened.info.camera
        if (camera.width_px, camera.height_px) != (size_px, size_px):
            got = f"{camera.width_px} x {camera.height_px}"
            raise UserError(opened.store, "frames", got, f"{size_px} x {size_px} pixels; --size-px sets it")
    metadata = export_metadata(trained, size_px)
    terrain, terrain_check = _terrain(trained.checkpoint, opened if int8 else None, allow_overlap)
    metadata["terrain"] = {**terrain.plain(), **(terrain_check.metrics() if terrain_check is not None else {})}
    verdict = None
    with new_folder(out) as folder:
        if opened is None:
            frames = noise_frames(_CHECKED_FRAMES, size_px)
        else:
            val = load_split(opened, "val", trained.config.labels)
            frames = val.frames.images[np.linspace(0, len(val) - 1, min(_CHECKED_FRAMES, len(val))).astype(int)]
        metadata["compared_on"] = "noise" if opened is None else "validation frames"
        images = network_input(normalised(frames), channels).contiguous().numpy()
        onnx_path, xml_path = folder / "detector.onnx", folder / "detector.xml"
        write_onnx(FlightDetector(trained.network, size_px), onnx_path, metadata, channels, size_px)
        engines = [(onnx_path, "onnxruntime", onnxruntime_engine(onnx_path))]
        if "openvino" in formats:
            write_openvino(onnx_path, xml_path)
            engines.append((xml_path, "openvino", openvino_engine(xml_path)))
        min_score = trained.config.evaluation.min_score
        differences = {
            name: check(path, name, trained.network, engine, images, min_score) for path, name, engine in engines
        }
        metadata["differences_from_torch"] = differences
        for name, largest in differences.items():
            say(
                f"{name}: boxes within {largest['largest_px']:.2g} px of torch's, scores {largest['largest_score']:.2g}"
            )
        if int8 and opened is not None:
            verdict = try_int8(onnx_path, folder / "detector-int8.onnx", opened, val, trained.config)
            metadata["int8"] = verdict.as_metadata()
            say_page(verdict.summary())
        if "onnx" not in formats:
            onnx_path.unlink()
        metadata["files"] = {p.name: sha256_of(p) for p in sorted(folder.iterdir())}
        write_text(folder / "detector.json", json.dumps(metadata, indent=2) + "\n")
        write_markdown(folder / "README.md", readme(metadata))
        if terrain_check is not None:
            mark_files(folder, ("README.md",), terrain_check.mark)
    return verdict
