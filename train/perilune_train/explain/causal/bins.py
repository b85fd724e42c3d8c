"""Effects of removing craters by crater radius, depth and Sun elevation: tables, pictures and metrics."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from perilune_train.explain.page.bars import BLUE, GREY, ORANGE
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.pictures import save_figure

VERSIONS = {"rendered": ("crater removed, rendered again", BLUE), "inpainted": ("crater inpainted", ORANGE)} | {
    "placebo": ("empty ground inpainted", GREY)
}
"""Label and colour of each changed version of a frame."""
BINS = {
    "radius_px": ("radius, px", (0, 3, 5, 10, 80)),
    "depth_ratio": ("depth / diameter", (0, 0.05, 0.1, 0.15, 1)),
    "sun_elevation_deg": ("Sun, degrees", (0, 20, 35, 50, 90)),
}
"""Label and bin edges of each property of a crater."""
OUTSIDE = "outside"
"""Name of the bin for values outside all other bins; it is not drawn."""
MAX_ROWS = 6
"""Largest number of gates that are drawn as bars. More gates are drawn as a heat map."""


def binned(table: pd.DataFrame, value: str) -> pd.DataFrame:
    """Means of the column `value` in bins of each property of `BINS`.

    Columns: property, bin, version, value (the mean), n (number of views), and map if `table` has this column. The bin
    3-5 has values above 3 and up to 5; the bin "outside" has values outside all other bins.
    """
    parts, keys = [], [name for name in ("map", "version") if name in table]
    for name, (label, edges) in BINS.items():
        bins = pd.cut(table[name], edges, labels=_bin_names(edges)).astype(object).fillna(OUTSIDE)
        grouped = table.assign(bin=bins).dropna(subset=value).groupby([*keys, "bin"], sort=False)[value]
        means = grouped.agg(["mean", "size"]).reset_index()
        parts.append(means.rename(columns={"mean": "value", "size": "n"}).assign(property=label))
    return pd.concat(parts, ignore_index=True)


def bin_metrics(table: pd.DataFrame, prefix: str) -> Metrics:
    """Figures of `binned` for metrics.json: means, and numbers of crater views.

    A mean has the key <prefix>/<version>[/<map>]/<property>/<bin>. A number of views does not depend on the map and has
    the key <prefix>/<version>/<property>/<bin>_n.
    """
    names = {label: name for name, (label, _) in BINS.items()}
    metrics: Metrics = {}
    for row in table.to_dict("records"):
        bin_name = f"{names[row['property']]}/{row['bin']}"
        version_and_map = f"{row['version']}/{row['map']}" if "map" in row else row["version"]
        metrics[f"{prefix}/{version_and_map}/{bin_name}"] = float(row["value"])
        metrics[f"{prefix}/{row['version']}/{bin_name}_n"] = int(row["n"])
    return metrics


def draw_bins(path: Path, tables: Mapping[str, pd.DataFrame]) -> None:
    """Draw the means of `binned` as bars: one row of panels per table, one column per property.

    The keys of `tables` label the rows. The number of crater views stands below each bin.
    """
    figure = Figure(figsize=(12, 0.8 + 2.8 * len(tables)), layout="constrained")
    axes = figure.subplots(len(tables), len(BINS), sharey="row", squeeze=False)
    for row, (label, table) in zip(axes, tables.items(), strict=True):
        for axis, (title, edges) in zip(row, BINS.values(), strict=True):
            _bars(axis, table[table["property"] == title], _bin_names(edges))
            axis.set_xlabel(title)
        row[0].set_ylabel(label, fontsize=9)
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, ncols=4, loc="outside upper center", fontsize=8)
    save_figure(path, figure)


def draw_gate_bins(path: Path, table: pd.DataFrame) -> None:
    """Draw the mean changes of all gates by bin: as bars for up to MAX_ROWS gates, else as a heat map.

    `table` is the result of `binned` with the column map.
    """
    gates = list(dict.fromkeys(table["map"]))
    if len(gates) <= MAX_ROWS:
        draw_bins(path, {f"change of {gate},\ndeviations of the gate": table[table["map"] == gate] for gate in gates})
        return
    versions = [version for version in VERSIONS if (table["version"] == version).any()]
    figure = Figure(figsize=(13, 1.2 + 0.19 * len(gates) * len(versions) + 0.6 * len(versions)), layout="constrained")
    axes = figure.subplots(len(versions), len(BINS), squeeze=False)
    largest = max(float(table["value"].abs().max()), 1e-9)
    for row, version in zip(axes, versions, strict=True):
        for axis, (title, edges) in zip(row, BINS.values(), strict=True):
            rows = table[(table["version"] == version) & (table["property"] == title)]
            picture = _heat(axis, rows, gates, _bin_names(edges), largest)
            axis.set_xlabel(title, fontsize=8)
            axis.set_title(VERSIONS[version][0], fontsize=8)
    figure.colorbar(picture, ax=axes, label="mask with crater - without, deviations of the gate", shrink=0.5)
    save_figure(path, figure)


def _bars(axis: Axes, table: pd.DataFrame, bins: list[str]) -> None:
    for k, version in enumerate(dict.fromkeys(table["version"])):
        rows = table[table["version"] == version].set_index("bin").reindex(bins)
        name, colour = VERSIONS.get(str(version), ("with the crater", "black"))
        axis.bar(np.arange(len(bins)) + 0.2 * k, rows["value"], 0.19, color=colour, label=name)
    axis.set_xticks(np.arange(len(bins)) + 0.2, _ticks(table, bins), fontsize=8)
    axis.set_xlim(-0.2, len(bins) - 0.2)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.grid(axis="y", alpha=0.3)


def _heat(axis: Axes, table: pd.DataFrame, gates: list[str], bins: list[str], largest: float) -> AxesImage:
    values = table.pivot(index="map", columns="bin", values="value").reindex(index=gates, columns=bins)
    picture = axis.imshow(values, cmap="RdBu_r", vmin=-largest, vmax=largest, aspect="auto")
    for (row, column), value in np.ndenumerate(values.to_numpy()):
        if np.isfinite(value):
            colour = "white" if abs(value) > 0.6 * largest else "black"
            axis.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=6, color=colour)
    axis.set_xticks(np.arange(len(bins)), _ticks(table, bins), fontsize=7)
    axis.set_yticks(np.arange(len(gates)), gates, fontsize=6)
    return picture


def _ticks(table: pd.DataFrame, bins: list[str]) -> list[str]:
    counts = table.groupby("bin")["n"].max().reindex(bins).fillna(0).astype(int)
    return [f"{name}\nn = {n}" for name, n in zip(bins, counts, strict=True)]


def _bin_names(edges: tuple[float, ...]) -> list[str]:
    return [f"{low:g}-{high:g}" for low, high in pairwise(edges)]
