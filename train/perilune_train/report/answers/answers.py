"""Compute the answers on single detections of the viewer: occlusion, changed frames, and the effect on the position."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image

from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_train.data.frames import frame_table, load_images
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.finished_run import config_of_run, raw_threshold
from perilune_train.detect.images.predict import above
from perilune_train.detect.inference.detector import Detector, open_detector, open_run
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.explain.causal.pairs import read_removed
from perilune_train.landing.craters.catalogue import (
    MIN_DIAMETER_M,
    Catalogue,
    CatalogueErrors,
    exact_catalogue,
    with_errors,
)
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.fly.detections import flight_config
from perilune_train.landing.fly.run import sightings_of
from perilune_train.report.answers.position import SeenFrame, sentences_on_position
from perilune_train.report.answers.shading import (
    MIN_DECREASE,
    N_PATCHES,
    Occlusion,
    Patches,
    occlude,
    score_at,
    sentences_of,
)
from perilune_train.report.content import Answer, AnswerPicture, Answers, FramePicture, Viewer
from perilune_train.report.frames import LabelledFrames, picture_uri
from perilune_train.report.sources import AnswerInputs, provenance_of_dataset
from perilune_train.training.runs import RunFolder

Image8 = NDArray[np.uint8]
_GOLDEN = (np.sqrt(5) - 1) / 2
Place = tuple[int, int]
"""Index of a frame in the viewer, and index of a detection in this frame."""
_LOWERS, _RAISES = (230, 159, 0), (86, 180, 233)
"""Colours of patches that lower and that raise the score when they are covered."""
_MAX_OPACITY = 190
_MAX_SIDE_PX = 96
"""Largest side of an embedded square of ground, pixels."""
_NO_FRAMES = "No changed frames were given: no --counterfactual, --shallower or --turned."


@dataclass(frozen=True, slots=True)
class ChangedFrames:
    """Frames of the viewer in a changed version."""

    caption: str
    """What is changed."""
    dataset: Dataset
    """The dataset of these frames."""
    craters: frozenset[tuple[str, int]] | None
    """scene_id and crater_id of the changed craters; None if the light is changed everywhere."""
    rows: pd.DataFrame
    """Rows of `frame_table`, indexed by frame_id."""

    def images(self, frame_ids: list[str]) -> dict[str, Image8]:
        """The changed frames (height, width) by frame_id; frames that were not rendered are left out."""
        rows = self.rows[self.rows.index.isin(frame_ids)].reset_index()
        return dict(zip(rows["frame_id"], load_images(self.dataset, rows, "test"), strict=True)) if len(rows) else {}

    def reason_not_to_show(self, is_rendered: bool, scene_id: str, crater: int | None) -> str:
        """Why this version of a frame says nothing about a detection; empty if it does.

        `crater` is the crater_id of the detection's label, None without a label.
        """
        if not is_rendered:
            return "this frame was not rendered"
        if self.craters is None:
            return ""
        if crater is None:
            return "no labelled crater is here"
        return "" if (scene_id, crater) in self.craters else "this crater was not changed"


def open_changed(dataset: Dataset, inputs: AnswerInputs) -> list[ChangedFrames]:
    """Open the datasets of changed frames that are given. Raises UserError if one does not fit its option."""
    opened = []
    whole = frame_table(dataset, "test").set_index("frame_id")
    for option, address in (
        ("--counterfactual", inputs.counterfactual),
        ("--shallower", inputs.shallower),
        ("--turned", inputs.turned),
    ):
        if address is None:
            continue
        changed = open_single(address)
        rows = frame_table(changed, "test").set_index("frame_id")
        known = rows.index.isin(whole.index)
        if not known.all() or changed.info.camera != dataset.info.camera:
            got = f"{len(rows)} frames, {known.sum()} of them in {dataset.store}"
            raise UserError(changed.store, "frames", got, "frames of the report's dataset, with the same camera")
        craters = None
        if option == "--turned":
            caption = f"Sun turned by {_turn_deg(whole, rows):.0f}°"
        else:
            share = _depth_share(changed)
            if (share == 0) != (option == "--counterfactual"):
                expected = "another option: --counterfactual for removed craters, --shallower for shallower craters"
                raise UserError(option, "depth_share", f"{share:g} in {changed.store}", expected)
            caption = "crater removed" if share == 0 else f"{share:g} of the crater's depth"
            removed = read_removed(address)
            rows_of = removed[["scene_id", "crater_id"]].itertuples(index=False)
            craters = frozenset((str(scene), int(crater)) for scene, crater in rows_of)
        opened.append(ChangedFrames(caption, changed, craters, rows))
    return opened


def _depth_share(changed: Dataset) -> float:
    """Share of the depth that the changed craters of a counterfactual dataset keep."""
    sections = [recipe.config.get("counterfactual") for recipe in changed.info.recipes.values()]
    shares = [section.get("depth_share", 0.0) for section in sections if isinstance(section, dict)]
    share = shares[0] if shares else 0.0
    return float(share) if isinstance(share, int | float) else 0.0


def _turn_deg(whole: pd.DataFrame, rows: pd.DataFrame) -> float:
    """Change of the Sun's azimuth in the first changed frame, degrees, from -180 to 180; clockwise is positive."""
    # Azimuths from north towards east: x points west, and y south.
    first, second = (
        np.arctan2(-sun[0], -sun[1])
        for sun in (whole.loc[rows.index[0], "sun_direction"], rows["sun_direction"].iloc[0])
    )
    return float((np.degrees(second - first) + 180) % 360 - 180)


