"""Effects of removed craters, on masks and detections that are known."""

import numpy as np
import pandas as pd
import pytest

from perilune_train.detect.evaluate.matching import Detections
from perilune_train.explain.causal.effects import (
    detection_effects,
    empty_shift,
    filled_frames,
    mask_effects,
    region,
    with_found,
)
from perilune_train.explain.causal.pairs import CraterPairs
from perilune_train.explain.causal.pictures import by_gate

CRATER = {
    "frame_id": "f0",
    "scene_id": "s0",
    "crater_id": 7,
    "image": 0,
    "ellipse_cx_px": 20.0,
    "ellipse_cy_px": 30.0,
    "ellipse_a_px": 5.0,
    "ellipse_b_px": 5.0,
    "ellipse_theta_rad": 0.3,
    "bbox_x0_px": 15.0,
    "bbox_y0_px": 25.0,
    "bbox_x1_px": 25.0,
    "bbox_y1_px": 35.0,
    "radius_px": 5.0,
    "depth_ratio": 0.12,
    "sun_elevation_deg": 30.0,
}


@pytest.fixture
def pairs():
    factual = np.full((1, 64, 64), 100, np.uint8)
    factual[0][region((64, 64), pd.Series(CRATER))] = 180
    frames = pd.DataFrame({"frame_id": ["f0"], "scene_id": ["s0"]})
    return CraterPairs(factual, np.full_like(factual, 100), frames, pd.DataFrame([CRATER]))


def test_the_region_is_the_outermost_ring_of_the_crater():
    chosen = region((64, 64), pd.Series(CRATER))
    v, u = np.nonzero(chosen)
    assert np.hypot(u + 0.5 - 20, v + 0.5 - 30).max() <= 7.0
    assert chosen.sum() == pytest.approx(np.pi * 49, rel=0.03)
    moved = region((64, 64), pd.Series(CRATER), (10, -5))
    np.testing.assert_array_equal(np.roll(chosen, (-5, 10), (0, 1)), moved)
    flat = region((64, 64), pd.Series(CRATER | {"ellipse_b_px": 2.5, "ellipse_theta_rad": 0.0}))
    assert flat[30, 20 + 6] and not flat[30 + 4, 20] and flat[30 + 2, 20]


def test_a_placebo_lies_on_free_ground_or_is_left_out():
    rng = np.random.default_rng(0)
    occupied = np.ones((64, 64), bool)
    assert empty_shift(pd.Series(CRATER), occupied, rng) is None
    occupied[40:, 40:] = False
    shift = empty_shift(pd.Series(CRATER), occupied, rng)
    assert shift is not None
    assert not (region((64, 64), pd.Series(CRATER), shift) & occupied).any()


def test_filling_removes_the_crater_and_a_placebo_elsewhere(pairs):
    occupied = pairs.factual > 150
    without, placebo, shifts = filled_frames(pairs, occupied, np.random.default_rng(1))
    # The ground around is even; the filling is exact up to a few grey values.
    np.testing.assert_allclose(without.astype(int), pairs.counterfactual, atol=4)
    np.testing.assert_allclose(placebo.astype(int), pairs.factual, atol=4)
    assert len(shifts) == 1 and shifts[0] is not None


def test_a_gate_that_follows_brightness_reacts_by_the_known_amount(pairs):
    shift = (20.0, 10.0)
    masks_of = {"B_11": lambda images: images / 100.0, "B_12": lambda images: np.indices(images.shape)[2] / 64.0}
    versions = {"factual": pairs.factual, "rendered": pairs.counterfactual, "inpainted": pairs.counterfactual}
    versions["placebo"] = pairs.factual
    masks = {name: {gate: f(images) for gate, f in masks_of.items()} for name, images in versions.items()}
    table = mask_effects(pairs, masks, [shift]).set_index(["map", "version"])
    deviation = (pairs.factual / 100.0).std()
    assert table.loc[("B_11", "rendered"), "change"] == pytest.approx(0.8 / deviation)
    assert table.loc[("B_11", "placebo"), "change"] == 0
    assert (table.loc["B_12", "change"] == 0).all()
    assert (table["depth_ratio"] == 0.12).all()
    without = mask_effects(pairs, masks, [None])
    assert without[without["version"] == "placebo"]["change"].isna().all()


def test_the_best_matching_detection_counts(pairs):
    box = np.array([[15.0, 25, 25, 35], [15, 25, 25, 34], [40, 40, 50, 50]])

    def detect(images):
        found = Detections(box, np.array([0.6, 0.8, 0.9]))
        return [found if image.max() > 150 else Detections(box[2:], np.array([0.9])) for image in images]

    table = detection_effects(pairs, detect, {"factual": pairs.factual, "rendered": pairs.counterfactual})
    assert dict(zip(table["version"], table["score"], strict=True)) == {"factual": 0.8, "rendered": 0.0}


def test_intervals_need_five_scenes():
    def table(n_scenes):
        rows = [
            {"map": "B_11", "version": "rendered", "change": 1.0 + 0.1 * k, "scene_id": f"s{k}", "frame_id": f"f{k}"}
            for k in range(n_scenes)
        ]
        return by_gate(pd.DataFrame(rows), np.random.default_rng(0)).iloc[0]

    few, enough = table(4), table(8)
    assert np.isnan(few["low"]) and few["change"] == pytest.approx(1.15)
    assert enough["change"] == pytest.approx(1.35)
    assert enough["low"] < 1.35 < enough["high"]


def test_a_placebo_that_was_not_drawn_finds_nothing():
    rows = [
        {"crater": k, "version": version, "score": 0.2 + 0.5 * k} for version in ("factual", "placebo") for k in (0, 1)
    ]
    table = with_found(pd.DataFrame(rows), 0.6, [(3.0, 4.0), None])
    assert table["found"].tolist()[:3] == [0, 1, 0] and np.isnan(table["found"].iloc[3])
