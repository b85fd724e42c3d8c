"""Bar charts of the correlations of all blocks."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from perilune_train.evaluation.pictures import save_figure

DETECT_BARS = {
    "pcc1_background": "PCC1: mask and G (1 on background)",
    "pcc1_craterness": "craterness: mask and 1 - G",
    "pcc2": "PCC2: masks of two frames",
}
DETECT_TITLE = (
    "G is 1 on background and 0 in craters. PCC1 above 0: the gate is weaker on craters. "
    "Craterness above 0: the gate is stronger on craters."
)
NAVIGATE_BARS = {"pcc3": "PCC3: halves", "pcc4": "PCC4: halves, lower one aligned to the upper"}
NAVIGATE_TITLE = (
    "Bars: over the pixels that both frames see. Dots and crosses: over all pixels (for PCC4 0 outside the overlap)."
)


def draw_bars(path: Path, table: pd.DataFrame, measures: dict[str, str], title: str) -> None:
    """Draw bars of several measures for each block; a missing bar means that the value was undefined in every image.

    Dots show the same measure over all pixels, for measures over part of the pixels.
    """
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    axis = figure.subplots()
    width = 0.8 / len(measures)
    for i, (measure, label) in enumerate(measures.items()):
        own = table[table["measure"] == measure]
        place = np.arange(len(own)) + width * i
        axis.bar(place, own["value"], width, label=label)
        if own["value_all_pixels"].notna().any():
            axis.plot(
                place, own["value_all_pixels"], "ko" if i == 0 else "kx", markersize=4, label=f"{label}: all pixels"
            )
        axis.set_xticks(np.arange(len(own)) + 0.4 - width / 2, own["block"], rotation=60)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set(ylabel="Pearson correlation", ylim=(-1, 1))
    axis.set_title(title, fontsize=9)
    axis.grid(axis="y", alpha=0.3)
    axis.legend(fontsize=8)
    save_figure(path, figure, dpi=120)
