"""The locked benchmark: what is compared with the manifests, how detections are scored, and what is refused."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.helpers import in_process
from tests.helpers.stored_run import store_run
from tests.helpers.terrain_record import store_record, uses_of

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.subset import subset
from perilune_train.cli.main import main
from perilune_train.records.benchmark_parts import part_names

BOX = ("x0_px", "y0_px", "x1_px", "y1_px")


@pytest.fixture(scope="module")
def places(make_dataset, tmp_path_factory):
    """A rendered benchmark of two parts (three and two scenes, four frames each), and its manifests."""
    folder = tmp_path_factory.mktemp("benchmark")
    for name, n_scenes, seed in (("benchmark-detect-highland", 3, 21), ("benchmark-detect-mare", 2, 22)):
        made = make_dataset(folder / "data" / name, "detect", splits={"test": n_scenes}, n_frames=4, seed=seed)
        subset(open_dataset(made), folder / "manifests" / name, images="none")
    return folder / "data", folder / "manifests"


def truth(data, selected=lambda labels: labels):
    """Detections of a detector that finds every label; `selected` changes the rows."""
    rows = []
    for name in part_names("detect"):
        if (data / name).exists():
            labels = selected(open_dataset(data / name).table("labels").to_pandas())
            columns = {"dataset": [name] * len(labels), "frame_id": labels["frame_id"].tolist()}
            columns |= {key: labels[f"bbox_{key}"].astype(np.float64) for key in BOX}
            rows.append(pa.table({**columns, "score": np.full(len(labels), 0.9)}))
    return pa.concat_tables(rows)


def call(places, *arguments):
    data, manifests = places
    return in_process.call(main, "detect", "benchmark", "--data", data, "--manifests", manifests, *arguments)


def submitted(places, table, folder, *more):
    pq.write_table(table, folder / "mine.parquet")
    chosen = ("--detections", folder / "mine.parquet", "--threshold", "0.5", "--out", folder / "out", *more)
    return call(places, *chosen)


@pytest.mark.usefixtures("no_pictures")
def test_a_detector_that_finds_every_label_is_perfect_by_the_papers_rule(places, tmp_path):
    done = submitted(places, truth(places[0]), tmp_path)
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "out/benchmark.json").read_text())
    for scoring_rule in ("", "edge/", "strict/"):
        assert figures[f"paper/{scoring_rule}ap50_paper"] == figures[f"paper/{scoring_rule}f1"] == 1
    # By `visible`, the boxes on eroded craters are ignored, but count as false positives by the strict scoring rule.
    assert figures["visible/ap50_paper"] == 1 and figures["visible/strict/ap50_paper"] < 1
    assert figures["headline/ap50_paper"] == figures["visible/strict/ap50_paper"]
    assert figures["headline/ap50_paper_account"] == "visible, strict"
    assert (figures["paper/intervals_over"], figures["paper/intervals_units"]) == ("scene", 5)
    assert (figures["paper/region/highland/scenes"], figures["paper/region/mare/scenes"]) == (3, 2)
    page = (tmp_path / "out/benchmark.md").read_text()
    assert "by the least favourable scoring rule (AP: labels by `visible`, strict rule" in page
    assert "`benchmark-detect-mare`: all frames of the shared manifest" in page
    assert "`benchmark-detect-camera`: **not scored**" in page


@pytest.mark.usefixtures("no_pictures")
def test_the_headline_is_the_lowest_of_all_scoring_rules(places, tmp_path):
    """Half of the labels found: recall 0.5 by the paper's rule, whatever the scoring rule."""
    done = submitted(places, truth(places[0], lambda labels: labels.iloc[::2]), tmp_path)
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "out/benchmark.json").read_text())
    scoring_rules = [
        f"{rule}/{prefix}ap50_paper" for rule in ("visible", "paper") for prefix in ("", "edge/", "strict/")
    ]
    assert figures["headline/ap50_paper"] == min(figures[key] for key in scoring_rules) < 0.6
    assert figures["paper/recall"] == pytest.approx(0.5, abs=0.01)
    found = {name: figures[f"paper/region/{name}/ap50_paper"] for name in ("highland", "mare")}
    assert all(0.4 < ap < 0.6 for ap in found.values())


