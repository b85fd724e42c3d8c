"""Charts of all gates: correlations with nulls, harm of interventions, similarity of masks, localisation."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from perilune_train.explain.evidence.gates import forced_summary
from perilune_train.explain.evidence.removal import PERFECT
from perilune_train.records.pictures import save_figure

BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#999999"
"""Colours that the colour-blind can tell apart (Okabe & Ito 2008)."""
_MARKERS = {
    "untrained": ("o", "#000000"),
    "edge": ("^", ORANGE),
    "contrast": ("s", GREEN),
    "brightness": ("v", RED),
    "other frame": ("x", "#CC79A7"),
    "other pair": ("x", "#CC79A7"),
    "permutation": ("+", "#56B4E9"),
}
"""Marker and colour of each null."""


def draw_correlations(
    path: Path, summary: pd.DataFrame, differences: pd.DataFrame, tested: pd.DataFrame, measures: Mapping[str, str]
) -> None:
    """Draw each measure in one row: the gates as bars with 95 % intervals, the means of their nulls as markers.

    The bar of a gate that beats every null is filled; the other bars are open. A bar is missing if the mask is constant
    in every image. For PCC1, a gate and its nulls are drawn on the same side of 0, so that magnitudes can be compared.
    `measures` maps names of measures to axis labels. The three tables are fields of `Evidence`.
    """
    figure = Figure(figsize=(12, 3.3 * len(measures)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(measures), 1))
    for axis, (measure, label) in zip(axes, measures.items(), strict=True):
        rows = summary[(summary["kind"] == "gate") & (summary["measure"] == measure)].reset_index(drop=True)
        verdicts = tested[tested["measure"] == measure].set_index("map")["beats_all"]
        beats = [bool(verdicts.get(block, False)) for block in rows["map"]]
        position = np.arange(len(rows))
        colours = [BLUE if is_beating else "white" for is_beating in beats]
        axis.bar(position, rows["value"], 0.7, color=colours, edgecolor=BLUE, linewidth=1.2)
        errors = np.abs(np.vstack([rows["value"] - rows["low"], rows["high"] - rows["value"]]))
        if np.isfinite(errors).any():
            axis.errorbar(position, rows["value"], errors, fmt="none", ecolor="black", capsize=2, linewidth=1)
        _draw_nulls(axis, rows, differences[differences["measure"] == measure])
        axis.set_xticks(position, rows["map"], rotation=60)
        axis.axhline(0, color="black", linewidth=0.8)
        axis.set(ylabel=label, xlim=(-0.6, len(rows) - 0.4))
        axis.grid(axis="y", alpha=0.3)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(
        handles,
        names,
        ncols=6,
        loc="outside upper center",
        fontsize=9,
        title="Bars: gates (filled: beats every null). Markers: nulls",
    )
    save_figure(path, figure, dpi=110)


def _draw_nulls(axis: Axes, gates: pd.DataFrame, differences: pd.DataFrame) -> None:
    # The bar of a gate with a negative PCC1 is below 0. Null values are above 0 (times their sign): move them below 0.
    side = (
        np.where(gates["value"] < 0, -1.0, 1.0) if gates["measure"].iloc[0].startswith("pcc1") else np.ones(len(gates))
    )
    for null, rows in differences.groupby("null", sort=False):
        values = rows.set_index("map")["null_value"].reindex(gates["map"]).to_numpy()
        marker, colour = _MARKERS.get(str(null), ("d", GREY))
        axis.plot(np.arange(len(gates)), side * values, marker, color=colour, markersize=4, label=str(null))


def draw_gates(path: Path, gates: pd.DataFrame, unit: str, higher_is_better: bool) -> None:
    """Draw the harm of forcing each gate, each stage and all gates to their means.

    Bars are means with 95 % intervals over scenes, if there are five or more; dots are scenes.
    """
    harm = (gates["before"] - gates["after"]) * (1 if higher_is_better else -1)
    table = gates.assign(harm=harm)
    means = forced_summary(gates, higher_is_better, np.random.default_rng(0))
    scopes, mean = means["scope"].tolist(), means["value"]
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    axis = figure.subplots()
    colours = [BLUE if scope.startswith("B_") else ORANGE for scope in scopes]
    axis.bar(np.arange(len(scopes)), mean, 0.7, color=colours)
    errors = np.vstack([mean - means["low"], means["high"] - mean])
    if np.isfinite(errors).any():
        axis.errorbar(np.arange(len(scopes)), mean, errors, fmt="none", ecolor="black", capsize=3, linewidth=1)
    for scene, rows in table.groupby("scene_id"):
        values = rows.groupby("scope")["harm"].mean().reindex(scopes)
        axis.plot(np.arange(len(scopes)), values, ".", color="black", markersize=4, label=str(scene))
    axis.set_xticks(np.arange(len(scopes)), scopes, rotation=60)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_ylabel(f"harm: {unit}", fontsize=9)
    axis.grid(axis="y", alpha=0.3)
    save_figure(path, figure, dpi=110)


def draw_removal(path: Path, removal: pd.DataFrame, unit: str, higher_is_better: bool) -> None:
    """Draw the mean harm of removing pixels, by map and filling, for four choices of pixels."""
    harm = (removal["before"] - removal["after"]) * (1 if higher_is_better else -1)
    means = removal.assign(harm=harm).groupby(["map", "how", "which"], sort=False)["harm"].mean()
    groups = list(dict.fromkeys((name, how) for name, how, _ in means.index))
    figure = Figure(figsize=(1.6 + 2.2 * len(groups), 3.6), layout="constrained")
    axis = figure.subplots()
    kinds = {
        "most": ("most attended", BLUE, ""),
        "random": ("random, same brightness", GREY, "//"),
        "shifted": ("same shape elsewhere", ORANGE, ".."),
        "least": ("least attended", "white", ""),
    }
    for k, (which, (label, colour, hatch)) in enumerate(kinds.items()):
        values = [means.get((*group, which), np.nan) for group in groups]
        axis.bar(
            np.arange(len(groups)) + 0.2 * k, values, 0.19, color=colour, edgecolor="black", hatch=hatch, label=label
        )
    names = {PERFECT: "perfect mask"}
    axis.set_xticks(
        np.arange(len(groups)) + 0.3, [f"{names.get(name, name)}\n{how}" for name, how in groups], fontsize=8
    )
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set_ylabel(f"harm: {unit}", fontsize=9)
    axis.legend(fontsize=8)
    save_figure(path, figure, dpi=110)


def draw_randomisation(path: Path, randomisation: pd.DataFrame) -> None:
    """Draw the rank correlation of each gate's mask with the trained mask as more stages are randomised."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    for axis, (direction, rows) in zip(
        figure.subplots(1, 2), randomisation.groupby("direction", sort=False), strict=True
    ):
        table = rows.pivot_table(index="map", columns="step", values="spearman", sort=False, dropna=False)
        picture = axis.imshow(table.to_numpy(np.float64).T, cmap="cividis", vmin=-1, vmax=1, aspect="auto")
        axis.set_xticks(np.arange(len(table)), table.index, rotation=90, fontsize=7)
        axis.set_yticks(np.arange(table.shape[1]), table.columns, fontsize=8)
        axis.set_title(f"{str(direction).replace('_', ' ')}: Spearman correlation with the trained mask", fontsize=9)
        figure.colorbar(picture, ax=axis)
    save_figure(path, figure, dpi=110)


