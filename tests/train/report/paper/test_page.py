"""The page of the paper's experiment, from runs with known figures, all of them or some."""

import json
import shutil

import cv2
import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process
from tests.helpers.stored_run import store_run
from tests.train.report.paper.toy_runs import (
    detector_metrics,
    explained,
    navigator_metrics,
    write_all,
    write_detector,
    write_halves,
    write_navigators,
)
from torch.utils.tensorboard import SummaryWriter

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text
from perilune_train.cli.main import main
from perilune_train.records.metrics_file import write_metrics
from perilune_train.report.paper.detections import read_detections, width_ratio
from perilune_train.report.paper.page import write_page
from perilune_train.report.paper.prose import lead
from perilune_train.report.paper.runs import (
    ATTENTION,
    CAUSES,
    CURVE,
    NAVIGATORS,
    READINGS,
    PaperRuns,
    detect_name,
    navigate_name,
    nearest_share,
)
from perilune_train.report.paper.tables import lost_to, table_2, table_3

SECTIONS = (
    "Claims",
    "Table II: crater detection",
    "Density of craters",
    "Detections",
    "Table III: navigation",
    "Three causes",
    "Learning curves",
    "Attention",
    "Deviations that remain",
)


@pytest.fixture
def dataset(make_dataset, tmp_path):
    """Craters of up to 20 px and more: frames near the ground."""
    return make_dataset(tmp_path / "data", "detect", splits={"train": 1, "val": 1, "test": 2}, n_frames=4)


@pytest.fixture
def runs(dataset, tmp_path):
    """All planned runs, finished: attention is better, and its boxes are 0.9 times as wide as the truth."""
    root = tmp_path / "runs"
    stored = store_run(tmp_path / "stored", "labels.selection=paper")
    labels = open_dataset(dataset).table("labels").to_pandas()
    corners = labels[[f"bbox_{name}_px" for name in ("x0", "y0", "x1", "y1")]].to_numpy(np.float64)
    centre, half = (corners[:, :2] + corners[:, 2:]) / 2, (corners[:, 2:] - corners[:, :2]) / 2
    test = set(open_dataset(dataset).table("frames", ["frame_id"], split="test")["frame_id"].to_pylist())
    for network, factor in zip(ATTENTION, (1.0, 0.9, 0.9), strict=True):
        shutil.copytree(stored, root / "detect" / network)
        boxes = np.hstack([centre - factor * half, centre + factor * half])
        boxes = pd.DataFrame(boxes, columns=["x0_px", "y0_px", "x1_px", "y1_px"])
        boxes = boxes.assign(frame_id=labels["frame_id"], score=0.9)
        boxes[boxes["frame_id"].isin(test)].to_parquet(root / "detect" / network / "detections.parquet")
    write_all(root)
    write_metrics(
        PaperRuns(root).detector("transfer-yolov3"),
        detector_metrics(0.8) | {"train/start": "a/own/checkpoints/best.ckpt"},
    )
    pairs = {"scene_id": "s", "trajectory_id": "t", "step": range(4), "position_error_m": 1.0, "method": "stack"}
    for reading in READINGS:
        for name in NAVIGATORS.values():
            folder = PaperRuns(root).navigator(navigate_name(name, reading))
            pd.DataFrame(pairs).assign(orientation_error_deg=0.1).to_parquet(folder / "errors.parquet")
    writer = SummaryWriter(str(root / "detect" / "yolov3"))
    writer.add_scalar("val/ap50_paper", 0.5, 1)
    writer.close()
    for name in ("masks_detect", "masks_navigate", "pcc_detect", "pcc_navigate"):
        cv2.imwrite(str(PaperRuns(root).explained / f"{name}.png"), np.zeros((4, 4), np.uint8))
    causes = {"loss/sums/AP": 0.02, "loss/means/AP": 0.9, "gates/plain CBAM, 1/16/AP": 0.15, "loss/sums/steps": "490"}
    # With the record of its run, as the benchmark writes it.
    write_text(root / CAUSES, json.dumps({**causes, "run": {"commit": "0", "load": 0.5}}))
    return root


def sections(page):
    """Text of each section by its title; the first has the title of the page."""
    parts = page.read_text().split("\n## ")
    return {part.partition("\n")[0]: part.partition("\n")[2] for part in parts}


