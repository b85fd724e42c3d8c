"""README of an exported detector."""

from typing import Any

from perilune_train.detect.evaluate.split_evaluation import at_scales

_PROGRAM = '''\
import json
import os

import cv2
import numpy as np

# Set before the import; official builds of ONNX Runtime otherwise send telemetry.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime

facts = json.load(open("detector.json"))
session = onnxruntime.InferenceSession("detector.onnx", providers=["CPUExecutionProvider"])


def detect(grey):
    """Return boxes (D, 4) in pixels and scores (D,), highest first, for a grey image."""
    levels = grey.astype(np.float32)
    image = (levels - levels.mean()) / max(levels.std(), 1.0)
    images = np.repeat(image[None, None], facts["input"]["shape"][1], axis=1)
    boxes, scores = (part[0] for part in session.run(["boxes", "scores"], {"images": images}))
    strong = scores >= facts["score_threshold"]
    boxes, scores = boxes[strong].astype(float), scores[strong]
    corner_and_size = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    kept = np.array(cv2.dnn.NMSBoxes(corner_and_size, scores, 0.0, facts["nms_iou"]), int).ravel()
    return boxes[kept], scores[kept]
'''


def readme(metadata: dict[str, Any]) -> str:
    """Markdown page for the users of an export; `metadata` is the content of detector.json."""
    _, channels, size_px, _ = metadata["input"]["shape"]
    threshold = f"{metadata['score_threshold']:.4f}"
    lines = [
        "# Crater detector",
        "",
        f"Input: `images`, float32, (n, {channels}, {size_px}, {size_px}). "
        f"{metadata['input']['normalisation'].capitalize()}.",
        "",
        f"Output: {'; '.join(f'`{name}` {text}' for name, text in metadata['outputs'].items())}.",
        "",
        f"Report detections with a score of at least {threshold}, the threshold chosen on validation frames. "
        "Apply non-maximum suppression, which is not part of the graph: of two boxes with an IoU above "
        f"{metadata['nms_iou']:g}, drop the one with the lower score.",
        "",
        *_probability(metadata),
        "The graph has no alarm for images unlike the training frames (column `novelty` of `perilune-train detect "
        "predict`).",
        "",
        f"{metadata['multiply_adds'] / 1e9:.3f} G multiply-adds per image, {metadata['parameters']:,} parameters.",
        "",
        "| File | SHA-256 |",
        "|---|---|",
        *(f"| {name} | `{digest}` |" for name, digest in metadata["files"].items()),
        "",
        "`detector.json` contains these and all other values; the ONNX file contains most of them as metadata.",
        "OpenVINO computes in bfloat16 if the processor supports it, which is faster but less accurate;",
        "`INFERENCE_PRECISION_HINT=f32` gives the same boxes as torch. Fixing the shape to one image (`model.reshape`)",
        "also makes it faster.",
        "",
    ]
    if metadata["scales"] != [1.0]:
        lines += [
            f"The threshold of {threshold} is for images evaluated {at_scales(tuple(metadata['scales']))}: resize the",
            "image to each scale, run the graph on tiles of its size, divide the boxes by the scale, and apply one",
            "non-maximum suppression to all of them. A single scale needs another threshold.",
            "",
        ]
    if "detector-int8.onnx" in metadata["files"]:
        int8 = metadata["int8"]
        lines += [
            "`detector-int8.onnx` has its convolutions in 8-bit integers, except gates and heads. Its AP on the",
            f"validation frames is {int8['ap50_paper_int8']:.4f}; in float32 it is {int8['ap50_paper_float']:.4f}.",
            "It is made for OpenVINO; ONNX Runtime runs it more slowly than `detector.onnx`.",
            "",
        ]
    if "detector.onnx" in metadata["files"]:
        lines += ["```python", _PROGRAM.rstrip(), "```", ""]
    return "\n".join(lines)


def _probability(metadata: dict[str, Any]) -> list[str]:
    """Lines on the calibration of the scores."""
    calibration = metadata["score_calibration"]
    if calibration is None:
        return ["The run has no calibration: a score is no probability.", ""]
    return [
        "A score is no probability. After suppression, the probability that a detection with the score s matches a "
        f"label is `{calibration['probability']}` (beta calibration, fitted on validation frames; parameters in "
        "`detector.json`).",
        "",
    ]
