"""Terrain that a network was fitted to: stored, carried along, and kept out of test splits."""

import json

import cv2
import pyarrow.parquet as pq
import pytest
import torch
from tests.helpers.stored_run import store_run
from tests.helpers.terrain_record import store_record, uses_of
from typer.testing import CliRunner

from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.metadata import recipes_of
from perilune_shared.errors import UserError
from perilune_train.cli.main import app
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.deploy.export import ExportedFiles, export_run
from perilune_train.detect.evaluate.split_evaluation import WRITTEN
from perilune_train.detect.evaluate_runs import compare_folders
from perilune_train.detect.train.detect_run import run_detect
from perilune_train.detect.train.transfer import inherited_terrain
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.records.provenance import (
    UNKNOWN,
    Provenance,
    TerrainUse,
    check_calibration,
    check_terrain,
    read_provenance,
    split_terrain,
    training_provenance,
)
from perilune_train.training import runs
from perilune_train.training.runs import NamedRun

QUICK = ("detect.epochs=1", "detect.width=0.125", "detect.precision=float32", "detect.device=cpu")
ELSEWHERE = TerrainUse("elsewhere", "scene-0007", "trained", "ab" * 32, "elsewhere")


def settings(*more):
    return resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*QUICK, *more))


def stored(folder, uses):
    """A run without training whose checkpoint has this record; None leaves it out."""
    root = store_run(folder, "evaluation.min_score=0.9")
    if uses is not None:
        store_record(runs.RunFolder(root).best, uses)
    return root


def call(*arguments):
    return CliRunner().invoke(app, ["detect", *map(str, arguments)], catch_exceptions=False)


def evaluated(run, dataset, *more):
    result = call("evaluate", "--run", run, "--dataset", dataset, *more)
    assert result.exit_code == 0, result.output
    return run / "evaluation"


@pytest.fixture(scope="module")
def overlapping(dataset_detect, tmp_path_factory):
    """A run that was trained on the test terrain in another dataset."""
    return stored(tmp_path_factory.mktemp("overlapping"), uses_of(dataset_detect, "test"))


@pytest.fixture(scope="module")
def allowed(overlapping, dataset_detect):
    """Its evaluation with --allow-overlap."""
    return evaluated(overlapping, dataset_detect, "--allow-overlap")


@pytest.mark.usefixtures("no_pictures")
def test_training_stores_its_terrain_and_that_of_the_network_it_starts_from(dataset_detect, tmp_path):
    parent = stored(tmp_path / "parent", [ELSEWHERE]) / "checkpoints" / "best.ckpt"
    run = run_detect(settings(f"detect.init_from={parent}"), dataset_detect, tmp_path, "child")
    record = read_provenance(runs.load_weights(run.best), run.best)
    own = {(use.scene_id, use.use) for use in record.uses if use.dataset == "test"}
    assert own == {
        ("s000", "trained"),
        ("s001", "trained"),
        ("s002", "trained"),
        ("s003", "selected"),
        ("s004", "tested"),
    }
    assert ELSEWHERE in record.uses and record.known
    metrics = json.loads(run.metrics.read_text())
    assert (metrics["terrain/status"], metrics["terrain/mark"]) == ("disjoint", "")
    assert metrics["dataset/protocol"] == "held-out scenes"
    # A run that is resumed takes the record from its last state.
    assert inherited_terrain(settings(), run.last) == [record]
    # One from before the record has unknown terrain.
    older = {key: value for key, value in torch.load(run.last, weights_only=True).items() if key != "terrain"}
    torch.save(older, run.last)
    assert inherited_terrain(settings(), run.last) == [UNKNOWN]


@pytest.mark.parametrize("key", ["init_from", "teacher"])
def test_training_refuses_a_network_that_knows_the_test_terrain(key, overlapping, dataset_detect, tmp_path):
    best = overlapping / "checkpoints" / "best.ckpt"
    with pytest.raises(UserError, match=r"test terrain.*s004 = elsewhere/s004 \(trained\).*--allow-overlap") as error:
        run_detect(settings(f"detect.{key}={best}"), dataset_detect, tmp_path, "child")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "detect").exists()


