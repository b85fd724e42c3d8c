"""Score fixes and the filter on the locked benchmark, by region and with intervals over scenes."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.export.foreign_text import code_span
from perilune_shared.storage.files import new_folder
from perilune_shared.storage.store import Address
from perilune_train.landing.map.files import read_maps
from perilune_train.landing.methods.absolute import (
    absolute_errors,
    absolute_summary,
    catalogues_of,
    on_the_same_frames,
)
from perilune_train.landing.methods.fixes import WRONG_PX
from perilune_train.landing.methods.page import COLUMNS_ABSOLUTE, cell, same_frames_section
from perilune_train.landing.methods.pictures import draw_by_altitude
from perilune_train.landing.methods.seen import seen_descents
from perilune_train.motion.data.trajectories import load_split
from perilune_train.records.benchmark_parts import Part, open_parts, part_names
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.records.provenance import check_terrain, read_provenance
from perilune_train.records.spread import Resamples, Spread, draw_resamples, spreads
from perilune_train.training.runs import RunFolder, load_weights

PAGE, FIGURES, FRAMES, PICTURE = "benchmark.md", "benchmark.json", "frames.parquet", "altitude.png"
POSITION = "position_rmse_m"


def score_landing(
    detector: Path, data: Address, manifests: Address, out: Path, maps: Path | None = None, allow_overlap: bool = False
) -> Metrics:
    """Score fixes, lost-in-space fixes and the filter with a detector; returns the metrics.

    `maps` contains one folder from `navigate map` for each part of the benchmark, named after the part. Parts without a
    folder are not scored with a map. Writes a page, the metrics, a table of all frames and a picture to the new folder
    `out`; writes nothing if it fails. Raises UserError if the benchmark is missing or changed, or if the detector was
    fitted to its terrain (unless `allow_overlap`).
    """
    parts = open_parts("nav", data, manifests)
    best = RunFolder(detector).best
    provenance = read_provenance(load_weights(best), best)
    checks = [check_terrain(provenance, part.dataset, "test", allow_overlap) for part in parts]
    mark = "; ".join(dict.fromkeys(check.mark for check in checks if check.mark))
    catalogues = {part.name: _mapped(part, maps) for part in parts}
    with new_folder(out) as folder:
        tables, seconds = [], {}
        for part in parts:
            trajectories = load_split(part.dataset, "test")
            known = catalogues_of(
                part.dataset, sorted({trajectory.ids[0] for trajectory in trajectories}), catalogues[part.name]
            )
            descents, seconds[part.name] = seen_descents(part.dataset, trajectories, detector)
            for method, errors in absolute_errors(part.dataset, descents, known).items():
                names = part.name + "/" + errors["scene_id"]
                tables.append(errors.assign(method=method, region=part.region, scene_id=names))
        frames = pd.concat(tables, ignore_index=True)
        by_method = {str(method): rows_of_method for method, rows_of_method in frames.groupby("method", sort=False)}
        figures: Metrics = {"terrain/mark": mark}
        for part in parts:
            figures[f"frames/{part.name}"] = part.dataset.info.counts.frames
            figures[f"locked_frames/{part.name}"] = part.n_locked
            figures[f"detection_s/{part.name}"] = seconds[part.name]
        for method, rows_of_method in by_method.items():
            figures |= {f"{method}/{key}": value for key, value in absolute_summary(method, rows_of_method).items()}
            figures |= _spread(method, rows_of_method).keys(f"{method}/{POSITION}")
            for region, rows in rows_of_method.groupby("region"):
                summary = absolute_summary(method, rows)
                figures |= {f"{method}/region/{region}/{key}": value for key, value in summary.items()}
        for method, compared in on_the_same_frames(by_method).items():
            figures |= {f"{method}/same_frames/{key}": value for key, value in compared.items()}
        frames.to_parquet(folder / FRAMES, index=False)
        draw_by_altitude(
            folder / PICTURE, {name: rows_of_method for name, rows_of_method in by_method.items() if "lost" not in name}
        )
        write_markdown(folder / PAGE, _page(detector, by_method, figures))
        mark_files(folder, [PAGE, FRAMES, PICTURE], mark)
        write_metrics(folder, figures | {"scored": f"run {detector.resolve().name}"}, FIGURES)
    return figures


def _mapped(part: Part, maps: Path | None) -> Mapping:
    """The catalogues mapped for a part of the benchmark; empty if the part has no map."""
    if maps is None or not (maps / part.name).is_dir():
        return {}
    return read_maps(maps / part.name, part.dataset)


def _spread(method: str, errors: pd.DataFrame) -> Spread:
    """Spread over scenes of the position RMSE; for fixes, the RMSE of correct fixes only."""
    used = errors[errors["error_px"] < WRONG_PX] if method.startswith(("fix", "lost")) else errors
    used = used.dropna(subset=["error_m"])
    rows, squares = np.arange(len(used)), np.square(used["error_m"].to_numpy())

    def statistics(drawn: Resamples) -> dict[str, np.ndarray]:
        with np.errstate(invalid="ignore"):
            return {POSITION: np.sqrt(drawn.totals(rows, squares) / drawn.totals(rows))}

    scenes, names = used["scene_id"].tolist(), (used["scene_id"] + "/" + used["trajectory_id"]).tolist()
    return spreads(statistics, rows, draw_resamples(scenes, names, names, np.random.default_rng(0)))[POSITION]


def _page(detector: Path, by_method: dict[str, pd.DataFrame], figures: Metrics) -> str:
    """The results page as Markdown."""
    lines = ["# Locked benchmark of landing", "", f"Craters by the detector {code_span(detector.resolve().name)}.", ""]
    for name in part_names("nav"):
        n_frames, n_locked = figures.get(f"frames/{name}"), figures.get(f"locked_frames/{name}")
        whole = "all frames" if n_frames == n_locked else f"**a part: {n_frames} of {n_locked} frames**"
        lines.append(f"- `{name}`: {whole} of the shared manifest" if n_frames else f"- `{name}`: **not scored**")
    lines += [
        "",
        f"A fix is right if it is off by less than {WRONG_PX:g} pixels on the ground; errors are those of right ones.",
        "Errors of filter and smoother are those of all frames.",
        "",
    ]
    used = {key: title for key, title in COLUMNS_ABSOLUTE.items() if key != POSITION}
    rows = []
    for method, rows_of_method in by_method.items():
        values = absolute_summary(method, rows_of_method)
        spread = _spread(method, rows_of_method).text(values[POSITION])
        rows.append([f"`{method}`", spread, *(cell(key, values.get(key, np.nan)) for key in used)])
    lines += [*table(["method", COLUMNS_ABSOLUTE[POSITION], *used.values()], rows), ""]
    lines += ["In brackets: 95 % intervals over scenes, or the value of each scene if there are fewer than five.", ""]
    lines += same_frames_section(on_the_same_frames(by_method))
    regions = sorted({region for rows_of_method in by_method.values() for region in rows_of_method["region"]})
    for key, title in ((POSITION, "Position RMSE (m)"), ("position_end_rmse_m", "Position RMSE at the end (m)")):
        lines += [f"## {title} by region", ""]
        head = ["method", *regions]
        cells = [
            [f"`{method}`", *(number(figures.get(f"{method}/region/{region}/{key}")) for region in regions)]
            for method, rows_of_method in by_method.items()
            if key in absolute_summary(method, rows_of_method)
        ]
        lines += [*table(head, cells), ""]
    caption = "Errors by altitude, and normalised errors squared"
    return "\n".join([*lines, f"![{caption}]({PICTURE})", "", f"*{caption}.*", ""])
