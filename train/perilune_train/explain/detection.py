"""Compute evidence on the detector's gates: correlations with nulls, interventions, localisation, stability."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from perilune_shared.console.terminal import say
from perilune_train.data.frames import normalised
from perilune_train.detect.data.batches import network_input
from perilune_train.detect.inference.detector import Detector
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.correlation.measures import FrameTargets, detector_values
from perilune_train.explain.evidence.gates import forced_gates, gate_means
from perilune_train.explain.evidence.localisation import MEASURES, localisation
from perilune_train.explain.evidence.nulls import detector_nulls, measure_statistics, of_other_rows, renamed
from perilune_train.explain.evidence.performance import DetectionPerformance
from perilune_train.explain.evidence.permutation import detector_permutations
from perilune_train.explain.evidence.randomisation import randomised
from perilune_train.explain.evidence.removal import PERFECT, removal_effect
from perilune_train.explain.evidence.significance import against_nulls, null_differences, summary, validation_signs
from perilune_train.explain.evidence.stability import stability
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.explain.inputs import LabelledFrames, evenly_spaced
from perilune_train.explain.maps.attributions import DetectorTarget, grad_cam, integrated_gradients, occlusion
from perilune_train.explain.maps.baselines import baseline_maps, brightness_map, gradient_map
from perilune_train.explain.maps.masks import Masks, detector_masks
from perilune_train.models.yolo import YOLOv3

TASK = "detect"
SHALLOW_STAGES = "123"
"""Numbers of the stages with strides up to 8."""


def explain_detector(
    settings: ExplainConfig, detector: Detector, frames: LabelledFrames, validation: LabelledFrames, where: Path
) -> tuple[Evidence, Masks]:
    """All evidence tables of the detector, and its masks for the test frames (N, height, width).

    The signs of correlations, and the gate whose pixels are removed, are chosen on the validation frames. Raises
    UserError if the network has no attention; the message names the checkpoint `where`.
    """
    network = detector.network
    rng = np.random.default_rng([settings.seed, 1])
    masks, known = (detector_masks(network, subset.images, where) for subset in (frames, validation))
    untrained = untrained_detector(detector, validation.images, settings.seed)
    untrained_masks, known_untrained_masks = (
        detector_masks(untrained, subset.images, where) for subset in (frames, validation)
    )
    say("detector: masks and null maps")
    validation_values = _values(validation, known, known_untrained_masks, rng)
    signs = validation_signs(validation_values)
    sign_of_map = {name: int(sign) for (_, measure, name), sign in signs.items() if measure == "pcc1_craterness"}
    strongest = strongest_gate(validation_values, sign_of_map)
    values = _values(frames, masks, untrained_masks, rng)
    permutations = detector_permutations(masks, _targets(frames), signs, rng)
    differences = pd.concat([null_differences(values, signs, rng), permutations], ignore_index=True)

    some = evenly_spaced(len(frames.images), settings.n_attributed)
    attributed = attributions(settings, network, frames.images[some])
    sign_of_map |= dict.fromkeys(attributed, 1)
    nulls = baseline_maps(frames.images) | renamed("untrained", untrained_masks)
    nulls |= renamed("other frame", of_other_rows(masks, frames.scene_ids, rng))
    chosen = pd.DataFrame({"frame_id": frames.frame_ids, "scene_id": frames.scene_ids})
    located = pd.concat(
        [
            localisation(masks, frames.craters, sign_of_map, chosen, TASK, "gate"),
            localisation(nulls, frames.craters, sign_of_map, chosen, TASK, "null"),
            localisation(attributed, frames.craters[some], sign_of_map, chosen.iloc[some], TASK, "attribution"),
        ],
        ignore_index=True,
    )
    compared = null_differences(located[located["measure"].isin(MEASURES)], signs, rng)
    values = pd.concat([values, _attribution_values(frames, some, attributed), located], ignore_index=True)
    differences = pd.concat([differences, compared], ignore_index=True)
    stage = strongest[2]
    changed = evenly_spaced(len(frames.images), settings.n_changed)
    images, ids = frames.images[changed], chosen.iloc[changed].reset_index(drop=True)
    measure = DetectionPerformance(detector, [frames.labels[i] for i in changed], frames.radius_px)
    gates = forced_gates(network.backbone, gate_means(known), images, measure, "force gates of the detector")
    to_remove = {strongest: masks[strongest][changed], f"edge/stage_{stage}": nulls[f"edge/stage_{stage}"][changed]}
    to_remove[PERFECT] = frames.perfect_masks(changed)
    say(f"detector: remove pixels by {strongest}, chosen on validation frames, by edges and by the labels")
    removal = removal_effect(images, to_remove, sign_of_map | {PERFECT: 1}, measure, rng, settings.removed_share)

    def masks_of(changed_images: NDArray[np.uint8]) -> Masks:
        return detector_masks(network, changed_images, where)

    few = frames.images[evenly_spaced(len(frames.images), max(2, settings.n_changed // 2))]
    evidence = Evidence(
        values,
        summary(values, rng),
        differences,
        against_nulls(differences),
        gates.merge(ids, left_on="image", right_index=True),
        removal.merge(ids, left_on="frame_index", right_index=True),
        randomised(network, masks_of, few, settings.seed),
        stability(masks_of, few, rng),
        sign_of_map,
        strongest,
    )
    return evidence, masks


def untrained_detector(detector: Detector, images: NDArray[np.uint8], seed: int) -> YOLOv3:
    """An untrained network of the detector's architecture, with batch statistics of `images` (N, height, width)."""
    trained, config = detector.network, detector.config
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = YOLOv3(None, config.in_channels, config.width, config.attention, trained.strides)
    network.to(detector.device)
    measure_statistics(network, network_input(normalised(images), config.in_channels).to(detector.device))
    return network


