"""Answers on single detections: the choice, occlusion, changed frames, and the effect on the position."""

import base64
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from tests.helpers.drawn_dataset import build_dataset
from tests.train.report.conftest import CHANGED, report_command

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.evaluate.split_evaluation import ELLIPSE_COLUMNS
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.projection import Pose, projected
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.records.metrics_file import write_metrics
from perilune_train.report.answers.answers import chosen_detections
from perilune_train.report.answers.position import SeenFrame, sentences_on_position
from perilune_train.report.answers.shading import N_PATCHES, Patches, covered, occlude, sentences_of
from perilune_train.report.content import FramePicture, Mark
from perilune_train.report.page import gather
from perilune_train.report.sources import AnswerInputs


def frame(*kinds: str) -> FramePicture:
    """A frame with detections of these kinds, sorted by score."""
    marks = tuple(Mark(kind, (0.0, 0.0, 4.0 + k, 4.0, 0.9 - 0.1 * k)) for k, kind in enumerate(kinds))
    return FramePicture("f", "", 96, 96, "", (), marks)


def test_detections_are_chosen_in_turn_from_all_frames():
    frames = [frame("matched", "false", "false", "matched") for _ in range(4)]
    craters = [[5, None, None, 7] for _ in range(4)]
    chosen = chosen_detections(frames, craters, {7}, 100)
    # Here the changed craters are the correct detections with the lowest score.
    assert set(chosen) == {(f, k) for f in range(4) for k in (1, 3)}
    first = chosen_detections(frames, craters, {7}, 2)
    assert first == chosen[:2] and {k for _, k in first} == {1, 3}
    assert len({f for f, _ in chosen_detections(frames, craters, set(), 4)}) >= 2
    assert chosen_detections(frames, craters, {7}, 0) == []
    assert chosen_detections([frame(), frame()], [[], []], {7}, 3) == []


def test_new_craters_come_before_seen_ones():
    frames = [frame("matched", "matched"), frame("matched", "matched")]
    chosen = chosen_detections(frames, [[1, 2], [1, 3]], {1, 2, 3}, 100)
    # Crater 1 of frame 1 is last, since frame 0 shows it too.
    assert chosen == [(0, 0), (0, 1), (1, 1), (1, 0)]


def test_a_patch_is_covered_by_the_mean_around_it():
    image = np.random.default_rng(0).integers(0, 255, (40, 50)).astype(np.uint8)
    patches = Patches.around(np.array([20.0, 15.0, 30.0, 25.0]))
    assert patches == Patches(15, 10, 4)
    changed = covered(image, patches, 1, 2)
    around = image[10:22, 19:31].astype(float)
    mean = (around.sum() - around[4:8, 4:8].sum()) / (144 - 16)
    expected = image.copy()
    expected[14:18, 23:27] = round(mean)
    np.testing.assert_array_equal(changed, expected)
    # At a corner only the pixels in the image count; a patch off the image changes nothing.
    corner = covered(image, Patches(-4, -4, 4), 1, 1)
    mean = (image[:8, :8].astype(float).sum() - image[:4, :4].sum()) / 48
    assert (corner[:4, :4] == round(mean)).all() and np.array_equal(corner[4:], image[4:])
    np.testing.assert_array_equal(covered(image, Patches(-4, -4, 4), 0, 0), image)


def test_occlusion_finds_the_pixels_that_a_score_depends_on():
    box = np.array([20.0, 20.0, 40.0, 40.0])
    image = np.full((64, 64), 100, np.uint8)
    image[18:26, 26:34] = 20  # dark, above the middle: the patch in row 1, column 2

    def detect(images):
        scores = 0.9 - 0.01 * np.abs(images[:, 18:26, 26:34].astype(float) - 20).mean(axis=(1, 2))
        # A second box with a higher score is elsewhere.
        boxes = np.array([box + 1, box + 30])
        return [Detections(boxes, np.array([score, 0.99])) for score in scores]

    found = occlude(detect, image, box)
    assert found.score == pytest.approx(0.9) and found.patches.side_px == 8
    assert np.unravel_index(found.decrease.argmax(), (N_PATCHES, N_PATCHES)) == (1, 2)
    assert found.decrease.max() == pytest.approx(0.8) and (np.delete(found.decrease.ravel(), 7) == 0).all()
    first, second = sentences_of(found, np.array([0.0, -1.0]))
    assert "from 0.90 to 0.10: dark ground on the side towards the Sun" in first
    assert second == "Dark patches cause 100 % of the whole decrease, bright patches 0 %."
    assert "away from the Sun" in sentences_of(found, np.array([0.0, 2.0]))[0]
    assert "at right angles" in sentences_of(found, np.array([1.0, 0.0]))[0]
    (nothing,) = sentences_of(replace(found, decrease=found.decrease / 100), np.array([1.0, 0.0]))
    assert "No single patch of ground decides" in nothing and "0.01" in nothing


