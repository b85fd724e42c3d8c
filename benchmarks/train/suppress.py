"""Time of non-maximum suppression: compiled, frame by frame, against a whole batch on the device and against OpenCV.

A frame has 8,000 candidates, about fifteen per crater. Both keep the same boxes. A network that is hardly trained has
more candidates, of which thousands are kept; `untrained` compares the limit on detections with keeping all, and with
OpenCV.
Writes runs/bench/suppress.json.
"""

import statistics
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.figures import write_figures
from perilune_train.detect.config import EvaluationSettings
from perilune_train.detect.evaluate.boxes import suppress
from perilune_train.detect.inference.suppression import suppress_batch

CANDIDATES, THRESHOLD_IOU, ROUNDS = 8000, 0.45, 7


def candidates(rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Boxes (K, 4) and scores (K,) for one frame of 256 px."""
    which = rng.integers(CANDIDATES // 15, size=CANDIDATES)
    side = rng.lognormal(1.8, 0.6, (CANDIDATES // 15, 1)).clip(3, 80)[which]
    centre = rng.uniform(0, 256, (CANDIDATES // 15, 2))[which] + 0.1 * side * rng.normal(size=(CANDIDATES, 2))
    half = side * np.exp(0.1 * rng.normal(size=(CANDIDATES, 2))) / 2
    boxes = torch.tensor(np.concatenate([centre - half, centre + half], axis=1), dtype=torch.float32)
    return boxes, torch.tensor(rng.uniform(0.01, 1, CANDIDATES), dtype=torch.float32)


def untrained_candidates(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Boxes (K, 4) and scores (K,) of all predictors for one frame of 256 px: three anchors at strides 4, 8 and 16."""
    boxes = []
    for stride, anchors in ((4, (6, 9, 13)), (8, (18, 26, 36)), (16, (50, 70, 100))):
        grid = np.stack(np.meshgrid(*[np.arange(0, 256, stride) + stride / 2] * 2), axis=-1).reshape(-1, 2)
        for anchor in anchors:
            centre = grid + stride / 3 * rng.normal(size=grid.shape)
            half = anchor * np.exp(0.1 * rng.normal(size=(len(grid), 1))) / 2
            boxes.append(np.concatenate([centre - half, centre + half], axis=1))
    return np.concatenate(boxes), rng.uniform(0.01, 0.2, sum(map(len, boxes)))


def median_s(call: Callable[[], object]) -> float:
    """Median time of a call in seconds."""
    times = []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main() -> None:
    """Run the benchmark."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    result: dict[str, object] = {"device": device, "candidates": CANDIDATES}
    for n_frames in (1, 8):
        rng = np.random.default_rng(0)
        boxes, scores = (
            torch.stack(part).to(device) for part in zip(*(candidates(rng) for _ in range(n_frames)), strict=True)
        )
        every = torch.ones_like(scores, dtype=torch.bool)

        def by_frame(boxes: Tensor = boxes, scores: Tensor = scores) -> None:
            for some_boxes, some_scores in zip(boxes.cpu().numpy(), scores.cpu().numpy(), strict=True):
                suppress(some_boxes, some_scores, THRESHOLD_IOU, CANDIDATES)

        def whole(boxes: Tensor = boxes, scores: Tensor = scores, every: Tensor = every) -> None:
            suppress_batch(boxes, scores, every, THRESHOLD_IOU).cpu()

        frames_s, batch_s = median_s(by_frame), median_s(whole)
        result[f"frames_{n_frames}"] = {"frame_by_frame_s": frames_s, "batch_s": batch_s, "ratio": batch_s / frames_s}
        print(f"{n_frames} frames: one by one {frames_s:.3f} s, batch on {device} {batch_s:.3f} s")
    several_boxes, several_scores = untrained_candidates(np.random.default_rng(0))
    limit = EvaluationSettings().max_detections
    all_s = median_s(lambda: suppress(several_boxes, several_scores, THRESHOLD_IOU, len(several_boxes)))
    limited_s = median_s(lambda: suppress(several_boxes, several_scores, THRESHOLD_IOU, limit))
    sizes = np.concatenate([several_boxes[:, :2], several_boxes[:, 2:] - several_boxes[:, :2]], axis=1)
    scores_list = several_scores.tolist()
    opencv_s = median_s(lambda: cv2.dnn.NMSBoxes(sizes, scores_list, 0.0, THRESHOLD_IOU))
    result["untrained"] = {
        "candidates": len(several_boxes),
        "limit": limit,
        "all_s": all_s,
        "limited_s": limited_s,
        "opencv_s": opencv_s,
        "ratio": limited_s / opencv_s,
    }
    own = f"all {all_s:.4f} s, {limit} detections {limited_s:.4f} s, OpenCV {opencv_s:.3f} s"
    print(f"untrained, {len(several_boxes)} candidates: {own}")
    write_figures(Path("runs/bench/suppress.json"), result)


if __name__ == "__main__":
    main()