def test_every_section_of_finished_runs(runs, dataset):
    done = in_process.call(main, "paper", "--runs", runs, "--dataset", dataset, "--about", "a trial")
    assert done.returncode == 0, done.stderr
    page = sections(runs / "paper.md")
    assert tuple(page)[1:] == SECTIONS
    assert "ot run" not in "".join(text for title, text in page.items() if title != "Three causes")
    assert "30 claims of the paper: holds: 26, open: 4." in page["Claims"]
    assert (
        "| attention raises AP (plain CBAM) | 0.8963 against 0.8926 | 0.8600 (0.8500 to 0.8700) against"
        in page["Claims"]
    )
    table = page["Table II: crater detection"]
    assert "| the paper | attention-YOLOv3 | - | - | 0.8963 | 0.8458 | 0.9336 | 0.8875 | - | - | - | - |" in table
    row = "| headline | attention-YOLOv3, plain CBAM | 1 | - | 0.850 (0.840 to 0.860) | 0.850 (0.840 to 0.860) |"
    assert row in table and "| 0.650 | 0.750 (0.740 to 0.760) | 0.750 | 25.0 |" in table
    assert "| headline at half width | YOLOv3 | 3 | - | 0.810 (0.800 to 0.820) |" in table
    for ground in ("sparse (0.1)", "our usual", "headline after transfer"):
        assert f"| {ground} | attention-YOLOv3, plain CBAM | 1 | - | 0.850" in table
    assert "Weights: rows after transfer from our own network `own`, in place of YOLOv3 trained on COCO." in table
    curve = page["Density of craters"]
    assert "| **0.4, headline** | 25.0 | 0.895 | 0.900 (0.890 to 0.910) | 0.800 (0.790 to 0.810) |" in curve
    assert [line.split(" | ")[0].strip("|* ") for line in curve.splitlines() if line.startswith("| ")][2:] == [
        "0.1",
        "0.4, headline",
        "0.8",
        "lunar (our usual ground)",
    ]
    navigation = page["Table III: navigation"]
    assert (
        navigation.index("Pose in O_L:")
        < navigation.index("Pose in O_L over")
        < navigation.index("Motion between consecutive frames")
    )
    assert "| Darknet53-LSTM | the paper | 7.61 | - | 0.011 | 0.22 |" in navigation
    assert "| attention-Darknet53-LSTM | here | 1.000 (0.900 to 1.100) | 1.732 | 0.01000 | 0.204 |" in navigation
    assert "| ridge regression on the frozen features of Darknet53-LSTM | here | 11.000" in navigation
    assert "| KLT tracks, without training | here | 0.500" in navigation
    causes = page["Three causes"]
    assert (
        "| sums | 0.020 | 490 |" in causes
        and "| means | 0.900 | - |" in causes
        and "| plain CBAM, 1/16 | 0.150 |" in causes
    )
    assert causes.count("Ablation: not run.") == 1, "the ground has no rows"
    attention = page["Attention"]
    assert "| PCC1: mask and craters | 0.40 to 0.40 | edge 0.45 to 0.45 | - |" in attention
    assert "| PCC2: masks of two frames | 0.90 to 0.90 | - | 4 of 23 |" in attention
    head = page["# The paper's experiment"]
    assert "- a trial" in head and "labels `paper`, loss of means" in head
    assert "- YOLOv3 ignores predictors that overlap" in page["Deviations that remain"]
    for name in ("detections", "trajectory", "learning", "curve", "masks_detect", "pcc_navigate"):
        assert f"({name}.png)" in (runs / "paper.md").read_text() and (runs / f"{name}.png").stat().st_size > 50
    figures = json.loads((runs / "paper.json").read_text())
    assert (
        figures["detect/yolov3/test/ap50_paper"] == 0.80
        and figures["navigate/darknet53-lstm-stack/test/ms_per_single_pair"]
    )
    assert {value for key, value in figures.items() if key.endswith("/answer")} == {"holds", "open"}


def test_the_first_paragraph(runs, dataset):
    def paragraph(share=None):
        chosen = share or nearest_share(PaperRuns(runs).curve())
        return lead(PaperRuns(runs), chosen, given=share is not None)

    text = paragraph()
    assert text == write_page(runs, str(dataset)).read_text().splitlines()[2]
    assert "The headline ground has `equilibrium_share` 0.4: ground as difficult as the paper's" in text
    assert "Of 4 grounds it has the validation AP (0.895) nearest to the paper's 0.893." in text
    assert "By the strict scoring rule, the nearest share would be 0.1 (0.870)." in text
    assert "(precision 0.840 at recall 0.926; here 0.800 usual and 0.700 strict at recall 0.800)" in text
    assert "At half width, there are 3 training runs of each network." in text
    assert "The share was set by the user; on the curve 0.4 is nearer to 0.893." in paragraph("0.8")
    for path in (runs / "detect").glob("*-half-*"):
        shutil.rmtree(path)
    assert "Every figure comes from one training run of each network." in paragraph()
    for path in (runs / "detect").glob("curve-*"):
        shutil.rmtree(path)
    assert "The curve that chooses it was not run." in paragraph()
    assert "The share was set by the user; the curve was not run." in paragraph("0.3")