def test_an_occlusion_at_the_edge_of_the_image_leaves_out_what_is_outside():
    found = occlude(
        lambda images: [Detections(np.zeros((0, 4)), np.zeros(0))] * len(images),
        np.eye(32, dtype=np.uint8),
        np.array([-4.0, -4.0, 6.0, 6.0]),
    )
    assert np.isnan(found.grey[0, 0]) and np.isfinite(found.grey[4, 4])
    assert found.score == 0 and (found.decrease == 0).all()


@pytest.fixture
def seen() -> SeenFrame:
    """Thirty craters on a plane, seen without errors from 500 m; the last crater is not in the catalogue."""
    rng = np.random.default_rng(2)
    centre = np.column_stack([rng.uniform(-150, 150, (30, 2)), np.zeros(30)])
    radius = rng.uniform(8, 20, 30)
    normal = np.tile([0.0, 0.0, 1.0], (30, 1))
    whole = Catalogue(centre, normal, radius, 1.0, 0.03)
    camera = Camera.from_field_of_view(256, 256, 45.0)
    true = Pose(np.array([3.0, -5.0, 500.0]), ROTATION_CAMERA_FROM_BODY)
    view = projected(whole, camera, true)
    assert len(view.index) == 30
    half = view.radius_px[:, None]
    boxes = np.hstack([view.centre_px - half, view.centre_px + half])
    # An error of half a pixel, so that each crater has an effect.
    boxes += np.tile(rng.normal(0, 0.5, (30, 2)), 2)
    sightings = Sightings.of_boxes(boxes, np.full(30, 0.9))
    gone = int(np.argmin(np.linalg.norm(view.centre_px - sightings.centre_px[0], axis=1)))
    return SeenFrame(sightings, camera, true, whole.part(np.arange(30) != view.index[gone]))


def one_of(seen: SeenFrame, k: int) -> Sightings:
    return seen.sightings.part(np.array([k]))


def test_a_crater_moves_the_position_and_makes_it_surer(seen):
    lines = sentences_on_position(seen, one_of(seen, 12))
    moved = float(re.search(r"moves by ([\d.]+) m", lines[0])[1])
    with_it, without = map(float, re.findall(r"([\d.]+) m with", " ".join(lines[1:2])))
    assert 0 < moved < 3 and 0 < with_it < without
    assert re.search(r"left out of 2\d matched craters", lines[0])
    errors = [float(value) for value in re.findall(r"([\d.]+) m with", lines[2])]
    assert 0 < max(errors) < 5


def test_craters_that_the_position_does_not_use(seen):
    (line,) = sentences_on_position(seen, one_of(seen, 0))
    assert "no crater of the catalogue matches it" in line
    elsewhere = Sightings(np.array([[-50.0, -50.0]]), np.array([9.0]), np.array([0.9]))
    (line,) = sentences_on_position(seen, elsewhere)
    assert "does not find it" in line
    few = replace(seen, sightings=seen.sightings.part(np.arange(3, 6)))
    assert "fewer than 6 detections" in sentences_on_position(few, one_of(seen, 4))[0]
    six = replace(seen, sightings=seen.sightings.part(np.arange(3, 9)))
    (line,) = sentences_on_position(six, one_of(seen, 4))
    assert "Without this crater there is no position" in line


def image_of(uri: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))))


