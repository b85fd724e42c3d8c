"""One explanation run: masks of both networks, their correlations, bar charts."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from perilune_shared.errors import UserError
from perilune_shared.files import written_aside
from perilune_shared.manifest import open_dataset
from perilune_shared.progress import console, progress_bar
from perilune_train.data.frames import load_frames
from perilune_train.detect.run import load_detector
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.correlation import (
    ground_affine,
    ground_truth_mask,
    mean_defined,
    mean_of_others,
    pearson,
    pearson_between,
    warped_mask,
)
from perilune_train.explain.masks import Masks, detector_masks, draw_masks, navigator_masks
from perilune_train.navigate.data import Descent, load_descents, pair_sequence
from perilune_train.navigate.task import load_navigator
from perilune_train.runs import RunFolder, choose_device, start_run, write_metrics


def explain_run(
    settings: ExplainConfig, detect_data: Path, nav_data: Path, detector: Path, navigator: Path, runs: Path, name: str
) -> RunFolder:
    """Explain two checkpoints on the test frames of two datasets into runs/explain/<name>.

    Raises UserError where a dataset or checkpoint is missing or of another kind, or a network has no attention.
    """
    device = choose_device(settings.device)
    network = load_detector(detector).to(device)
    stack, architecture = load_navigator(navigator, "stack")
    frames, truth = _detect_frames(settings, detect_data)
    test = [descent for descent in load_descents(open_dataset(nav_data)) if descent.split == "test"]
    pairs = _spread([(descent, step) for descent in test for step in range(descent.n_pairs)], settings.n_pairs)
    run = start_run(runs, "explain", name, settings, False)
    detected = detector_masks(network, frames, detector)
    draw_masks(run.root / "masks_detect.png", *_some(frames, detected, settings.n_drawn))
    shrunk = {id(descent): descent.shrunk(architecture["size_px"]) for descent in test}
    sequences = [pair_sequence(shrunk[id(descent)], step, 1, warp=False) for descent, step in pairs]
    size = test[0].images.shape[1:]
    stacked = navigator_masks(
        stack.to(device),
        np.concatenate([s.first for s in sequences]),
        np.concatenate([s.second for s in sequences]),
        (size[0], size[1]),
        navigator,
    )
    both = np.stack([np.concatenate([d.images[step], d.images[step + 1]]) for d, step in pairs])
    draw_masks(run.root / "masks_navigate.png", *_some(both, stacked, settings.n_drawn))
    rows = _detector_correlations(detected, truth) + _navigator_correlations(stacked, pairs)
    table = pd.DataFrame(rows)
    with written_aside(run.root / "correlations.parquet") as aside:
        table.to_parquet(aside, index=False)
    draw_bars(
        run.root / "pcc_detect.png", table, {"pcc1": "PCC1: mask and crater mask", "pcc2": "PCC2: masks of two frames"}
    )
    draw_bars(run.root / "pcc_navigate.png", table, {"pcc3": "PCC3: halves", "pcc4": "PCC4: halves, lower one moved"})
    undefined = int(table["undefined"].sum())
    if undefined:
        console.print(f"{undefined} of {int(table['count'].sum())} correlations undefined: a mask was constant")
    metrics: dict[str, float | int | str | None] = {f"{row['measure']}/{row['block']}": row["value"] for row in rows}
    metrics |= {
        "frames": len(frames),
        "pairs": len(pairs),
        "undefined": undefined,
        "detector": detector.as_posix(),
        "navigator": navigator.as_posix(),
    }
    write_metrics(run, metrics)
    return run


def _detect_frames(settings: ExplainConfig, root: Path) -> tuple[np.ndarray, np.ndarray]:
    """Test frames (N, height, width) and the paper's masks G of their labels, float32 (N, height, width)."""
    dataset = open_dataset(root)
    if dataset.info.kind != "detect":
        raise UserError(root, "kind", dataset.info.kind, "detect, a dataset with labels")
    store = load_frames(dataset, "test")
    chosen = _spread(range(len(store)), settings.n_frames)
    labels = dict(list(dataset.table("labels").to_pandas().groupby("frame_id")))
    masks = []
    for i in chosen:
        own = labels.get(store.table["frame_id"][i])
        centres = np.zeros((0, 2)) if own is None else own[["ellipse_cx_px", "ellipse_cy_px"]].to_numpy()
        radii = np.zeros(0) if own is None else own["radius_px"].to_numpy()
        height, width = store.images.shape[1:]
        masks.append(ground_truth_mask(width, height, centres, radii, settings.ring_factors).astype(np.float32))
    return store.images[chosen], np.stack(masks)


def _detector_correlations(masks: Masks, truth: np.ndarray) -> list[dict]:
    rows = []
    for block, found in masks.items():
        value, undefined = mean_defined([pearson(mask, g) for mask, g in zip(found, truth, strict=True)])
        rows.append(_row(block, "pcc1", value, undefined, len(found)))
        value, undefined = mean_of_others(pearson_between(found))
        rows.append(_row(block, "pcc2", value, undefined, len(found) * (len(found) - 1)))
    return rows


def _navigator_correlations(masks: Masks, pairs: list[tuple[Descent, int]]) -> list[dict]:
    affines = []
    for descent, step in pairs:
        position, rotation = descent.position_m, descent.rotation_camera_from_site
        affines.append(
            ground_affine(descent.camera, position[step], rotation[step], position[step + 1], rotation[step + 1])
        )
    rows = []
    with progress_bar() as progress:
        task = progress.add_task("correlate", total=len(masks), unit="blocks", note="")
        for block, found in masks.items():
            uppers, lowers = np.split(found, 2, axis=1)
            plain, moved = [], []
            for upper, lower, affine in zip(uppers, lowers, affines, strict=True):
                plain.append(pearson(upper, lower))
                warped, seen = warped_mask(lower, affine)
                moved.append(pearson(upper, warped, seen))
            rows.append(_row(block, "pcc3", *mean_defined(plain), len(found)))
            rows.append(_row(block, "pcc4", *mean_defined(moved), len(found)))
            progress.advance(task)
    return rows


def _row(block: str, measure: str, value: float, undefined: int, count: int) -> dict:
    return {"block": block, "measure": measure, "value": value, "undefined": undefined, "count": count}


def _spread(items, count: int) -> list:
    """At most `count` items, evenly spaced."""
    items = list(items)
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, count).astype(int))]


def _some(images: np.ndarray, masks: Masks, count: int) -> tuple[np.ndarray, Masks]:
    chosen = _spread(range(len(images)), count)
    return images[chosen], {name: found[chosen] for name, found in masks.items()}


def draw_bars(path: Path, table: pd.DataFrame, measures: dict[str, str]) -> None:
    """Bars of two measures, block by block; a block without a bar was undefined in every image."""
    figure, axis = plt.subplots(figsize=(12, 4.5), constrained_layout=True)
    for i, (measure, label) in enumerate(measures.items()):
        own = table[table["measure"] == measure]
        axis.bar(np.arange(len(own)) + 0.4 * i, own["value"], 0.4, label=label)
        axis.set_xticks(np.arange(len(own)) + 0.2, own["block"], rotation=60)
    axis.axhline(0, color="black", linewidth=0.8)
    axis.set(ylabel="Pearson correlation", ylim=(-1, 1))
    axis.grid(axis="y", alpha=0.3)
    axis.legend()
    with written_aside(path) as aside:
        figure.savefig(aside, dpi=120)
    plt.close(figure)
