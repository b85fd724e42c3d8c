"""Frames with and without single craters, and where these craters are."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.labels.selection import selected
from perilune_shared.labels.thresholds import Selection
from perilune_train.data.frames import frame_table, load_images

REMOVED = "removed.parquet"
_LABELS = ["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad"]
_BOX = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]
_THRESHOLDED = ["radius_px", "visible_fraction", "sunlit_fraction", "contrast"]


@dataclass(frozen=True)
class CraterPairs:
    """N frames rendered twice: on the ground, and on the same ground without some craters."""

    factual: NDArray[np.uint8]
    """Frames with all craters (N, height, width)."""
    counterfactual: NDArray[np.uint8]
    """The same frames without the removed craters (N, height, width)."""
    frames: pd.DataFrame
    """frame_id and scene_id of the frames (N rows)."""
    craters: pd.DataFrame
    """A row for each removed crater in each frame that shows it whole: image (index of the frame), frame_id, scene_id,
    crater_id, ellipse and box in pixels, radius_px, depth_ratio, sun_elevation_deg."""


def crater_pairs(factual: Dataset, counterfactual: Dataset, split: str, selection: Selection) -> CraterPairs:
    """Load the frames of a counterfactual dataset and the same frames of the dataset that it was rendered from.

    Only craters that `selection` accepts in the factual frame, whole in the image, are listed. Raises UserError if the
    second dataset has no table of removed craters, or frames that the first does not have.
    """
    rows = frame_table(counterfactual, split)
    whole = frame_table(factual, split)
    known = whole[whole["frame_id"].isin(rows["frame_id"])].reset_index(drop=True)
    if known["frame_id"].tolist() != rows["frame_id"].tolist():
        found = f"{len(rows)} frames, {len(known)} of them in {factual.store}"
        raise UserError(counterfactual.store, "frames", found, "frames of the dataset that it was rendered from")
    images = load_images(factual, known, split), load_images(counterfactual, rows, split)
    return CraterPairs(*images, rows[["frame_id", "scene_id"]], _shown(factual, counterfactual, rows, selection))


def _shown(factual: Dataset, counterfactual: Dataset, rows: pd.DataFrame, selection: Selection) -> pd.DataFrame:
    if not counterfactual.store.exists(REMOVED):
        expected = "a dataset of `perilune-render counterfactual`"
        raise UserError(counterfactual.store, REMOVED, "no such file", expected)
    removed = pd.read_parquet(pa.BufferReader(counterfactual.store.read(REMOVED)))
    names = list(dict.fromkeys(["frame_id", "crater_id", *_LABELS, *_BOX, *_THRESHOLDED]))
    tables = []
    for scene_id, own in removed.groupby("scene_id"):
        labels = factual.table("labels", names, scene_id=str(scene_id)).to_pandas()
        labels = labels[labels["crater_id"].isin(own["crater_id"]) & labels["frame_id"].isin(rows["frame_id"])]
        labels = labels[np.asarray(selected(labels, selection))]
        tables.append(labels.assign(scene_id=str(scene_id)).merge(own[["crater_id", "depth_ratio"]], on="crater_id"))
    craters = pd.concat(tables, ignore_index=True)
    camera = factual.info.camera
    inside = (craters["bbox_x0_px"] >= 0) & (craters["bbox_x1_px"] <= camera.width_px)
    inside &= (craters["bbox_y0_px"] >= 0) & (craters["bbox_y1_px"] <= camera.height_px)
    craters = craters[inside].reset_index(drop=True)
    place = {frame_id: index for index, frame_id in enumerate(rows["frame_id"])}
    sun = {
        frame_id: np.degrees(np.arcsin(direction[2]))
        for frame_id, direction in zip(rows["frame_id"], rows["sun_direction"], strict=True)
    }
    return craters.assign(image=craters["frame_id"].map(place), sun_elevation_deg=craters["frame_id"].map(sun))