def with_answers(viewer: Viewer, frames: LabelledFrames, run: Path, dataset: Dataset, inputs: AnswerInputs) -> Viewer:
    """The viewer with answers on at most `inputs.n_detections` detections.

    `run` is the folder with the network of the detections. Without its weights, only the scores are explained. Raises
    UserError if a dataset of changed frames does not fit.
    """
    changed = open_changed(dataset, inputs)
    of_score = _of_score(frames)
    total = sum(len(frame.detections) for frame in viewer.frames)
    if not total:
        return replace(viewer, answers=Answers(of_score, "The detector finds no crater in these frames."))
    if inputs.n_detections and not RunFolder(run).best.is_file():
        text = f"No further answers: the run {run.name} has no weights."
        return replace(viewer, answers=Answers(of_score, text))
    if inputs.n_detections and dataset.info.camera.model != "pinhole":
        text = f"No further answers: the camera has the lens model {dataset.info.camera.model}."
        return replace(viewer, answers=Answers(of_score, text))
    names = frames.split.frames.table["frame_id"].tolist()
    indices = [names.index(frame.name) for frame in viewer.frames]
    craters = [frames.craters_of(index) for index in indices]
    scene = viewer.trajectory.partition("/")[0]
    own = {crater for each in changed for name, crater in each.craters or () if name == scene}
    places = chosen_detections(viewer.frames, craters, own, inputs.n_detections)
    each = tuple(_answers(frames, indices, places, craters, _Explainer.of(run, dataset, changed)) if places else ())
    sources = tuple(provenance_of_dataset(one.dataset) for one in changed)
    about = Answers(of_score, _chosen(len(each), total, bool(own)), each, sources)
    return replace(viewer, answers=about, sources=(*viewer.sources, *sources))


def _chosen(n_each: int, total: int, with_changed: bool) -> str:
    if not n_each:
        return "Answers on shading and position were not computed (--answers 0)."
    parts = ["changed craters"] if with_changed else []
    parts += ["the false positive of a frame with the highest score", "the correct detection with the lowest score"]
    listed = f"{', '.join(parts[:-1])} and {parts[-1]}"
    return (
        f"Shading and position were computed for {n_each} of {total} detections, drawn with thick lines: in turn for "
        f"{listed}, in frames that are far apart."
    )


def _of_score(frames: LabelledFrames) -> str:
    if not frames.are_probabilities:
        return "The run has no calibration: the score is no probability."
    return "The score is calibrated on validation frames: it is the probability that the detection is a crater."


