"""A dataset of six test scenes, the same without some craters, and the table of these craters."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS

SPLITS = {"train": 1, "val": 1, "test": 6}
PER_SCENE = 4


@dataclass(frozen=True)
class Rendered:
    """Two datasets of the same frames."""

    factual: Path
    """All craters: 6 test scenes, 2 frames of 96 px each."""
    without: Path
    """The same frames without four craters of each test scene; <without>.removed.parquet lists them."""
    removed: pd.DataFrame
    """scene_id, crater_id and depth_ratio of the removed craters."""


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    folder = tmp_path_factory.mktemp("causal")
    factual = build_dataset(folder / "all", "detect", splits=SPLITS, n_frames=2)
    labels = read_labels(open_dataset(factual), ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"], "test")
    labels = labels[selected(labels, SELECTIONS["visible"])]
    low, high = labels[["bbox_x0_px", "bbox_y0_px"]].min(axis=1), labels[["bbox_x1_px", "bbox_y1_px"]].max(axis=1)
    whole = labels[(low >= 0) & (high <= 96)].sort_values("radius_px", ascending=False)
    chosen = {scene: own["crater_id"].unique()[:PER_SCENE].tolist() for scene, own in whole.groupby("scene_id")}
    without = build_dataset(folder / "without", "detect", splits=SPLITS, n_frames=2, removed=chosen)
    removed = pd.DataFrame([{"scene_id": scene, "crater_id": one} for scene, own in chosen.items() for one in own])
    removed["depth_ratio"] = np.float64(0.15)
    removed.to_parquet(folder / "without.removed.parquet")
    return Rendered(factual, without, removed)
