"""The detector in fewer and simpler operations, and its export to ONNX and OpenVINO files."""

import copy
import json
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from perilune_train.detect.deploy.engines import OUTPUT_NAMES, openvino_core, package
from perilune_train.models.fold import fold
from perilune_train.models.yolo import OUTPUTS, YOLOv3, decode, decode_shapes

_OPSET = 17


class FlightDetector(nn.Module):
    """A detector in operations that ONNX supports: maps images to boxes, scores and perhaps shapes.

    Images (N, in_channels, size_px, size_px) give boxes (N, K, 4), x0 y0 x1 y1 in pixels, scores (N, K) and, if the
    network predicts ellipses, shapes (N, K, 5). They equal the results of `YOLOv3.detect_ellipses` up to rounding;
    non-maximum suppression is not included. Batch norm is folded exactly
    into the convolutions: W' = W g / sqrt(v + eps), b' = beta - m g / sqrt(v + eps). CBAM is replaced by standard
    operations. The given network is not changed.
    """

    def __init__(self, network: YOLOv3, size_px: int = 256):
        super().__init__()
        if size_px % 32:
            raise ValueError(f"size_px is {size_px}, not a multiple of 32")
        self.network = copy.deepcopy(network).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        self.network.eval().requires_grad_(False)
        fold(self.network)
        for scale, stride in enumerate(network.strides):
            at = torch.arange(size_px // stride, dtype=torch.float32)
            rows, columns = torch.meshgrid(at, at, indexing="ij")
            self.register_buffer(f"cells_{scale}", torch.stack([columns, rows], dim=-1))

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        boxes, scores, shapes = [], [], []
        for scale, raw in enumerate(self.network(images)):
            anchors = self.network.anchors[scale][:, None, None, :]
            cells = getattr(self, f"cells_{scale}")
            boxes.append(decode(raw, cells, anchors, self.network.strides[scale]).flatten(1, 3))
            scores.append(raw[..., 4].sigmoid().flatten(1))
            if self.network.ellipses:
                shapes.append(decode_shapes(raw[..., OUTPUTS:].flatten(1, 3), boxes[-1]))
        return tuple(torch.cat(parts, 1) for parts in (boxes, scores, shapes) if parts)


def write_onnx(detector: FlightDetector, path: Path, metadata: dict[str, Any], in_channels: int, size_px: int) -> None:
    """Write an ONNX file for any number of images; it stores each entry of `metadata` as JSON."""
    onnx = package("onnx")
    outputs = OUTPUT_NAMES[: 3 if detector.network.ellipses else 2]
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        # Use the tracing exporter: the newer exporter needs two more packages and gives the same graph.
        torch.onnx.export(
            detector,
            (torch.zeros(1, in_channels, size_px, size_px),),
            str(path),
            input_names=["images"],
            output_names=list(outputs),
            dynamic_axes={name: {0: "n"} for name in ("images", *outputs)},
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, {key: json.dumps(value) for key, value in metadata.items()})
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def write_openvino(onnx_path: Path, path: Path) -> None:
    """Convert an ONNX file to OpenVINO's format: `path` (.xml), and the float32 weights (.bin) beside it."""
    openvino = package("openvino")
    # Read with the runtime: the converter sends telemetry.
    openvino.save_model(openvino_core().read_model(str(onnx_path)), str(path), compress_to_fp16=False)
