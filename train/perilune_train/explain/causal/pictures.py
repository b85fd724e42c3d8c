"""Tables and pictures of the effects of removed craters."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from perilune_train.explain.causal.bins import VERSIONS
from perilune_train.explain.causal.effects import region
from perilune_train.explain.causal.pairs import CraterPairs
from perilune_train.records.pictures import save_figure, save_image
from perilune_train.records.spread import Resamples, draw_resamples, spreads

_CELL_PX = 256


def by_gate(effects: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Mean change of every gate in each version, with a 95 % interval over scenes.

    `effects` is the table of `mask_effects`. Columns: map, version, change, low, high, n. low and high are NaN with
    fewer than five scenes. n is the number of crater views with a value; if n is 0, the change is NaN.
    """
    rows = []
    for (gate, version), views in effects.groupby(["map", "version"], sort=False):
        defined = views.dropna(subset="change")
        low, high = scene_interval(
            defined["change"].to_numpy(), defined["scene_id"].tolist(), defined["frame_id"].tolist(), rng
        )
        change = defined["change"].mean()
        rows.append({"map": gate, "version": version, "change": change, "low": low, "high": high, "n": len(defined)})
    return pd.DataFrame(rows)


def scene_interval(
    values: NDArray[np.float64], scene_ids: list[str], frame_ids: list[str], rng: np.random.Generator
) -> tuple[float, float]:
    """95 % interval of the mean of values (N,) by bootstrap over scenes; NaN with fewer than five scenes."""
    resamples = draw_resamples(scene_ids, [""] * len(scene_ids), frame_ids, rng)
    all_rows = np.arange(len(values))

    def mean(drawn: Resamples) -> dict[str, NDArray[np.float64]]:
        return {"mean": drawn.totals(all_rows, values) / np.maximum(drawn.totals(all_rows), 1)}

    interval = spreads(mean, all_rows, resamples)["mean"].interval if resamples.unit == "scene" else None
    return interval or (float("nan"), float("nan"))


def draw_gate_effects(path: Path, gates: pd.DataFrame) -> None:
    """Draw the table of `by_gate` as bars, with intervals if they exist."""
    gate_names = list(dict.fromkeys(gates["map"]))
    figure = Figure(figsize=(12, 3.8), layout="constrained")
    axis = figure.subplots()
    for k, (version, (label, colour)) in enumerate(VERSIONS.items()):
        rows = gates[gates["version"] == version].set_index("map").reindex(gate_names)
        position = np.arange(len(gate_names)) + 0.27 * k
        axis.bar(position, rows["change"], 0.26, color=colour, label=label)
        errors = np.abs(np.vstack([rows["change"] - rows["low"], rows["high"] - rows["change"]]))
        if np.isfinite(errors).any():
            axis.errorbar(position, rows["change"], errors, fmt="none", ecolor="black", capsize=1.5, linewidth=0.8)
    axis.set_xticks(np.arange(len(gate_names)) + 0.27, gate_names, rotation=60)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_ylabel("mask with minus without crater,\nstandard deviations of the gate", fontsize=9)
    axis.legend(fontsize=8)
    axis.grid(axis="y", alpha=0.3)
    save_figure(path, figure)


def draw_pair(path: Path, pairs: CraterPairs, masks: dict[str, NDArray[np.floating]], image: int, gate: str) -> None:
    """Draw, as one PNG row, a frame before and after the removal of craters, and the gate's masks for both.

    The removed craters are outlined. `masks` are the masks (N, height, width) of the gate in the versions "factual" and
    "rendered". `image` is the index of the frame.
    """
    removed_craters = pairs.craters[pairs.craters["image"] == image]
    frames = [cv2.cvtColor(images[image], cv2.COLOR_GRAY2BGR) for images in (pairs.factual, pairs.counterfactual)]
    low, high = (float(getattr(masks["factual"][image], end)()) for end in ("min", "max"))
    for version in ("factual", "rendered"):
        level = np.clip(255 * (masks[version][image] - low) / max(high - low, 1e-9), 0, 255).astype(np.uint8)
        frames.append(cv2.applyColorMap(level, cv2.COLORMAP_CIVIDIS))
    cells = []
    for cell, text in zip(
        frames, ("before", "without outlined craters", f"{gate} before", f"{gate} without"), strict=True
    ):
        picture = np.asarray(cell, np.uint8).copy()
        for _, crater in removed_craters.iterrows():
            outline, _ = cv2.findContours(
                region(picture.shape[:2], crater).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
            )
            cv2.drawContours(picture, outline, -1, (0, 159, 230), 1)
        picture = cv2.resize(picture, (_CELL_PX, _CELL_PX), interpolation=cv2.INTER_NEAREST)
        picture = cv2.copyMakeBorder(picture, 2, 20, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        where = 4, picture.shape[0] - 5
        cv2.putText(picture, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
        cells.append(picture)
    save_image(path, np.hstack(cells))
