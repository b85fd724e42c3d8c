"""Fly all methods over the descents of a split and write tables, a page and pictures."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import open_single
from perilune_shared.export.foreign_text import code_span, for_markdown
from perilune_shared.run_record import run_record
from perilune_shared.storage.files import new_folder, write_text
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import PosePrior
from perilune_train.landing.craters.locate import locate
from perilune_train.landing.map.files import read_maps
from perilune_train.landing.methods.absolute import (
    absolute_errors,
    absolute_summary,
    catalogues_of,
    on_the_same_frames,
)
from perilune_train.landing.methods.detector_errors import deviation_table, matches_of
from perilune_train.landing.methods.page import deviations_section, page_of, same_frames_section
from perilune_train.landing.methods.pictures import draw_by_altitude, draw_flights, draw_matches
from perilune_train.landing.methods.seen import SeenDescent, seen_descents
from perilune_train.motion.data.trajectories import Trajectory, load_split
from perilune_train.motion.evaluate_runs import fusion_of, learned_motions
from perilune_train.motion.metrics.baselines import MethodMotions, baselines
from perilune_train.motion.metrics.errors import motion_errors, summary
from perilune_train.motion.network import check_motion
from perilune_train.records.markdown import write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import write_metrics
from perilune_train.records.provenance import EvaluatedSplit, check_terrain, read_provenance
from perilune_train.training.begin import hashes_of
from perilune_train.training.runs import RunFolder, load_weights

PAGE, TABLE, FRAMES = "methods.md", "navigation.parquet", "frames.parquet"
DEVIATIONS = "deviations.parquet"
PICTURES = ("altitude.png", "flights.png", "matches_high.png", "matches_low.png")


def fly_methods(
    evaluated: EvaluatedSplit, navigator: Path | None, detector: Path, out: Path, maps: Path | None = None
) -> pd.DataFrame:
    """Fly all methods over a split; returns one row per method.

    `navigator` and `detector` are folders of runs; without a navigator, all methods of relative motion are methods
    without training. `maps` is the folder of a map from `navigate map`. Writes
    methods.md, navigation.parquet (one row per method), frames.parquet (one row per absolute method and frame),
    deviations.parquet (stated and measured errors of detected centres),
    pictures, inputs.json (hashes) and metrics.json (split, commit, command) to the new folder `out`; writes nothing if
    it fails. Raises UserError if a network was fitted to the terrain of the split (unless `evaluated` allows overlap),
    or if the dataset lacks frames.
    """
    address, split = evaluated.dataset, evaluated.split
    # Record the commit at the start: the checkout may change during the run.
    run_record()
    dataset = open_single(address)
    runs = {"navigator": navigator, "detector": detector}
    best = {name: RunFolder(run).best for name, run in runs.items() if run is not None}
    contents = {name: load_weights(path) for name, path in best.items()}
    if navigator is not None:
        fusion_of(best["navigator"], contents["navigator"]["architecture"])
        check_motion(best["navigator"], contents["navigator"]["architecture"])
    checks = [
        check_terrain(read_provenance(contents[name], path), dataset, split, evaluated.allow_overlap)
        for name, path in best.items()
    ]
    mapped = {} if maps is None else read_maps(maps, dataset)
    with new_folder(out) as folder:
        trajectories = load_split(dataset, split)
        catalogues = catalogues_of(dataset, sorted({trajectory.ids[0] for trajectory in trajectories}), mapped)
        descents, detection_s = seen_descents(dataset, trajectories, detector)
        learned = MethodMotions({}, {}) if navigator is None else learned_motions(navigator, trajectories)
        relative = _relative(trajectories, learned)
        errors = absolute_errors(dataset, descents, catalogues)
        absolute = pd.DataFrame([{"method": name, **absolute_summary(name, table)} for name, table in errors.items()])
        rows = pd.concat([relative, absolute.assign(kind="absolute")], ignore_index=True)
        rows.to_parquet(folder / TABLE, index=False)
        frames = pd.concat([table.assign(method=name) for name, table in errors.items()], ignore_index=True)
        frames.to_parquet(folder / FRAMES, index=False)
        draw_by_altitude(folder / PICTURES[0], {name: errors[name] for name in errors if not name.startswith("lost")})
        if "filter" in errors:
            draw_flights(folder / PICTURES[1], errors["filter"])
        _draw_matches(folder, trajectories[0], descents[0], catalogues.rough[descents[0].ids[0]])
        deviations = deviation_table([(each, matches_of(each, catalogues.exact[each.ids[0]])) for each in descents])
        if len(deviations):
            deviations.to_parquet(folder / DEVIATIONS, index=False)
        drawn = [name for name in PICTURES if (folder / name).is_file()]
        source = f"Dataset {code_span(dataset.info.name)}, split {for_markdown(split)}"
        sections = [*same_frames_section(on_the_same_frames(errors)), *deviations_section(deviations)]
        write_markdown(folder / PAGE, page_of(source, rows, descents, detection_s, drawn, sections))
        tables = [TABLE, FRAMES, *([DEVIATIONS] if len(deviations) else [])]
        for check in checks:
            mark_files(folder, (PAGE, *tables, *drawn), str(check.metrics()["terrain/mark"]))
        write_text(folder / "inputs.json", json.dumps(hashes_of({"dataset": address, **best}), indent=2) + "\n")
        write_metrics(folder, {"split": split, "seed": "fixed in the code"})
    return rows


def _relative(trajectories: list[Trajectory], learned: MethodMotions) -> pd.DataFrame:
    """Errors of the motion between consecutive frames, one row per method."""
    classical = baselines([], trajectories)
    rows, covariances = [], learned.covariances | classical.covariances
    for method, motions in (learned.motions | classical.motions).items():
        figures = summary(motion_errors(trajectories, motions, covariances.get(method)))
        rows.append(
            {
                "method": method,
                "kind": "relative",
                "n_frames": float(sum(trajectory.n_pairs for trajectory in trajectories)),
                "position_rmse_m": figures["position_rmse_vector_m"],
                "attitude_rmse_deg": figures["orientation_rmse_angle_deg"],
                "stated_rmse_m": figures.get("stated_position_rmse_vector_m", np.nan),
                "normalised_error_squared_mean": figures.get("normalised_error_squared_mean", np.nan),
                "position_end_rmse_m": figures["drift_final_m"],
            }
        )
    return pd.DataFrame(rows)


def _draw_matches(folder: Path, trajectory: Trajectory, descent: SeenDescent, catalogue: Catalogue) -> None:
    """Draw the first and the last frame of a descent, with the matched craters."""
    for name, frame in ((PICTURES[2], 0), (PICTURES[3], len(descent.true) - 1)):
        near = PosePrior(descent.true[frame], np.diag(np.square([5.0] * 3 + [0.002] * 3)))
        located = locate(descent.sightings[frame], catalogue, descent.camera, near)
        if located is not None:
            draw_matches(folder / name, trajectory.images[frame], descent, frame, catalogue, located)
