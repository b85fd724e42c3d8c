"""ONNX and OpenVINO files of a detector."""

import json
import warnings
from pathlib import Path
from typing import Any

import torch

from perilune_train.detect.deploy.engines import openvino_core, package
from perilune_train.detect.deploy.flight_detector import FlightDetector

_OPSET = 17


def write_onnx(detector: FlightDetector, path: Path, metadata: dict[str, Any], in_channels: int, size_px: int) -> None:
    """Write the graph for any number of images; `metadata` is stored in it, each entry as JSON."""
    onnx = package("onnx")
    names = {"images": {0: "n"}, "boxes": {0: "n"}, "scores": {0: "n"}}
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        # The tracing exporter: the newer one needs two more packages and gives the same graph.
        torch.onnx.export(
            detector,
            (torch.zeros(1, in_channels, size_px, size_px),),
            str(path),
            input_names=["images"],
            output_names=["boxes", "scores"],
            dynamic_axes=names,
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def write_openvino(onnx_path: Path, path: Path) -> None:
    """Convert an ONNX file to OpenVINO's format: `path` (.xml) and, beside it, the weights (.bin) in float32."""
    openvino = package("openvino")
    # Read with the runtime: the converter sends telemetry.
    openvino.save_model(openvino_core().read_model(str(onnx_path)), str(path), compress_to_fp16=False)
