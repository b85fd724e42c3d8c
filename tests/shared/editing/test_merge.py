"""Merged datasets contain every frame once and are consistent."""

import shutil

import pyarrow.compute as pc
import pytest
from license_expression import get_spdx_licensing
from tests.helpers.drawn_dataset import build_dataset, seal
from tests.helpers.hostile import edit, rewrite

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.diff import differences
from perilune_shared.editing.licence import joined_licence
from perilune_shared.editing.merge import merge
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.editing.subset import subset
from perilune_shared.errors import UserError
from perilune_shared.export.stats import summary
from perilune_shared.validation.validate import validate


def merged(out, *sources, **options):
    merge([open_dataset(source) for source in sources], out, **options)
    made = open_dataset(out)
    assert validate(made) == []
    return made


def test_different_terrains_with_the_same_name_are_renamed(drawn, other, tmp_path):
    made = merged(tmp_path / "m", drawn, other)
    assert made.info.counts.frames == 80 and made.info.counts.scenes == 10 and made.info.split_by == "scene"
    assert "s000-2" in made.scene_ids()
    first, second = open_dataset(drawn), open_dataset(other)
    new = made.table("labels", ["radius_px"], scene_id="s000-2")
    assert new.equals(second.table("labels", ["radius_px"], scene_id="s000"))
    # Statistics are computed from all rows, not from those of the sources.
    rows = summary(made).set_index("split")
    assert rows.loc["train", "labels"] == sum(d.table("labels", split="train").num_rows for d in (first, second))
    path = made.table("frames", ["png_path"], scene_id="s000-2")["png_path"][3].as_py()
    assert made.file(path).read_bytes() == (other / "frames/s000/t000/000003.png").read_bytes()


def test_merging_both_halves_restores_the_dataset(drawn, tmp_path):
    whole = open_dataset(drawn)
    subset(whole, tmp_path / "even", ["frame_index % 2 == 0"])
    subset(whole, tmp_path / "odd", ["frame_index % 2 == 1"])
    made = merged(tmp_path / "m", tmp_path / "even", tmp_path / "odd", name="test")
    found = differences(whole, made)
    assert [each.column for each in found] == ["history"]


def test_merging_a_dataset_with_itself_changes_nothing(drawn, tmp_path):
    made = merged(tmp_path / "m", drawn, drawn)
    assert made.info.counts == open_dataset(drawn).info.counts


def test_a_frame_with_two_splits_keeps_the_first(drawn, tmp_path):
    split_dataset(open_dataset(drawn), tmp_path / "f", Split(by="frame", seed=3))
    made = merged(tmp_path / "m", tmp_path / "f", drawn)
    assert made.info.split_by == "frame"
    theirs = open_dataset(tmp_path / "f").table("frames", ["frame_id", "split"]).sort_by("frame_id")
    assert made.table("frames", ["frame_id", "split"]).sort_by("frame_id").equals(theirs)


def test_two_trajectories_over_one_terrain(tmp_path):
    build_dataset(tmp_path / "a", "nav", splits={"train": 2}, scenes=1, n_frames=3, craters=40)
    build_dataset(tmp_path / "b", "nav", splits={"train": 2}, scenes=1, n_frames=3, craters=40, jitter_m=9)
    with pytest.raises(UserError, match="a different position_m"):
        merged(tmp_path / "m", tmp_path / "a", tmp_path / "b")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


def test_frames_can_be_left_out(drawn, other, tmp_path):
    made = merged(tmp_path / "m", drawn, other, images="none")
    assert made.info.images == "absent" and not (tmp_path / "m/frames").exists()
    with pytest.raises(UserError, match="absent"):
        merged(tmp_path / "n", drawn, tmp_path / "m")
    again = merged(tmp_path / "n", drawn, tmp_path / "m", images="none")
    assert again.info.counts.frames == 80


def test_copies_and_links(drawn, other, tmp_path):
    merged(tmp_path / "l", drawn, other, images="link")
    merged(tmp_path / "c", drawn, other)
    relative = "frames/s000/t000/000000.png"
    assert (tmp_path / "l" / relative).samefile(drawn / relative)
    assert not (tmp_path / "c" / relative).samefile(drawn / relative)