def test_a_run_is_scored_at_its_own_threshold_and_its_terrain_is_checked(places, tmp_path, no_pictures):
    run = store_run(tmp_path)
    best = run / "checkpoints" / "best.ckpt"
    refused = call(places, "--run", run, "--out", tmp_path / "a")
    store_record(best, [])
    done = call(places, "--run", run, "--out", tmp_path / "b")
    assert done.returncode == 0, done.stderr
    assert refused.returncode == 0 and "TRAINING TERRAIN UNKNOWN" in (tmp_path / "a/benchmark.md").read_text()
    figures = json.loads((tmp_path / "b/benchmark.json").read_text())
    assert figures["threshold"] == 0.005 and figures["terrain/mark"] == ""
    assert figures["frames/benchmark-detect-highland"] == figures["locked_frames/benchmark-detect-highland"] == 12
    store_record(best, uses_of(places[0] / "benchmark-detect-mare", "test"))
    refused = call(places, "--run", run, "--out", tmp_path / "c")
    assert refused.returncode == 2 and "test terrain" in refused.stderr and not (tmp_path / "c").exists()


@pytest.mark.usefixtures("no_pictures")
def test_a_part_of_the_frames_is_scored_and_named(places, tmp_path):
    data, manifests = places
    subset(
        open_dataset(data / "benchmark-detect-mare"), tmp_path / "data/benchmark-detect-mare", ["scene_id == 's000'"]
    )
    done = submitted((tmp_path / "data", manifests), truth(tmp_path / "data"), tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "out/benchmark.md").read_text()
    assert "`benchmark-detect-mare`: **only 4 of 8 frames** of the shared manifest" in page


@pytest.mark.usefixtures("no_pictures")
def test_oblique_views_have_a_row_and_change_no_other_figure(places, make_dataset, tmp_path):
    """A detector that finds every second label, and no crater in oblique views."""
    data, manifests = tmp_path / "data", tmp_path / "manifests"
    shutil.copytree(places[0], data)
    shutil.copytree(places[1], manifests)
    table = truth(data, lambda labels: labels.iloc[::2])
    figures = {}
    for case in ("before", "after"):
        if case == "after":
            name = "benchmark-detect-oblique"
            made = make_dataset(data / name, "detect", splits={"test": 2}, n_frames=4, seed=23)
            subset(open_dataset(made), manifests / name, images="none")
        (tmp_path / case).mkdir()
        done = submitted((data, manifests), table, tmp_path / case)
        assert done.returncode == 0, done.stderr
        figures[case] = json.loads((tmp_path / case / "out/benchmark.json").read_text())
    before, after = figures["before"], figures["after"]
    measured = [key for key in before if key.startswith(("headline/", "visible/", "paper/"))]
    assert len(measured) > 100 and {key: after[key] for key in measured} == {key: before[key] for key in measured}
    added = {key for key in after if "oblique" in key}
    assert added == after.keys() - before.keys()
    assert after["paper/region/oblique/scenes"] == 2 and after["paper/region/oblique/ap50_paper"] == 0
    assert after["paper/region/oblique/labels"] > 0
    old, new = ((tmp_path / case / "out/benchmark.md").read_text() for case in figures)
    assert "`benchmark-detect-oblique`: **not scored**" in old and "| oblique |" not in old
    assert "`benchmark-detect-oblique`: all frames of the shared manifest" in new and "| oblique | 2 |" in new
    assert new.count("All other figures of this page exclude `oblique`.") == 2


