"""README of an exported navigator."""

from typing import Any

_START = '''\
import json
import os

import cv2
import numpy as np

# Set before the import; official builds of ONNX Runtime otherwise send telemetry.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime

facts = json.load(open("navigator.json"))
session = onnxruntime.InferenceSession("navigator.onnx", providers=["CPUExecutionProvider"])
size = facts["width_px"], facts["height_px"]


def normalised(grey):
    """Shrink a grey frame to the input's size and normalise it."""
    small = grey if grey.shape == size[::-1] else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    levels = small.astype(np.float32)
    return (levels - levels.mean()) / max(levels.std(), 1.0)


def start():
    """The state before the first pair of a descent."""
    return [np.zeros((2, 1, facts["hidden"]), np.float32)] * 2


def run(inputs, state):
    """Run the graph; return translation (3,), rotation (3, 3) and the new state."""
    translation, rotation, *state = session.run(None, {**inputs, "hidden": state[0], "cell": state[1]})
    return translation[0], rotation[0], state
'''
_WARP = '''

def step(earlier, later, nominal_translation_m, altitude_m, down, state):
    """The motion between two frames, from the expected translation (3,), the altitude and the unit vector down (3,).

    Vectors are in the frame of the earlier camera. The later frame is resampled over the ground plane to what the
    earlier camera would see after the expected motion without rotation.
    """
    camera = np.array(facts["camera_matrix"])
    camera[:2, 2] -= 0.5  # OpenCV's origin is the middle of the first pixel.
    plane = np.eye(3) - np.outer(nominal_translation_m, down) / altitude_m
    homography = camera @ plane @ np.linalg.inv(camera)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    inputs = {
        "first": normalised(earlier)[None],
        "second": cv2.warpPerspective(normalised(later), homography, size, flags=flags)[None],
        "nominal_translation_m": np.array(nominal_translation_m, np.float32)[None],
        "altitude_m": np.array([altitude_m], np.float32),
    }
    return run(inputs, state)
'''
_STACK = '''

def step(earlier, later, state):
    """The motion between two frames."""
    return run({"first": normalised(earlier)[None], "second": normalised(later)[None]}, state)
'''


def readme(metadata: dict[str, Any]) -> str:
    """Return the README, in Markdown, of an export with this metadata (navigator.json)."""
    height, width, hidden = metadata["height_px"], metadata["width_px"], metadata["hidden"]
    warp = metadata["fusion"] == "warp"
    rows = [
        ("first", f"(1, {height}, {width})", "earlier frame, normalised"),
        ("second", f"(1, {height}, {width})", "later frame, normalised" + (", resampled (see `step`)" if warp else "")),
        ("nominal_translation_m", "(1, 3)", "expected translation, frame of the earlier camera, metres"),
        ("altitude_m", "(1)", "expected altitude at the earlier frame, metres"),
        ("hidden", f"(2, 1, {hidden})", "hidden state of the LSTM; zeros at the start of a descent"),
        ("cell", f"(2, 1, {hidden})", "cell state of the LSTM; zeros at the start of a descent"),
        ("translation_m", "(1, 3)", "output: translation, frame of the earlier camera, metres"),
        ("rotation_c2_from_c1", "(1, 3, 3)", "output: rotation from the earlier to the later camera"),
        ("hidden_out", f"(2, 1, {hidden})", "output: hidden state for the next pair"),
        ("cell_out", f"(2, 1, {hidden})", "output: cell state for the next pair"),
    ]
    known = {*metadata["inputs"], *metadata["outputs"]}
    lines = [
        f"# Navigator ({metadata['fusion']})",
        "",
        "`navigator.onnx` estimates the motion of a camera between two consecutive frames, one pair at a time. The",
        "state of its LSTM is an input and an output. Camera frame: x right, y down in the image, z along the view.",
        "",
        "| Input or output | Shape, float32 | Content |",
        "|---|---|---|",
        *(f"| `{name}` | {shape} | {content} |" for name, shape, content in rows if name in known),
        "",
        f"Normalisation: {metadata['normalisation']}.",
        "",
    ]
    if warp:
        lines += [
            "The graph is for one camera, `camera_matrix` in navigator.json (pixels of the input, origin at the outer",
            "corner of the first pixel), without distortion. For another camera, export again with `--dataset` and a",
            "dataset of that camera.",
            "",
        ]
    lines += [
        f"The file was run pair by pair over {metadata['compared_pairs']} pairs of {metadata['compared_on']} and",
        "compared with torch, which ran over all pairs at once. Largest difference:",
        f"{metadata['largest_difference_from_torch']:.1e}, for translations relative to the largest translation (at",
        "least 1 m).",
        "",
        "`navigator.json` contains all values of this page and more; the ONNX file contains most of them as metadata.",
        "",
        "```python",
        (_START + (_WARP if warp else _STACK)).rstrip(),
        "```",
        "",
    ]
    return "\n".join(lines)