def test_the_page_has_answers_of_the_installed_detector(answered):
    viewer = answered.report.viewer
    assert viewer is not None and viewer.answers is not None
    answers = viewer.answers
    assert "probability" in answers.of_score and "6 of" in answers.chosen
    assert len(answers.each) == 6 and len({(one.frame, one.detection) for one in answers.each}) == 6
    assert len(answers.sources) == 3 and all(source in viewer.sources for source in answers.sources)
    complete = [one for one in answers.each if len(one.pictures) == 4]
    assert complete
    for one in answers.each:
        mark = viewer.frames[one.frame].detections[one.detection]
        assert one.pictures[0].caption.startswith(f"frame: score {mark.shape[4]:.2f}")
        assert image_of(one.pictures[0].overlay).shape == (N_PATCHES + 2, N_PATCHES + 2, 4)
        assert one.pictures[-1].caption.startswith("Sun turned by 40°")
        assert one.why and one.position
        size = len(json.dumps([[picture.image, picture.overlay] for picture in one.pictures]))
        assert size < 40_000
    scores = [[float(picture.caption.split("score ")[1][:4]) for picture in one.pictures] for one in complete]
    captions = [picture.caption.split(":")[0] for picture in complete[0].pictures]
    assert captions == ["frame", "crater removed", "0.5 of the crater's depth", "Sun turned by 40°"]
    # Without its crater, a detection loses most of its score.
    assert np.mean([removed for _, removed, _, _ in scores]) < np.mean([whole for whole, *_ in scores]) / 2


def test_a_square_of_ground_has_the_pixels_of_the_frame(answered):
    viewer = answered.report.viewer
    # Larger squares are reduced.
    one = min(viewer.answers.each, key=lambda each: viewer.frames[each.frame].detections[each.detection].shape[2])
    shown = viewer.frames[one.frame]
    image = open_dataset(str(answered.data / "detect"))[shown.name].image
    x, y, width, height, _ = shown.detections[one.detection].shape
    patches = Patches.around(np.array([x, y, x + width, y + height]))
    square = image_of(one.pictures[0].image)
    side = (N_PATCHES + 2) * patches.side_px
    assert square.shape == (side, side)
    left, top = (round(start - share * side) for start, share in zip((x, y), one.pictures[0].box, strict=False))
    padded = np.pad(image, side)
    np.testing.assert_array_equal(square, padded[side + top :, side + left :][:side, :side])
    # The middle of the detection is in the middle patch.
    middle = np.array([x + width / 2 - left, y + height / 2 - top]) / patches.side_px
    assert (np.abs(middle - (N_PATCHES + 2) / 2) <= 0.5).all()
    np.testing.assert_allclose(one.pictures[0].box[2:], np.array([width, height]) / side, atol=1e-3)


def detection_alone(data: Path, runs: Path, folder: Path) -> tuple[Path, Path]:
    """Folders of the datasets and runs with detection only, whose report takes less time."""
    (folder / "data").mkdir()
    (folder / "data/detect").symlink_to(data / "detect")
    shutil.copytree(runs / "detect", folder / "runs/detect")
    return folder / "data", folder / "runs"


def test_without_changed_frames_the_panel_says_so(answered, tmp_path):
    data, runs = detection_alone(answered.data, answered.runs, tmp_path)
    report = gather("demo", "demo", data, runs, AnswerInputs(1))
    (one,) = report.viewer.answers.each
    assert len(one.pictures) == 1 and one.why[-1].startswith("No changed frames were given")


def test_the_panel_names_the_changed_frames_that_say_nothing_about_a_detection(answered):
    viewer = answered.report.viewer
    partly = [one for one in viewer.answers.each if len(one.pictures) == 2]
    assert partly
    for one in partly:
        assert re.fullmatch(
            r"Not shown: crater removed and 0\.5 of the crater's depth \((no labelled crater is here|this crater "
            r"was not changed)\)\.",
            one.why[-1],
        )
    false = [one for one in partly if viewer.frames[one.frame].detections[one.detection].kind == "false"]
    assert all("no labelled crater" in one.why[-1] for one in false)


def test_no_answers_are_computed_by_default(report):
    answers = report.viewer.answers
    assert answers.each == () and "--answers 0" in answers.chosen and "no calibration" in answers.of_score


def test_a_run_without_weights_is_one_line(report_data, report_runs, tmp_path):
    data, runs = detection_alone(report_data, report_runs, tmp_path)
    answers = gather("demo", "demo", data, runs, AnswerInputs(3)).viewer.answers
    assert answers.each == () and answers.chosen == "No further answers: the run demo has no weights."


