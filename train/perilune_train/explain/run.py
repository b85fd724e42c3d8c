"""One explain run: attention masks of both networks, their correlations, bar charts."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.files import written_aside
from perilune_shared.storage.store import Address
from perilune_shared.terminal import console, progress_bar
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.split_evaluation import selection_entries
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.inference.detector import load_detector
from perilune_train.evaluation.marks import mark_files
from perilune_train.evaluation.metrics_file import Metrics, write_metrics
from perilune_train.evaluation.provenance import check_terrain, protocol_of, read_provenance
from perilune_train.explain.bars import DETECT_BARS, DETECT_TITLE, NAVIGATE_BARS, NAVIGATE_TITLE, draw_bars
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.correlation import ground_affine, ground_truth_mask
from perilune_train.explain.masks import Masks, detector_masks, draw_masks, navigator_masks
from perilune_train.explain.measures import PCC1_SIGN, detector_correlations, navigator_correlations
from perilune_train.navigate.data.sequences import pair_sequence
from perilune_train.navigate.data.trajectories import Trajectory, load_trajectories
from perilune_train.navigate.network import load_navigator
from perilune_train.training.begin import hashes_of, start_run, state_of
from perilune_train.training.runs import RunFolder, choose_device, load_weights

_TABLE = "correlations.parquet"
_PICTURES = {
    "detector": ("masks_detect.png", "pcc_detect.png"),
    "navigator": ("masks_navigate.png", "pcc_navigate.png"),
}
"""Picture files of each network: masks and correlations."""


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
    """Compute and draw the attention masks of two networks on test frames; writes runs/explain/<name>.

    `detector` is checkpoints/best.ckpt in the folder of its run, whose config.yaml defines the selected craters. Leaves
    a finished run of the same settings, datasets and checkpoints unchanged; `overwrite` replaces any existing run.

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
    device = choose_device(settings.device)
    network = load_detector(detector).to(device)
    stack, architecture = load_navigator(navigator, "stack")
    marks, terrain = _check_terrain(
        {"detector": (detector, detect_data), "navigator": (navigator, nav_data)}, allow_overlap
    )
    own = config_of_run(detector.parent.parent, ())
    frames, truth, labels = detect_frames(settings, own, detect_data)
    test = [trajectory for trajectory in load_trajectories(open_dataset(nav_data)) if trajectory.split == "test"]
    pairs = _evenly_spaced([(one, step) for one in test for step in range(one.n_pairs)], settings.n_pairs)
    start_run(run, "explain", settings, inputs, state)
    detected = detector_masks(network, frames, detector)
    draw_masks(run.root / "masks_detect.png", *_to_draw(frames, detected, settings.n_drawn))
    shrunk = {id(trajectory): trajectory.shrunk(architecture["size_px"]) for trajectory in test}
    sequences = [pair_sequence(shrunk[id(trajectory)], step, 1, warp=False) for trajectory, step in pairs]
    size = test[0].images.shape[1:]
    stacked = navigator_masks(
        stack.to(device),
        np.concatenate([s.first for s in sequences]),
        np.concatenate([s.second for s in sequences]),
        (size[0], size[1]),
        navigator,
    )
    both = np.stack([np.concatenate([one.images[step], one.images[step + 1]]) for one, step in pairs])
    draw_masks(run.root / "masks_navigate.png", *_to_draw(both, stacked, settings.n_drawn))
    rows = detector_correlations(detected, truth) + _navigator_rows(stacked, pairs)
    table = pd.DataFrame(rows)
    with written_aside(run.root / _TABLE) as aside:
        table.to_parquet(aside, index=False)
    draw_bars(run.root / "pcc_detect.png", table, DETECT_BARS, DETECT_TITLE)
    draw_bars(run.root / "pcc_navigate.png", table, NAVIGATE_BARS, NAVIGATE_TITLE)
    console.print(PCC1_SIGN, markup=False)
    # pcc1_craterness is undefined whenever pcc1_background is; count them once.
    counted = table[table["measure"] != "pcc1_craterness"]
    undefined = int(counted["undefined"].sum())
    if undefined:
        console.print(f"{undefined} of {int(counted['count'].sum())} correlations undefined: a mask was constant")
    metrics: Metrics = {f"{row['measure']}/{row['block']}": row["value"] for row in rows}
    metrics |= {
        f"{row['measure']}_all_pixels/{row['block']}": row["value_all_pixels"]
        for row in rows
        if row["measure"] in ("pcc3", "pcc4")
    }
    metrics |= labels | terrain
    metrics |= {
        "pcc1_sign": PCC1_SIGN,
        "frames": len(frames),
        "pairs": len(pairs),
        "undefined": undefined,
        "detector": detector.as_posix(),
        "navigator": navigator.as_posix(),
    }
    for part, mark in marks.items():
        mark_files(run.root, _PICTURES[part], mark)
    mark_files(run.root, [_TABLE], "; ".join(f"{part}: {mark}" for part, mark in marks.items() if mark))
    write_metrics(run.root, metrics)
    return run