def draw_stability(path: Path, stability: pd.DataFrame) -> None:
    """Draw the mean correlation between each gate's masks before and after each change of the image."""
    table = stability.pivot_table(index="change", columns="map", values="pearson", sort=False, dropna=False)
    figure = Figure(figsize=(3 + 0.55 * table.shape[1], 3.6), layout="constrained")
    axis = figure.subplots()
    values = table.to_numpy(np.float64)
    picture = axis.imshow(values, cmap="cividis", vmin=0, vmax=1, aspect="auto")
    for row, column in np.ndindex(*values.shape):
        value = values[row, column]
        text = f"{value:.2f}" if np.isfinite(value) else "-"
        axis.text(column, row, text, ha="center", va="center", fontsize=7, color="black" if value > 0.6 else "white")
    axis.set_xticks(np.arange(table.shape[1]), table.columns, rotation=60, fontsize=8)
    axis.set_yticks(np.arange(len(table)), table.index, fontsize=8)
    figure.colorbar(picture, ax=axis, label="correlation with the mask of the unchanged image")
    save_figure(path, figure, dpi=110)


def draw_localisation(path: Path, summary: pd.DataFrame) -> None:
    """Draw the ROC-AUC of every map on crater pixels: gates, nulls and attribution methods; chance is 0.5."""
    rows = summary[summary["measure"] == "auc"]
    for null in ("untrained", "other frame"):
        # These nulls have one map for each gate. Draw only the map with the largest value.
        is_null = rows["map"].str.startswith(f"{null}/")
        best = rows.loc[is_null, "value"].max()
        rows = rows[~is_null | (rows["value"] == best)]
    rows = rows.reset_index(drop=True)
    colours = rows["kind"].map({"gate": BLUE, "null": GREY, "attribution": ORANGE})
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    axis = figure.subplots()
    axis.bar(np.arange(len(rows)), rows["value"] - 0.5, 0.7, bottom=0.5, color=colours)
    errors = np.abs(np.vstack([rows["value"] - rows["low"], rows["high"] - rows["value"]]))
    if np.isfinite(errors).any():
        axis.errorbar(np.arange(len(rows)), rows["value"], errors, fmt="none", ecolor="black", capsize=2, linewidth=1)
    axis.axhline(0.5, color="black", linewidth=0.8)
    axis.set_xticks(np.arange(len(rows)), rows["map"], rotation=75, fontsize=8)
    axis.set_ylabel("ROC-AUC on crater pixels")
    axis.grid(axis="y", alpha=0.3)
    save_figure(path, figure, dpi=110)
