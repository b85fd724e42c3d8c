"""All methods over a rendered dataset, from the command to its page."""

import json

import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process

from perilune_shared.storage.files import sha256_of
from perilune_train.cli.main import main
from perilune_train.landing.methods.absolute import on_the_same_frames


def methods(*arguments):
    return in_process.call(main, "navigate", "methods", *arguments)


@pytest.mark.slow
def test_a_page_with_every_method(quick, mapped, tmp_path):
    out = tmp_path / "methods"
    done = methods("--dataset", quick / "nav", "--map", mapped, "--out", out)
    assert done.returncode == 0, done.stderr
    rows = pd.read_parquet(out / "navigation.parquet").set_index("method")
    expected = {
        "klt",
        "klt_gyroscope",
        "alignment",
        "alignment_gyroscope",
        "nominal",
        "fix",
        "filter",
        "smoother",
        "filter, exact catalogue",
        "filter, map",
    }
    assert expected <= set(rows.index)
    assert rows.loc["filter, map", "n_frames"] == rows.loc["filter", "n_frames"]
    page = (out / "methods.md").read_text(encoding="utf-8")
    assert all(f"`{method}`" in page for method in rows.index)
    assert "terrain" not in page.split("##")[0]
    frames = pd.read_parquet(out / "frames.parquet")
    flown = frames[frames["method"] == "filter"]
    assert len(flown) == rows.loc["filter", "n_frames"]
    assert np.isclose(np.sqrt(np.mean(flown["error_m"] ** 2)), rows.loc["filter", "position_rmse_m"])
    for name in ("altitude.png", "flights.png"):
        assert (out / name).stat().st_size > 10_000
        assert f"]({name})" in page
    record, inputs = (json.loads((out / name).read_text()) for name in ("metrics.json", "inputs.json"))
    assert record["split"] == "test" and "torch" in record["run/versions"] and record["run/commit"]
    assert inputs["dataset"] == sha256_of(quick / "nav/dataset.json") and "detector" in inputs
    again = methods("--dataset", quick / "nav", "--out", out)
    assert again.returncode == 2
    assert len(again.stderr.strip().splitlines()) == 1


def test_mistakes_get_one_line(tmp_path):
    for arguments, words in (
        (["--dataset", tmp_path / "nowhere"], ["nowhere", "no such file"]),
        (["--dataset", tmp_path, "--split", "tset"], ["--split", "tset", "one of train, val, test"]),
    ):
        done = methods(*arguments, "--out", tmp_path / "out")
        assert done.returncode == 2
        assert len(done.stderr.strip().splitlines()) == 1
        assert all(word in done.stderr for word in words)
        assert not (tmp_path / "out").exists()


def test_fixes_and_filter_are_compared_on_equal_frames():
    frames = {"scene_id": ["a"] * 4, "trajectory_id": ["t"] * 4}
    fix = pd.DataFrame({**frames, "error_m": [3.0, np.nan, 4.0, 90.0], "error_px": [1.0, np.nan, 1.0, 30.0]})
    flown = pd.DataFrame({**frames, "error_m": [1.0, 50.0, 5.0, 2.0]})
    (compared,) = on_the_same_frames({"fix": fix, "filter": flown}).values()
    assert compared["n_frames"] == 2
    assert compared["fix_rmse_m"] == pytest.approx(np.sqrt((9 + 16) / 2))
    assert compared["filter_rmse_m"] == pytest.approx(np.sqrt((1 + 25) / 2))
    assert compared["filter_better_share"] == 0.75
    assert on_the_same_frames({"fix": fix}) == {}