def test_evaluation_refuses_terrain_of_the_training(overlapping, dataset_detect, tmp_path):
    with pytest.raises(UserError, match=r"s004 = elsewhere/s004"):
        call("evaluate", "--run", overlapping, "--dataset", dataset_detect, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_overlap_that_is_let_through_marks_everything(allowed):
    metrics = json.loads((allowed / "metrics.json").read_text())
    assert metrics["terrain/status"] == "overlap" and "s004 = elsewhere/s004" in metrics["terrain/mark"]
    page = (allowed / "report.md").read_text()
    assert page.index("TERRAIN OVERLAP") < page.index("- run") and "## All frames (TERRAIN OVERLAP)" in page
    for name in WRITTEN:
        path = allowed / name
        if path.suffix == ".png":
            blue, green, red = cv2.imread(str(path))[1, 1].astype(int)
            assert red > 150 and max(blue, green) < 80, name
        if path.suffix == ".parquet":
            assert b"TERRAIN OVERLAP" in pq.read_schema(path).metadata[b"terrain_mark"], name


def test_compare_refuses_figures_on_terrain_of_the_training(allowed, tmp_path):
    with pytest.raises(UserError, match=r"TERRAIN OVERLAP"):
        compare_folders([allowed], tmp_path)
    assert not (tmp_path / "compare.md").exists()
    compare_folders([allowed], tmp_path, allow_overlap=True)
    assert "TERRAIN OVERLAP" in (tmp_path / "compare.md").read_text()
    assert cv2.imread(str(tmp_path / "precision_recall.png"))[1, 1][2] > 150


@pytest.mark.usefixtures("no_pictures")
def test_a_checkpoint_without_a_record_is_marked_as_unknown(dataset_detect, tmp_path):
    folder = evaluated(stored(tmp_path, None), dataset_detect)
    assert json.loads((folder / "metrics.json").read_text())["terrain/status"] == "unknown"
    assert "TRAINING TERRAIN UNKNOWN" in (folder / "report.md").read_text()


def test_a_threshold_chosen_on_the_test_terrain_is_refused(dataset_detect):
    dataset = open_dataset(dataset_detect)
    same = frozenset(
        TerrainUse("test", u.scene_id, "calibrated", u.sha256, "test") for u in uses_of(dataset_detect, "test")
    )
    with pytest.raises(UserError, match=r"calibrated"):
        check_terrain(Provenance(same), dataset)
    assert check_terrain(training_provenance(dataset), dataset).status == "disjoint"


def test_terrain_that_the_protocol_shares_is_declared_by_its_name(dataset_nav):
    dataset = open_dataset(dataset_nav)
    assert check_terrain(training_provenance(dataset), dataset).status == "by protocol"
    with pytest.raises(UserError, match=r"elsewhere/s000 \(trained\)"):
        check_terrain(Provenance(uses_of(dataset_nav, "train")), dataset)


@pytest.fixture
def named(dataset_nav):
    """The navigation dataset as if from a configuration of this name with `shared_terrain`."""

    def change(name):
        info = open_dataset(dataset_nav).info
        recipe = info.recipe().model_copy(update={"config": {"name": name, "shared_terrain": True}})
        changed = {"name": f"perilune-{name}-{info.kind}", "recipes": recipes_of(recipe)}
        return Dataset(dataset_nav, info.model_copy(update=changed))

    return change


@pytest.mark.parametrize("name", ["p" * 300, "a\x1b[2J", 7, None])
def test_a_record_can_be_read_whatever_a_configuration_is_called(named, name, tmp_path):
    dataset = named("paper")
    (key,) = dataset.info.recipes
    dataset.info.recipes[key].config["name"] = name
    record = training_provenance(dataset)
    assert read_provenance({"terrain": record.plain()}, tmp_path / "best.ckpt") == record


def test_the_papers_two_datasets_are_one_landing_area(named, dataset_nav):
    """The detector's terrain is by design that of the navigator's test, but only under the same name."""
    detect = named("paper")
    nav = Dataset(dataset_nav, detect.info.model_copy(update={"name": "perilune-paper-nav"}))
    assert check_terrain(training_provenance(detect), nav).status == "by protocol"
    with pytest.raises(UserError, match=r"test terrain"):
        check_terrain(training_provenance(named("other")), nav)


def test_export_refuses_to_calibrate_on_terrain_that_the_run_was_tested_on(dataset_detect, tmp_path):
    tested = stored(tmp_path, uses_of(dataset_detect, "train", "tested"))
    with pytest.raises(UserError, match=r"elsewhere/s000 = test/s000 \(calibrated\)"):
        export_run(tested, tmp_path / "flight", ExportedFiles(size_px=96, int8=True), dataset_detect)
    assert not (tmp_path / "flight").exists()


def test_calibration_on_training_frames_of_the_own_dataset_is_fine(dataset_detect):
    dataset = open_dataset(dataset_detect)
    own = split_terrain(dataset, "train", "calibrated") | split_terrain(dataset, "val", "calibrated")
    assert check_calibration(training_provenance(dataset), own, dataset).status == "disjoint"


def test_navigation_refuses_a_backbone_that_knows_the_test_terrain(dataset_nav, tmp_path):
    detector = stored(tmp_path / "detector", uses_of(dataset_nav, "test")) / "checkpoints" / "best.ckpt"
    network = {
        "size_px": 64,
        "width": 0.125,
        "hidden": 16,
        "attention": "cbam_last",
        "coarse_epochs": 0,
        "fine_epochs": 1,
        "learning_rate": 1e-3,
    }
    expected = NavigateConfig(device="cpu", warp=network, stack=network)
    with pytest.raises(UserError, match=r"s000 = elsewhere/s000"):
        navigate_run(expected, dataset_nav, NamedRun(tmp_path, "a"), detector)
    assert not (tmp_path / "navigate").exists()


@pytest.mark.parametrize(
    "record",
    [
        "text",
        {"known": True},
        {"known": 1, "uses": []},
        {"known": True, "uses": "rows"},
        {"known": True, "uses": [["a", "b", "trained", "ab" * 32]]},
        {"known": True, "uses": [["a", "b", "seen", "ab" * 32, "a"]]},
        {"known": True, "uses": [["a", "b", "trained", "AB" * 32, "a"]]},
        {"known": True, "uses": [["a\x1b[2J", "b", "trained", "ab" * 32, "a"]]},
        {"known": True, "uses": [["a", 3, "trained", "ab" * 32, "a"]]},
    ],
)
def test_a_malformed_record_is_refused(record, tmp_path):
    with pytest.raises(UserError, match=r"terrain"):
        read_provenance({"terrain": record}, tmp_path / "best.ckpt")
