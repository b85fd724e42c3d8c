"""Quantise a trained detector to int8; keep the result only if it is faster and nearly as accurate."""

import dataclasses
import logging
import re
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import Dataset
from perilune_train.data.frames import load_frames, normalised
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import network_input
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.deploy.engines import Array, Engine, EnginePrecision, has_bf16, openvino_engine, package
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.evaluate.split_evaluation import match_detections
from perilune_train.detect.inference.suppression import detections_of

MAX_AP_LOSS = 0.005
"""Largest accepted loss of AP on the validation split."""
_CALIBRATION_FRAMES = 64
_TIMED = 30
_KEPT_FLOAT = re.compile(r"/(squeeze|excite|spatial)|/heads\.\d+\.1/|/ellipse_tower")
"""Operations that stay in floating point: the gates, which are cheap, and the last convolutions of each head, which
give boxes and ellipses."""


@dataclass(frozen=True)
class Int8Verdict:
    """Accuracy and speed before and after quantisation, measured with OpenVINO on this machine."""

    ap50_paper_float: float
    """AP on the validation split in float32, at scale 1 only."""
    ap50_paper_int8: float
    """AP on the validation split of the int8 network; the parts that are not int8 compute in `precision`."""
    float_s: float
    """Median time of one image before quantisation, seconds, in `precision`."""
    int8_s: float
    """Median time of one image in int8, seconds."""
    precision: EnginePrecision
    """Precision of the parts that are not int8: bf16 if the processor supports it."""

    @property
    def kept(self) -> bool:
        """Whether int8 is faster and loses at most MAX_AP_LOSS of AP."""
        return self.ap50_paper_float - self.ap50_paper_int8 <= MAX_AP_LOSS and self.int8_s < self.float_s

    def as_metadata(self) -> dict[str, Any]:
        """The verdict as plain data, for detector.json."""
        return {**dataclasses.asdict(self), "kept": self.kept}

    def summary(self) -> str:
        """Summary in one line."""
        comparison = (
            f"AP {self.ap50_paper_int8:.4f} (float32 {self.ap50_paper_float:.4f}) on the validation split, "
            f"{1000 * self.int8_s:.1f} ms an image ({self.precision} {1000 * self.float_s:.1f} ms)"
        )
        return f"int8 {'kept' if self.kept else 'not kept'}: {comparison}"


def try_int8(source: Path, out: Path, dataset: Dataset, val: DetectSplit, config: DetectConfig) -> Int8Verdict:
    """Quantise the ONNX file `source` into `out`, and evaluate both files on `val`.

    Calibrates on 64 frames spread over the training split. Deletes `out` unless int8 is kept.
    """
    frames = load_frames(dataset, "train").images
    chosen = frames[np.linspace(0, len(frames) - 1, min(_CALIBRATION_FRAMES, len(frames))).astype(int)]
    quantise(source, out, network_input(normalised(chosen), config.in_channels).contiguous().numpy())
    precision: EnginePrecision = "bf16" if has_bf16() else "f32"
    quick = {"float": openvino_engine(source, precision, batch=1), "int8": openvino_engine(out, precision, batch=1)}
    image = network_input(normalised(val.frames.images[:1]), config.in_channels).contiguous().numpy()
    times = interleaved(quick, image, _TIMED)
    ap_float = average_precision(openvino_engine(source, "f32", batch=1), val, config, "evaluate float32")
    ap_int8 = average_precision(quick["int8"], val, config, "evaluate int8")
    verdict = Int8Verdict(
        ap_float, ap_int8, statistics.median(times["float"]), statistics.median(times["int8"]), precision
    )
    if not verdict.kept:
        out.unlink()
    return verdict


def quantise(source: Path, out: Path, images: Array) -> None:
    """Quantise an ONNX file with ONNX Runtime's static method.

    Quantises weights per channel, and activations at the inputs of convolutions. The network runs on `images` (N, C, H,
    W) to measure the range of each activation.
    """
    onnx, quantization = package("onnx"), package("onnxruntime.quantization")

    class Frames(quantization.CalibrationDataReader):  # type: ignore[name-defined]
        def __init__(self) -> None:
            self.remaining: Iterator[Array] = iter(images)

        def get_next(self) -> dict[str, Array] | None:
            image = next(self.remaining, None)
            return None if image is None else {"images": image[None]}

    graph = onnx.load(str(source), load_external_data=False).graph
    level = logging.root.level
    logging.root.setLevel(logging.ERROR)
    try:
        quantization.quantize_static(
            str(source),
            str(out),
            Frames(),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            per_channel=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
            nodes_to_exclude=[node.name for node in graph.node if _KEPT_FLOAT.search(node.name)],
            # Do not quantise outputs, so that engines can fuse a convolution with the next operation before rounding.
            extra_options={"OpTypesToExcludeOutputQuantization": ["Conv"]},
        )
    finally:
        logging.root.setLevel(level)


def average_precision(engine: Engine, split: DetectSplit, config: DetectConfig, label: str) -> float:
    """The paper's AP of an engine on a split, at the run's IoU.

    The engine gets one image at a time, at scale 1, as in flight.
    """
    import torch

    detections = []
    with progress_bar() as bar:
        task = bar.add_task(label, total=len(split), unit="frames", note="")
        for frame in split.frames.images:
            image = network_input(normalised(frame[None]), config.in_channels).contiguous().numpy()
            boxes, scores, *_ = (torch.as_tensor(part) for part in engine(image))
            detections += detections_of(boxes, scores, config.evaluation)
            bar.advance(task)
    return curve(match_detections(split, detections, config)).ap_paper()


def interleaved(engines: dict[str, Engine], images: Array, rounds: int, warm_up: int = 5) -> dict[str, list[float]]:
    """Time of each call of each engine, seconds.

    The engines take turns, so that other load slows all of them equally.
    """
    for engine in engines.values():
        for _ in range(warm_up):
            engine(images)
    seconds: dict[str, list[float]] = {name: [] for name in engines}
    for _ in range(rounds):
        for name, engine in engines.items():
            start = time.perf_counter()
            engine(images)
            seconds[name].append(time.perf_counter() - start)
    return seconds