def _check_terrain(networks: Mapping[str, tuple[Path, Address]], allow_overlap: bool) -> tuple[dict[str, str], Metrics]:
    """Marks and entries of metrics.json by network, from each network's checkpoint and dataset.

    Raises UserError if a network was fitted to terrain of its dataset's test frames, unless `allow_overlap`.
    """
    marks: dict[str, str] = {}
    metrics: Metrics = {}
    for part, (checkpoint, address) in networks.items():
        dataset = open_dataset(address)
        check = check_terrain(read_provenance(load_weights(checkpoint), checkpoint), dataset, "test", allow_overlap)
        marks[part] = check.mark
        figures = {"dataset/protocol": protocol_of(dataset.info), **check.metrics()}
        metrics |= {f"{part}/{key}": value for key, value in figures.items()}
    return marks, metrics


def detect_frames(
    settings: ExplainConfig, detector: DetectConfig, address: Address
) -> tuple[np.ndarray, np.ndarray, Metrics]:
    """Test frames (N, height, width), the paper's masks G of them, float32 (N, height, width), and their selection.

    G contains only craters that the detector's own run selects, so no hardly visible ones.
    """
    dataset = open_dataset(address)
    if dataset.info.kind != "detect":
        raise UserError(dataset.store, "kind", dataset.info.kind, "detect, a dataset with labels")
    split = load_split(dataset, "test", detector.labels)
    chosen = _evenly_spaced(range(len(split)), settings.n_frames)
    height, width = split.frames.images.shape[1:]
    masks = []
    for own in (split.labels[i] for i in chosen):
        centres, radii = own.ellipses[own.selected, :2], own.radius_px[own.selected]
        masks.append(ground_truth_mask(width, height, centres, radii, settings.ring_factors).astype(np.float32))
    return split.frames.images[chosen], np.stack(masks), selection_entries(detector, split)


def _navigator_rows(masks: Masks, pairs: list[tuple[Trajectory, int]]) -> list[dict]:
    affines = []
    for trajectory, step in pairs:
        position, rotation = trajectory.position_m, trajectory.rotation_camera_from_site
        affines.append(
            ground_affine(trajectory.camera, position[step], rotation[step], position[step + 1], rotation[step + 1])
        )
    rows = []
    with progress_bar() as progress:
        task = progress.add_task("correlate", total=len(masks), unit="blocks", note="")
        for block, found in masks.items():
            rows += navigator_correlations(block, found, affines)
            progress.advance(task)
    return rows


def _evenly_spaced(items, count: int) -> list:
    """At most `count` items, evenly spaced."""
    items = list(items)
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).astype(int))]


def _to_draw(images: np.ndarray, masks: Masks, count: int) -> tuple[np.ndarray, Masks]:
    """At most `count` of the images (N, height, width), evenly spaced, and their masks."""
    chosen = _evenly_spaced(range(len(images)), count)
    return images[chosen], {name: found[chosen] for name, found in masks.items()}
