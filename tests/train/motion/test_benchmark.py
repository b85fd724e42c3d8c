"""A navigator on the locked benchmark."""

import json

import pandas as pd
import pytest
from tests.helpers import in_process

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.subset import subset
from perilune_train.cli.main import main


@pytest.fixture
def run(navigated):
    return navigated / "a"


@pytest.fixture(scope="module")
def places(make_dataset, tmp_path_factory):
    """A rendered benchmark of two parts (three and two scenes, four frames each), and its manifests."""
    folder = tmp_path_factory.mktemp("benchmark")
    for name, n_scenes, seed in (("benchmark-nav-highland", 3, 31), ("benchmark-nav-camera", 2, 32)):
        made = make_dataset(folder / "data" / name, "nav", splits={"test": n_scenes}, n_frames=4, seed=seed)
        subset(open_dataset(made), folder / "manifests" / name, images="none")
    return folder / "data", folder / "manifests"


def call(places, *arguments):
    data, manifests = places
    return in_process.call(main, "navigate", "benchmark", "--data", data, "--manifests", manifests, *arguments)


@pytest.mark.usefixtures("no_pictures")
def test_all_methods_are_scored_over_all_scenes(run, places, tmp_path):
    done = call(places, "--run", run, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "out/benchmark.json").read_text())
    pairs = pd.read_parquet(tmp_path / "out/errors.parquet")
    for method, own in pairs.groupby("method"):
        rms = float((own["position_error_m"] ** 2).mean() ** 0.5)
        assert figures[f"{method}/position_rmse_vector_m"] == pytest.approx(rms)
        camera = own[own["scene_id"].str.startswith("benchmark-nav-camera/")]
        rms = float((camera["position_error_m"] ** 2).mean() ** 0.5)
        assert figures[f"{method}/region/other camera/position_rmse_vector_m"] == pytest.approx(rms)
    assert figures["headline/position_rmse_vector_m"] == figures["warp/position_rmse_vector_m"]
    assert figures["warp/region/highland/scenes"] == 3 and "warp/position_rmse_vector_m_low" in figures
    page = (tmp_path / "out/benchmark.md").read_text()
    assert "`benchmark-nav-highland`: all frames" in page and "`benchmark-nav-mare`: **not scored**" in page
    assert "| other camera |" in page and "klt" in page


@pytest.mark.usefixtures("no_pictures")
def test_without_a_run_alignment_is_the_headline(places, tmp_path):
    done = call(places, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    figures = json.loads((tmp_path / "out/benchmark.json").read_text())
    assert figures["headline/position_rmse_vector_m"] == figures["alignment/position_rmse_vector_m"]
    assert (figures["headline/method"], figures["scored"]) == ("alignment", "alignment")
    page = (tmp_path / "out/benchmark.md").read_text()
    assert "direct alignment." in page and "this network" not in page and "| other camera |" in page


def test_mistakes(run, places, dataset_detect, tmp_path):
    for arguments, message in (
        (("--run", tmp_path / "none"), "no such file"),
        (("--run", run, "--data", tmp_path / "none"), "benchmark-nav-highland"),
    ):
        done = call(places, *arguments, "--out", tmp_path / "out")
        assert done.returncode == 2 and message in done.stderr and not (tmp_path / "out").exists()
        assert len(done.stderr.strip().splitlines()) == 1
