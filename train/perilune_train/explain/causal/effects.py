"""Measure how masks, detections and poses change when single craters are removed.

Three changes of a frame are compared in an ellipse around each crater:

- rendered: the crater is removed from the ground, and the frame is rendered again. Pixels far from the crater stay
  equal, except for one or two grey values if the automatic exposure changes.
- inpainted: the ellipse is filled from its surroundings, which removes the crater's pixels.
- placebo: an ellipse of equal shape on ground without labelled craters is filled from its surroundings. This shows the
  effect of filling alone.

A gate reacts to craters if the rendered change alters its mask and the placebo does not.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_train.data.frames import frame_table
from perilune_train.detect.evaluate.boxes import iou_matrix
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.explain.causal.pairs import CraterPairs
from perilune_train.explain.maps.masks import Masks
from perilune_train.models.navigator import StackNavigator
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.network import predict, target_of
from perilune_train.motion.pose import predict_pose

REACH = 1.4
"""Semi-axes of the region around a crater, divided by the crater's semi-axes. The region ends where the outermost ring
of the paper's mask G ends."""
_INPAINT_RADIUS_PX = 3
_TRIES = 200
_MIN_IOU = 0.5
_TRAJECTORY = ["scene_id", "trajectory_id"]


def region(shape: tuple[int, ...], crater: pd.Series, shift_px: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.bool_]:
    """Pixels (height, width) of the elliptic region around a crater, moved by `shift_px` (x, y).

    `crater` is a row of `CraterPairs.craters`.
    """
    u, v = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    x, y = u - crater["ellipse_cx_px"] - shift_px[0], v - crater["ellipse_cy_px"] - shift_px[1]
    c, s = np.cos(crater["ellipse_theta_rad"]), np.sin(crater["ellipse_theta_rad"])
    along, across = (c * x + s * y) / crater["ellipse_a_px"], (c * y - s * x) / crater["ellipse_b_px"]
    return along**2 + across**2 <= REACH**2


def empty_shift(crater: pd.Series, occupied: NDArray[np.bool_], rng: np.random.Generator) -> tuple[float, float] | None:
    """A random shift (x, y), pixels, that moves a crater's region onto free ground; None if no shift was found.

    `occupied` (height, width) are pixels in or near labelled craters. Shifts are drawn until the region is free, at
    most 200 times.
    """
    height, width = occupied.shape
    reach = REACH * crater["ellipse_a_px"] + 1
    if 2 * reach >= min(height, width):
        return None
    for _ in range(_TRIES):
        x, y = rng.uniform(reach, width - reach), rng.uniform(reach, height - reach)
        shift = x - crater["ellipse_cx_px"], y - crater["ellipse_cy_px"]
        if not (region((height, width), crater, shift) & occupied).any():
            return shift
    return None


