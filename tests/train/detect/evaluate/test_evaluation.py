"""Bins, errors, intervals and the report, by hand."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from perilune_train.detect.data.frame_facts import FrameFacts, unknown_facts
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.evaluate.bootstrap import average_precisions
from perilune_train.detect.evaluate.evaluation import evaluate_detections
from perilune_train.detect.evaluate.matching import FALSE, FOUND, Criteria, Detections, Matches
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.evaluate.pictures import choose_frames
from perilune_train.detect.evaluate.report import write_evaluation
from perilune_train.records.spread import Spread, draw_resamples, read_spread


def circles(*rows):
    """Boxes (N, 4) of circles given by centre and radius."""
    x, y, radius = np.array(rows, float).reshape(-1, 3).T
    return np.stack([x - radius, y - radius, x + radius, y + radius], axis=1)


def labels(*rows, selected=None, depth_ratio=None):
    boxes = circles(*rows)
    radius = (boxes[:, 2] - boxes[:, 0]) / 2
    selected = np.ones(len(boxes), bool) if selected is None else np.array(selected)
    ellipses = np.stack([*(boxes[:, :2] + radius[:, None]).T, radius, radius, 0 * radius], axis=1)
    ratio = None if depth_ratio is None else np.array(depth_ratio)
    return FrameLabels(boxes, radius, ellipses, selected, np.ones(len(boxes), bool), ratio)


def found(*rows):
    return Detections(circles(*[row[:3] for row in rows]), np.array([row[3] for row in rows], float))


def facts(scenes, altitude_m=None, sun_deg=None):
    count = len(scenes)
    names = [f"{scene}/0/{k}" for k, scene in enumerate(scenes)]
    return FrameFacts(
        names,
        np.full((count, 2), 200),
        list(scenes),
        [f"{scene}/0" for scene in scenes],
        np.array(altitude_m or [np.nan] * count, float),
        np.array(sun_deg or [np.nan] * count, float),
    )


def by_key(evaluation):
    return {part.key: part for part in evaluation.bins}


def test_radius_bins_ignore_the_labels_and_the_detections_of_other_bins():
    truth = [labels((20, 20, 4), (60, 60, 8), (100, 100, 12))]
    # Both smaller are found; in the open lie a false one of 4 px and one of 15 px.
    ours = [found((20, 20, 4, 0.9), (60, 60, 8, 0.8), (150, 20, 4, 0.85), (150, 150, 15, 0.7))]
    bins = by_key(evaluate_detections(ours, truth, facts("a"), Criteria(0.5, (2.0, 50.0))))
    assert set(bins) == {"radius_3_5_px", "radius_5_10_px", "radius_10_20_px"}
    small = bins["radius_3_5_px"]
    assert (small.precision, small.recall, small.ap50_paper) == (0.5, 1, 1)
    assert (bins["radius_5_10_px"].precision, bins["radius_5_10_px"].ap50_paper) == (1, 1)
    assert (bins["radius_10_20_px"].precision, bins["radius_10_20_px"].recall) == (0, 0)


def test_labels_above_50_px_have_a_bin_of_their_own():
    truth = [labels((100, 100, 50), (300, 300, 80))]
    ours = [found((100, 100, 50, 0.9), (300, 300, 80, 0.8))]
    evaluation = evaluate_detections(ours, truth, facts("a"), Criteria(0.5, (2.0, 200.0)))
    bins = by_key(evaluation)
    assert set(bins) == {"radius_20_50_px", "radius_50_inf_px"}
    assert all((part.labels, part.precision, part.recall) == (1, 1, 1) for part in bins.values())
    assert bins["radius_50_inf_px"].label == "above 50 px"


def test_a_find_of_another_size_counts_for_the_labels_bin():
    truth, ours = [labels((50, 50, 4.8))], [found((50, 50, 5.2, 0.9))]
    bins = by_key(evaluate_detections(ours, truth, facts("a"), Criteria(0.5, (2.0, 50.0))))
    assert bins["radius_3_5_px"].ap50_paper == 1 and set(bins) == {"radius_3_5_px"}


def test_altitude_and_sun_bins_hold_whole_frames():
    truth = [labels((20, 20, 5)), labels((20, 20, 5)), labels((20, 20, 5))]
    ours = [found((20, 20, 5, 0.9)), found((90, 90, 5, 0.9)), found((20, 20, 5, 0.4))]
    known = facts("aab", altitude_m=[190, 500, 5000], sun_deg=[20, 29.9, 90])
    evaluation = evaluate_detections(ours, truth, known, Criteria(0.5, (2.0, 50.0)))
    bins = by_key(evaluation)
    # 190 m is within a tenth of the first bin, 5000 m is in none.
    assert (bins["altitude_200_500_m"].ap50_paper, bins["altitude_500_1000_m"].ap50_paper) == (1, 0)
    assert "altitude_1000_1500_m" not in bins
    assert bins["sun_20_30_deg"].labels == 2
    assert bins["sun_60_90_deg"].recall == 0 and bins["sun_60_90_deg"].ap50_paper == 1
    figures = evaluation.figures()
    assert (figures["lowest_ap50_paper_by_altitude"], figures["altitude_200_500_m/ap50_paper"]) == (0, 1)
    assert figures["intervals_over"] == "scene" and figures["intervals_units"] == 2


def test_freshness_has_recall_alone():
    ratio = [0.05, 0.05, 0.12, np.nan, 0.01]
    truth = [
        labels(*[(20 + 30 * k, 20, 5) for k in range(5)], depth_ratio=ratio, selected=[True, True, True, True, False])
    ]
    ours = [found((20, 20, 5, 0.9), (50, 20, 5, 0.2), (80, 20, 5, 0.9))]
    evaluation = evaluate_detections(ours, truth, facts("a"), Criteria(0.5, (2.0, 50.0)))
    bins = {key: part for key, part in by_key(evaluation).items() if part.by == "depth_ratio"}
    assert {key: (part.labels, part.recall) for key, part in bins.items()} == {
        "depth_ratio_0.04_0.06": (2, 0.5),
        "depth_ratio_0.1_0.15": (1, 1.0),
    }
    assert "depth_ratio_0.1_0.15/ap50_paper" not in evaluation.figures()


def test_errors_of_found_craters():
    truth = [labels((50, 50, 10), (100, 100, 20), (150, 150, 10))]
    ours = [found((53, 54, 10, 0.9), (100, 100, 22, 0.9), (150, 150, 10, 0.1))]
    errors = evaluate_detections(ours, truth, facts("a"), Criteria(0.5, (2.0, 50.0))).errors
    # Two found above the threshold: 5 px off, and 2 px too large.
    assert errors["centre_error_px_median"] == pytest.approx(2.5)
    assert errors["centre_error_relative_p95"] == pytest.approx(0.95 * 0.5)
    assert errors["radius_error_px_median"] == errors["radius_bias_px"] == pytest.approx(1)
    assert errors["radius_bias_relative"] == pytest.approx(0.05)
    nothing = evaluate_detections([found()], truth, facts("a"), Criteria(0.5, (2.0, 50.0))).errors
    assert all(np.isnan(value) for value in nothing.values())


def resamples_of(known):
    return draw_resamples(known.scene, known.trajectory, known.name, np.random.default_rng(1))


def random_matches(seed, n_frames, n_detections, n_wanted):
    rng = np.random.default_rng(seed)
    hit = rng.random(n_detections) < 0.7
    frame = np.sort(rng.integers(0, n_frames, n_detections))
    scores = np.clip(rng.normal(0.5, 0.15, n_detections) + 0.2 * hit, 0.01, 0.99)
    outcome = np.where(hit, FOUND, FALSE).astype(np.int8)
    return Matches(scores, outcome, np.zeros(n_detections, np.intp), frame, rng.integers(0, n_frames, n_wanted))


def test_errors_of_ellipses():
    """A crater of 4 px, and one of 10 px that is found with semi-axes of 12 and 8 px."""
    truth = [labels((20, 20, 4), (60, 60, 10), (120, 120, 5))]
    boxes = np.array([[16.3, 16.4, 24.3, 24.4], [48, 52, 72, 68], [150, 20, 170, 40]])
    shapes = np.array([[0, 0.3, 0.4, 0.5, 0.5], [0, 1.0, 2.0, 1.0, 4.0], [0, 1.0, 1.0, 1.0, 1.0]])
    ours = [Detections(boxes, np.array([0.9, 0.8, 0.4]), shapes)]
    criteria = Criteria(0.5, (2.0, 50.0))
    figures = evaluate_detections(ours, truth, facts("a"), criteria).figures()
    assert figures["centre_error_px_rms"] == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 2))
    assert figures["centre_error_px_rms_above_5_px"] == figures["centre_error_px_median_above_5_px"] == 0
    # Semi-axes of 4 and 4, and of 12 and 8 in place of 10 and 10.
    assert figures["semi_major_error_px_median"] == figures["semi_minor_error_px_median"] == pytest.approx(1)
    assert figures["semi_major_error_px_rms"] == pytest.approx(np.sqrt(2))
    # Errors over deviations: 1 and 1 in the centre of the first, 0 in the second; 0, 0 and 2, -1/2 in the semi-axes.
    assert figures["centre_normalised_error_squared"] == pytest.approx(0.5)
    assert figures["axes_normalised_error_squared"] == pytest.approx((4 + 0.25) / 4)
    assert figures["axes_normalised_error_squared_above_5_px"] == pytest.approx((4 + 0.25) / 2)
    plain = evaluate_detections([replace(ours[0], shapes=None)], truth, facts("a"), criteria).figures()
    assert np.isnan(plain["axes_normalised_error_squared"]) and plain["semi_major_error_px_median"] == pytest.approx(1)


def test_ellipses_are_compared_with_those_of_the_labels_not_with_their_boxes():
    """The label is an ellipse at 45 degrees. It is found as itself, and as a circle in the same box."""
    plain = labels((60, 60, 10))
    a, b = np.sqrt(150.0), np.sqrt(50.0)
    truth = [replace(plain, ellipses=np.array([[60, 60, a, b, np.pi / 4]]))]
    for correlation, errors, score in ((0.5, (0, 0), 100), (0.0, (a - 10, 10 - b), 0)):
        ours = [Detections(plain.boxes, np.array([0.9]), np.array([[correlation, 1, 1, 1, 1]]))]
        figures = evaluate_detections(ours, truth, facts("a"), Criteria(0.5, (2.0, 50.0))).figures()
        found_errors = figures["semi_major_error_px_median"], figures["semi_minor_error_px_median"]
        assert found_errors == pytest.approx(errors, abs=1e-9)
        # A circle differs by more than 7 % of the rim.
        assert figures["ellipse_score"] == pytest.approx(score)


def test_the_score_of_ellipses_ignores_what_the_scoring_rule_ignores():
    """Two labels, one of them not selected; both are found. The second frame has no labels and no detections."""
    truth = [labels((20, 20, 4), (60, 60, 10), selected=[True, False]), labels()]
    ours = [found((20, 20, 4, 0.9), (60, 60, 10, 0.8), (100, 20, 5, 0.4)), found()]
    figures = evaluate_detections(ours, truth, facts("ab"), Criteria(0.5, (2.0, 50.0))).figures()
    assert (figures["ellipse_score"], figures["strict/ellipse_score"]) == pytest.approx((100, 75))


@pytest.mark.parametrize(
    ("n_detections", "decimals", "tolerance"), [(1500, 16, 1e-12), (30_000, 2, 1e-12), (30_000, 16, 5e-4)]
)
def test_resampled_average_precision_is_that_of_the_frames_repeated(n_detections, decimals, tolerance):
    matches = random_matches(0, 12, n_detections, n_detections)
    matches = replace(matches, scores=matches.scores.round(decimals))
    known = facts("aaabbbcccddd")
    resamples = resamples_of(known)
    resamples = replace(resamples, weights=resamples.weights[:5])
    drawn = average_precisions(matches, resamples)
    for weights, value in zip(resamples.weights, drawn, strict=True):
        times = weights[resamples.of_row].astype(int)
        rows, selected = (np.repeat(np.arange(len(f)), times[f]) for f in (matches.frame, matches.selected_frame))
        repeated = Matches(
            matches.scores[rows],
            matches.outcome[rows],
            matches.label[rows],
            matches.frame[rows],
            matches.selected_frame[selected],
        )
        assert value == pytest.approx(curve(repeated).ap_paper(), abs=tolerance)


def test_the_unit_of_resampling():
    assert resamples_of(facts("aab")).unit == "scene"
    one_scene = FrameFacts(["x", "y"], np.ones((2, 2)), ["a", "a"], ["a/0", "a/1"], np.zeros(2), np.zeros(2))
    assert resamples_of(one_scene).unit == "trajectory"
    # Frames of one trajectory are not independent of each other.
    assert (resamples_of(facts("aaa")).unit, resamples_of(facts("aaa")).count) == ("trajectory", 1)
    nothing_known = resamples_of(unknown_facts(["x.png", "y.png"], np.ones((2, 2))))
    assert (nothing_known.unit, nothing_known.count) == ("image", 2)
    assert (nothing_known.weights.sum(axis=1) == 2).all()


def scenes_found(scenes):
    """One label a frame, of which the second scene finds none; a find in each frame of the others."""
    ours = [found((20, 20, 5, 0.9)) if scene != "b" else found() for scene in scenes]
    known = facts(scenes, altitude_m=[300 if scene in "ab" else 700 for scene in scenes])
    return evaluate_detections(ours, [labels((20, 20, 5))] * len(scenes), known, Criteria(0.5, (2.0, 50.0)))


def test_fewer_than_five_units_give_their_values_and_no_interval(tmp_path):
    figures = scenes_found("aabbcd").figures()
    assert figures["recall"] == pytest.approx(4 / 6)
    assert figures["recall_interval"] is None and "recall_low" not in figures and "recall_high" not in figures
    assert [figures[f"recall/by_scene/{name}"] for name in "abcd"] == [1, 0, 1, 1]
    assert [figures[f"ap50_paper/by_scene/{name}"] for name in "abcd"] == [1, 0, 1, 1]
    evaluation = scenes_found("aabbcd")
    write_evaluation(tmp_path, evaluation, [np.zeros((200, 200), np.uint8)] * 6, [])
    report = (tmp_path / "report.md").read_text()
    assert "at least 5 scenes are needed for an interval" in report and " to 1.000)" not in report
    assert "| recall | 0.667 (a 1.000, b 0.000, c 1.000, d 1.000)" in report


def test_five_units_give_an_interval_but_not_in_bins_that_hold_fewer():
    figures = scenes_found("abcde").figures()
    assert figures["recall_low"] < figures["recall"] == 0.8 < figures["recall_high"]
    assert not any(name.startswith("recall/by_") for name in figures)
    assert figures["altitude_200_500_m/ap50_paper_interval"] is None
    assert figures["altitude_200_500_m/ap50_paper/by_scene/b"] == 0
    assert figures["radius_5_10_px/ap50_paper_low"] < 0.8


def test_spreads_are_read_from_flat_figures_as_they_were_written():
    for given in (Spread("", (0.1, 0.2)), Spread("scene", None, {"s/0": 0.5, "t": 0.25})):
        assert read_spread(given.keys("strict/f1") | {"f1_low": 0.0, "f1_high": 1.0}, "strict/f1") == given


def test_best_typical_and_worst_frames():
    f1 = np.array([0.9, 0.91, np.nan, 0.5, 0.1, 0.12, 0.55, 0.2])
    chosen = choose_frames(f1, ["a", "a", "a", "b", "c", "c", "c", "d"], 2)
    # Frames 1 and 0 are of one descent, and so are 4 and 5; nearest to the median of 0.5, and not yet taken, is 0.12.
    assert chosen == {"best": [1, 6], "typical": [3, 5], "worst": [4, 7]}
    assert choose_frames(np.array([np.nan]), ["a"], 2) == {"best": [], "typical": [], "worst": []}


def test_the_report_of_images_of_which_nothing_is_known(tmp_path: Path):
    """As of real images: sizes differ, no scene, no Sun, a frame without labels and one without detections."""
    sizes = [(64, 48), (100, 80), (64, 64)]
    truth = [labels((20, 20, 5), (40, 30, 8)), labels((50, 50, 6)), labels()]
    ours = [found((20, 20, 5, 0.9), (50, 20, 4, 0.8)), found(), found((30, 30, 5, 0.6))]
    known = unknown_facts(["one|x.png", "two.png", "three.png"], np.array(sizes))
    evaluation = evaluate_detections(ours, truth, known, Criteria(0.5, (2.0, 50.0)))
    images = [np.full((height, width), 90, np.uint8) for width, height in sizes]
    write_evaluation(tmp_path, evaluation, images, ["made by hand"])
    report = (tmp_path / "report.md").read_text()
    assert (
        "made by hand" in report
        and "3 frames, 3 selected labels" in report
        and "the value of each image; at least 5 images are needed" in report
    )
    assert "| precision | 0.333" in report
    assert "## Radius" in report and "## Sun" not in report and "## Freshness" not in report
    assert "nan" not in report
    for name in ("precision_recall.png", "bins.png", "detections.png"):
        assert cv2.imread(str(tmp_path / name)).std() > 5, name


def test_nothing_at_all(tmp_path: Path):
    evaluation = evaluate_detections([found()], [labels()], facts("a"), Criteria(0.5, (2.0, 50.0)))
    assert evaluation.bins == [] and evaluation.figures()["ap50_paper"] == 0
    write_evaluation(tmp_path, evaluation, [np.zeros((64, 64), np.uint8)], [])
    assert (tmp_path / "report.md").is_file()
