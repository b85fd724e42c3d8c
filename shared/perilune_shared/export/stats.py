"""Statistics of a dataset. Labels are read one row group at a time, to limit memory."""

import numpy as np
import pandas as pd

from perilune_shared.dataset.keys import FRAME_COLUMNS, KeyCheck
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.parts import Part
from perilune_shared.errors import UserError


def summary(dataset: Dataset) -> pd.DataFrame:
    """Return a table of counts and quantiles, with one row per split.

    Columns: scenes, trajectories, frames, labels, labels per frame, quantiles of the radius in pixels, mean visible
    fraction, craters in view that are too large for a label (None if not known) and size of the PNGs (10^6 bytes).

    Raises UserError if there are no frames, or if the keys of labels and frames are inconsistent.
    """
    frames = dataset.table("frames", [*FRAME_COLUMNS, "split", "png_bytes", "n_craters_above_max_radius"])
    keys = KeyCheck(dataset, frames)
    if not len(frames):
        raise UserError(dataset.store, "frames", "none", "a dataset with frames")
    gathered = {split: _Gathered() for split in sorted(frames["split"].unique().to_pylist())}
    split_of = frames["split"].combine_chunks().dictionary_encode()
    names = np.array(split_of.dictionary.to_pylist(), object)
    codes = split_of.indices.to_numpy()
    for part in dataset.parts("labels"):
        opened = Part(dataset.store, part, "labels")
        for group in range(opened.n_groups):
            rows = opened.read(["frame_id", "scene_id", "crater_id", "radius_px", "visible_fraction"], [group])
            code = codes[keys.add_labels(rows)]
            radius, visible = rows["radius_px"].to_numpy(), rows["visible_fraction"].to_numpy()
            for k, name in enumerate(names):
                in_split = code == k
                gathered[name].radius_px.append(radius[in_split].astype(np.float32))
                gathered[name].visible += float(visible[in_split].sum())
    keys.finish()
    table = frames.to_pandas()
    return pd.DataFrame([_row(split, part, gathered[split]) for split, part in table.groupby("split")])


class _Gathered:
    """Values collected from the labels of one split."""

    def __init__(self) -> None:
        self.radius_px: list[np.ndarray] = []
        self.visible = 0.0


def _row(split: str, frames: pd.DataFrame, labels: _Gathered) -> dict:
    radius = np.concatenate(labels.radius_px) if labels.radius_px else np.empty(0, np.float32)
    quantiles = np.quantile(radius, [0.1, 0.5, 0.9]).round(2).tolist() if len(radius) else [None] * 3
    png_bytes, too_large = frames["png_bytes"].sum(), frames["n_craters_above_max_radius"]
    return {
        "split": split,
        "scenes": frames["scene_id"].nunique(),
        "trajectories": len(frames.drop_duplicates(["scene_id", "trajectory_id"])),
        "frames": len(frames),
        "labels": len(radius),
        "labels_per_frame": round(len(radius) / len(frames), 1),
        **dict(zip(("radius_px_q10", "radius_px_median", "radius_px_q90"), quantiles, strict=True)),
        "visible_fraction_mean": round(labels.visible / len(radius), 3) if len(radius) else None,
        "craters_too_large_for_a_label": None if too_large.isna().any() else int(too_large.sum()),
        "png_mb": round(float(png_bytes) / 1e6, 1),
    }
