"""One explain run: evidence on the gates of a detector and of a stack navigator, as tables, pictures and claims."""

import json
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from perilune_shared.dataset.manifest import open_single
from perilune_shared.storage.files import write_text, written_aside
from perilune_shared.storage.store import Address
from perilune_shared.terminal import console
from perilune_train.detect.evaluate.split_evaluation import selection_entries
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.train.guide import GUIDED
from perilune_train.evaluation.marks import mark_files
from perilune_train.evaluation.metrics_file import write_metrics
from perilune_train.explain import detection, navigation
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.correlation.measures import PCC1_SIGN
from perilune_train.explain.evidence.tables import TABLES, Evidence
from perilune_train.explain.figures import figures_of
from perilune_train.explain.inputs import (
    consecutive_pairs,
    first_descent,
    frames_of,
    labelled_frames,
    pairs_of_descent,
)
from perilune_train.explain.maps.masks import Masks, detector_masks, navigator_masks
from perilune_train.explain.networks import folder_of, open_single_scale, terrain_marks
from perilune_train.explain.page import claims as page
from perilune_train.explain.page.pictures import CAPTIONS, PICTURES, draw_detector, draw_navigator
from perilune_train.explain.page.viewer import save_masks
from perilune_train.navigate.data.trajectories import load_split
from perilune_train.navigate.network import load_navigator
from perilune_train.training.begin import hashes_of, start_run, state_of
from perilune_train.training.runs import RunFolder, choose_device


def explain_run(
    settings: ExplainConfig,
    detect_data: Address,
    nav_data: Address,
    detector: Path,
    navigator: Path,
    runs: Path,
    name: str,
    overwrite: bool = False,
    allow_overlap: bool = False,
) -> RunFolder:
    """Compute the evidence on the attention gates of two networks on test data; writes runs/explain/<name>.

    `detector` is checkpoints/best.ckpt of a run, or the weights of an installed network: the config.yaml of its folder
    defines the selected craters. Leaves a finished run of the same settings, datasets and checkpoints unchanged;
    `overwrite` replaces any existing run.
    Signs and the gates whose pixels are removed are chosen on the validation splits.

    Raises UserError if the existing run has other settings, datasets or checkpoints; if a dataset, a checkpoint or
    config.yaml is missing or invalid; if a network has no attention; or if it was fitted to terrain of its test frames
    (unless `allow_overlap`).
    """
    run = RunFolder(runs / "explain" / name)
    inputs = hashes_of(
        {"detection dataset": detect_data, "navigation dataset": nav_data, "detector": detector, "navigator": navigator}
    )
    state = state_of(run, "explain", settings, inputs, overwrite)
    if state == "finished":
        return run
    stack, architecture = load_navigator(navigator, "stack")
    stack = stack.to(choose_device(settings.device))
    marks, terrain = terrain_marks(
        {"detector": (detector, detect_data), "navigator": (navigator, nav_data)}, allow_overlap
    )
    own = config_of_run(folder_of(detector), ())
    opened = open_single_scale(detector, own, settings)
    labelled, flown = open_single(detect_data), open_single(nav_data)
    frames, split = labelled_frames(labelled, "test", own, settings.n_frames, settings.ring_factors)
    known_frames, _ = labelled_frames(labelled, "val", own, settings.n_validation, settings.ring_factors)
    descents = load_split(flown, "test")
    pairs, flight = consecutive_pairs(descents, settings.n_pairs), pairs_of_descent(descents[0], settings.n_drawn)
    known_pairs = consecutive_pairs(load_split(flown, "val"), settings.n_validation)
    descent = frames_of(split, first_descent(split), settings.ring_factors)
    start_run(run, "explain", settings, inputs, state)

    found, masks = detection.explain_detector(settings, opened, frames, known_frames, detector)
    along = detector_masks(opened.network, descent.images, detector)
    draw_detector(run.root, settings, frames, masks, found, descent, along)
    save_masks(run.root / "masks_detect.npz", descent.frame_ids, along)
    seen, stacked = navigation.explain_navigator(settings, stack, architecture, pairs, known_pairs, navigator)
    flown_masks = navigator_masks(stack, flight.images, architecture["size_px"], navigator)
    draw_navigator(run.root, settings, pairs, stacked, seen, flight, flown_masks)

    guided = GUIDED if own.loss.lambda_guide > 0 else ()
    claims = page.detector_claims(found, _deviations(masks), guided) + page.navigator_claims(seen, _deviations(stacked))
    _write_tables(run, {detection.TASK: found, navigation.TASK: seen})
    write_text(run.root / "claims.json", json.dumps([one.plain() for one in claims], indent=2) + "\n")
    write_text(run.root / "captions.json", json.dumps(CAPTIONS, indent=2) + "\n")
    metrics = (
        figures_of(found, detection.TASK, higher_is_better=True)
        | figures_of(seen, navigation.TASK, higher_is_better=False)
        | selection_entries(own, split)
        | terrain
    )
    metrics |= {f"mask_deviation/{block}": value for block, value in _deviations(masks).items()}
    metrics |= {f"mask_deviation_stack/{block}": value for block, value in _deviations(stacked).items()}
    metrics |= {
        "detect/guided_gates": " ".join(guided),
        "headline": page.headline(claims),
        "pcc1_sign": PCC1_SIGN,
        "frames": len(frames.images),
        "pairs": len(pairs.images),
        "scenes": len(set(frames.scene_ids)),
        "pair_scenes": len(set(pairs.scene_ids)),
        "detector": detector.as_posix(),
        "navigator": navigator.as_posix(),
    }
    for part, mark in marks.items():
        mark_files(run.root, PICTURES[part], mark)
    joined = "; ".join(f"{part}: {mark}" for part, mark in marks.items() if mark)
    mark_files(run.root, [f"{name}.parquet" for name in TABLES], joined)
    console.print(page.headline(claims), markup=False, soft_wrap=True)
    write_metrics(run.root, metrics)
    return run


def _deviations(masks: Masks) -> dict[str, float]:
    """Standard deviation of each gate's mask over pixels and images."""
    return {block: float(found.std()) for block, found in masks.items()}


def _write_tables(run: RunFolder, evidence: Mapping[str, Evidence]) -> None:
    tables = [found.with_task(task) for task, found in evidence.items()]
    for name in TABLES:
        with written_aside(run.root / f"{name}.parquet") as aside:
            pd.concat([one[name] for one in tables], ignore_index=True).to_parquet(aside, index=False)
