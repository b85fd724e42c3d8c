"""Load frames with and without single craters, and the labels of these craters."""

import io
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import Selection
from perilune_shared.storage.store import Address, open_store
from perilune_train.data.frames import frame_table, load_images

_LABELS = ["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad"]
_BOX = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]
_REMOVED = ["scene_id", "crater_id", "depth_ratio"]
_MAX_BYTES = 64 * 2**20


@dataclass(frozen=True)
class CraterPairs:
    """N frames rendered twice, with all craters and without some of them."""

    factual: NDArray[np.uint8]
    """Frames with all craters (N, height, width)."""
    counterfactual: NDArray[np.uint8]
    """These frames without the removed craters (N, height, width)."""
    frames: pd.DataFrame
    """frame_id and scene_id of the frames (N rows)."""
    craters: pd.DataFrame
    """One row per removed crater and frame that shows the whole crater: image (index of the frame), frame_id, scene_id,
    crater_id, ellipse and box in pixels, radius_px, depth_ratio, sun_elevation_deg."""


def crater_pairs(
    factual: Dataset, counterfactual: Dataset, removed: pd.DataFrame, split: str, selection: Selection
) -> CraterPairs:
    """Load the frames of a counterfactual dataset and the matching frames of the dataset it was rendered from.

    `removed` is the table of `read_removed`. The result lists only removed craters that `selection` accepts in the
    factual frame and that are wholly in the image. Raises UserError if there are no such craters, or if the
    counterfactual dataset has frames that the factual dataset lacks.
    """
    known, rows = same_frames(factual, counterfactual, split)
    craters = _shown(factual, removed, rows, split, selection)
    if craters.empty:
        expected = "removed craters that are labelled and whole in a frame; remove more, with --craters-per-scene"
        raise UserError(counterfactual.store, f"craters of split {split}", f"none of {len(removed)}", expected)
    images = load_images(factual, known, split), load_images(counterfactual, rows, split)
    return CraterPairs(*images, rows[["frame_id", "scene_id"]], craters)


def same_frames(factual: Dataset, other: Dataset, split: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The frames of a split that both datasets contain, as two `frame_table`s in equal order.

    Raises UserError if `other` has frames that `factual` lacks.
    """
    rows, whole = (frame_table(dataset, split) for dataset in (other, factual))
    known = whole[whole["frame_id"].isin(rows["frame_id"])].reset_index(drop=True)
    if known["frame_id"].tolist() != rows["frame_id"].tolist():
        got = f"{len(rows)} frames, {len(known)} of them in {factual.store}"
        raise UserError(other.store, "frames", got, "frames of the dataset that it was rendered from")
    return known, rows


def read_removed(address: Address) -> pd.DataFrame:
    """Read <dataset>.removed.parquet, the table of the craters removed from a counterfactual dataset.

    Raises UserError if the table is missing, damaged or empty.
    """
    above, _, name = f"{str(address).rstrip('/')}.removed.parquet".rpartition("/")
    store = open_store(above or ".")
    if not store.exists(name):
        raise UserError(store.at(name), "table", "no such file", "the table of `perilune-render counterfactual`")
    try:
        table = pd.read_parquet(io.BytesIO(store.read(name, most_bytes=_MAX_BYTES)), columns=_REMOVED)
    except (ValueError, OSError) as error:
        raise UserError(store.at(name), "table", str(error).splitlines()[0], ", ".join(_REMOVED)) from None
    if table.empty:
        raise UserError(store.at(name), "rows", 0, "removed craters; render with --craters-per-scene above 0")
    return table


def _shown(
    factual: Dataset, removed: pd.DataFrame, rows: pd.DataFrame, split: str, selection: Selection
) -> pd.DataFrame:
    labels = read_labels(factual, [*_LABELS, *_BOX], split)
    labels = labels[labels["frame_id"].isin(rows["frame_id"]) & selected(labels, selection)]
    keys = ["scene_id", "crater_id"]
    craters = labels.merge(removed[[*keys, "depth_ratio"]], on=keys)
    camera = factual.info.camera
    inside = (craters["bbox_x0_px"] >= 0) & (craters["bbox_x1_px"] <= camera.width_px)
    inside &= (craters["bbox_y0_px"] >= 0) & (craters["bbox_y1_px"] <= camera.height_px)
    craters = craters[inside].reset_index(drop=True)
    index_of = {frame_id: index for index, frame_id in enumerate(rows["frame_id"])}
    sun = {
        frame_id: np.degrees(np.arcsin(direction[2]))
        for frame_id, direction in zip(rows["frame_id"], rows["sun_direction"], strict=True)
    }
    return craters.assign(image=craters["frame_id"].map(index_of), sun_elevation_deg=craters["frame_id"].map(sun))
