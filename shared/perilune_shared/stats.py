"""What a dataset holds, in numbers."""

import pandas as pd

from perilune_shared.manifest import Dataset


def summary(dataset: Dataset) -> pd.DataFrame:
    """One row a split: scenes, trajectories, frames, labels, labels per frame and quantiles of the radius in pixels."""
    frames = dataset.table("frames", ["frame_id", "scene_id", "trajectory_id", "split", "png_bytes"]).to_pandas()
    labels = dataset.table("labels", ["frame_id", "radius_px", "visible_fraction"]).to_pandas()
    labels = labels.merge(frames[["frame_id", "split"]], on="frame_id")
    rows = []
    for split, part in frames.groupby("split"):
        seen = labels[labels["split"] == split]
        rows.append(
            {
                "split": split,
                "scenes": part["scene_id"].nunique(),
                "trajectories": len(part.drop_duplicates(["scene_id", "trajectory_id"])),
                "frames": len(part),
                "labels": len(seen),
                "labels_per_frame": round(len(seen) / len(part), 1),
                "radius_px_q10": _quantile(seen["radius_px"], 0.1),
                "radius_px_median": _quantile(seen["radius_px"], 0.5),
                "radius_px_q90": _quantile(seen["radius_px"], 0.9),
                "visible_fraction_mean": round(float(seen["visible_fraction"].mean()), 3) if len(seen) else None,
                "png_mb": round(part["png_bytes"].sum() / 1e6, 1),
            }
        )
    return pd.DataFrame(rows)


def _quantile(values: pd.Series, share: float) -> float | None:
    return round(float(values.quantile(share)), 2) if len(values) else None