def test_incompatible_datasets_are_refused(drawn, tmp_path):
    nav = build_dataset(tmp_path / "nav", "nav", splits={"train": 1}, n_frames=2, craters=40)
    small = build_dataset(tmp_path / "small", "detect", splits={"train": 1}, n_frames=2, craters=40, side_px=64)
    for source, field in ((nav, "kind"), (small, "camera")):
        with pytest.raises(UserError, match=field):
            merged(tmp_path / "m", drawn, source)
    with pytest.raises(UserError, match="at least two"):
        merged(tmp_path / "m", drawn)
    with pytest.raises(UserError, match="name"):
        merged(tmp_path / "m", drawn, drawn, name="<script>")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").touch()
    with pytest.raises(UserError, match="--out"):
        merged(tmp_path / "full", drawn, drawn)
    assert not (tmp_path / "m").exists() and not list(tmp_path.glob(".*"))


def test_a_missing_frame_leaves_no_result(drawn, other, tmp_path):
    broken = shutil.copytree(drawn, tmp_path / "broken")
    (broken / "frames/s001/t001/000002.png").unlink()
    with pytest.raises(UserError, match=r"000002\.png"):
        merged(tmp_path / "m", broken, other)
    assert not (tmp_path / "m").exists() and not list(tmp_path.glob(".*"))


def test_recipes_and_licences_are_kept(drawn, other, tmp_path):
    made = merged(tmp_path / "m", drawn, other)
    assert len(made.info.recipes) == 2 and made.info.licence == "CC0-1.0"
    scenes = made.table("scenes")
    seeds = {made.info.recipes[key].seed for key in pc.unique(scenes["recipe"]).to_pylist()}
    assert seeds == {7, 8}


def with_info(source, folder, **changes):
    """Copy a dataset and replace fields of its dataset.json."""
    root = shutil.copytree(source, folder)
    edit(lambda content: content.update(changes))(root)
    seal(root)
    return root


def test_exrs_of_two_cameras_are_not_merged(little, tmp_path):
    camera = open_dataset(little).info.camera.model_dump(mode="json")
    hashes = {"exr_path": "frames/s000/t000/000000.exr", "exr_sha256": "0" * 64, "exr_bytes": 1}
    roots = []
    for name, fx_px in (("a", 50.0), ("b", 60.0)):
        root = with_info(little, tmp_path / name, exr_camera={**camera, "fx_px": fx_px})
        rewrite(root, "frames", lambda rows: rows[0].update(hashes))
        seal(root)
        roots.append(open_dataset(root))
    with pytest.raises(UserError, match="exr_camera"):
        merge(roots, tmp_path / "m", images="none")
    same = with_info(roots[0].store.folder, tmp_path / "same", name="same")
    merge([roots[0], open_dataset(same), open_dataset(little)], tmp_path / "m", images="none")
    assert open_dataset(tmp_path / "m").info.exr_camera == roots[0].info.exr_camera


@pytest.mark.parametrize(
    ("licences", "joined"),
    [
        (("CC0-1.0", "CC0-1.0"), "CC0-1.0"),
        (("MIT OR Apache-2.0", "CC-BY-4.0"), "CC-BY-4.0 AND (MIT OR Apache-2.0)"),
        (("MIT OR Apache-2.0", "Apache-2.0 OR MIT"), "Apache-2.0 OR MIT"),
        (("CC0-1.0 AND MIT", "MIT", "CC-BY-4.0"), "CC-BY-4.0 AND CC0-1.0 AND MIT"),
        (("LicenseRef-mine", "CC0-1.0"), "CC0-1.0 AND LicenseRef-mine"),
    ],
)
def test_licences_are_joined(licences, joined):
    assert equal_licences(joined_licence(("a", licence) for licence in licences), joined)
    again = joined_licence(("a", licence) for licence in (joined, *licences))
    assert equal_licences(again, joined) and len(again) == len(joined)


def equal_licences(one, two):
    spdx = get_spdx_licensing()
    return spdx.is_equivalent(one, two)


@pytest.mark.parametrize("licence", ["Free-For-All", "MIT AND (", "MIT OR", ""])
def test_an_invalid_licence_is_refused(licence):
    with pytest.raises(UserError, match=r"data: licence: got .*, expected an SPDX licence expression"):
        joined_licence([("data", licence), ("b", "MIT")])


def test_alternative_licences_can_be_merged(little, tmp_path):
    root = with_info(little, tmp_path / "either", licence="MIT OR Apache-2.0")
    merge([open_dataset(root), open_dataset(little)], tmp_path / "m", images="none")
    assert open_dataset(tmp_path / "m").info.licence == "(MIT OR Apache-2.0) AND CC0-1.0"
