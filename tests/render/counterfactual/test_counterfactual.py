"""The command `counterfactual`: frames of a dataset again, without some craters or under another Sun."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_render.terrain.craters.removal import REACH_RADII
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import camera_from_site
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.validation.validate import validate


def counterfactual(*arguments):
    return in_process.call(main, "counterfactual", *arguments)


@pytest.fixture(scope="module")
def made(quick, tmp_path_factory) -> Path:
    """Three test frames of `tiny` without three of its craters."""
    out = tmp_path_factory.mktemp("counterfactual") / "without"
    done = counterfactual(*command(quick, out))
    assert done.returncode == 0, done.stderr
    assert "3 craters removed" in done.stdout.replace("\n", " ")
    return out


def command(quick, out, n_craters=3):
    numbers = ["--craters-per-scene", n_craters, "--frames-per-trajectory", 3]
    return ["--manifest", quick / "detect", "--out", out, *numbers, "--workers", 0]


def removed_craters(made: Path) -> pd.DataFrame:
    return pd.read_parquet(made.with_name(f"{made.name}.removed.parquet"))


def frames(dataset):
    return {row["frame_id"]: row for row in dataset.table("frames").to_pylist()}


def image(folder: Path, row) -> np.ndarray:
    return cv2.imread(str(folder / row["png_path"]), cv2.IMREAD_UNCHANGED).astype(int)


def test_it_is_a_valid_dataset_of_the_same_frames(quick, made):
    before, after = open_dataset(quick / "detect"), open_dataset(made)
    assert validate(after) == []
    same = ("split", "time_s", "position_m", "rotation_wxyz", "velocity_mps", "sun_direction", "frame_index")
    old, new = frames(before), frames(after)
    assert [row["frame_index"] for row in new.values()] == [0, 4, 7]
    for frame_id, row in new.items():
        assert [row[name] for name in same] == [old[frame_id][name] for name in same]
        assert row["split"] == "test"
    (recipe,) = after.info.recipes.values()
    assert "counterfactual" not in before.info.recipe().config
    table = removed_craters(made)
    assert recipe.config["counterfactual"]["removed"] == {str(table["seed"][0]): table["crater_id"].tolist()}


def test_removed_craters_are_of_the_dataset_and_apart(quick, made):
    table = removed_craters(made)
    craters = open_dataset(quick / "detect").table("craters").to_pandas()
    rows = table.merge(craters, on=["scene_id", "crater_id"], validate="one_to_one")
    assert len(table) == len(rows) == 3
    assert np.array_equal(rows["x_m_x"], rows["x_m_y"]) and np.array_equal(rows["diameter_m_x"], rows["diameter_m_y"])
    assert np.allclose(rows["depth_ratio"], rows["depth_m"] / rows["diameter_m_y"])
    assert (table["reach_m"] >= REACH_RADII * table["diameter_m"] / 2).all() and (table["n_frames"] >= 1).all()
    for i in range(3):
        for j in range(i):
            one, two = table.iloc[i], table.iloc[j]
            assert np.hypot(one.x_m - two.x_m, one.y_m - two.y_m) >= one.reach_m + two.reach_m


def test_labels_lack_the_removed_craters_alone(quick, made):
    key = ["frame_id", "crater_id"]
    gone = set(removed_craters(made)["crater_id"])
    before, after = (open_dataset(folder).table("labels").to_pandas() for folder in (quick / "detect", made))
    before = before[before["frame_id"].isin(after["frame_id"])]
    assert gone & set(before["crater_id"]) and not gone & set(after["crater_id"])
    both = before.merge(after, on=key, how="outer", suffixes=("", "_after"), indicator=True)
    lost = both[~both["crater_id"].isin(gone) & (both["_merge"] != "both")]
    assert len(lost) < 0.02 * len(before)
    both = both[both["_merge"] == "both"]
    # Rims on the changed ground are measured again; all others stay as they are.
    assert (both["ellipse_cx_px"] == both["ellipse_cx_px_after"]).mean() > 0.8


@pytest.mark.slow
def test_images_of_blender_change_at_removed_craters_of_a_few_pixels(tiny, tmp_path):
    done = counterfactual(*command(tiny, tmp_path / "without"))
    assert done.returncode == 0, done.stderr
    check_images_change(tiny, tmp_path / "without", 2)


def test_images_change_at_the_removed_craters(quick, made):
    # A smaller crater has few vertices on the coarse ground of `quick`.
    check_images_change(quick, made, 4)


def check_images_change(rendered, made, least_radius_px):
    before, after = open_dataset(rendered / "detect"), open_dataset(made)
    old, table, camera = frames(before), removed_craters(made), after.info.camera.intrinsics()
    z_m = before.table("craters").to_pandas().merge(table, on=["scene_id", "crater_id"])["z_m"].to_numpy()
    row_px, column_px = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    changed_within = n_checked = 0
    for frame_id, row in frames(after).items():
        change = np.abs(image(made, row) - image(rendered / "detect", old[frame_id]))
        centres = np.column_stack([table["x_m"], table["y_m"], z_m])
        in_camera = camera_from_site(centres, row["position_m"], matrix_from_quaternion(row["rotation_wxyz"]))
        radius_px = camera.fx_px * table["diameter_m"].to_numpy() / 2 / in_camera[:, 2]
        reach = table["reach_m"].to_numpy() / (table["diameter_m"].to_numpy() / 2)
        far = np.ones(change.shape, bool)
        for (x, y), radius, reach_radii in zip(camera.project(in_camera), radius_px, reach, strict=True):
            distance = np.hypot(column_px - x, row_px - y)
            far &= distance > (reach_radii + 0.5) * radius + 2
            if camera.inside(np.array([[x, y]]))[0] and radius > least_radius_px:
                changed_within += bool((change[distance < 1.5 * radius] > 5).any())
                n_checked += 1
        # Beyond, only the automatic exposure may change.
        assert far.sum() > 100 and change[far].max() <= 1
    assert n_checked >= 1 and changed_within == n_checked


def test_without_a_change_frames_are_byte_identical(quick, tmp_path):
    done = counterfactual(*command(quick, tmp_path / "out", n_craters=0))
    assert done.returncode == 0, done.stderr
    old, new = frames(open_dataset(quick / "detect")), frames(open_dataset(tmp_path / "out"))
    assert len(new) == 3
    assert all(row["png_sha256"] == old[frame_id]["png_sha256"] for frame_id, row in new.items())
    assert not len(removed_craters(tmp_path / "out"))


def test_it_is_resumed_and_rendered_again_from_its_manifest(quick, made, tmp_path):
    again = counterfactual(*command(quick, made))
    assert again.returncode == 0, again.stderr
    other = counterfactual(*command(quick, made), "--seed", 7)
    assert other.returncode == 2 and "counterfactual.removed" in other.stderr
    done = in_process.call(main, "dataset", "--manifest", made, "--out", tmp_path / "again", "--workers", 0)
    assert done.returncode == 0, done.stderr
    assert "3 of 3 frames are byte-identical" in done.stdout
    verified = in_process.call(main, "regenerate", "--manifest", made, "--verify", "--sample", 1)
    assert verified.returncode == 0 and "1 identical" in verified.stdout


def test_a_turned_sun_changes_the_light_alone(quick, tmp_path):
    out = tmp_path / "sun"
    done = counterfactual(*command(quick, out, n_craters=0), "--sun-azimuth-offset-deg", 40)
    assert done.returncode == 0, done.stderr
    before, after = open_dataset(quick / "detect"), open_dataset(out)
    old, new = ({row["scene_id"]: row for row in one.table("scenes").to_pylist()} for one in (before, after))
    for scene_id, row in new.items():
        assert (row["sun_azimuth_deg"] - old[scene_id]["sun_azimuth_deg"]) % 360 == pytest.approx(40)
        assert row["sun_elevation_deg"] == old[scene_id]["sun_elevation_deg"]
        assert row["content_sha256"] == old[scene_id]["content_sha256"]
    for frame_id, row in frames(after).items():
        assert row["png_sha256"] != frames(before)[frame_id]["png_sha256"]


def test_shallower_craters_keep_their_labels_and_the_recipe_says_so(quick, made, tmp_path):
    out = tmp_path / "half"
    done = counterfactual(*command(quick, out), "--depth-share", 0.5)
    assert done.returncode == 0, done.stderr
    assert "3 craters reduced to 0.5 of their depth" in done.stdout.replace("\n", " ")
    before, gone, after = open_dataset(quick / "detect"), open_dataset(made), open_dataset(out)
    assert "depth_share" not in gone.info.recipe().config["counterfactual"]
    assert after.info.recipe().config["counterfactual"]["depth_share"] == 0.5
    pd.testing.assert_frame_equal(removed_craters(out), removed_craters(made))
    keys = ["scene_id", "crater_id"]
    changed = removed_craters(out)[keys]
    depths = [
        changed.merge(each.table("craters", [*keys, "depth_m"]).to_pandas(), on=keys)["depth_m"]
        for each in (before, after)
    ]
    assert len(depths[1]) == 3 and (depths[1] / depths[0]).between(0.3, 0.7).all()
    for frame_id, row in frames(after).items():
        # The change of the frame is smaller than by removal.
        whole, without, half = (
            image(folder, frames(each)[frame_id])
            for folder, each in ((quick / "detect", before), (made, gone), (out, after))
        )
        assert 0 < np.abs(half - whole).sum() < np.abs(without - whole).sum()
        assert row["split"] == "test"


def test_as_many_craters_as_fit_are_removed(quick, tmp_path):
    numbers = ["--craters-per-scene", 500, "--frames-per-trajectory", 1]
    done = counterfactual("--manifest", quick / "detect", "--out", tmp_path / "out", *numbers, "--workers", 0)
    assert done.returncode == 0, done.stderr
    n_removed = len(removed_craters(tmp_path / "out"))
    assert 3 < n_removed < 500
    assert f"{n_removed} of 500 craters are removed" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--split", "all"], ["--split", "all"]),
        (["--craters-per-scene", -1], ["--craters-per-scene"]),
        (["--frames-per-trajectory", 0], ["--frames-per-trajectory"]),
        (["--sun-azimuth-offset-deg", 200], ["sun_azimuth_offset_deg", "200", "180"]),
        (["--depth-share", 1], ["--depth-share", "depth_share", "1"]),
        (["--out", "memory://bucket"], ["--out", "memory://bucket"]),
    ],
)
def test_options_that_cannot_be(quick, tmp_path, arguments, words):
    done = counterfactual("--manifest", quick / "detect", "--out", tmp_path / "out", *arguments)
    assert done.returncode == 2
    assert all(word in done.stderr for word in words), done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "out").exists()


def test_sources_that_cannot_be(quick_survey, made, tmp_path):
    plan = Path(__file__).parents[3] / "data_manifests" / "small-detect"
    for source, words in ((quick_survey, "a survey"), (made, "a counterfactual"), (plan, "no labels, as in a plan")):
        done = counterfactual("--manifest", source, "--out", tmp_path / "out", "--workers", 0)
        assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert words in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_preset_has_no_counterfactual(tmp_path):
    preset = ["dataset", "--preset", "tiny", "--out", tmp_path / "out", "--set"]
    for setting, words in (
        ("dataset.counterfactual.sun_azimuth_offset_deg=3", "perilune-render counterfactual"),
        ("dataset.counterfactual.remove={}", "removed"),
    ):
        done = in_process.call(main, *preset, setting)
        assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert words in done.stderr
    assert not (tmp_path / "out").exists()
