"""The verdicts on the paper's claims, from runs with known figures."""

import json

import pytest
from tests.train.report.paper.toy_runs import (
    ORIENTATION,
    explained,
    navigator_metrics,
    write_all,
    write_detector,
    write_halves,
    write_navigators,
)

from perilune_train.records.metrics_file import write_metrics
from perilune_train.report.paper.detections import WidthRatio
from perilune_train.report.paper.runs import NAVIGATORS, PaperRuns, detect_name, navigate_name
from perilune_train.report.paper.verdicts import verdicts

AP = "attention raises AP (plain CBAM)"
FAST = "a pair takes as long with attention as without"


def verdict(root, claim):
    (found,) = [one for one in verdicts(PaperRuns(root), None) if one.claim.startswith(claim)]
    return found


def answers(root, start):
    return [one.answer for one in verdicts(PaperRuns(root), None) if one.claim.startswith(start)]


def test_every_claim_holds_where_the_runs_are_as_the_paper_says(tmp_path):
    write_all(tmp_path)
    found = verdicts(PaperRuns(tmp_path), WidthRatio(0.95, (0.94, 0.96)))
    # Without an interval, one training decides nothing: orientations. Figures of the strict scoring rest on three.
    open_ = [one.claim for one in found if one.answer != "holds"]
    assert len(found) == 30 and [claim for claim in open_ if "orientation" not in claim] == [] and len(open_) == 3


@pytest.mark.parametrize("network", ["attention-yolov3", "attention-identity"])
@pytest.mark.parametrize(
    ("attended", "answer"),
    [
        ((0.90, 0.91, 0.92), "holds"),
        ((0.70, 0.71, 0.72), "does not hold"),
        ((0.79, 0.91, 0.92), "open"),
        ((0.70, 0.71, 0.80), "open"),
        ((0.90, 0.91), "open"),
    ],
)
def test_several_trainings(tmp_path, network, attended, answer):
    write_halves(tmp_path, "yolov3", (0.80, 0.80, 0.82))
    write_halves(tmp_path, network, attended)
    claim = "attention raises F1 (" + ("plain CBAM" if network == "attention-yolov3" else "gates from identity")
    found = verdict(tmp_path, claim)
    counted = "3 each" if len(attended) == 3 else "2 and 3 each"
    assert (found.answer, found.trainings) == (answer, f"{counted}, half width")
    mean = sum(attended) / len(attended)
    assert (
        found.measured == f"{mean:.4f} ({min(attended):.4f} to {max(attended):.4f}) against 0.8067 (0.8000 to 0.8200)"
    )


@pytest.mark.parametrize(
    ("attended", "spread", "answer"),
    [(0.85, 0.01, "holds"), (0.75, 0.01, "does not hold"), (0.85, 0.03, "open"), (0.75, 0.03, "open")],
)
def test_one_training(tmp_path, attended, spread, answer):
    write_detector(tmp_path, "yolov3", 0.80, spread)
    write_detector(tmp_path, "attention-yolov3", attended, spread)
    found = verdict(tmp_path, AP)
    assert (found.answer, found.trainings) == (answer, "one training run each")
    assert verdict(tmp_path, "attention raises AP (gates").answer == "not measured"
    # The strict precision has no interval.
    assert verdict(tmp_path, "attention raises precision, strict scoring (plain").answer == "open"


def test_full_width_against_several_trainings(tmp_path):
    write_halves(tmp_path, "yolov3", (0.80, 0.81, 0.82))
    write_halves(tmp_path, "attention-yolov3", (0.90, 0.91, 0.92))
    write_detector(tmp_path, "yolov3", 0.80)
    write_detector(tmp_path, "attention-yolov3", 0.81)
    found = verdict(tmp_path, AP)
    assert found.answer == "holds" and found.measured.endswith("against 0.8000 (0.7900 to 0.8100), open")
    write_detector(tmp_path, "attention-yolov3", 0.70)
    found = verdict(tmp_path, AP)
    assert found.answer == "open" and found.measured.endswith("does not hold")


