"""README of an exported detector."""

from typing import Any

from perilune_train.detect.evaluate.split_evaluation import at_scales

_PROGRAM = '''\
import json
import os

import cv2
import numpy as np

# Before the import: official builds of ONNX Runtime send events to their maker otherwise.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime

facts = json.load(open("detector.json"))
session = onnxruntime.InferenceSession("detector.onnx", providers=["CPUExecutionProvider"])


def detect(grey):
    """Boxes (D, 4) in pixels and scores (D,), best first, of a grey image."""
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


def readme(told: dict[str, Any]) -> str:
    """Markdown for users of the files with these facts (detector.json)."""
    _, channels, size_px, _ = told["input"]["shape"]
    lines = [
        "# Crater detector",
        "",
        f"In: `images`, float32, (n, {channels}, {size_px}, {size_px}). {told['input']['normalisation'].capitalize()}.",
        "",
        f"Out: `boxes` {told['outputs']['boxes']}; `scores` {told['outputs']['scores']}.",
        "",
        f"A crater is reported from a score of {told['score_threshold']:.4f} (highest F1 on validation frames). Many "
        f"boxes lie on one crater: of two that overlap by an IoU above {told['nms_iou']:g} the weaker goes "
        "(non-maximum suppression), which is not part of the graph.",
        "",
        f"{told['multiply_adds'] / 1e9:.3f} G multiply-adds an image, {told['parameters']:,} parameters.",
        "",
        "| File | SHA-256 |",
        "|---|---|",
        *(f"| {name} | `{digest}` |" for name, digest in told["files"].items()),
        "",
        "`detector.json` holds these and all other facts, the ONNX file has them in its metadata.",
        "OpenVINO computes in bfloat16 where the processor has it, which is faster and not exact;",
        "`INFERENCE_PRECISION_HINT=f32` gives torch's boxes. A shape fixed to one image (`model.reshape`) is faster",
        "too.",
        "",
    ]
    if told["scales"] != [1.0]:
        lines += [
            f"The score of {told['score_threshold']:.4f} is for images looked at {at_scales(tuple(told['scales']))}:",
            "resized, run through the graph in pieces of its size, boxes divided by the scale, all put through one",
            "suppression. A look at one scale alone needs a threshold of its own.",
            "",
        ]
    if "detector-int8.onnx" in told["files"]:
        int8 = told["int8"]
        lines += [
            "`detector-int8.onnx` has its convolutions, but for gates and heads, in 8-bit integers. On the validation",
            f"frames it has an AP of {int8['ap50_paper_int8']:.4f}; in float32 {int8['ap50_paper_float']:.4f}.",
            "Made for OpenVINO; ONNX Runtime runs it more slowly than `detector.onnx`.",
            "",
        ]
    if "detector.onnx" in told["files"]:
        lines += ["```python", _PROGRAM.rstrip(), "```", ""]
    return "\n".join(lines)
