"""Run `perilune-train explain`: write evidence on attention gates as tables, pictures and claims."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from perilune_shared.console.terminal import say_page
from perilune_shared.storage.files import write_text, written_aside
from perilune_shared.storage.store import Address
from perilune_train.detect.evaluate.split_evaluation import selection_entries
from perilune_train.detect.train.guide import GUIDED
from perilune_train.explain import detection, navigation
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.correlation.measures import PCC1_SIGN
from perilune_train.explain.evidence.removal import PERFECT, removal_summary
from perilune_train.explain.evidence.tables import TABLES, Evidence
from perilune_train.explain.maps.masks import Masks, detector_masks, navigator_masks, save_masks
from perilune_train.explain.networks import (
    ExplainedDetector,
    ExplainedNavigator,
    open_detection,
    open_navigation,
    terrain_marks,
)
from perilune_train.explain.page import claims as page
from perilune_train.explain.page.claims import Claim, beating_gates, forced_harm, relative_removal, removal_row
from perilune_train.explain.page.pictures import CAPTIONS, PICTURES, Masked, draw_detector, draw_navigator
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import Metrics, write_metrics
from perilune_train.training.begin import hashes_of, held, start_run, state_of
from perilune_train.training.runs import NamedRun, RunFolder

_COUNTED = {"detect": ("pcc1_craterness", "pcc1_partial"), "navigate": ("pcc4", "pcc4_minus_pcc3")}
"""Measures of each task in which metrics.json counts the gates that beat every null."""
_RELATIVE = {"control": "ratio", PERFECT: "of_perfect", "perfect control": "perfect_ratio"}
"""Endings of metrics by the key of `relative_harm`; the other keys are edge maps."""


@dataclass(frozen=True, slots=True)
class NetworkOnData:
    """A network to explain, and the dataset whose test split is used."""

    checkpoint: Path
    """checkpoints/best.ckpt of a run, or the weights of an installed network."""
    dataset: Address
    """Folder or address of the dataset."""


def explain_run(
    settings: ExplainConfig,
    named: NamedRun,
    detector: NetworkOnData | None,
    navigator: NetworkOnData | None,
    allow_overlap: bool = False,
) -> RunFolder:
    """Compute evidence on the attention gates of one or two networks on test data; writes runs/explain/<name>.

    `detector` and `navigator` are the networks; None skips a network. The config.yaml in the folder of the detector's
    checkpoint defines which craters are selected. The signs of correlations, and the gates whose pixels are removed,
    are chosen on the validation splits. A finished run with equal settings, datasets and checkpoints is left unchanged.

    Raises UserError if an existing run has different settings, datasets or checkpoints; if a dataset, a checkpoint or
    config.yaml is missing or invalid; if a network has no attention; or if a network was fitted to the terrain of its
    test frames (unless `allow_overlap`).
    """
    with held(named.folder("explain")):
        return _run(settings, named, detector, navigator, allow_overlap)


def _run(
    settings: ExplainConfig,
    named: NamedRun,
    detector: NetworkOnData | None,
    navigator: NetworkOnData | None,
    allow_overlap: bool,
) -> RunFolder:
    run = named.folder("explain")
    read: dict[str, Address | None] = {}
    networks: dict[str, tuple[Path, Address]] = {}
    for name, task, network in (("detector", "detection", detector), ("navigator", "navigation", navigator)):
        if network is not None:
            read |= {f"{task} dataset": network.dataset, name: network.checkpoint}
            networks[name] = network.checkpoint, network.dataset
    inputs = hashes_of(read)
    state = state_of(run, "explain", settings, inputs, named.overwrite)
    if state == "finished":
        return run
    navigation_inputs = (
        None if navigator is None else open_navigation(navigator.checkpoint, navigator.dataset, settings)
    )
    marks, metrics = terrain_marks(networks, allow_overlap)
    detection_inputs = None if detector is None else open_detection(detector.checkpoint, detector.dataset, settings)
    start_run(run, "explain", settings, inputs, state)

    parts = [] if detection_inputs is None else [_explain_detector(run, settings, detection_inputs)]
    parts += [] if navigation_inputs is None else [_explain_navigator(run, settings, navigation_inputs)]
    claims = [claim for part in parts for claim in part.claims]
    _write_tables(run, {part.task: part.evidence for part in parts})
    write_text(run.root / "claims.json", json.dumps([claim.plain() for claim in claims], indent=2) + "\n")
    captions = {name: CAPTIONS[name] for part in networks for name in PICTURES[part]}
    write_text(run.root / "captions.json", json.dumps(captions, indent=2) + "\n")
    for part in parts:
        metrics |= part.metrics
    metrics |= {"headline": page.headline(claims), "pcc1_sign": PCC1_SIGN}
    for name, mark in marks.items():
        mark_files(run.root, PICTURES[name], mark)
    joined = "; ".join(f"{name}: {mark}" for name, mark in marks.items() if mark)
    mark_files(run.root, [f"{name}.parquet" for name in TABLES], joined)
    say_page(page.headline(claims))
    write_metrics(run.root, metrics)
    return run


@dataclass(frozen=True)
class _Part:
    """Results of an explain run for one network."""

    task: str
    """detect or navigate."""
    evidence: Evidence
    """All tables."""
    claims: list[Claim]
    """Statements with verdicts."""
    metrics: Metrics
    """Entries of metrics.json."""


def _explain_detector(run: RunFolder, settings: ExplainConfig, seen: ExplainedDetector) -> _Part:
    where = seen.checkpoint
    evidence, masks = detection.explain_detector(settings, seen.detector, seen.frames, seen.known_frames, where)
    along = detector_masks(seen.detector.network, seen.descent.images, where)
    draw_detector(run.root, settings, evidence, Masked(seen.frames, masks), Masked(seen.descent, along))
    save_masks(run.root / "masks_detect.npz", seen.descent.frame_ids, along)
    deviations, guided = _deviations(masks), GUIDED if seen.config.loss.lambda_guide > 0 else ()
    metrics = figures_of(evidence, detection.TASK, higher_is_better=True) | selection_entries(seen.config, seen.split)
    metrics |= {f"mask_deviation/{block}": value for block, value in deviations.items()}
    metrics |= {"detect/guided_gates": " ".join(guided), "detector": where.as_posix()}
    metrics |= {"frames": len(seen.frames.images), "scenes": len(set(seen.frames.scene_ids))}
    return _Part(detection.TASK, evidence, page.detector_claims(evidence, deviations, guided), metrics)


def _explain_navigator(run: RunFolder, settings: ExplainConfig, flown: ExplainedNavigator) -> _Part:
    where, network, pairs = flown.checkpoint, flown.network, flown.pairs
    evidence, masks = navigation.explain_navigator(
        settings, network, flown.architecture, pairs, flown.known_pairs, where
    )
    along = navigator_masks(network, flown.flight.images, flown.architecture["size_px"], where)
    draw_navigator(run.root, settings, evidence, Masked(pairs, masks), Masked(flown.flight, along))
    deviations = _deviations(masks)
    metrics = figures_of(evidence, navigation.TASK, higher_is_better=False) | {"navigator": where.as_posix()}
    metrics |= {f"mask_deviation_stack/{block}": value for block, value in deviations.items()}
    metrics |= {"pairs": len(pairs.images), "pair_scenes": len(set(pairs.scene_ids))}
    return _Part(navigation.TASK, evidence, page.navigator_claims(evidence, deviations), metrics)


def _deviations(masks: Masks) -> dict[str, float]:
    """Standard deviation of each gate's mask over pixels and images."""
    return {block: float(gate_masks.std()) for block, gate_masks in masks.items()}