@dataclass(frozen=True)
class _Explainer:
    """The networks and the changed frames that answers need."""

    detector: Detector
    """The network with the settings of the evaluation."""
    in_flight: Detector
    """The network with the settings of a flight, without calibration."""
    threshold: float
    """Smallest score in a flight."""
    dataset: Dataset
    """The dataset of the frames."""
    changed: list[ChangedFrames]
    """Changed versions of the frames."""
    catalogues: dict[str, Catalogue]
    """Catalogues by scene, filled as they are needed."""

    @classmethod
    def of(cls, run: Path, dataset: Dataset, changed: list[ChangedFrames]) -> "_Explainer":
        detector = open_run(run, config_of_run(run))
        in_flight = open_detector(RunFolder(run).best, flight_config(run))
        return cls(detector, in_flight, raw_threshold(run), dataset, changed, {})

    def detect(self, images: Image8) -> list[Detections]:
        """Detections of N frames (N, height, width), with the scores of the report."""
        found: list[Detections] = []
        for start in range(0, len(images), self.detector.config.batch_size):
            found += detect_at_scales(self.detector, images[start : start + self.detector.config.batch_size])
        return found

    def seen(self, image: Image8, row: pd.Series) -> SeenFrame:
        """A frame (height, width) as the landing filter sees it, with the row of `frame_table`."""
        camera, scene = self.dataset.info.camera.intrinsics(), str(row["scene_id"])
        if scene not in self.catalogues:
            exact = exact_catalogue(self.dataset, scene, MIN_DIAMETER_M)
            # A catalogue with the errors of orbiter images, as in `perilune-train navigate methods`.
            rng = np.random.default_rng(0)
            self.catalogues[scene] = with_errors(exact, CatalogueErrors(), rng) if len(exact) else exact
        found = above(detect_at_scales(self.in_flight, image[None])[0], self.threshold)
        rotation_camera_from_site = matrix_from_quaternion(np.asarray(row["rotation_wxyz"], np.float64))
        pose = Pose(np.asarray(row["position_m"], np.float64), rotation_camera_from_site)
        pinhole = camera.covering_pinhole() if any(camera.distortion) else camera
        return SeenFrame(sightings_of(found, camera).strongest(), pinhole, pose, self.catalogues[scene])


def _answers(
    frames: LabelledFrames,
    indices: list[int],
    places: list[Place],
    craters: list[list[int | None]],
    explainer: _Explainer,
) -> list[Answer]:
    answers, numbers, table = [], sorted({frame for frame, _ in places}), frames.split.frames.table
    names = [table["frame_id"][indices[number]] for number in numbers]
    versions = [(each, each.images(names)) for each in explainer.changed]
    with progress_bar() as progress:
        bar = progress.add_task("answers", total=len(places), unit="detections", note="")
        for number, name in zip(numbers, names, strict=True):
            index = indices[number]
            image, row = frames.split.frames.images[index], table.iloc[index]
            seen = explainer.seen(image, row)
            found = {
                k: explainer.detect(images[name][None])[0] for k, (_, images) in enumerate(versions) if name in images
            }
            sun_px = (seen.true.rotation_camera_from_site @ np.asarray(row["sun_direction"], np.float64))[:2]
            for k in sorted(k for frame, k in places if frame == number):
                box, crater = frames.found[index].boxes[k], craters[number][k]
                occlusion = occlude(explainer.detect, image, box)
                pictures, missing = [_occluded(image, box, occlusion)], {}
                for version, (each, images) in enumerate(versions):
                    reason = each.reason_not_to_show(version in found, row["scene_id"], crater)
                    if reason:
                        missing[each.caption] = reason
                        continue
                    caption = f"{each.caption}: score {score_at(found[version], box):.2f}"
                    pictures.append(_ground(images[name], box, occlusion.patches, caption))
                why = [*sentences_of(occlusion, sun_px), *(_on_missing(missing) if explainer.changed else [_NO_FRAMES])]
                one = sightings_of(Detections(box[None], np.ones(1)), explainer.dataset.info.camera.intrinsics())
                position = sentences_on_position(seen, one) if len(one) and len(seen.sightings) else _NO_SIGHTING
                answers.append(Answer(number, k, tuple(pictures), tuple(why), tuple(position)))
                progress.advance(bar)
    return answers


_NO_SIGHTING = ["The filter sees no crater in this frame with the settings of a flight."]


