"""Curves of real NAC crops and of rendered frames. The plots contain no pixels of either."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.nac import statistics as st
from perilune_shared.storage.files import written_aside

REAL, OURS = "tab:orange", "tab:blue"


def draw_curves(out: Path, figures: dict, real: list[np.ndarray], ours: list[np.ndarray]) -> None:
    """Write spectra.png, gradients.png, brightness.png and counts.png.

    They show medians and the band from 10 to 90 % of the images. `figures` is the content of nac.json; `real` and
    `ours` are grey images.
    """
    _draw_spectra(out / "spectra.png", figures["crops"])
    middles = (st.GRADIENT_EDGES[1:] + st.GRADIENT_EDGES[:-1]) / 2
    _draw_histograms(
        out / "gradients.png",
        middles,
        [_gradient_histogram(image) for image in real],
        [_gradient_histogram(image) for image in ours],
        "log10 of the gradient over mean brightness, per pixel",
    )
    middles = (st.BRIGHTNESS_EDGES[1:] + st.BRIGHTNESS_EDGES[:-1]) / 2
    _draw_histograms(
        out / "brightness.png",
        middles,
        [_brightness_histogram(image) for image in real],
        [_brightness_histogram(image) for image in ours],
        "brightness over its mean",
    )
    _draw_counts(out / "counts.png", figures)


def _gradient_histogram(image: np.ndarray) -> st.Array:
    return st.histogram(np.log10(np.maximum(st.gradients(image), 1e-6)), st.GRADIENT_EDGES)


def _brightness_histogram(image: np.ndarray) -> st.Array:
    return st.histogram(image / image.mean(), st.BRIGHTNESS_EDGES)


def _save(figure, path: Path) -> None:
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=90, bbox_inches="tight")
    plt.close(figure)


def _draw_spectra(path: Path, rows: list[dict]) -> None:
    """One panel for each third of the crops, with the Sun's elevation ascending from left to right."""
    thirds = [part for part in np.array_split(np.arange(len(rows)), 3) if len(part)]
    figure, axes = plt.subplots(1, len(thirds), figsize=(4.2 * len(thirds), 3.8), sharey=True, squeeze=False)
    for ax, part in zip(axes[0], thirds, strict=True):
        for origin, colour in (("real", REAL), ("ours", OURS)):
            _band(ax, st.FREQUENCY, np.array([rows[i][origin]["spectrum"] for i in part]), colour, origin)
        suns = [rows[i]["sun"]["elevation_deg"] for i in part]
        ax.set(xscale="log", yscale="log", xlabel="cycles per pixel", title=f"Sun {suns[0]:.0f} to {suns[-1]:.0f} deg")
    axes[0, 0].set_ylabel("power over squared mean, px$^2$")
    axes[0, 0].legend()
    _save(figure, path)


def _draw_histograms(path: Path, x: np.ndarray, real: list, ours: list, label: str) -> None:
    figure, ax = plt.subplots(figsize=(5.5, 3.8))
    _band(ax, x, np.array(real), REAL, "real")
    _band(ax, x, np.array(ours), OURS, "ours")
    ax.set(xlabel=label, ylabel="density")
    ax.legend()
    _save(figure, path)


def _draw_counts(path: Path, figures: dict) -> None:
    figure, ax = plt.subplots(figsize=(5.5, 3.8))
    x, counts = figures["thresholds_px"], figures["craters_per_million_px"]
    single = np.array([row["real"]["craters"] for row in figures["crops"]])
    _band(ax, x, single, REAL, "marked in real crops")
    for shade, ratio in zip(np.linspace(0.35, 1, len(counts) - 1), [k for k in counts if k != "real"], strict=True):
        ax.plot(x, counts[ratio], color=OURS, alpha=shade, label=f"ours, d/D from {ratio}")
    ax.set(xscale="log", yscale="log", xlabel="diameter, px", ylabel="craters at least as large per million px")
    ax.legend(fontsize=8)
    _save(figure, path)


def _band(ax, x, curves: np.ndarray, colour: str, label: str) -> None:
    """Median and 10 and 90 % quantiles of the curves (N, len(x))."""
    low, middle, high = np.percentile(curves, [10, 50, 90], axis=0)
    ax.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
    ax.plot(x, middle, color=colour, label=label)