def _write_tables(run: RunFolder, evidence: Mapping[str, Evidence]) -> None:
    tables = [task_evidence.with_task(task) for task, task_evidence in evidence.items()]
    for name in TABLES:
        with written_aside(run.root / f"{name}.parquet") as aside:
            pd.concat([evidence_table[name] for evidence_table in tables], ignore_index=True).to_parquet(
                aside, index=False
            )


def figures_of(evidence: Evidence, task: str, *, higher_is_better: bool) -> Metrics:
    """Metrics of one network by name; undefined values are left out.

    - <measure>/<map>: mean of a gate or an attribution method; with _low and _high, the ends of its interval
    - <measure>_null/<gate>/<null>: mean of a null
    - <measure>_p/<gate>: p over all nulls, corrected for the number of gates
    - <task>/forced/<scope>: harm of forcing a gate, a stage or all gates to their means; with _low and _high
    - <task>/removal/<map>/<how>/<which>: harm of removed pixels
    - <task>/removal_ratio, _of_edges, _of_perfect, _perfect_ratio: see `relative_harm`; with _low and _high
    - <task>/stability/<change>/<gate>, <task>/randomised/<direction>/<step>/<gate>: similarity of masks
    """
    numbers: dict[str, float] = {}
    for row in evidence.summary[evidence.summary["kind"] != "null"].to_dict("records"):
        key = f"{row['measure']}/{row['map']}"
        numbers |= {key: row["value"], f"{key}_low": row["low"], f"{key}_high": row["high"]}
    for row in evidence.differences.to_dict("records"):
        numbers[f"{row['measure']}_null/{row['map']}/{row['null']}"] = row["null_value"]
    for row in evidence.tested.to_dict("records"):
        numbers[f"{row['measure']}_p/{row['map']}"] = row["p_adjusted"]
    for row in forced_harm(evidence, higher_is_better=higher_is_better).to_dict("records"):
        key = f"{task}/forced/{row['scope']}"
        numbers |= {key: row["value"], f"{key}_low": row["low"], f"{key}_high": row["high"]}
    for name, ratio in relative_removal(evidence, higher_is_better=higher_is_better).items():
        key = f"{task}/removal_{_RELATIVE.get(name, 'of_edges')}"
        low, high = ratio.interval or (math.nan, math.nan)
        numbers |= {key: ratio.value, f"{key}_low": low, f"{key}_high": high}
    for row in removal_summary(evidence.removal, higher_is_better).to_dict("records"):
        for which in ("most", "least", "random", "shifted"):
            numbers[f"{task}/removal/{row['map']}/{row['how']}/{which}"] = row[which]
    alike = evidence.stability.groupby(["change", "map"], sort=False)["pearson"].mean()
    for row in alike.reset_index().to_dict("records"):
        numbers[f"{task}/stability/{row['change']}/{row['map']}"] = row["pearson"]
    ranked = evidence.randomisation.groupby(["direction", "step", "map"], sort=False)["spearman"].mean()
    for row in ranked.reset_index().to_dict("records"):
        numbers[f"{task}/randomised/{row['direction']}/{row['step']}/{row['map']}"] = row["spearman"]

    metrics: Metrics = {name: float(value) for name, value in numbers.items() if math.isfinite(value)}
    for row in evidence.tested.to_dict("records"):
        metrics[f"{row['measure']}_beats_nulls/{row['map']}"] = bool(row["beats_all"])
    least = removal_row(evidence, higher_is_better=higher_is_better)
    metrics |= {f"{task}/removal_{name}": float(least[name]) for name in ("most", "least", "random", "shifted")}
    # The ratio is undefined if no control does harm; record 0.
    metrics.setdefault(f"{task}/removal_ratio", 0.0)
    metrics[f"{task}/strongest_gate"] = evidence.strongest
    for measure in _COUNTED[task]:
        metrics[f"{task}/{measure}_beating_to_stride_8"] = len(beating_gates(evidence, measure))
        metrics[f"{task}/{measure}_beating"] = len(beating_gates(evidence, measure, "12345"))
    gates = evidence.summary[evidence.summary["kind"] == "gate"]
    metrics[f"{task}/undefined"] = int(gates["undefined"].sum())
    return metrics
