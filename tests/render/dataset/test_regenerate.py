"""Frames made again from a manifest alone: the same bytes, whatever was done to the manifest since."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from rich.progress import Progress
from tests.helpers import in_process
from tests.helpers.rendered import QUICK

from perilune_render.cli.main import main
from perilune_render.dataset.regenerate import exr_outlier_share, png_outlier_share, regenerate, spread
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.schema import complete
from perilune_shared.editing.diff import differences
from perilune_shared.editing.merge import merge
from perilune_shared.editing.pack import pack
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.editing.subset import subset
from perilune_shared.errors import UserError
from perilune_shared.validation.validate import validate

RENDER = str(Path(sys.executable).parent / "perilune-render")


def again(source, out, frame_ids):
    with Progress(disable=True) as progress:
        return regenerate(open_dataset(source), frame_ids, out, progress)


def run(*arguments):
    """In this process, where Blender is loaded once."""
    return in_process.call(main, *arguments)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """The plan of the detection dataset of `quick`, by the command line."""
    out = tmp_path_factory.mktemp("plan") / "quick"
    made = run("plan", "--preset", "tiny", "--kind", "detect", *QUICK, "--out", out)
    assert made.returncode == 0, made.stderr
    return out


@pytest.mark.slow
def test_frames_on_levels_of_ground_are_the_same_bytes(tmp_path):
    """Also from a manifest without the frames before them, which determine no level."""
    source, part = tmp_path / "source", tmp_path / "part"
    settings = ("terrain.max_vertices=150000", "detect.n_scenes=1", "detect.n_frames=6", "detect.val_share=0")
    chosen = [option for setting in settings for option in ("--set", f"dataset.{setting}")]
    size = ("--set", "dataset.camera.width_px=64", "--set", "dataset.camera.height_px=64")
    made = run("dataset", "--preset", "tiny", "--kind", "detect", "--out", source, *size, *chosen)
    assert made.returncode == 0, made.stderr
    subset(open_dataset(source / "detect"), part, ["frame_index in [1, 4]"], images="none")
    outcomes = again(part, tmp_path / "out", spread(open_dataset(part), 2))
    assert [outcome.state for outcome in outcomes] == ["identical", "identical"]


def test_after_merge_subset_and_split_the_bytes_are_the_same(quick, tmp_path):
    whole = open_dataset(quick / "detect")
    subset(whole, tmp_path / "a", ["frame_index < 3"], images="none")
    subset(whole, tmp_path / "b", ["frame_index > 5"], images="none")
    merge([open_dataset(tmp_path / name) for name in "ab"], tmp_path / "m")
    split_dataset(open_dataset(tmp_path / "m"), tmp_path / "s", Split(by="frame"))
    pack(open_dataset(tmp_path / "s"), tmp_path / "p")
    ids = ["scene-0001/trajectory-0000/000002", "scene-0002/trajectory-0000/000007"]
    outcomes = again(tmp_path / "p", tmp_path / "out", ids)
    assert [(o.frame_id, o.png, o.exr, o.same_ground) for o in outcomes] == [
        (frame_id, "identical", "identical", True) for frame_id in ids
    ]
    for frame_id in ids:
        for kind in ("png", "exr"):
            path = f"frames/{frame_id}.{kind}"
            assert (tmp_path / "out" / path).read_bytes() == (quick / "detect" / path).read_bytes()


def test_a_plan_is_the_dataset_before_it_is_rendered(quick, plan, tmp_path):
    planned, rendered = open_dataset(plan), open_dataset(quick / "detect")
    assert validate(planned) == [] and planned.info.images == "planned"
    found = {(each.table, each.column) for each in differences(planned, rendered)}
    hashes = {("frames", f"{kind}_{name}") for kind in ("png", "exr") for name in ("sha256", "bytes")}
    # Counted on the rendered frame.
    hashes |= {("frames", "real_ground_share"), ("frames", "n_craters_above_max_radius")}
    # A plan's recipe has the versions of the ground alone.
    keys = {*planned.info.recipes, *rendered.info.recipes}
    recipes = {("dataset.json", f"recipes.{key}") for key in keys} | {("scenes", "recipe")}
    assert len(keys) == 2 and found == hashes | recipes | {(name, "") for name in ("craters", "boulders", "labels")}
    frame_id = "scene-0001/trajectory-0000/000005"
    (outcome,) = again(plan, tmp_path, [frame_id])
    assert outcome.same_ground and outcome.state == "new"
    path = f"frames/{frame_id}.png"
    assert (tmp_path / path).read_bytes() == (quick / "detect" / path).read_bytes()


def test_part_of_a_manifest_is_rendered_with_its_labels(quick, plan, tmp_path):
    """Names, splits and gaps are the manifest's; frames and labels are those of the whole dataset."""
    cut = ["frame_index % 3 == 1", "split != 'val'"]
    subset(open_dataset(quick / "detect"), tmp_path / "hashed", cut, images="plan")
    split_dataset(
        open_dataset(tmp_path / "hashed"), tmp_path / "s", Split(by="trajectory", val_share=0, test_share=0.5)
    )
    made = run("dataset", "--workers", 0, "--manifest", tmp_path / "s", "--out", tmp_path / "out")
    assert made.returncode == 0, made.stderr
    n = len(open_dataset(tmp_path / "s").table("frames"))
    assert f"{n} of {n} frames are byte-identical to the manifest's; terrain hashes match" in made.stdout
    new, old = open_dataset(tmp_path / "out"), open_dataset(quick / "detect")
    assert validate(new) == [] and new.info.counts.scenes == 2
    ids = new.table("frames", ["frame_id"])["frame_id"]
    labels = old.table("labels").filter(pc.is_in(old.table("labels")["frame_id"], ids.combine_chunks()))
    assert new.table("labels").equals(labels)
    assert set(new.table("frames")["split"].to_pylist()) == {"train", "test"}
    again = run("dataset", "--workers", 0, "--manifest", tmp_path / "s", "--out", tmp_path / "out")
    assert again.returncode == 0 and f"{n} of {n}" in again.stdout
    for arguments, message in (
        (["--manifest", tmp_path / "s", "--set", "dataset.seed=3", "--out", tmp_path / "o"], "--set"),
        (["--manifest", tmp_path / "s"], "--out"),
        (["--manifest", tmp_path / "s", "--preset", "tiny", "--out", tmp_path / "o"], "--preset"),
        (["--manifest", tmp_path / "s", "--dem", __file__, "--out", tmp_path / "o"], "names no such file"),
        (["--manifest", tmp_path / "none", "--out", tmp_path / "o"], "no such file"),
    ):
        refused = run("dataset", *arguments)
        assert refused.returncode == 2 and message in refused.stderr and not (tmp_path / "o").exists()


