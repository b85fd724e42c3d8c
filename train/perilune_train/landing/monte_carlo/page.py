"""The page of a Monte Carlo run."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from perilune_shared.export.foreign_text import code_span, for_markdown
from perilune_train.landing.monte_carlo.scenario import SCENARIOS, Draws
from perilune_train.landing.monte_carlo.summary import by_trajectory, run_summary
from perilune_train.records.markdown import number, table

_COLUMNS = {
    "position_rmse_m": "position RMSE (m)",
    "position_end_rmse_m": "at the end (m)",
    "position_end_95_m": "95 % of the ends (m)",
    "position_end_worst_m": "worst end (m)",
    "attitude_rmse_deg": "attitude RMSE (deg)",
    "normalised_error_squared_mean": "normalised error squared (6)",
    "in_band_share": "in the 95 % band",
    "lost_share": "lost",
    "silently_wrong_share": "silently wrong",
    "ends_silently_wrong": "flights that end silently wrong",
}
_CAPTIONS = {
    "errors.png": "Errors of position over all draws: 50, 95 and 100 %, and the median of three stated sigmas",
    "consistency.png": "Mean normalised error squared over the draws of a descent; 6 if the covariance is right",
}


def page_of(dataset: str, split: str, draws: Draws, rows: pd.DataFrame, seconds: float, pictures: Sequence[str]) -> str:
    """The page as Markdown."""
    overall, own = run_summary(rows), by_trajectory(rows)
    n_flights = len(rows.groupby(["scene_id", "trajectory_id", "draw"]))
    cells = [["all", *_cells(overall)]]
    cells += [[for_markdown("/".join(map(str, ids))), *_cells(figures)] for ids, figures in own.items()]
    lines = [
        "# Monte Carlo of the navigation filter",
        "",
        f"Dataset {code_span(dataset)}, split {for_markdown(split)}, "
        f"scenario `{draws.scenario}`: {SCENARIOS[draws.scenario]}.",
        f"Descents: {len(own)}, with {draws.count} draws of each, {n_flights} flights, {len(rows)} frames, seed "
        f"{draws.seed}; {seconds / 60:.1f} minutes.",
        "",
        f"Drawn: errors of the start (60 m, 1 m/s and {draws.attitude_deg:g} degrees on each axis), of the tactical "
        "inertial unit, and of the catalogue (1 m, 3 % of the diameter, 10 % missing, 5 % false). Not drawn: "
        "detections and ranges, which are those of the recorded descent. Draws of a descent share their errors, so "
        "they say how much a result depends on what is drawn, and not how it would be on other ground.",
        "",
        "Silently wrong is a frame whose normalised error squared is above 60 and that is not said to be lost.",
        "",
        *table(["Descent", *_COLUMNS.values()], cells),
    ]
    for name in pictures:
        lines += ["", f"![{_CAPTIONS[name]}]({name})", "", f"*{_CAPTIONS[name]}.*"]
    return "\n".join(lines) + "\n"


def _cells(figures: Mapping[str, float]) -> list[str]:
    return [_cell(key, figures[key]) for key in _COLUMNS]


def _cell(key: str, value: float) -> str:
    if key == "ends_silently_wrong":
        return f"{value:.0f}"
    if not np.isfinite(value):
        return "-"
    return f"{100 * value:.2f} %" if key.endswith("_share") else number(float(value))