def test_oblique_views_alone_are_refused(places, make_dataset, tmp_path):
    name = "benchmark-detect-oblique"
    made = make_dataset(tmp_path / "data" / name, "detect", splits={"test": 1}, n_frames=2, seed=23)
    subset(open_dataset(made), tmp_path / "manifests" / name, images="none")
    done = submitted((tmp_path / "data", tmp_path / "manifests"), truth(places[0]), tmp_path)
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error"))
    assert done.returncode == 2 and "got only benchmark-detect-oblique, expected one of" in line
    assert not (tmp_path / "out").exists()


def test_frames_that_are_not_those_of_the_manifest_are_refused(places, make_dataset, tmp_path):
    data, manifests = places
    make_dataset(tmp_path / "a/benchmark-detect-mare", "detect", splits={"test": 2}, n_frames=4, seed=5)
    shutil.copytree(data / "benchmark-detect-mare", tmp_path / "b/benchmark-detect-highland")
    for name, message in (("a", "content_sha256"), ("b", "content_sha256"), ("c", "no dataset")):
        done = submitted((tmp_path / name, manifests), truth(data), tmp_path)
        assert done.returncode == 2 and message in done.stderr and not (tmp_path / "out").exists()
    done = submitted((data, tmp_path / "none"), truth(data), tmp_path)
    assert done.returncode == 2 and "none/benchmark-detect-highland" in done.stderr


def without(name):
    return lambda table: table.drop_columns([name])


def with_value(name, value):
    def change(table):
        values = [value, *table[name].to_pylist()[1:]]
        return table.set_column(table.schema.get_field_index(name), name, pa.array(values, table[name].type))

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("score"), "columns: got no score"),
        (with_value("dataset", "large"), "dataset: row 0: got 'large'"),
        (with_value("frame_id", "s000/t000/999999"), "frame_id: row 0: got 's000/t000/999999'"),
        (with_value("score", 1.5), "score: row 0: got 1.5"),
        (with_value("score", None), "score: row 0: got nothing"),
        (with_value("x0_px", float("nan")), "x0_px: row 0: got nothing"),
        (with_value("x1_px", -1e9), "x1_px: row 0: got -1000000000.0, expected a finite number above x0_px"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(change, message, places, tmp_path):
    done = submitted(places, change(truth(places[0])), tmp_path)
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error"))
    assert done.returncode == 2 and message in line and not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [None, b"no parquet"])
def test_a_file_that_is_no_table_is_refused_in_one_line(content, places, tmp_path):
    if content is not None:
        (tmp_path / "mine.parquet").write_bytes(content)
    done = call(places, "--detections", tmp_path / "mine.parquet", "--threshold", "0.5", "--out", tmp_path / "out")
    assert done.returncode == 2 and "mine.parquet: " in done.stderr and not (tmp_path / "out").exists()


def test_detections_come_back_by_frame_and_score(places, tmp_path, no_pictures):
    """The order of rows does not matter."""
    table = truth(places[0])
    scores = np.linspace(0.1, 1, len(table))
    table = table.set_column(table.schema.get_field_index("score"), "score", pa.array(scores))
    order = np.random.default_rng(0).permutation(len(table))
    for name, rows in (("a", table), ("b", table.take(pa.array(order)))):
        (tmp_path / name).mkdir()
        assert submitted(places, rows, tmp_path / name).returncode == 0
    first, second = (json.loads((tmp_path / name / "out/benchmark.json").read_text()) for name in ("a", "b"))
    assert {key: value for key, value in first.items() if key.startswith(("visible/", "paper/"))} == {
        key: value for key, value in second.items() if key.startswith(("visible/", "paper/"))
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--run", "a", "--detections", "b"], "both --run and --detections"),
        (["--detections", "b"], "--threshold"),
        (["--run", "a", "--threshold", "0.5"], "a run has its own threshold"),
        (["--detections", "b", "--threshold", "2"], "a number from 0 to 1"),
        (["--run", "no-such-run"], "no-such-run: run: got no such folder"),
    ],
)
def test_wrong_options_are_refused_in_one_line(arguments, message, places):
    done = call(places, *arguments)
    assert done.returncode == 2 and message in done.stderr and "Traceback" not in done.stderr