def test_developed_frames_are_made_again_with_the_first_camera_ground(quick, tmp_path):
    changes = ("--set", "dataset.camera.horizontal_fov_deg=44", "--set", "dataset.sensor.bits=12")
    done = run("develop", "--dataset", quick / "detect", "--out", tmp_path / "d", *changes)
    assert done.returncode == 0, done.stderr
    (outcome,) = again(tmp_path / "d", tmp_path / "out", ["scene-0002/trajectory-0000/000004"])
    assert (outcome.png, outcome.exr, outcome.state) == ("identical", None, "identical") and outcome.same_ground


@pytest.mark.parametrize("made_by", ["quick", pytest.param("tiny", marks=pytest.mark.slow)])
def test_verify_counts_what_is_the_same(request, made_by):
    source = request.getfixturevalue(made_by) / "detect"
    made = run("regenerate", "--manifest", source, "--verify", "--sample", "3")
    assert made.returncode == 0 and "3 frames: 3 identical" in made.stdout


def test_a_frame_from_elsewhere_is_compared_and_reported(quick_detect, tmp_path):
    """As another machine would have rendered it: a few grey levels off, or another picture."""
    part = quick_detect / "manifest/frames/all.parquet"
    rows = pq.read_table(part).to_pandas()
    for row, shift in ((0, 1), (1, 40)):
        path = quick_detect / rows.at[row, "png_path"]
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.where(image < 200, image + shift, image).astype(np.uint8))
        rows.at[row, "png_sha256"] = "0" * 64
    pq.write_table(complete("frames", pa.Table.from_pandas(rows, preserve_index=False)), part)
    ids = [f"scene-0000/trajectory-0000/00000{k}" for k in range(3)]
    outcomes = again(quick_detect, tmp_path / "out", ids)
    assert [o.png for o in outcomes] == ["within tolerance", "different", "identical"]
    result = run(
        "regenerate", "--manifest", quick_detect, "--out", tmp_path / "o", "--frames", ids[0], "--frames", ids[1]
    )
    assert result.returncode == 2 and "1 within tolerance" in result.stdout and "1 different" in result.stdout