@pytest.mark.parametrize(
    ("reading", "where"),
    [
        ("pose", "pose in O_L"),
        ("attitude", "pose in O_L, attitude noise"),
        ("motion", "motion between frames"),
    ],
)
def test_navigation(tmp_path, reading, where):
    claim = f"attention lowers the position RMSE, per component ({where})"
    for errors, answer in (((7.0, 1.0), "holds"), ((1.0, 7.0), "does not hold"), ((7.0, 6.9), "open")):
        write_navigators(tmp_path, errors, (200.0, 200.0), reading)
        assert verdict(tmp_path, claim).answer == answer
    write_navigators(tmp_path, (12.0, 9.0), (200.0, 200.0), reading)
    lost = "mean motion of the training" if reading == "motion" else "mean pose of the training"
    measured = verdict(tmp_path, claim).measured
    assert f"; with attention, not better than the {lost}; without attention, not better than the {lost}" in measured


def test_a_constant_orientation_is_not_measured(tmp_path):
    for reading, where, mean in (("pose", "pose in O_L)", "mean_pose"), ("motion", "motion", "mean")):
        claim = "attention lowers the orientation RMSE, per component (" + where
        write_navigators(tmp_path, (7.0, 1.0), (200.0, 200.0), reading)
        assert verdict(tmp_path, claim).answer == "open"
        for name in NAVIGATORS.values():
            metrics = navigator_metrics(7.0, 200.0, reading) | {f"baseline/{mean}/{ORIENTATION}": 1e-6}
            write_metrics(PaperRuns(tmp_path).navigator(navigate_name(name, reading)), metrics)
        found = verdict(tmp_path, claim)
        assert found.answer == "not measured" and "ATTITUDE=1" in found.measured


@pytest.mark.parametrize(
    ("pose", "motion", "answer"),
    [
        ((200.0, 209.0), (200.0, 191.0), "holds"),
        ((200.0, 220.0), (200.0, 230.0), "does not hold"),
        ((220.0, 200.0), (230.0, 200.0), "does not hold"),
        ((200.0, 220.0), (200.0, 200.0), "open"),
        ((200.0, 220.0), (220.0, 200.0), "open"),
    ],
)
def test_times_are_compared_in_both_directions(tmp_path, pose, motion, answer):
    for reading, times in zip(("pose", "motion"), (pose, motion), strict=True):
        write_navigators(tmp_path, (7.0, 1.0), times, reading)
    found = verdict(tmp_path, FAST)
    assert (found.answer, found.trainings) == (answer, "2 comparisons")
    assert (
        f"pose: {pose[1] / 1e3:.3f} s against {pose[0] / 1e3:.3f} s" in found.measured and "motion: " in found.measured
    )


def test_times_of_two_machines_are_not_compared(tmp_path):
    write_navigators(tmp_path, (7.0, 1.0), (200.0, 200.0), "pose")
    path = PaperRuns(tmp_path).navigator("darknet53-lstm") / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"run/hardware": "another machine"}))
    found = verdict(tmp_path, FAST)
    assert found.answer == "not measured" and "not compared" in found.measured


def test_large_craters(tmp_path):
    def answer(ratio):
        (found,) = [one for one in verdicts(PaperRuns(tmp_path), ratio) if "large craters" in one.claim]
        return found.answer

    write_detector(tmp_path, "attention-yolov3", 0.8)
    cases = {(0.95, 0.97): "holds", (1.01, 1.03): "does not hold", (0.99, 1.01): "open", None: "open"}
    assert [answer(WidthRatio(1.0, limits)) for limits in cases] == list(cases.values())
    assert answer(None) == "not measured"


def test_gates(tmp_path):
    def write(*figures, **more):
        write_metrics(PaperRuns(tmp_path).explained, explained(*figures, **more))
        return answers(tmp_path, "PCC")

    assert write() == ["holds"] * 6
    measured = verdict(tmp_path, "PCC1").measured
    assert measured == "2 of 2: B_11 -0.40, B_35 -0.40; nulls: edge 0.45 to 0.45; 5 scenes"
    assert write(0.1, 0.5, -0.1) == ["does not hold"] * 6
    assert write(scenes=1) == ["open"] * 6, "one scene decides nothing"
    mixed = explained() | {"pcc2/B_48": 0.7}
    write_metrics(PaperRuns(tmp_path).explained, mixed)
    found = verdict(tmp_path, "PCC2")
    assert found.answer == "open" and found.measured.startswith("4 of 5: B_48 0.70, ")


def test_nothing_is_measured_without_runs(tmp_path):
    write_detector(tmp_path, detect_name("yolov3", "sparse"), 0.9)
    assert {one.answer for one in verdicts(PaperRuns(tmp_path), None)} == {"not measured"}
    assert {one.trainings for one in verdicts(PaperRuns(tmp_path), None)} == {"-"}