def strongest_gate(validation: pd.DataFrame, signs: Mapping[str, int]) -> str:
    """The gate up to stride 8 with the largest mean craterness, times the gate's sign, on validation frames.

    The first gate if no gate has a defined correlation.
    """
    rows = validation[(validation["kind"] == "gate") & (validation["measure"] == "pcc1_craterness")]
    rows = rows[rows["map"].str[2].isin(list(SHALLOW_STAGES))]
    means = rows.groupby("map", sort=False)["value"].mean()
    strength = means * pd.Series(signs).reindex(means.index)
    return str(strength.idxmax()) if strength.notna().any() else str(means.index[0])


def attributions(settings: ExplainConfig, network: YOLOv3, images: NDArray[np.uint8]) -> Masks:
    """Grad-CAM, integrated gradients and occlusion (N, height, width) of the detector's objectness."""
    target, frames = DetectorTarget(network), normalised(images)
    say("detector: Grad-CAM, integrated gradients, occlusion")
    return {
        "grad_cam": grad_cam(target, frames),
        "integrated_gradients": integrated_gradients(target, frames, settings.integration_steps),
        "occlusion": occlusion(target, frames, settings.occlusion_px, settings.occlusion_px),
    }


def _values(frames: LabelledFrames, masks: Masks, untrained: Masks, rng: np.random.Generator) -> pd.DataFrame:
    targets = _targets(frames)
    nulls = detector_nulls(frames.images, masks, untrained, targets, rng)
    return pd.concat([detector_values(masks, targets), nulls], ignore_index=True)


def _targets(frames: LabelledFrames) -> FrameTargets:
    brightness, gradient = brightness_map(frames.images), gradient_map(frames.images)
    return FrameTargets(frames.truth, brightness, gradient, frames.frame_ids, frames.scene_ids)


def _attribution_values(frames: LabelledFrames, some: list[int], maps: Masks) -> pd.DataFrame:
    images = frames.images[some]
    ids, scenes = ([names[i] for i in some] for names in (frames.frame_ids, frames.scene_ids))
    targets = FrameTargets(frames.truth[some], brightness_map(images), gradient_map(images), ids, scenes)
    return detector_values(maps, targets, "attribution")
