"""The command `navigate map` over a rendered survey; tests/train/landing/methods uses its catalogues."""

import json
import shutil

import pandas as pd
from tests.helpers import in_process

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.pack import pack
from perilune_shared.editing.subset import subset
from perilune_train.cli.main import main


def test_a_catalogue_with_its_errors(mapped):
    craters = pd.read_parquet(mapped / "scene-0000.parquet")
    assert list(craters.columns) == ["x_m", "y_m", "z_m", "diameter_m", "score"]
    assert len(craters) > 100
    assert craters["diameter_m"].is_monotonic_decreasing
    errors = pd.read_parquet(mapped / "errors.parquet").set_index("diameter_m")
    assert errors["mapped"].sum() == len(craters)
    middle = errors.loc["20 to 40"]
    assert middle["true_share"] > 0.7
    assert middle["position_rmse_m"] < 4.0
    page = (mapped / "map.md").read_text(encoding="utf-8")
    assert "scene-0000" in page and "](map.png)" in page
    stated = json.loads((mapped / "map.json").read_text(encoding="utf-8"))["scenes"]["scene-0000"]
    assert stated["craters"] == len(craters)
    assert stated["sun_elevation_deg"] == 30.0


def test_damaged_maps_get_one_line(mapped, quick, tmp_path):
    def damaged(name, text):
        folder = tmp_path / name
        shutil.copytree(mapped, folder)
        (folder / "map.json").write_text(text, encoding="utf-8")
        return folder

    good = json.loads((mapped / "map.json").read_text(encoding="utf-8"))
    other = json.loads(json.dumps(good))
    other["scenes"]["scene-0000"]["content_sha256"] = "0" * 64
    renamed = {"scenes": {"../../etc/passwd": good["scenes"]["scene-0000"]}}
    for folder, words in (
        (tmp_path / "nowhere", ["map.json", "no such file"]),
        (damaged("cut", json.dumps(good)[:-20]), ["map.json", "JSONDecodeError"]),
        (damaged("list", "[1]"), ["map.json", "TypeError"]),
        (damaged("other", json.dumps(other)), ["content_sha256", "the ground of the dataset"]),
        (damaged("renamed", json.dumps(renamed)), ["map.json", "scenes"]),
        (damaged("nan", json.dumps(good).replace('"position_sigma_m": ', '"position_sigma_m": -')), ["deviations"]),
    ):
        done = in_process.call(
            main, "navigate", "methods", "--dataset", quick / "nav", "--map", folder, "--out", tmp_path / "out"
        )
        assert done.returncode == 2, folder
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert all(word in done.stderr for word in words), done.stderr
        assert not (tmp_path / "out").exists()


def test_frames_of_a_descent_make_no_map(quick, tmp_path):
    done = in_process.call(main, "navigate", "map", "--dataset", quick / "nav", "--out", tmp_path / "out")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert "perilune-render survey" in done.stderr
    assert not (tmp_path / "out").exists()


def test_an_unfinished_survey_makes_no_map(quick_survey, tmp_path):
    """A rendering that was stopped before its first frame leaves a valid dataset without frames."""
    begun = tmp_path / "begun"
    shutil.copytree(quick_survey, begun)
    info = json.loads((begun / "dataset.json").read_text(encoding="utf-8"))
    info["complete"], info["counts"] = False, dict.fromkeys(info["counts"], 0)
    (begun / "dataset.json").write_text(json.dumps(info), encoding="utf-8")
    for name in ("manifest", "index"):
        shutil.rmtree(begun / name)
    done = in_process.call(main, "navigate", "map", "--dataset", begun, "--out", tmp_path / "out")
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr, done.stderr
    assert "frames" in done.stderr and not (tmp_path / "out").exists()


def test_a_survey_without_frames_and_a_packed_one(quick_survey, mapped, tmp_path):
    survey = open_dataset(quick_survey)
    subset(survey, tmp_path / "absent", images="none")
    done = in_process.call(main, "navigate", "map", "--dataset", tmp_path / "absent", "--out", tmp_path / "out")
    assert done.returncode == 2
    # The line before it is the progress bar.
    *_, last = done.stderr.strip().splitlines()
    assert last.startswith("error: ") and "a dataset with frames" in last
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
    pack(survey, tmp_path / "packed")
    done = in_process.call(main, "navigate", "map", "--dataset", tmp_path / "packed", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    craters, expected = (pd.read_parquet(folder / "scene-0000.parquet") for folder in (tmp_path / "out", mapped))
    pd.testing.assert_frame_equal(craters, expected)