def inpainted(image: NDArray[np.uint8], chosen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The image (height, width) with the chosen pixels (height, width) filled from their surroundings (Telea 2004)."""
    filled = cv2.inpaint(image, chosen.astype(np.uint8), _INPAINT_RADIUS_PX, cv2.INPAINT_TELEA)
    return np.asarray(filled, np.uint8)


def filled_frames(
    pairs: CraterPairs, occupied: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], list[tuple[float, float] | None]]:
    """Inpaint the removed craters in copies of the frames, and placebo regions in other copies.

    Returns the frames with inpainted craters and the frames with inpainted placebo regions, both (N, height, width),
    and the shift of the placebo region for each row of `pairs.craters`. `occupied` (N, height, width) are pixels in or
    near labelled craters.
    """
    shape = pairs.factual.shape[1:]
    without, placebo = (np.zeros(pairs.factual.shape, bool) for _ in range(2))
    shifts = []
    taken = occupied.copy()
    for _, crater in pairs.craters.iterrows():
        image = int(crater["image"])
        without[image] |= region(shape, crater)
        shift = empty_shift(crater, taken[image], rng)
        shifts.append(shift)
        if shift is not None:
            chosen = region(shape, crater, shift)
            placebo[image] |= chosen
            taken[image] |= chosen
    fill = [
        np.stack([inpainted(*pair) for pair in zip(pairs.factual, chosen, strict=True)])
        for chosen in (without, placebo)
    ]
    return fill[0], fill[1], shifts


def mask_effects(
    pairs: CraterPairs, masks: dict[str, Masks], shifts: Sequence[tuple[float, float] | None]
) -> pd.DataFrame:
    """Change of every gate's mask in the region of every crater, in standard deviations of the mask.

    `masks` has the masks of the versions "factual", "rendered", "inpainted" and "placebo". The change is the mean of
    the factual mask over the region minus the mean of the other version's mask. A change above 0 means that the gate is
    stronger with the crater. `shifts` comes from `filled_frames`; the change of a placebo without a shift is NaN.
    Columns: crater, map, version, change, and the crater's ids and properties.
    """
    shape, rows = pairs.factual.shape[1:], []
    for (_, crater), shift in zip(pairs.craters.iterrows(), shifts, strict=True):
        inside, image = region(shape, crater), int(crater["image"])
        moved = None if shift is None else region(shape, crater, shift)
        regions = {"rendered": inside, "inpainted": inside, "placebo": moved}
        for version, chosen in regions.items():
            for block, factual in masks["factual"].items():
                if chosen is None or not chosen.any():
                    change = np.nan
                else:
                    change = float((factual[image] - masks[version][block][image])[chosen].mean())
                rows.append({"crater": crater.name, "map": block, "version": version, "change": change})
    table = pd.DataFrame(rows)
    spread = {block: max(float(gate_masks.std()), 1e-9) for block, gate_masks in masks["factual"].items()}
    table["change"] /= table["map"].map(spread)
    return table.merge(_facts(pairs), left_on="crater", right_index=True)


def detection_effects(
    pairs: CraterPairs, detect: Callable[[NDArray[np.uint8]], list[Detections]], versions: dict[str, NDArray[np.uint8]]
) -> pd.DataFrame:
    """Highest score of the detections that match each crater, in each version of its frame.

    A detection matches if its box has an IoU of at least 0.5 with the crater's box. The score is 0 without a match.
    `versions` are frames (N, height, width) by name. Columns: crater, version, score, and the crater's ids and
    properties.
    """
    boxes = pairs.craters[["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]].to_numpy(np.float64)
    image, rows = pairs.craters["image"].to_numpy(), []
    for version, images in versions.items():
        detections = detect(images)
        for k in range(len(boxes)):
            frame_detections = detections[image[k]]
            overlap = iou_matrix(frame_detections.boxes.reshape(-1, 4), boxes[k : k + 1])[:, 0]
            score = float(frame_detections.scores[overlap >= _MIN_IOU].max(initial=0.0))
            rows.append({"crater": k, "version": version, "score": score})
    return pd.DataFrame(rows).merge(_facts(pairs), left_on="crater", right_index=True)


def with_found(effects: pd.DataFrame, threshold: float, shifts: Sequence[tuple[float, float] | None]) -> pd.DataFrame:
    """The table of `detection_effects` with the column found: 1 if the score reaches the threshold, else 0.

    `shifts` comes from `filled_frames`. A crater whose shift is None has no placebo, so found is NaN for its placebo.
    """
    missing = np.array([shift is None for shift in shifts], bool)[effects["crater"].to_numpy(int)]
    is_found = (effects["score"] >= threshold).astype(float)
    return effects.assign(found=is_found.mask((effects["version"] == "placebo") & missing))


def _facts(pairs: CraterPairs) -> pd.DataFrame:
    return pairs.craters[["frame_id", "scene_id", "crater_id", "radius_px", "depth_ratio", "sun_elevation_deg"]]


def pose_effects(
    navigator: StackNavigator, architecture: dict[str, Any], factual: Dataset, counterfactual: Dataset, split: str
) -> pd.DataFrame:
    """The navigator's position error in each pair of frames, before and after the removal of craters.

    Columns: frame_id (scene/trajectory/step), scene_id, before, after (position errors, metres), moved_m (distance
    between both estimates). Raises UserError if the counterfactual dataset lacks frames of a trajectory, because its
    pairs would not be consecutive.
    """
    check_descents(factual, counterfactual, split)
    originals = {trajectory.ids: trajectory for trajectory in load_split(factual, split)}
    of_pose, tables = target_of(architecture) == "pose", []
    predicted = predict_pose if of_pose else predict
    for changed in load_split(counterfactual, split):
        original = originals[changed.ids]
        estimates = [predicted(navigator, architecture, version)[0] for version in (original, changed)]
        truth_m = original.pose[0] if of_pose else original.motion[0]
        before, after = (np.linalg.norm(version - truth_m, axis=1) for version in estimates)
        steps = ["/".join([*changed.ids, str(step)]) for step in range(changed.n_pairs)]
        moved = np.linalg.norm(estimates[1] - estimates[0], axis=1)
        columns = {"frame_id": steps, "scene_id": changed.ids[0], "before": before, "after": after, "moved_m": moved}
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def check_descents(factual: Dataset, counterfactual: Dataset, split: str) -> None:
    """Raise UserError if the counterfactual dataset lacks frames of one of its trajectories."""
    whole, changed = (
        Counter(frame_table(dataset, split)[_TRAJECTORY].agg("/".join, axis=1)) for dataset in (factual, counterfactual)
    )
    for trajectory, count in changed.items():
        if whole[trajectory] != count:
            got = f"{count} frames of {trajectory}"
            expected = "all frames of a trajectory of the dataset; render with --frames-per-trajectory 1000"
            raise UserError(counterfactual.store, "frames", got, expected)
