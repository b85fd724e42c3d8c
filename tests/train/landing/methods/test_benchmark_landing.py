"""Craters and filter on a locked benchmark of one rendered part."""

import json

import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.subset import subset
from perilune_train.cli.main import main


@pytest.fixture(scope="module")
def places(quick, tmp_path_factory):
    """The test descents of `tiny` as one part of a benchmark, and its manifest."""
    folder = tmp_path_factory.mktemp("landing")
    part = folder / "data" / "benchmark-nav-highland"
    subset(open_dataset(quick / "nav"), part, where=["split == 'test'"])
    subset(open_dataset(part), folder / "manifests" / part.name, images="none")
    return folder / "data", folder / "manifests"


def call(places, *arguments):
    data, manifests = places
    return in_process.call(main, "navigate", "benchmark-landing", "--data", data, "--manifests", manifests, *arguments)


def test_figures_are_those_of_the_frames(places, tmp_path):
    out = tmp_path / "out"
    done = call(places, "--out", out)
    assert done.returncode == 0, done.stderr
    figures = json.loads((out / "benchmark.json").read_text(encoding="utf-8"))
    frames = pd.read_parquet(out / "frames.parquet")
    flown = frames[frames["method"] == "filter"]
    rms = float(np.sqrt(np.mean(flown["error_m"] ** 2)))
    assert figures["filter/position_rmse_m"] == pytest.approx(rms)
    assert figures["filter/region/highland/position_rmse_m"] == pytest.approx(rms)
    assert set(flown["scene_id"]) == {"benchmark-nav-highland/scene-0000"}
    right = frames[(frames["method"] == "fix") & (frames["error_px"] < 5)]
    assert figures["fix/right_share"] == pytest.approx(len(right) / (frames["method"] == "fix").sum())
    assert figures["fix/same_frames/n_frames"] == len(right)
    page = (out / "benchmark.md").read_text(encoding="utf-8")
    assert "`benchmark-nav-highland`: all frames" in page
    assert "`benchmark-nav-mare`: **not scored**" in page
    assert "`filter, map`" not in page
    assert "## Fixes and filter on the same frames" in page
    assert (out / "altitude.png").stat().st_size > 10_000


def test_mistakes_get_one_line(places, tmp_path):
    for arguments, words in (
        (["--data", tmp_path / "none"], ["none", "benchmark-nav-highland"]),
        (["--detector", tmp_path / "none"], ["none"]),
    ):
        done = call(places, *arguments, "--out", tmp_path / "out")
        assert done.returncode == 2
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert all(word in done.stderr for word in words), done.stderr
        assert not (tmp_path / "out").exists()
