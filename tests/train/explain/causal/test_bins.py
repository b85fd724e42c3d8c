"""Effects by size, freshness and Sun: tables, pictures and figures of metrics.json."""

import cv2
import numpy as np
import pandas as pd
import pytest

from perilune_train.explain.causal import bins
from perilune_train.explain.causal.bins import bin_metrics, binned, draw_bins, draw_gate_bins


def gate_table(gates):
    """Views of three sizes, one without a placebo; gate number k changes by k + 1, 0 under the placebo."""
    rows = [
        {
            "map": gate,
            "version": version,
            "change": np.nan if version == "placebo" and radius == 90.0 else (k + 1.0) * (version != "placebo"),
            "radius_px": radius,
            "depth_ratio": 0.07,
            "sun_elevation_deg": 25.0,
        }
        for k, gate in enumerate(gates)
        for version in ("rendered", "inpainted", "placebo")
        for radius in (2.0, 4.0, 4.5, 90.0)
    ]
    return pd.DataFrame(rows)


def test_bins_keep_every_view():
    rows = [
        {
            "version": "factual",
            "found": float(k % 2),
            "radius_px": 2.0 + k,
            "depth_ratio": 0.07,
            "sun_elevation_deg": 25,
        }
        for k in range(6)
    ]
    table = binned(pd.DataFrame(rows), "found")
    by_size = table[table["property"] == "radius, px"]
    assert by_size["n"].sum() == 6
    assert (by_size["value"] * by_size["n"]).sum() == pytest.approx(3)


def test_the_bins_of_every_gate_are_figures():
    metrics = bin_metrics(binned(gate_table(["B_11", "B_22"]), "change"), "bins")
    assert metrics["bins/rendered/B_22/radius_px/3-5"] == 2 and metrics["bins/rendered/radius_px/3-5_n"] == 2
    assert metrics["bins/rendered/B_11/radius_px/0-3"] == 1 and metrics["bins/rendered/radius_px/0-3_n"] == 1
    assert metrics["bins/rendered/B_22/radius_px/outside"] == 2
    assert (
        metrics["bins/placebo/B_11/depth_ratio/0.05-0.1"] == 0 and metrics["bins/placebo/depth_ratio/0.05-0.1_n"] == 3
    )
    assert metrics["bins/inpainted/B_22/sun_elevation_deg/20-35"] == 2
    assert "bins/placebo/B_11/radius_px/outside" not in metrics
    # Without gates, as of detections.
    found = gate_table(["B_11"]).drop(columns="map").rename(columns={"change": "found"})
    assert bin_metrics(binned(found, "found"), "found_bins")["found_bins/rendered/radius_px/3-5"] == 1


@pytest.mark.parametrize("count", [1, 5, pytest.param(23, marks=pytest.mark.slow)])
def test_all_gates_are_drawn(count, tmp_path, monkeypatch):
    drawn = []
    for name in ("_bars", "_heat"):
        own = getattr(bins, name)
        monkeypatch.setattr(bins, name, lambda *parts, own=own, name=name: (drawn.append(name), own(*parts))[1])
    table = binned(gate_table([f"B_{k + 11}" for k in range(count)]), "change")
    draw_gate_bins(tmp_path / "bins.png", table)
    # Bars: a row for each gate. Heat maps of many gates: a row for each version.
    assert drawn == ["_heat"] * 9 if count > 6 else drawn == ["_bars"] * 3 * count
    assert cv2.imread(str(tmp_path / "bins.png")).std() > 5


def test_detections_have_one_row(tmp_path):
    found = gate_table(["B_11"]).drop(columns="map").rename(columns={"change": "found"})
    draw_bins(tmp_path / "bins.png", {"share": binned(found, "found")})
    height, width, _ = cv2.imread(str(tmp_path / "bins.png")).shape
    assert height < width / 3
