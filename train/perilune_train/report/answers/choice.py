"""Choose the detections of the viewer for which answers are computed."""

from collections import Counter
from collections.abc import Collection, Sequence
from itertools import zip_longest

import numpy as np

from perilune_train.report.content import FramePicture

_GOLDEN = (np.sqrt(5) - 1) / 2
Place = tuple[int, int]
"""Index of a frame in the viewer, and index of a detection in this frame."""


def chosen_detections(
    frames: Sequence[FramePicture], craters: Sequence[Sequence[int | None]], changed: Collection[int], count: int
) -> list[Place]:
    """At most `count` detections: in turn a changed crater, a false positive, and a correct detection.

    `craters` has the crater_id of each detection's label by frame, None without a label; `changed` has the craters that
    counterfactual frames change. Craters that were not chosen before come first. Of each frame, the false positive with
    the highest score and the correct detection with the lowest score are considered. Consecutive choices are from
    frames that are far apart.
    """
    # Multiples of the golden ratio spread any number of first frames evenly over the descent.
    order = np.argsort(np.arange(len(frames)) * _GOLDEN % 1, kind="stable").tolist()
    of_changed: list[tuple[int, Place]] = []
    false: list[Place] = []
    correct: list[Place] = []
    seen: Counter[int] = Counter()
    for frame in order:
        detections = frames[frame].detections
        for k, crater in enumerate(craters[frame]):
            if crater is not None and crater in changed:
                of_changed.append((seen[crater], (frame, k)))
                seen[crater] += 1
        wrong = [k for k, mark in enumerate(detections) if mark.kind == "false"]
        right = [k for k, mark in enumerate(detections) if mark.kind == "matched"]
        # Detections are sorted by score.
        false += [(frame, wrong[0])] if wrong else []
        correct += [(frame, right[-1])] if right else []
    of_changed.sort(key=lambda ranked: ranked[0])
    queues = ([place for _, place in of_changed], false, correct)
    in_turn = [place for group in zip_longest(*queues) for place in group if place is not None]
    return list(dict.fromkeys(in_turn))[:count]
