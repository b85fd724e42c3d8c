"""Recall and AP by detectability, and the ideal observer."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.stats import norm
from tests.helpers import in_process

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.detect.config import LabelSettings
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.detectability import (
    by_detectability,
    ideal_ap,
    ideal_recall,
    observer_threshold,
    places,
    read_d_prime,
    separation,
)
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.records.metrics_file import read_metrics


@pytest.fixture(scope="module")
def split(quick):
    return load_split(open_dataset(quick / "detect"), "test", LabelSettings(radius_px=(2.0, 50.0)))


def write_table(path, split, d_prime):
    """A table of `perilune-render detectability`, with the d' of the labels of a split."""
    ids = np.concatenate([part.crater_id for part in split.labels])
    names = np.repeat(split.frames.table["frame_id"].to_numpy(), [len(part.boxes) for part in split.labels])
    rows = pd.DataFrame({"frame_id": names, "crater_id": ids, "d_prime": d_prime})[ids >= 0]
    rows.to_parquet(path, index=False)
    return path


def all_d_prime(split, seed=0):
    """d' between 0 and 8 for every label, drawn at random."""
    return np.random.default_rng(seed).uniform(0, 8, sum(len(part.boxes) for part in split.labels))


def detections_of(split, d_prime, found):
    """A detection on each label for which `found` is true, with a score that rises with its d'."""
    detections, start = [], 0
    for part in split.labels:
        rows = slice(start, start + len(part.boxes))
        start += len(part.boxes)
        hit = found[rows] & part.labelled
        scores = 0.5 + d_prime[rows][hit] / 20
        order = np.argsort(-scores)
        detections.append(Detections(part.boxes[hit][order], scores[order]))
    return detections


def test_labels_know_their_craters(quick, split):
    labels = open_dataset(quick / "detect").labels
    part, frame_id = split.labels[0], split.frames.table["frame_id"].iloc[0]
    rows = labels[labels["frame_id"] == frame_id].set_index("crater_id")
    assert part.labelled.sum() == len(rows)
    assert (part.crater_id[~part.labelled] == -1).all()
    expected = rows.loc[part.crater_id[part.labelled], "radius_px"]
    np.testing.assert_allclose(part.radius_px[part.labelled], expected)


def test_the_table_is_joined_by_frame_and_crater(split, tmp_path):
    d_prime = all_d_prime(split)
    found = read_d_prime(write_table(tmp_path / "d.parquet", split, d_prime), split)
    labelled = np.concatenate([part.labelled for part in split.labels])
    np.testing.assert_allclose(found[labelled], d_prime[labelled])
    assert np.isnan(found[~labelled]).all()


def test_figures_of_a_detector_with_a_sharp_limit(split):
    """A detector that finds exactly the labels above d' 4 has recall 0 below, 1 above, and full separation."""
    d_prime = all_d_prime(split)
    result = by_detectability(split, detections_of(split, d_prime, d_prime >= 4), d_prime, 0.5, 0.5)
    figures = result.figures()
    assert figures["detectability/auc"] > 0.97
    assert figures["detectability/above_4/ap50_paper"] > 0.97
    assert figures["detectability/above_4/ap50_paper"] > figures["detectability/above_1/ap50_paper"] + 0.2
    by_d_prime = {group.range: group for group in result.groups if group.by == "d_prime"}
    assert by_d_prime["2 to 3"].recall < 0.05
    assert by_d_prime["6 to 10"].recall > 0.95
    for by in ("d_prime", "radius", "sun"):
        groups = [group for group in result.groups if group.by == by]
        assert sum(group.labels for group in groups) == result.groups[0].labels
    assert result.groups[0].share_of_ap == pytest.approx(result.groups[0].ap50_paper / result.groups[0].ideal_ap)
    assert "| 6 to 10 |" in result.markdown(["a line"])


def test_only_frames_with_known_labels_count(split):
    d_prime = all_d_prime(split)
    first = np.arange(len(d_prime)) < len(split.labels[0].boxes)
    known = np.where(first, d_prime, np.nan)
    every = np.ones(len(d_prime), bool)
    result = by_detectability(split, detections_of(split, d_prime, every), known, 0.5, 0.5)
    assert result.frames == 1
    assert result.groups[0].recall > 0.95
    assert result.false_positives == 0


