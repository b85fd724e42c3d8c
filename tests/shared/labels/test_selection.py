"""Named selections, and labels read with the columns that they need."""

import numpy as np
import pandas as pd
import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.labels.selection import label_bound_px, read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS, Selection

GOOD = {
    "radius_px": 5.0,
    "visible_fraction": 0.9,
    "sunlit_fraction": 0.9,
    "contrast": 20.0,
    "depth_m": 1.0,
    "diameter_m": 10.0,
}


def labels(*changes):
    return pd.DataFrame([{**GOOD, **change} for change in changes])


def test_the_named_selections():
    rows = labels(
        {},
        {"radius_px": 1.9},
        {"radius_px": 51.0, "contrast": 200.0},
        {"visible_fraction": 0.2},
        {"sunlit_fraction": 0.05},
        {"contrast": 3.9},
        {"depth_m": 0.39},
        {"depth_m": np.nan, "diameter_m": np.nan},
    )
    assert selected(rows, SELECTIONS["all"]).all()
    assert selected(rows, SELECTIONS["paper"]).tolist() == [True, False, False, *[True] * 5]
    assert selected(rows, SELECTIONS["visible"]).tolist() == [True, False, True, *[False] * 5]


@pytest.mark.parametrize(
    ("width_px", "stated", "bound"),
    [(128, None, 50.0), (256, None, 50.0), (1024, None, 200.0), (1024, 50.0, 50.0), (1024, "much", 200.0)],
)
def test_the_label_bound_comes_from_the_recipe_or_the_image_width(quick, width_px, stated, bound):
    info = open_dataset(quick / "detect").info
    recipe = info.recipe().model_copy(update={"config": {"labels": {"max_radius_px": stated}}})
    camera = info.camera.model_copy(update={"width_px": width_px})
    assert label_bound_px(info.model_copy(update={"camera": camera, "recipes": {recipe.key: recipe}})) == bound


@pytest.mark.parametrize(
    ("threshold", "value", "row"),
    [
        ("radius_px", (5.0, 5.0), {"radius_px": 5.1}),
        ("min_visible_fraction", 0.9, {"visible_fraction": 0.89}),
        ("min_sunlit_fraction", 0.9, {"sunlit_fraction": 0.89}),
        ("min_depth_ratio", 0.1, {"depth_m": 0.99}),
        ("min_contrast", 20.0, {"contrast": -30.0}),
    ],
)
def test_each_threshold_is_inclusive_and_independent(threshold, value, row):
    chosen = selected(labels({}, row), Selection(**{threshold: value}))
    assert chosen.dtype == np.bool_ and chosen.tolist() == [True, False]


def test_the_contrast_of_large_craters_is_limited():
    """4 px: pi (1.5 x 4)^2 = 113 pixels; 20 px: 2827 pixels, of which a hundredth counts."""
    rows = labels(
        {"radius_px": 4.0, "contrast": 5.0},
        {"radius_px": 20.0, "contrast": 49.9},
        {"radius_px": 20.0, "contrast": 50.1},
    )
    limited = Selection(min_contrast=5.0, contrast_pixels=28.2743)
    assert selected(rows, limited).tolist() == [False, False, True]
    assert selected(rows, Selection(min_contrast=5.0)).all()


def test_labels_are_read_with_their_craters(quick):
    dataset = open_dataset(quick / "detect")
    rows = read_labels(dataset, ["ellipse_a_px"])
    table = dataset.table("labels").to_pandas()
    for column in ("frame_id", "crater_id", "contrast", "ellipse_a_px"):
        assert rows[column].tolist() == table[column].tolist()
    craters = dataset.table("craters").to_pandas().set_index(["scene_id", "crater_id"])
    row = rows.iloc[len(rows) // 2]
    assert row.depth_m == craters.loc[(row.scene_id, row.crater_id)].depth_m
    parts = [read_labels(dataset, split=split) for split in ("train", "val", "test")]
    assert sum(map(len, parts)) == len(rows) and all(len(part) for part in parts)
    # A selection of a real dataset contains some labels, not all.
    seen = selected(rows, SELECTIONS["visible"])
    assert 0.2 < seen.mean() < 0.95 and selected(rows, SELECTIONS["paper"]).all()
    assert np.isfinite(rows["contrast"]).all() and (rows["contrast"] > 4).mean() < 0.98
    # Deep craters have more contrast than eroded ones.
    ratio = rows["depth_m"] / rows["diameter_m"]
    assert rows["contrast"][ratio > 0.1].median() > 1.5 * rows["contrast"][ratio < 0.04].median()
