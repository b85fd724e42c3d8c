"""The page of a Monte Carlo run, with its figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from perilune_shared.export.foreign_text import code_span, for_markdown
from perilune_train.landing.methods.flights import flight_summary
from perilune_train.landing.monte_carlo.consistency import DESCENT, is_silently_wrong
from perilune_train.landing.monte_carlo.pictures import ALTITUDES_M, MAX_ELLIPSES
from perilune_train.landing.monte_carlo.scenario import ALTIMETERS, DETECTIONS, SCENARIOS, Draws
from perilune_train.landing.monte_carlo.statistics import BOUND_SHARE, needed_draws, share_bound, supported_share
from perilune_train.records.markdown import number, table

_COLUMNS = {
    "position_rmse_m": "position RMSE (m)",
    "position_end_rmse_m": "position RMSE at the end (m)",
    "position_end_95_m": "95th percentile at the end (m)",
    "position_end_worst_m": "largest error at the end (m)",
    "attitude_rmse_deg": "attitude RMSE (deg)",
    "normalised_error_squared_mean": "normalised error squared (expected 6)",
    "in_band_share": "frames in the 95 % band",
    "lost_share": "frames lost",
    "silently_wrong_share": "frames silently wrong",
    "ends_silently_wrong": "flights that end silently wrong",
}
_CAPTIONS = {
    "errors.png": "Position error over all draws: median, 95th percentile, maximum; dashed: median stated 3 sigma",
    "consistency.png": "Mean normalised error squared over the draws of a descent, 6 if the covariance is correct, and"
    " normalised innovation squared per part, 1 if the innovations have the stated size, by altitude",
    "ellipses.png": f"Horizontal errors of the draws of at most {MAX_ELLIPSES} descents, with 95 % ellipses: measured"
    " (blue) and stated (dashed)",
    "miss.png": "Miss distance of the draws of each descent; triangles: upper bounds of 99 % of the flights",
}
_ALTITUDE_BANDS_M = ((800.0, np.inf), (400.0, 800.0), (0.0, 400.0))


@dataclass(frozen=True, slots=True)
class Run:
    """What a page says about its run."""

    dataset: str
    """Name of the dataset."""
    split: str
    """train, val or test."""
    draws: Draws
    """Settings of the draws."""
    seconds: float
    """Time of the flights."""
    pictures: Sequence[str]
    """Names of the pictures beside the page."""
    detector_errors: str
    """Name of the file with the measured errors of detections."""


def run_summary(rows: pd.DataFrame) -> dict[str, float]:
    """Figures over all frames of all draws, from the columns of draws.parquet."""
    flight = rows[["trajectory_id", "draw"]].astype(str).agg("/".join, axis=1)
    flights = rows.assign(seconds=np.nan, flight=flight)
    figures = flight_summary(flights.assign(trajectory_id=flights["flight"]))
    ends = flights.groupby(["scene_id", "flight"]).last()
    return figures | {
        "position_end_95_m": float(ends["error_m"].quantile(0.95)),
        "lost_share": float((rows["status"] == "lost").mean()),
        "silently_wrong_share": float(is_silently_wrong(rows).mean()),
        "ends_silently_wrong": float(is_silently_wrong(ends).sum()),
    }


def by_trajectory(rows: pd.DataFrame) -> dict[tuple[str, str], dict[str, float]]:
    """Figures of each descent over its draws."""
    groups = rows.groupby(DESCENT)
    return {
        (str(scene), str(trajectory)): run_summary(trajectory_rows) for (scene, trajectory), trajectory_rows in groups
    }


def page_of(run: Run, rows: pd.DataFrame, frames: pd.DataFrame, descents: pd.DataFrame) -> str:
    """The page as Markdown, from the rows of all draws and the tables of `by_altitude` and `of_descents`."""
    overall, by_descent = run_summary(rows), by_trajectory(rows)
    n_flights = int(descents["n_draws"].sum())
    cells = [["all", *_cells(overall)]]
    cells += [[for_markdown("/".join(map(str, ids))), *_cells(figures)] for ids, figures in by_descent.items()]
    lines = [
        "# Monte Carlo of the navigation filter",
        "",
        *_settings(run, descents, len(rows)),
        "",
        "A frame is silently wrong if its normalised error squared is above 60 and its status is not `lost`.",
        "",
        *table(["Descent", *_COLUMNS.values()], cells),
        "",
        "## What the draws support",
        "",
        *_support(run.draws, descents, n_flights),
        "",
        "## Consistency by altitude",
        "",
        *_consistency(frames, descents),
        "",
        "## Miss distance at the last frame",
        "",
        *_miss(descents),
        "",
        "## Silently wrong flights",
        "",
        *_silent(descents),
        "",
        "## Error ellipses",
        "",
        *_ellipses(frames),
    ]
    for name in run.pictures:
        lines += ["", f"![{_CAPTIONS[name]}]({name})", "", f"*{_CAPTIONS[name]}.*"]
    return "\n".join(lines) + "\n"


def _settings(run: Run, descents: pd.DataFrame, n_frames: int) -> list[str]:
    draws, sensors, n_flights = run.draws, run.draws.sensors, int(descents["n_draws"].sum())
    unit = sensors.inertial
    lines = [
        f"Dataset {code_span(run.dataset)}, split {for_markdown(run.split)}, "
        f"scenario `{draws.scenario}`: {SCENARIOS[draws.scenario]}.",
        f"Descents: {len(descents)}, with {draws.count} draws of each, {n_flights} flights, {n_frames} frames, seed "
        f"{draws.seed}, first draw {draws.first}; {run.seconds / 60:.1f} minutes, {60 * n_flights / run.seconds:.0f} "
        "flights per minute.",
        "",
        "Each draw has other errors of:",
        "",
        f"- the start: 60 m, 1 m/s and {draws.attitude_deg:g} degrees on each axis",
        "- the catalogue: 1 m, 3 % of the diameter, 10 % missing, 5 % false",
        f"- the inertial unit `{sensors.unit}`: gyroscope bias of {unit.gyro_bias_deg_per_h:g} degrees per hour, "
        f"accelerometer bias of {unit.accelerometer_bias_mg:g} mg, scale factors of {unit.scale_ppm:g} millionths, "
        f"misalignments of {unit.misalignment_arcsec:g} seconds of arc",
    ]
    if sensors.star_tracker_hz > 0:
        lines.append(f"- the star tracker: {sensors.star_tracker_hz:g} Hz, 10, 10 and 60 seconds of arc")
    if sensors.doppler_hz > 0:
        lines.append(f"- the Doppler lidar: {sensors.doppler_hz:g} Hz, 0.02 m/s along three beams, without ranges")
    lines += ["", f"Altimeter: {ALTIMETERS[sensors.altimeter]}. Detections: {DETECTIONS[draws.detections]}."]
    if draws.detections == "drawn":
        lines.append(
            f"`{run.detector_errors}` contains these errors. Which craters are detected, scores and unmatched "
            "detections stay as recorded."
        )
    outages = {
        "star tracker": sensors.star_tracker_outage_s if sensors.star_tracker_hz > 0 else 0.0,
        "altimeter": sensors.altimeter_outage_s if sensors.altimeter != "none" else 0.0,
        "detections": draws.detections_outage_s,
    }
    stated = [f"{name} {seconds:g} s" for name, seconds in outages.items() if seconds > 0]
    if stated:
        lines.append(f"Outages, each at a random time of a flight: {', '.join(stated)}.")
    return lines


def _support(draws: Draws, descents: pd.DataFrame, n_flights: int) -> list[str]:
    n_scenes, needed = descents["scene_id"].nunique(), needed_draws(BOUND_SHARE)
    scenes = "1 scene" if n_scenes == 1 else f"{n_scenes} scenes"
    lines = [
        f"The {n_flights} flights are draws of {len(descents)} descents over {scenes}. Scenes are the independent "
        "units: draws of one descent share its ground, light and path, and are not further scenes. All bands and "
        "bounds below describe further draws of these descents. This page states no interval over scenes.",
        "",
        f"A bound of {100 * BOUND_SHARE:g} % of the flights with 95 % confidence needs {needed} draws of a descent. "
        + (
            f"{draws.count} draws support it."
            if draws.count >= needed
            else f"{draws.count} draws do not support it: the largest value of {draws.count} draws bounds "
            f"{_floored(supported_share(draws.count))} % of the flights."
        ),
    ]
    if draws.detections == "recorded":
        lines += [
            "",
            "The draws of a descent share the errors of the recorded detections, but the bands assume independent "
            "draws. A mean outside its band may therefore be due to one set of detections.",
        ]
    return lines


def _floored(share: float) -> str:
    """A share in per cent with one decimal, never rounded up."""
    return f"{np.floor(1000 * share + 1e-9) / 10:.1f}"


def _consistency(frames: pd.DataFrame, descents: pd.DataFrame) -> list[str]:
    head = ["Descent", "altitude (m)", "frames", "position RMSE (m)", "NEES (expected 6)", "frames with NEES in band"]
    head += ["NIS per part (expected 1)", "frames with NIS in band"]
    cells = []
    for ids, of_descent in frames.groupby(DESCENT):
        for low, high in _ALTITUDE_BANDS_M:
            part = of_descent[(of_descent["altitude_m"] >= low) & (of_descent["altitude_m"] < high)]
            if part.empty:
                continue
            band = f"{low:.0f} to {high:.0f}" if np.isfinite(high) else f"above {low:.0f}"
            rmse_m = float(np.sqrt(np.mean(np.square(part["position_rmse_m"]))))
            name = for_markdown("/".join(map(str, ids)))
            row = [
                name,
                band,
                str(len(part)),
                number(rmse_m),
                number(float(part["nees"].mean())),
                _in_band(part, "nees"),
            ]
            cells.append([*row, number(float(part["nis"].mean())), _in_band(part, "nis")])
    low, high = frames["nees_low"].iloc[0], frames["nees_high"].iloc[0]
    over = [
        [
            for_markdown(f"{row.scene_id}/{row.trajectory_id}"),
            number(row.position_rmse_m),
            number(row.position_low_m),
            number(row.position_high_m),
        ]
        for row in descents.itertuples()
    ]
    return [
        "NEES: mean over the draws of the squared pose error, normalised by the stated covariance. "
        f"With {frames['n_draws'].iloc[0]} independent draws, 95 % of the frames lie between {low:.2f} and {high:.2f}.",
        "NIS per part: squared innovations of the crater updates, normalised by their stated covariance, divided by "
        "their number. Weights and gates of the matching change its distribution, so its narrow band is only a guide.",
        "Frames of one descent are correlated. The table `consistency.parquet` has one row per frame.",
        "",
        *table(head, cells),
        "",
        "Position RMSE over a descent, with percentiles over the flights:",
        "",
        *table(["Descent", "position RMSE (m)", "2.5 % of the flights (m)", "97.5 % of the flights (m)"], over),
    ]


def _in_band(part: pd.DataFrame, name: str) -> str:
    known = part[part[name].notna()]
    inside = known[name].between(known[f"{name}_low"], known[f"{name}_high"]).sum()
    return f"{inside} of {len(known)}"


def _miss(descents: pd.DataFrame) -> list[str]:
    head = ["Descent", "altitude (m)", "median (m)", "largest (m)", "share bounded by the largest", "bound of 99 % (m)"]
    cells = [
        [
            for_markdown(f"{row['scene_id']}/{row['trajectory_id']}"),
            f"{row['end_altitude_m']:.0f}",
            number(row["miss_median_m"]),
            number(row["miss_largest_m"]),
            f"{_floored(row['supported_share'])} %",
            number(row["miss_99_bound_m"]) if np.isfinite(row["miss_99_bound_m"]) else "too few draws",
        ]
        for row in descents.to_dict("records")
    ]
    return [
        "The miss distance is the horizontal error of the estimate at the last frame. Bounds hold with 95 % confidence "
        "for any distribution of the errors, because they are order statistics.",
        "",
        *table(head, cells),
    ]


def _silent(descents: pd.DataFrame) -> list[str]:
    head = [
        "Descent",
        "flights",
        "with a silently wrong frame",
        "upper bound",
        "that end silently wrong",
        "upper bound",
    ]
    kinds = ("silently_wrong_flights", "ends_silently_wrong")

    def line(name: str, part: pd.DataFrame) -> list[str]:
        n, cells = int(part["n_draws"].sum()), []
        for kind in kinds:
            count = int(part[kind].sum())
            cells += [str(count), f"{100 * share_bound(count, n):.2f} %"]
        return [name, str(n), *cells]

    cells = [line("all", descents)]
    for ids, part in descents.groupby(DESCENT):
        cells.append(line(for_markdown("/".join(map(str, ids))), part))
    return [
        "Upper bounds of the share of flights, one-sided, with 95 % confidence (Clopper and Pearson).",
        "",
        *table(head, cells),
    ]


def _ellipses(frames: pd.DataFrame) -> list[str]:
    head = ["Descent", "altitude (m)", "semi-axes (m)", "direction (deg)", "stated semi-axes (m)", "direction (deg)"]
    cells = []
    for ids, of_descent in frames.groupby(DESCENT):
        nearest = dict.fromkeys((of_descent["altitude_m"] - wanted).abs().idxmin() for wanted in ALTITUDES_M)
        for row in of_descent.loc[list(nearest)].itertuples():
            cells.append(
                [
                    for_markdown("/".join(map(str, ids))),
                    f"{row.altitude_m:.0f}",
                    f"{row.major_m:.2f}, {row.minor_m:.2f}",
                    f"{row.azimuth_deg:.0f}",
                    f"{row.stated_major_m:.2f}, {row.stated_minor_m:.2f}",
                    f"{row.stated_azimuth_deg:.0f}",
                ]
            )
    return [
        "Horizontal ellipses that contain 95 % of normally distributed errors: from the errors of the draws about zero "
        "and from the mean stated covariance. The direction of the major axis is measured from X_L towards Y_L.",
        "",
        *table(head, cells),
    ]


def _cells(figures: Mapping[str, float]) -> list[str]:
    return [_cell(key, figures[key]) for key in _COLUMNS]


def _cell(key: str, value: float) -> str:
    if key == "ends_silently_wrong":
        return f"{value:.0f}"
    if not np.isfinite(value):
        return "-"
    return f"{100 * value:.2f} %" if key.endswith("_share") else number(float(value))