def write_motion_only(root):
    write_navigators(root, (7.0, 1.0), (200.0, 204.0), "motion")


@pytest.mark.parametrize(
    ("write", "filled"),
    [
        (lambda root: write_detector(root, "yolov3", 0.8), {"Table II: crater detection"}),
        (lambda root: write_detector(root, "lunar-yolov3", 0.8), {"Table II: crater detection"}),
        (lambda root: write_halves(root, "yolov3", (0.8,)), {"Table II: crater detection"}),
        (lambda root: write_detector(root, f"{CURVE}-0.2", 0.8), {"Density of craters"}),
        (write_motion_only, {"Table III: navigation"}),
        (lambda root: write_metrics(PaperRuns(root).explained, explained(scenes=1)), {"Attention"}),
    ],
)
def test_a_section_without_runs_says_so(tmp_path, write, filled):
    write(tmp_path)
    page = sections(write_page(tmp_path, "nowhere"))
    optional = ("Table II: crater detection", "Density of craters", "Detections", "Learning curves", "Attention")
    assert {title for title in optional if page[title].strip() != "Not run."} | (
        {"Table III: navigation"} if "| here |" in page["Table III: navigation"] else set()
    ) == filled
    pose, _, motion = page["Table III: navigation"].partition("**Motion")
    assert "Not run." in pose and ("Not run." in motion) != (filled == {"Table III: navigation"})
    assert page["Three causes"].count("Ablation: not run.") == 3


def test_each_missing_run_leaves_the_rest(runs, dataset):
    """A run with a time budget stops early: take the finished runs away one by one."""
    for name in ("detections.parquet", "errors.parquet", "events.out.tfevents.*"):
        # Pictures take time.
        for path in runs.glob(f"*/*/{name}"):
            path.unlink()
    folders = sorted(path for kind in ("detect", "navigate", "explain") for path in (runs / kind).iterdir())
    for folder in folders[:-1]:
        (folder / "metrics.json").unlink()
        assert tuple(sections(write_page(runs, str(dataset))))[1:] == SECTIONS
    (folders[-1] / "metrics.json").unlink()
    with pytest.raises(UserError, match="no finished run"):
        write_page(runs, str(dataset))


def test_table_2_names_what_was_not_run(tmp_path):
    write_detector(tmp_path, "attention-yolov3", 0.8)
    write_halves(tmp_path, "yolov3", (0.8, 0.9))
    lines = table_2(PaperRuns(tmp_path))
    missing = "headline (YOLOv3; attention-YOLOv3, gates from identity), headline at half width (attention-YOLOv3, "
    missing += "plain CBAM; attention-YOLOv3, gates from identity), headline with more epochs, sparse (0.1), "
    missing += "our usual, headline after transfer."
    assert lines[-1] == f"Not run: {missing}"
    assert "| headline at half width | YOLOv3 | 2 | - | 0.850 (0.800 to 0.900) |" in "\n".join(lines)


def test_a_score_on_the_locked_benchmark(tmp_path):
    scores = {key.replace("test/", "paper/"): value for key, value in detector_metrics(0.4).items()}
    write_metrics(PaperRuns(tmp_path).benchmark("yolov3"), scores, "benchmark.json")
    assert "| locked benchmark | YOLOv3 | 1 | - | 0.400 (0.390 to 0.410) |" in "\n".join(table_2(PaperRuns(tmp_path)))
    write_navigators(tmp_path, (7.0, 1.0), (200.0, 204.0), "motion")
    scored = {key.replace("test/pos", "stack/pos"): value for key, value in navigator_metrics(24.0, 300.0).items()}
    write_metrics(PaperRuns(tmp_path).benchmark("darknet53-lstm"), scored, "benchmark.json")
    lines = "\n".join(table_3(PaperRuns(tmp_path), "motion"))
    assert "| Darknet53-LSTM | here, locked benchmark | 24.000 (23.900 to 24.100) |" in lines
    assert "longer than in training" in write_page(tmp_path, "nowhere").read_text()


