"""Run a causal analysis: the effect of removing single craters on masks, detections and poses."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.console.terminal import say
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text, written_aside
from perilune_shared.storage.store import Address
from perilune_train.data.frames import load_images
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.finished_run import config_of_run, raw_threshold
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.explain.causal import bins, pictures
from perilune_train.explain.causal.claims import Tested, detection_claim, pose_claim, reaction_claim
from perilune_train.explain.causal.effects import (
    check_descents,
    detection_effects,
    filled_frames,
    mask_effects,
    pose_effects,
    with_found,
)
from perilune_train.explain.causal.pairs import CraterPairs, crater_pairs, read_removed, same_frames
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.evidence.stability import between
from perilune_train.explain.inputs import frames_of
from perilune_train.explain.maps.masks import detector_masks
from perilune_train.explain.networks import folder_of, open_single_scale, terrain_marks
from perilune_train.motion.network import load_navigator
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.training.begin import hashes_of, start_run, state_of
from perilune_train.training.runs import NamedRun, RunFolder, choose_device

CAPTIONS = {
    "gates_causal.png": "Change of each gate's mask around single craters: crater removed from the ground and rendered"
    " again; the same pixels inpainted; empty ground inpainted.",
    "detections_causal.png": "Share of craters that the detector finds at its threshold, with and without the crater.",
    "bins_causal.png": "Change of every gate by size, freshness and Sun. n: views of craters.",
    "before_after_causal.png": "A frame with craters, the same frame rendered without the outlined craters, and one"
    " gate's masks for both frames.",
}
_BATCH = 8


@dataclass(frozen=True, slots=True)
class PoseInputs:
    """Descents with and without some craters, and the navigator to test on them."""

    dataset: Address
    """Navigation dataset with all craters."""
    counterfactual: Address
    """Dataset of these descents rendered without some craters."""
    checkpoint: Path
    """Path to best.ckpt of a stack navigator."""


@dataclass(frozen=True, slots=True)
class CausalInputs:
    """Frames with and without some craters, and optional inputs for further comparisons."""

    dataset: Address
    """Detection dataset with all craters."""
    counterfactual: Address
    """Dataset of these frames without some craters, from `perilune-render counterfactual`."""
    split: str = "test"
    """Split of the frames."""
    turned: Address | None = None
    """Dataset of these frames with all craters under another Sun; None to skip the comparison of Suns."""
    pose: PoseInputs | None = None
    """Inputs for the effect on the navigator; None to skip this effect."""


def causal_folder(named: NamedRun) -> RunFolder:
    """The folder that `causal_run` writes. The caller must lock this folder (`training.begin.held`)."""
    return named.folder("explain", "-causal")


def causal_run(
    settings: ExplainConfig,
    named: NamedRun,
    checkpoint: Path,
    gate: str,
    inputs: CausalInputs,
    allow_overlap: bool = False,
) -> RunFolder:
    """Measure how removing craters changes masks, detections and poses; writes runs/explain/<name>-causal.

    `checkpoint` contains the detector's weights. `gate` is the gate that the claims are about; choose it on other
    frames. A finished run with equal settings and inputs is left unchanged.

    Raises UserError if an existing run has different settings or inputs, if an input is missing or invalid, or if a
    network was fitted to the terrain of the frames (unless `allow_overlap`).
    """
    run = causal_folder(named)
    dataset, split, turned, pose = inputs.dataset, inputs.split, inputs.turned, inputs.pose
    read: dict[str, Address | None] = {
        "detection dataset": dataset,
        "counterfactual": inputs.counterfactual,
        "turned Sun": turned,
        "detector": checkpoint,
    }
    if pose is not None:
        read |= {
            "navigation dataset": pose.dataset,
            "navigation counterfactual": pose.counterfactual,
            "navigator": pose.checkpoint,
        }
    hashes = hashes_of(read)
    state = state_of(run, "explain", settings, hashes, named.overwrite)
    if state == "finished":
        return run
    folder = folder_of(checkpoint)
    config, threshold = config_of_run(folder, ()), raw_threshold(folder)
    removed, opened = read_removed(inputs.counterfactual), open_single(dataset)
    fitted = {"detector": (checkpoint, dataset)} | (
        {} if pose is None else {"navigator": (pose.checkpoint, pose.dataset)}
    )
    marks, terrain = terrain_marks(fitted, allow_overlap, split)
    detector = open_single_scale(checkpoint, config, settings)
    if gate not in detector.network.backbone.attentions:
        raise UserError("--gate", "", gate, f"one of {', '.join(detector.network.backbone.attentions)}")
    pairs = crater_pairs(opened, open_single(inputs.counterfactual), removed, split, config.labels)
    # Report errors in the other inputs before writing anything.
    if turned is not None:
        same_frames(opened, open_single(turned), split)
    if pose is not None:
        descents = open_single(pose.dataset), open_single(pose.counterfactual)
        check_descents(*descents, split)
        navigator, architecture = load_navigator(pose.checkpoint, "stack")
    start_run(run, "explain", settings, hashes, state)
    rng = np.random.default_rng([settings.seed, 3])
    versions, shifts = _versions(opened, pairs, split, config.labels, settings, rng)
    say(f"{len(pairs.craters)} views of {len(removed)} removed craters in {len(pairs.factual)} frames")
    masks = {version: detector_masks(detector.network, images, checkpoint) for version, images in versions.items()}
    moved = mask_effects(pairs, masks, shifts)
    detected = detection_effects(pairs, lambda images: _detect(detector, images), versions)
    detected = with_found(detected, threshold, shifts)
    gates = pictures.by_gate(moved, rng)
    tables = {"mask_effects": moved, "detection_effects": detected, "gate_effects": gates}
    tables |= {"mask_bins": bins.binned(moved, "change"), "detection_bins": bins.binned(detected, "found")}
    if turned is not None:
        tables["turned_sun"] = _turned(detector, opened, open_single(turned), split, checkpoint)
    if pose is not None:
        navigator = navigator.to(choose_device(settings.device))
        tables["pose_effects"] = pose_effects(navigator, architecture, *descents, split)
    for title, table in tables.items():
        with written_aside(run.root / f"{title}.parquet") as aside:
            table.to_parquet(aside, index=False)
    _draw(run.root, pairs, masks, tables, gate)
    mark_files(run.root, list(CAPTIONS), "; ".join(f"{part}: {mark}" for part, mark in marks.items() if mark))
    tested = _tested(tables, gate, rng)
    metrics = _metrics(tables, gate) | _p_values(tested) | terrain
    claims = [claim.claim for claim in tested.values()]
    write_text(run.root / "claims.json", json.dumps(claims, indent=2) + "\n")
    write_text(run.root / "captions.json", json.dumps(CAPTIONS, indent=2) + "\n")
    for claim in claims:
        say(f"{claim['claim']}: {claim['figure']}: {claim['verdict']}")
    write_metrics(run.root, metrics | {"split": split, "threshold": threshold, "detector": checkpoint.as_posix()})
    return run


def _versions(
    dataset: Dataset, pairs: CraterPairs, split: str, labels, settings: ExplainConfig, rng: np.random.Generator
) -> tuple[dict[str, NDArray[np.uint8]], list[tuple[float, float] | None]]:
    """The frames by name of the version, and the shift of each placebo region (None without free ground)."""
    whole = load_split(dataset, split, labels)
    index_of = {frame_id: index for index, frame_id in enumerate(whole.frames.table["frame_id"])}
    frames = frames_of(whole, [index_of[name] for name in pairs.frames["frame_id"]], settings.ring_factors)
    inpainted, placebo, shifts = filled_frames(pairs, frames.truth < 1, rng)
    names = ("factual", "rendered", "inpainted", "placebo")
    return dict(zip(names, (pairs.factual, pairs.counterfactual, inpainted, placebo), strict=True)), shifts


def _detect(detector: Detector, images: NDArray[np.uint8]) -> list[Detections]:
    detections = []
    for start in range(0, len(images), _BATCH):
        boxes, scores, _ = detector.predict(images[start : start + _BATCH])
        detections += detections_of(boxes, scores, detector.config.evaluation)
    return detections


def _turned(detector: Detector, factual: Dataset, turned: Dataset, split: str, checkpoint: Path) -> pd.DataFrame:
    """Similarity between the masks of each pose under two Suns. Columns: map, change, frame_index, pearson.

    Raises UserError if `turned` has frames that `factual` does not have.
    """
    tables = same_frames(factual, turned, split)
    images = [load_images(dataset, rows, split) for dataset, rows in zip((factual, turned), tables, strict=True)]
    masks = [detector_masks(detector.network, image, checkpoint) for image in images]
    return between(masks[0], masks[1], "turned Sun")


def _draw(folder: Path, pairs: CraterPairs, masks: dict, tables: dict[str, pd.DataFrame], gate: str) -> None:
    pictures.draw_gate_effects(folder / "gates_causal.png", tables["gate_effects"])
    bins.draw_bins(folder / "detections_causal.png", {"share of craters that are found": tables["detection_bins"]})
    bins.draw_gate_bins(folder / "bins_causal.png", tables["mask_bins"])
    image = int(np.bincount(pairs.craters["image"].to_numpy()).argmax())
    masks_of_pair = {version: masks[version][gate] for version in ("factual", "rendered")}
    pictures.draw_pair(folder / "before_after_causal.png", pairs, masks_of_pair, image, gate)


def _metrics(tables: dict[str, pd.DataFrame], gate: str) -> Metrics:
    metrics: Metrics = {"gate": gate, "crater_views": int(tables["mask_effects"]["crater"].nunique())}
    for row in tables["gate_effects"].to_dict("records"):
        metrics[f"{row['version']}/{row['map']}"] = float(row["change"])
        if np.isfinite(row["low"]):
            metrics[f"{row['version']}/{row['map']}_low"] = float(row["low"])
            metrics[f"{row['version']}/{row['map']}_high"] = float(row["high"])
    for version, share in tables["detection_effects"].groupby("version", sort=False)["found"].mean().items():
        metrics[f"found/{version}"] = float(share)
    if "pose_effects" in tables:
        pose = tables["pose_effects"]
        metrics |= {f"pose/{name}": float(np.sqrt((pose[name] ** 2).mean())) for name in ("before", "after", "moved_m")}
    if "turned_sun" in tables:
        means = tables["turned_sun"].groupby("map", sort=False)["pearson"].mean()
        metrics |= {f"turned_sun/{block}": float(value) for block, value in means.items()}
    metrics |= bins.bin_metrics(tables["mask_bins"], "bins")
    return metrics | bins.bin_metrics(tables["detection_bins"], "found_bins")


def _tested(tables: dict[str, pd.DataFrame], gate: str, rng: np.random.Generator) -> dict[str, Tested]:
    """Claims with their p values, by the prefix of their keys in metrics.json."""
    tested = {
        "gate": reaction_claim(tables["mask_effects"], tables["gate_effects"], gate),
        "found": detection_claim(tables["detection_effects"], rng),
    }
    return tested | ({"pose": pose_claim(tables["pose_effects"], rng)} if "pose_effects" in tables else {})


def _p_values(tested: dict[str, Tested]) -> Metrics:
    metrics: Metrics = {f"{name}_p": test.p for name, test in tested.items()}
    return metrics | {f"{name}_p_placebo": tested[name].p_placebo for name in ("gate", "found")}