def test_a_descent_without_detections_is_one_line(answered, tmp_path):
    data, runs = detection_alone(answered.data, answered.runs, tmp_path)
    path = runs / "detect/demo-installed/detections.parquet"
    pd.read_parquet(path).iloc[:0].to_parquet(path)
    answers = gather("demo", "demo", data, runs, AnswerInputs(3)).viewer.answers
    assert answers.each == () and answers.chosen == "The detector finds no crater in these frames."


def test_scores_of_a_table_older_than_the_calibration_become_probabilities(report_data, report_runs, tmp_path):
    data, runs = detection_alone(report_data, report_runs, tmp_path)
    folder = runs / "detect/demo"
    metrics = json.loads((folder / "metrics.json").read_text())
    fit = {"log_score": 1.0, "log_complement": 1.0, "offset": 1.0, "raw_threshold": 0.5, "threshold": 0.73}
    write_metrics(folder, metrics | {f"calibration/{key}": value for key, value in fit.items()})
    viewer = gather("demo", "demo", data, runs).viewer
    shown = {mark.shape[4] for each in viewer.frames for mark in each.detections}
    # logit p = logit s + 1
    expected = {round(1 / (1 + np.exp(-(np.log(s / (1 - s)) + 1))), 3) for s in (0.8, 0.9)}
    assert shown == expected and "probability" in viewer.answers.of_score


def test_ellipses_of_a_run_are_in_the_marks(report_data, report_runs, tmp_path):
    data, runs = detection_alone(report_data, report_runs, tmp_path)
    path = runs / "detect/demo/detections.parquet"
    rows = pd.read_parquet(path)
    # A circle's box and axes agree; the others are axis-aligned ellipses.
    half = (rows[["x1_px", "y1_px"]].to_numpy() - rows[["x0_px", "y0_px"]].to_numpy()) / 2
    values = [half.max(axis=1), half.min(axis=1), np.where(half[:, 0] >= half[:, 1], 0.0, 90.0)]
    values += [np.full(len(rows), sigma) for sigma in (0.1, 0.2, 0.3, 0.4)]
    rows.assign(**dict(zip(ELLIPSE_COLUMNS, values, strict=True))).to_parquet(path)
    viewer = gather("demo", "demo", data, runs).viewer
    marks = [mark for each in viewer.frames for mark in each.detections]
    assert marks and all(mark.ellipse[3:] == (0.1, 0.2, 0.3, 0.4) for mark in marks)
    for mark in marks:
        sides = sorted(mark.shape[2:4], reverse=True)
        np.testing.assert_allclose(mark.ellipse[:2], np.array(sides) / 2, atol=0.02)


def test_datasets_that_do_not_fit_their_option(answered, tmp_path):
    data, runs = detection_alone(answered.data, answered.runs, tmp_path)

    def given(**options):
        gather("demo", "demo", data, runs, AnswerInputs(1, **options))

    with pytest.raises(UserError, match=r"--shallower: depth_share: got 0 .*expected another option"):
        given(shallower=answered.inputs.counterfactual)
    with pytest.raises(UserError, match=r"--counterfactual: depth_share: got 0\.5 "):
        given(counterfactual=answered.inputs.shallower)
    build_dataset(tmp_path / "more", "detect", n_frames=5)
    with pytest.raises(UserError, match="frames of the report's dataset"):
        given(turned=str(tmp_path / "more"))
    build_dataset(tmp_path / "alone", "detect", n_frames=4, removed={"s004": CHANGED})
    with pytest.raises(UserError, match=r"alone\.removed\.parquet"):
        given(counterfactual=str(tmp_path / "alone"))


def test_the_command_takes_the_datasets(answered, tmp_path):
    data, runs = detection_alone(answered.data, answered.runs, tmp_path)
    given = ["--dataset", data, "--runs", runs, "--name", "demo", "--out", tmp_path / "out"]
    done = report_command(*given, "--answers", 1, "--turned", answered.inputs.turned)
    assert done.returncode == 0, done.stderr
    assert "Sun turned by 40" in (tmp_path / "out/report.html").read_text()
    done = report_command(*given, "--shallower", tmp_path / "nothing")
    assert done.returncode == 2 and "nothing" in done.stderr
    done = report_command(*given, "--answers", -1)
    assert done.returncode == 2 and "--answers" in done.stderr