def test_the_ideal_observer_follows_its_decision_model():
    """Draw the responses of the model and compare recall, false positives and AP with the formulas."""
    rng = np.random.default_rng(1)
    d_prime, n_places = rng.uniform(0, 7, 3000), 20_000
    response, empty = d_prime + rng.normal(size=3000), rng.normal(size=n_places)
    t = observer_threshold(20.0, n_places)
    assert t == pytest.approx(norm.isf(20 / n_places))
    assert (empty > t).sum() == pytest.approx(20, abs=15)
    assert ideal_recall(d_prime, t) == pytest.approx((response > t).mean(), abs=0.02)
    scores = np.concatenate([response, empty])
    hits = np.concatenate([np.ones(3000), np.zeros(n_places)])[np.argsort(-scores)]
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    assert ideal_ap(d_prime, n_places) == pytest.approx((precision * hits).sum() / 3000, abs=0.01)


def test_a_larger_d_prime_raises_the_ideal_and_more_places_lower_it():
    d_prime = np.linspace(0, 6, 100)
    assert ideal_ap(d_prime + 1, 5000) > ideal_ap(d_prime, 5000) > ideal_ap(d_prime, 50_000)
    assert ideal_recall(d_prime + 1, 3) > ideal_recall(d_prime, 3)


def test_places_are_the_area_over_circles_of_each_size():
    assert places(256, 256, (2.0, 2.0)) == pytest.approx(256**2 / (4 * np.pi))
    assert places(256, 256, (2.0, 4.0)) == pytest.approx(256**2 / (4 * np.pi) * (1 + 0.5 + 0.25))


def test_separation_is_the_area_under_the_roc_curve():
    assert separation(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 1
    assert separation(np.array([1.0]), np.array([1.0, 0.0])) == 0.75
    assert np.isnan(separation(np.array([]), np.array([1.0])))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.assign(d_prime=np.nan), "d_prime: row 0: got nothing"),
        (lambda rows: pd.concat([rows, rows.iloc[:1]]), "a pair that occurs twice"),
        (lambda rows: rows.assign(frame_id="other-" + rows["frame_id"]), "no label of the split"),
        (lambda rows: rows.drop(columns="d_prime"), "no d_prime"),
        (lambda rows: rows.assign(crater_id="x"), "crater_id"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(split, tmp_path, change, message):
    path = write_table(tmp_path / "d.parquet", split, all_d_prime(split))
    change(pd.read_parquet(path)).to_parquet(path, index=False)
    with pytest.raises(UserError, match=message) as refused:
        read_d_prime(path, split)
    assert "\n" not in str(refused.value)


def test_a_file_of_another_format_is_refused(split, tmp_path):
    path = tmp_path / "d.parquet"
    path.write_bytes(b"PAR1" + bytes(40) + b"PAR1")
    with pytest.raises(UserError):
        read_d_prime(path, split)
    pq.write_table(pa.table({"frame_id": [[1]], "crater_id": [1], "d_prime": [1.0]}), path)
    with pytest.raises(UserError):
        read_d_prime(path, split)


def test_evaluate_writes_report_and_metrics(quick, split, tmp_path):
    path = write_table(tmp_path / "d.parquet", split, all_d_prime(split))
    out = tmp_path / "out"
    arguments = (
        "--dataset",
        quick / "detect",
        "--detectability",
        path,
        "--out",
        out,
        "--set",
        "detect.labels.radius_px=[2,50]",
    )
    done = in_process.call(main, "detect", "evaluate", *arguments)
    assert done.returncode == 0, done.stderr
    metrics = read_metrics(out)
    labels = metrics["test/detectability/labels"]
    assert labels == sum(metrics.get(f"test/detectability/{key}/labels", 0) for key in bins(metrics))
    assert metrics["test/detectability/share_of_ideal_recall"] > 0
    report = (out / "detectability.md").read_text()
    assert report.startswith("# Detection by detectability")
    assert f"{labels} labels with a known d'" in report


def bins(metrics):
    return {key.split("/")[2] for key in metrics if "/detectability/d_prime_" in key}
