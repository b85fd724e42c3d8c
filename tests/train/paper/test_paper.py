"""The page of the paper's experiment, from runs with known figures."""

import json
import shutil

import cv2
import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process
from tests.helpers.stored_run import store_run

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.cli import main
from perilune_train.evaluation.metrics_file import write_metrics
from perilune_train.paper.detections import median_width_ratio, read_detections
from perilune_train.paper.runs import DETECTORS, NAVIGATORS, PaperRuns
from perilune_train.paper.tables import table_3
from perilune_train.paper.verdicts import verdicts

POSITION, ORIENTATION = "position_rmse_per_component_m", "orientation_rmse_per_component_deg"


def detector_metrics(ap, spread=0.01):
    """Metrics with all four figures of Table II equal, and intervals of this half width."""
    found = {"test/threshold": 0.5}
    for key in ("precision", "recall", "ap50_paper", "f1"):
        found |= {f"test/{key}": ap, f"test/{key}_low": ap - spread, f"test/{key}_high": ap + spread}
    return found | {f"test/radius_{bin_}_px/ap50_paper": ap for bin_ in ("2_3", "3_5")}


def navigator_metrics(position_m, ms):
    found = {"test/ms_per_single_pair": ms}
    for prefix, error in (("test", position_m), ("baseline/klt", 1.0), ("baseline/nominal", 9.0)):
        found |= {f"{prefix}/{POSITION}": error, f"{prefix}/position_rmse_vector_m": error * 3**0.5}
        found |= {f"{prefix}/{ORIENTATION}": error / 100}
    return found


def explained(shallow=0.4, deep=0.9, moved=0.2, scenes=5):
    """Gates as the paper describes them, over a number of scenes, and edge maps that follow craters more."""
    gates = [f"B_{i}{j}" for i, n in ((1, 1), (2, 2), (3, 8), (4, 8), (5, 4)) for j in range(1, n + 1)]
    found = {f"pcc1_background/{gate}": shallow for gate in gates} | {f"pcc2/{gate}": deep for gate in gates}
    found |= {f"pcc1_background_null/{gate}/edge": 0.45 for gate in gates} | {"scenes": scenes, "pair_scenes": scenes}
    for number, gate in enumerate(gates):
        for pixels in ("", "_all_pixels"):
            found |= {f"pcc3{pixels}/{gate}": 0.5, f"pcc4{pixels}/{gate}": 0.5 + (moved if number < 9 else -moved)}
    return found


@pytest.fixture
def dataset(make_dataset, tmp_path):
    """Craters of up to 20 px and more: frames near the ground."""
    return make_dataset(tmp_path / "data", "detect", splits={"train": 1, "val": 1, "test": 2}, n_frames=4)


@pytest.fixture
def runs(dataset, tmp_path):
    """Finished runs: attention is better, its boxes are 0.9 times as wide as the truth."""
    root = tmp_path / "runs"
    labels = open_dataset(dataset).table("labels").to_pandas()
    corners = labels[[f"bbox_{name}_px" for name in ("x0", "y0", "x1", "y1")]].to_numpy(np.float64)
    centre = (corners[:, :2] + corners[:, 2:]) / 2
    for (name, folder), ap, factor in zip(DETECTORS.items(), (0.80, 0.85), (1.0, 0.9), strict=True):
        stored = store_run(tmp_path / "stored" / folder, "labels.selection=paper")
        shutil.copytree(stored, root / "detect" / folder)
        write_metrics(PaperRuns(root).detector(name), detector_metrics(ap))
        half = (corners[:, 2:] - corners[:, :2]) / 2 * factor
        boxes = pd.DataFrame(np.hstack([centre - half, centre + half]), columns=["x0_px", "y0_px", "x1_px", "y1_px"])
        boxes = boxes.assign(frame_id=labels["frame_id"], score=0.9)
        test = set(open_dataset(dataset).table("frames", ["frame_id"], split="test")["frame_id"].to_pylist())
        boxes[boxes["frame_id"].isin(test)].to_parquet(root / "detect" / folder / "detections.parquet")
    pairs = pd.DataFrame(
        {"scene_id": "s", "trajectory_id": "t", "step": range(4), "position_error_m": 1.0, "orientation_error_deg": 0.1}
    )
    for (name, _), error, ms in zip(NAVIGATORS.items(), (7.0, 1.0), (200.0, 204.0), strict=True):
        folder = PaperRuns(root).navigator(name)
        write_metrics(folder, navigator_metrics(error, ms))
        pairs.assign(method="stack").to_parquet(folder / "errors.parquet")
    write_metrics(PaperRuns(root).explained, explained())
    for name in ("masks_detect", "masks_navigate", "pcc_detect", "pcc_navigate"):
        cv2.imwrite(str(PaperRuns(root).explained / f"{name}.png"), np.zeros((4, 4), np.uint8))
    return root