def _on_missing(reasons: Mapping[str, str]) -> list[str]:
    """One line on the changed versions that are not shown, from the reason of each; empty if all are shown."""
    if not reasons:
        return []
    by_reason = {
        reason: " and ".join(caption for caption, other in reasons.items() if other == reason)
        for reason in dict.fromkeys(reasons.values())
    }
    return [f"Not shown: {'; '.join(f'{captions} ({reason})' for reason, captions in by_reason.items())}."]


def _occluded(image: Image8, box: NDArray[np.float64], occlusion: Occlusion) -> AnswerPicture:
    """The ground of the frame, with a map of the effect of each patch."""
    largest = float(np.abs(occlusion.decrease).max())
    colours = "; orange: covering lowers it" if largest >= MIN_DECREASE else ""
    ground = _ground(image, box, occlusion.patches, f"frame: score {occlusion.score:.2f}{colours}")
    pixels = np.zeros((N_PATCHES + 2, N_PATCHES + 2, 4), np.uint8)
    inner = pixels[1:-1, 1:-1]
    inner[..., :3] = np.where(occlusion.decrease[..., None] >= 0, _LOWERS, _RAISES)
    inner[..., 3] = np.round(_MAX_OPACITY * np.abs(occlusion.decrease) / max(largest, MIN_DECREASE))
    return replace(ground, overlay=picture_uri(Image.fromarray(pixels)))


def _ground(image: Image8, box: NDArray[np.float64], patches: Patches, caption: str) -> AnswerPicture:
    """The square of ground with the patches and a margin of one patch; black outside the image."""
    side_px = (N_PATCHES + 2) * patches.side_px
    x0_px, y0_px = patches.x0_px - patches.side_px, patches.y0_px - patches.side_px
    square = np.zeros((side_px, side_px), np.uint8)
    rows, columns = (
        slice(max(low, 0), max(min(low + side_px, length), 0))
        for low, length in ((y0_px, image.shape[0]), (x0_px, image.shape[1]))
    )
    pixels = image[rows, columns]
    top, left = rows.start - y0_px, columns.start - x0_px
    square[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels
    picture = Image.fromarray(square)
    picture.thumbnail((_MAX_SIDE_PX, _MAX_SIDE_PX))
    shares = np.array([box[0] - x0_px, box[1] - y0_px, *(box[2:] - box[:2])]) / side_px
    x, y, width, height = (round(float(share), 4) for share in shares)
    return AnswerPicture(caption, picture_uri(picture), (x, y, width, height))


def chosen_detections(
    frames: Sequence[FramePicture], craters: Sequence[Sequence[int | None]], changed: Collection[int], count: int
) -> list[Place]:
    """At most `count` detections: in turn a changed crater, a false positive, and a correct detection.

    `craters` has the crater_id of each detection's label by frame, None without a label; `changed` has the craters that
    counterfactual frames change. Craters that were not chosen before come first. Of each frame, the false positive with
    the highest score and the correct detection with the lowest score are considered. Consecutive choices are from
    frames that are far apart.
    """
    # Multiples of the golden ratio spread any number of first frames evenly over the descent.
    order = np.argsort(np.arange(len(frames)) * _GOLDEN % 1, kind="stable").tolist()
    of_changed: list[tuple[int, Place]] = []
    false: list[Place] = []
    correct: list[Place] = []
    seen: Counter[int] = Counter()
    for frame in order:
        detections = frames[frame].detections
        for k, crater in enumerate(craters[frame]):
            if crater is not None and crater in changed:
                of_changed.append((seen[crater], (frame, k)))
                seen[crater] += 1
        wrong = [k for k, mark in enumerate(detections) if mark.kind == "false"]
        right = [k for k, mark in enumerate(detections) if mark.kind == "matched"]
        # Detections are sorted by score.
        false += [(frame, wrong[0])] if wrong else []
        correct += [(frame, right[-1])] if right else []
    of_changed.sort(key=lambda ranked: ranked[0])
    queues = ([place for _, place in of_changed], false, correct)
    in_turn = [place for group in zip_longest(*queues) for place in group if place is not None]
    return list(dict.fromkeys(in_turn))[:count]
