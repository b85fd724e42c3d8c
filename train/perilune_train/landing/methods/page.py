"""Write the page of all methods: what each method knows, its errors, and pictures."""

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from perilune_train.landing.methods.seen import SeenDescent
from perilune_train.records.markdown import number, table

_KNOWS = {
    "warp": "two frames, the nominal motion",
    "stack": "two frames",
    "klt": "two frames, the altitude at the start",
    "klt_gyroscope": "two frames, the altitude at the start, and a tactical gyroscope",
    "alignment": "two frames, the altitude at the start",
    "alignment_gyroscope": "two frames, the altitude at the start, and a tactical gyroscope",
    "nominal": "the planned curve; no frame",
    "fix, exact catalogue": "one frame, catalogue without errors, prior of 100 m and 1 degree",
    "fix": "one frame, catalogue with errors, prior of 100 m and 1 degree",
    "lost in space, exact catalogue": "one frame at 800 m or above, exact catalogue, altitude to 10 %, level camera",
    "lost in space": "one frame at 800 m or above, catalogue with errors, altitude to 10 %, level camera",
    "filter": "all frames so far, catalogue with errors, tactical unit, ranges, start of 60 m, 1 m/s, 0.5 degrees",
    "smoother": "as `filter`, and all later frames; for reference, not on board",
    "fix, map": "as `fix`, with a catalogue that the detector made from images taken from orbit",
    "lost in space, map": "as `lost in space`, with the catalogue of `fix, map`",
    "filter, map": "as `filter`, with the catalogue of `fix, map`",
    "filter, star tracker": "as `filter`, with a start of 0.02 degrees",
    "filter, star tracker in flight": "as `filter`, with an attitude at each frame (10, 10 and 60 arc seconds)"
    " and a gyroscope with a bias of 0.5 degrees per hour",
    "filter, constant deviations": "as `filter`, without the standard deviations that the detector predicts",
    "filter, star tracker in flight, constant deviations": "as `filter, star tracker in flight`, without the standard"
    " deviations that the detector predicts",
    "filter, exact catalogue": "as `filter`, with a catalogue without errors",
}
_RELATIVE = {
    "position_rmse_m": "position RMSE of a step, vector (m)",
    "attitude_rmse_deg": "orientation RMSE, angle (deg)",
    "stated_rmse_m": "as the covariance states (m)",
    "normalised_error_squared_mean": "normalised error squared (6)",
    "position_end_rmse_m": "drift at the end (m)",
}
COLUMNS_ABSOLUTE = {
    "n_frames": "frames",
    "right_share": "right or tracking",
    "wrong_share": "wrong",
    "position_rmse_m": "position RMSE (m)",
    "position_rmse_ground_px": "in ground pixels",
    "position_end_rmse_m": "at the end (m)",
    "attitude_rmse_deg": "attitude RMSE (deg)",
    "normalised_error_squared_mean": "normalised error squared (6)",
    "in_band_share": "in the 95 % band",
    "seconds_per_frame": "seconds per frame",
}
_CAPTIONS = {
    "altitude.png": "Errors by altitude, and normalised errors squared",
    "flights.png": "Errors of the filter within three standard deviations",
    "matches_high.png": "First frame: detections matched (cyan) and not (red), catalogue at the pose (yellow)",
    "matches_low.png": "Last frame, likewise",
}


def page_of(
    source: str,
    rows: pd.DataFrame,
    descents: list[SeenDescent],
    detection_s: float,
    pictures: Sequence[str],
    sections: Sequence[str],
) -> str:
    """The results page as Markdown.

    `source` names the dataset and the split, as Markdown. `sections` are the lines of further sections.
    """
    scenes = {descent.ids[0] for descent in descents}
    lines = [
        "# Navigation methods",
        "",
        f"{source}: {len(descents)} descents over {len(scenes)} scenes.",
        f"Detection takes {detection_s:.3f} s per frame, which every absolute method needs besides its own time.",
        "",
        "## Motion between consecutive frames",
        "",
        *_table(rows[rows["kind"] == "relative"], _RELATIVE),
        "",
        "What the covariance of KLT states is the Cramer-Rao bound of its tracks over a plane, if their errors are",
        "independent.",
        "",
        "## Position over ground",
        "",
        "A fix is right if it is off by less than 5 pixels on the ground; its errors are those of the right ones.",
        "Errors of the filter are those of all frames.",
        "",
        *_table(rows[rows["kind"] == "absolute"], COLUMNS_ABSOLUTE),
        "",
        *sections,
    ]
    for name in pictures:
        lines += ["", f"![{_CAPTIONS[name]}]({name})", "", f"*{_CAPTIONS[name]}.*"]
    return "\n".join(lines) + "\n"


def same_frames_section(compared: Mapping[str, Mapping[str, float]]) -> list[str]:
    """The lines that compare fixes and filter on equal frames, from `on_the_same_frames`."""
    if not compared:
        return []
    titles = {
        "n_frames": "frames with a right fix",
        "fix_rmse_m": "RMSE of the fix (m)",
        "filter_rmse_m": "RMSE of the filter (m)",
        "filter_better_share": "filter better, share of all frames",
    }
    rows = [[f"`{method}`", *(cell(key, values[key]) for key in titles)] for method, values in compared.items()]
    return [
        "## Fixes and filter on the same frames",
        "",
        "A frame without a fix counts for the filter in the last column.",
        "",
        *table(["method", *titles.values()], rows),
        "",
    ]


def deviations_section(deviations: pd.DataFrame) -> list[str]:
    """The lines about errors of detected centres, from `deviation_table`."""
    if not len(deviations):
        return []
    rows = [[cell(str(key), value) for key, value in row.items()] for row in deviations.to_dict("records")]
    return [
        "## Errors of detected centres",
        "",
        "Standard deviations per axis in pixels, as the filter states them and as measured on craters that are matched",
        "in two consecutive frames, by stated deviation; the last row is of all. Persistent errors repeat in every",
        "frame of a crater, independent ones differ from frame to frame. The normalised error squared is 1 if the",
        "stated deviations are right.",
        "",
        *table([_DEVIATIONS[key] for key in deviations.columns], rows),
        "",
    ]


_DEVIATIONS = {
    "n_pairs": "pairs",
    "radius_px": "radius, median (px)",
    "stated_px": "stated",
    "error_px": "measured",
    "normalised_error_squared": "normalised error squared",
    "stated_static_px": "persistent, stated",
    "static_px": "persistent, measured",
    "stated_noise_px": "independent, stated",
    "noise_px": "independent, measured",
}


def _table(rows: pd.DataFrame, columns: dict[str, str]) -> list[str]:
    used = {key: title for key, title in columns.items() if key in rows and rows[key].notna().any()}
    cells = [
        [f"`{row['method']}`", _KNOWS[row["method"]], *(cell(key, row[key]) for key in used)]
        for row in rows.to_dict("records")
    ]
    return table(["Method", "What it knows", *used.values()], cells)


def cell(key: str, value: float) -> str:
    """Format a figure as its column requires."""
    if not math.isfinite(value):
        return "-"
    if key in ("n_frames", "n_pairs"):
        return f"{value:.0f}"
    return f"{100 * value:.1f} %" if key.endswith("_share") else number(value)