@pytest.mark.parametrize("reading", READINGS)
def test_a_network_that_does_not_beat_the_best_floor_is_called_so(tmp_path, reading):
    first = "mean motion of the training" if reading == "motion" else "mean pose of the training"
    for error, lost in ((8.9, False), (9.0, True), (9.5, True)):
        write_navigators(tmp_path, (error, 1.0), (200.0, 200.0), reading)
        text = "\n".join(table_3(PaperRuns(tmp_path), reading))
        assert (f"| Darknet53-LSTM | here; **does not beat the {first}** | {error:.3f}" in text) is lost
        assert "| attention-Darknet53-LSTM | here | 1.000" in text
    metrics = navigator_metrics(1.0, 200.0, reading)
    # KLT tracks see the images, so they are no floor.
    assert lost_to(metrics) is None and metrics.get("baseline/klt/position_rmse_per_component_m") in (0.5, None)


def test_the_headline_ground_is_never_our_usual_one(tmp_path):
    for share, ap in (("0.05", 0.99), ("0.8", 0.5), ("lunar", 0.895)):
        write_detector(tmp_path, f"{CURVE}-{share}", ap)
    curve = PaperRuns(tmp_path).curve()
    assert list(curve) == ["0.05", "0.8", "lunar"] and nearest_share(curve) == "0.05" and nearest_share({}) is None


def test_names_of_the_runs():
    assert detect_name("yolov3") == "yolov3"
    assert detect_name("attention-yolov3", seed=2) == "attention-yolov3-half-2"
    assert detect_name("attention-identity", "sparse") == "sparse-attention-identity"
    assert [navigate_name("darknet53-lstm", reading) for reading in READINGS] == [
        "darknet53-lstm",
        "darknet53-lstm-attitude",
        "darknet53-lstm-motion",
    ]


def test_width_of_large_craters(runs, dataset):
    labels = open_dataset(dataset).table("labels").to_pandas()
    assert (np.sqrt(labels["ellipse_a_px"] * labels["ellipse_b_px"]) >= 20).any(), "the dataset has large craters"
    ratios = {name: width_ratio(read_detections(PaperRuns(runs).detector(name), dataset)) for name in ATTENTION}
    expected = {"yolov3": 1.0, "attention-yolov3": 0.9, "attention-identity": 0.9}
    assert {name: ratio.median for name, ratio in ratios.items()} == pytest.approx(expected)
    assert {ratio.interval for ratio in ratios.values()} == {None}, "two scenes"


def test_interval_of_the_width_of_large_craters(make_dataset, tmp_path):
    """Boxes of one known width in each scene: the interval contains the median, within the range of the widths."""
    data = make_dataset(tmp_path / "many", "detect", splits={"train": 1, "val": 1, "test": 16}, n_frames=4)
    run = store_run(tmp_path / "stored", "labels.selection=paper")
    labels = open_dataset(data).table("labels").to_pandas()
    labels = labels[labels["split"] == "test"]
    factor = 0.8 + 0.01 * pd.factorize(labels["scene_id"])[0]
    found = pd.DataFrame({"frame_id": labels["frame_id"], "score": 0.9})
    for axis in "xy":
        low, high = labels[f"bbox_{axis}0_px"], labels[f"bbox_{axis}1_px"]
        found[f"{axis}0_px"] = (low + high) / 2 - factor * (high - low) / 2
        found[f"{axis}1_px"] = (low + high) / 2 + factor * (high - low) / 2
    found.to_parquet(run / "detections.parquet")
    ratio = width_ratio(read_detections(run, data))
    low, high = ratio.interval
    assert 0.8 <= low < high <= 0.95 and low <= ratio.median <= high


def test_mistakes(runs, dataset, tmp_path):
    done = in_process.call(main, "paper", "--runs", tmp_path / "none", "--dataset", dataset)
    assert done.returncode == 2 and "make paper" in done.stderr and not (tmp_path / "none").exists()
    (tmp_path / "empty").mkdir()
    done = in_process.call(main, "paper", "--runs", tmp_path / "empty", "--dataset", dataset)
    assert done.returncode == 2 and "no finished run" in done.stderr and not list((tmp_path / "empty").iterdir())
    path = PaperRuns(runs).detector("yolov3") / "detections.parquet"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UserError, match=r"detections\.parquet"):
        read_detections(path.parent, dataset)
    path.unlink()
    with pytest.raises(UserError, match=r"detections\.parquet"):
        read_detections(path.parent, dataset)
    (PaperRuns(runs).detector("yolov3") / "metrics.json").write_text("[]")
    done = in_process.call(main, "paper", "--runs", runs, "--dataset", dataset)
    assert done.returncode == 2 and "metrics.json" in done.stderr and not (runs / "paper.md").exists()