def test_another_ground_is_reported(quick_detect):
    part = quick_detect / "manifest/scenes/all.parquet"
    rows = pq.read_table(part).to_pandas()
    rows["content_sha256"] = "0" * 64
    pq.write_table(complete("scenes", pa.Table.from_pandas(rows, preserve_index=False)), part)
    result = run("regenerate", "--manifest", quick_detect, "--verify", "--frames", "scene-0001/trajectory-0000/000000")
    assert result.returncode == 2 and "1 identical" in result.stdout and "terrain hash mismatch" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--verify", "--frames", "scene-0001/trajectory-0000/000099"], "a frame of the manifest, such as scene-0000"),
        (["--frames", "scene-0001/trajectory-0000/000001"], "--out"),
        (["--frames", "scene-0001/trajectory-0000/000001", "--all", "--out", "x"], "one of them"),
        ([], "--verify"),
    ],
)
def test_mistakes_are_reported_in_one_line(quick, arguments, message):
    made = run("regenerate", "--manifest", quick / "detect", *arguments)
    assert made.returncode == 2 and message in made.stderr and len(made.stderr.strip().splitlines()) == 1


def changed_recipe(root, change):
    """Change the recipe of a dataset as somebody else might; its key follows."""
    path = root / "dataset.json"
    info = json.loads(path.read_text())
    (recipe,) = info["recipes"].values()
    change(recipe)
    path.write_text(json.dumps(info))


def test_a_recipe_opens_no_file_of_its_own_choice(quick_detect):
    changed_recipe(quick_detect, lambda recipe: recipe["config"]["terrain"].update(dem="/etc/passwd"))
    result = run("regenerate", "--manifest", quick_detect, "--verify")
    assert result.returncode == 2 and "recipes" in result.stderr
    info = open_dataset_with_right_key(quick_detect)
    with pytest.raises(UserError, match="--dem with a local copy"):
        again(info, quick_detect / "out", ["scene-0000/trajectory-0000/000000"])


def open_dataset_with_right_key(root):
    """Write the changed recipe under the key of its content, in dataset.json and in the scenes."""
    from perilune_shared.dataset.metadata import Recipe

    path = root / "dataset.json"
    info = json.loads(path.read_text())
    (content,) = info["recipes"].values()
    key = Recipe.model_validate(content).key
    path.write_text(json.dumps({**info, "recipes": {key: content}}))
    for part in (root / "manifest/scenes").glob("*.parquet"):
        rows = pq.read_table(part).to_pandas()
        rows["recipe"] = key
        pq.write_table(complete("scenes", pa.Table.from_pandas(rows, preserve_index=False)), part)
    return root


def test_a_sample_is_spread_over_all_scenes(quick):
    ids = spread(open_dataset(quick / "detect"), 3)
    assert len({frame_id.split("/")[0] for frame_id in ids}) == 3
    assert len(spread(open_dataset(quick / "detect"), 1000)) == 24


def test_distances_by_hand():
    grey = np.full((10, 100), 100, np.uint8)
    other = grey.copy()
    other[0, :3] = [102, 103, 90]
    one, two = (cv2.imencode(".png", image)[1].tobytes() for image in (grey, other))
    assert png_outlier_share(one, one) == 0 and png_outlier_share(one, two) == pytest.approx(0.002)
    assert png_outlier_share(one, cv2.imencode(".png", grey[:5])[1].tobytes()) == 1
    z = np.full((10, 10), 500, np.float32)
    off = z.copy()
    off[0, 0], off[0, 1] = 501, np.inf
    assert exr_outlier_share({"Z": z}, {"Z": off}) == pytest.approx(0.02) and exr_outlier_share({"Z": z}, {"R": z}) == 1


def test_nothing_is_left_of_a_failed_plan(tmp_path):
    made = run("plan", "--preset", "tiny", "--set", "dataset.terrain.dem=none.tif", "--out", tmp_path / "p")
    assert made.returncode == 2 and "none.tif" in made.stderr and list(tmp_path.iterdir()) == []
    (tmp_path / "full").mkdir()
    shutil.copy(__file__, tmp_path / "full")
    made = run("plan", "--preset", "tiny", "--out", tmp_path / "full")
    assert made.returncode == 2 and "--out" in made.stderr


@pytest.mark.slow
def test_ctrl_c_in_a_plan_leaves_nothing(tmp_path):
    """At any moment, growing included, where code that Numba compiled must not be torn."""
    out = tmp_path / "p"
    for seed, seconds in enumerate((0.0, 0.4, 0.8)):
        # Another seed each time: no scene may come from the cache.
        settings = (f"--set=dataset.seed={seed}", "--set=dataset.detect.n_scenes=30")
        command = [RENDER, "plan", "--preset", "tiny", *settings, "--out", str(out)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        deadline = time.monotonic() + 60
        while not any(tmp_path.iterdir()) and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        stderr = process.communicate(timeout=60)[1]
        assert process.returncode == 130 and "Traceback" not in stderr
        assert list(tmp_path.iterdir()) == []