def test_the_page_has_the_papers_figures_beside_ours(runs, dataset):
    done = in_process.call(main, "paper", "--runs", runs, "--dataset", dataset, "--about", "a trial")
    assert done.returncode == 0, done.stderr
    page = (runs / "paper.md").read_text()
    assert "| attention-YOLOv3 | paper | 0.8458 | 0.9336 | 0.8963 | 0.8875 |" in page
    assert "| attention-YOLOv3 | here | 0.850 (0.840 to 0.860) |" in page
    assert "| Darknet53-LSTM | paper | 7.61 | - | 0.011 | 0.22 |" in page
    assert "| attention-Darknet53-LSTM | here | 1.000 | 1.732 | 0.01000 | 0.204 |" in page
    assert "| KLT tracks, without training | here | 1.000 |" in page
    assert "- a trial" in page and "Deviations that remain" in page
    for name in ("detections", "trajectory", "learning", "masks_detect", "pcc_navigate"):
        assert f"({name}.png)" in page and (runs / f"{name}.png").stat().st_size > 50
    figures = json.loads((runs / "paper.json").read_text())
    assert figures["YOLOv3/test/ap50_paper"] == 0.80
    answers = {key: value for key, value in figures.items() if key.endswith("/answer")}
    assert len(answers) >= 14 and set(answers.values()) <= {
        "holds",
        "does not hold",
        "within the spread",
        "undecided",
        "not measured",
    }


def answers_of(runs, ratio=0.9):
    return {one.claim: one.answer for one in verdicts(PaperRuns(runs), ratio)}


def test_verdicts(runs):
    answers = answers_of(runs)
    assert answers["attention raises AP"] == "holds"
    assert answers["attention lowers the position RMSE (per component)"] == "within the spread", "no intervals"
    assert answers["a pair takes as long with attention as without"] == "holds"
    assert [answer for claim, answer in answers.items() if claim.startswith("PCC")] == ["holds"] * 6
    (shallow,) = [one.measured for one in verdicts(PaperRuns(runs), 0.9) if one.claim.startswith("PCC1")]
    assert shallow == "2 of 2: B_11 0.40, B_35 0.40; nulls: edge 0.45 to 0.45; 5 scenes"
    # One scene decides nothing on masks.
    write_metrics(PaperRuns(runs).explained, explained(scenes=1))
    assert [answer for claim, answer in answers_of(runs).items() if claim.startswith("PCC")] == ["undecided"] * 6
    write_metrics(PaperRuns(runs).explained, explained())
    (large,) = [answer for claim, answer in answers.items() if "large craters" in claim]
    assert large == "holds"
    assert answers_of(runs, 1.02)[next(c for c in answers if "large craters" in c)] == "does not hold"
    # Intervals that overlap, figures the other way round, gates that do not differ.
    write_metrics(PaperRuns(runs).detector("YOLOv3"), detector_metrics(0.84))
    assert answers_of(runs)["attention raises AP"] == "within the spread"
    write_metrics(PaperRuns(runs).detector("YOLOv3"), detector_metrics(0.86))
    assert answers_of(runs)["attention raises AP"] == "does not hold"
    write_metrics(PaperRuns(runs).navigator("Darknet53-LSTM"), navigator_metrics(0.5, 100.0))
    answers = answers_of(runs)
    assert answers["attention lowers the position RMSE (per component)"] == "does not hold"
    assert answers["a pair takes as long with attention as without"] == "does not hold"
    for name in NAVIGATORS:
        still = navigator_metrics(1.0, 100.0) | {f"test/{ORIENTATION}": 2e-6}
        write_metrics(PaperRuns(runs).navigator(name), still)
    assert answers_of(runs)["attention lowers the orientation RMSE (per component)"] == "not measured"
    write_metrics(PaperRuns(runs).explained, explained(0.1, 0.5, -0.1))
    assert [a for claim, a in answers_of(runs).items() if claim.startswith("PCC")] == ["does not hold"] * 6
    write_metrics(PaperRuns(runs).explained, {})
    assert [a for claim, a in answers_of(runs).items() if claim.startswith("PCC")] == ["not measured"] * 6


def test_a_navigator_that_loses_to_a_floor_is_named(runs):
    own = navigator_metrics(3.0, 100.0) | {"evaluation/target": "pose", "evaluation/worse_than": "ridge"}
    own |= {f"baseline/ridge/{key}": 2.0 for key in (POSITION, "position_rmse_vector_m", ORIENTATION)}
    write_metrics(PaperRuns(runs).navigator("Darknet53-LSTM"), own)
    lines = table_3(PaperRuns(runs))
    (losing,) = (line for line in lines if "worse than" in line)
    assert losing.startswith("| Darknet53-LSTM | here, worse than ridge | 3.000 |")
    (floor,) = (line for line in lines if "ridge regression" in line)
    assert "of Darknet53-LSTM | here | 2.000" in floor and sum("KLT" in line for line in lines) == 1


def test_width_of_large_craters(runs, dataset):
    ratios = {name: median_width_ratio(read_detections(PaperRuns(runs).detector(name), dataset)) for name in DETECTORS}
    labels = open_dataset(dataset).table("labels").to_pandas()
    assert (np.sqrt(labels["ellipse_a_px"] * labels["ellipse_b_px"]) >= 20).any(), "the dataset has large craters"
    assert ratios == pytest.approx({"YOLOv3": 1.0, "attention-YOLOv3": 0.9})


def test_mistakes(runs, dataset, tmp_path):
    done = in_process.call(main, "paper", "--runs", tmp_path / "none", "--dataset", dataset)
    assert done.returncode == 2 and "make paper" in done.stderr and not (tmp_path / "none").exists()
    path = PaperRuns(runs).detector("YOLOv3") / "detections.parquet"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UserError, match=r"detections\.parquet"):
        read_detections(path.parent, dataset)
    path.unlink()
    (PaperRuns(runs).explained / "metrics.json").unlink()
    done = in_process.call(main, "paper", "--runs", runs, "--dataset", dataset)
    assert done.returncode == 2 and "metrics.json" in done.stderr and not (runs / "paper.md").exists()
