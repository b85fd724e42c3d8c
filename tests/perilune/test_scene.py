"""Scenes from Python: their sources, and frames that agree with those of datasets."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from tests.helpers.elevation_models import hilly_raster

import perilune
from perilune_render.config.dataset import DatasetConfig
from perilune_render.scenes import TERRAINS
from perilune_shared.config.resolve import resolve
from perilune_shared.geometry.frames import matrix_from_quaternion

ROOT = Path(__file__).parents[2]
SMALL = (
    "dataset.camera.width_px=64",
    "dataset.camera.height_px=64",
    "dataset.render.samples=1",
    "dataset.terrain.spacing_px=4",
)


@pytest.fixture(scope="module")
def scene():
    with perilune.Scene("mare", seed=7, sun_elevation_deg=20, settings=SMALL) as scene:
        yield scene


def test_a_frame_has_image_depth_and_labels(scene):
    frame = scene.render(perilune.look_down(altitude_m=800, tilt_deg=10))
    assert frame.image.shape == frame.depth_m.shape == (64, 64) and frame.image.std() > 3
    # The middle of a frame is 800 m / cos(10 degrees) away, but for relief.
    assert frame.depth_m[32, 32] == pytest.approx(800 / np.cos(np.radians(10)), rel=0.05)
    assert len(frame.labels) > 10 and (frame.labels["diameter_m"] > 0).all()
    assert set(frame.labels["crater_id"]) <= set(scene.craters["crater_id"])


def test_frames_of_a_list_are_those_of_their_poses(scene):
    poses = perilune.descent(n_frames=3)
    frames = scene.render(poses)
    assert [frame.pose for frame in frames] == poses
    np.testing.assert_array_equal(scene.render(poses[0]).image, frames[0].image)
    np.testing.assert_array_equal(scene.render(poses)[2].image, frames[2].image)
    assert len(scene.render([])) == 0
    # The same frames as stacked arrays and one table.
    np.testing.assert_array_equal(frames.images, np.stack([frame.image for frame in frames]))
    np.testing.assert_array_equal(np.from_dlpack(frames.depth_m)[1], frames[1].depth_m)
    assert [len(part) for _, part in frames.labels.groupby("frame")] == [len(frame.labels) for frame in frames]
    assert "3 frames of 64 x 64 px" in repr(frames)


def test_a_scene_is_determined_by_its_seed_and_settings(scene):
    pose = perilune.look_down(altitude_m=900)
    again, other = (perilune.Scene("mare", seed=n, sun_elevation_deg=20, settings=SMALL) for n in (7, 8))
    np.testing.assert_array_equal(again.render(pose).image, scene.render(pose).image)
    assert not np.array_equal(other.render(pose).image, scene.render(pose).image)
    assert other.config.seed == 8 and other.config.scene.sun_elevation_deg == 20


def test_a_scene_and_a_frame_can_be_drawn_and_printed(scene, monkeypatch):
    frame = scene.render(perilune.look_down(altitude_m=800))
    drawn = np.asarray(frame.plot())
    assert drawn.shape == (1024, 1024, 3) and (drawn[..., 0] != drawn[..., 1]).any()
    shown = []
    monkeypatch.setattr(Image.Image, "show", lambda picture: shown.append(picture))
    frame.show()
    assert len(shown) == 1
    assert repr(frame).startswith("RenderedFrame(64 x 64 px, uint8, ")
    assert repr(scene).startswith("Scene(mare: ") and "Sun at elevation 20 and azimuth 90 degrees" in repr(scene)


def test_a_scene_of_a_dataset_has_its_labels(quick):
    """The label of a crater depends on ground, pose and camera; so the ground is the one of the dataset."""
    dataset = perilune.open_dataset(quick / "nav")
    row, expected = dataset[0].row, dataset[0].labels
    scene = perilune.Scene(dataset)
    rotation = matrix_from_quaternion(row["rotation_wxyz"])
    pose = perilune.Pose(np.array(row["position_m"]), rotation, np.array(row["velocity_mps"]))
    found = scene.render(pose).labels
    assert found["crater_id"].tolist() == expected["crater_id"].tolist()
    for column in ("ellipse_cx_px", "ellipse_a_px", "visible_fraction"):
        np.testing.assert_allclose(found[column], expected[column], rtol=1e-6)
    sun = dataset.scenes.sort_values("scene_id").iloc[0]
    assert scene.config.scene.sun_elevation_deg == sun["sun_elevation_deg"]
    assert perilune.Scene(quick / "nav", sun_elevation_deg=9).config.scene.sun_elevation_deg == 9


def test_a_scene_of_a_file_of_settings(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump({"dataset": {"name": "own", "camera": {"width_px": 96, "height_px": 64}}}))
    scene = perilune.Scene(path, settings=SMALL[2:])
    assert scene.config.name == "own"
    assert scene.render(perilune.look_down(500)).image.shape == (64, 96)


def test_a_scene_over_an_elevation_model(tmp_path):
    path = hilly_raster(tmp_path / "hills.tif")
    scene = perilune.Scene(path, settings=SMALL)
    depth_m = scene.render(perilune.look_down(altitude_m=900)).depth_m
    # The hill of the model is 300 m high, the pit 120 m deep; both are within half a kilometre of the site.
    assert (900 - depth_m).max() > 150 and "hills.tif" in repr(scene)


def test_the_ground_of_a_dataset_with_an_elevation_model_is_not_guessed(quick):
    dataset = perilune.open_dataset(quick / "detect")
    (recipe,) = dataset.info.recipes.values()
    terrain = recipe.config["terrain"] | {"dem": "hills.tif"}
    recipe = recipe.model_copy(update={"config": recipe.config | {"terrain": terrain}})
    dataset.info = dataset.info.model_copy(update={"recipes": {recipe.key: recipe}})
    with pytest.raises(perilune.UserError, match=r"terrain.dem: got hills.tif, expected procedural ground"):
        perilune.Scene(dataset)


def test_the_polar_terrain_has_long_shadows(scene):
    pose = perilune.look_down(altitude_m=900)
    polar = perilune.Scene("polar", settings=SMALL).render(pose)
    dark, usual = (np.median(frame.labels["sunlit_fraction"]) for frame in (polar, scene.render(pose)))
    assert dark < usual


@pytest.mark.parametrize("name", ["mare", "highland"])
def test_a_named_terrain_has_the_settings_of_its_file(name):
    file = resolve(DatasetConfig, "dataset", "perilune_render", "small", ROOT / f"configs/{name}.yaml")
    assert resolve(DatasetConfig, "dataset", "perilune_render", "small", None, TERRAINS[name]) == file


def test_the_sun_of_the_polar_terrain_is_possible_there():
    polar = resolve(DatasetConfig, "dataset", "perilune_render", "small", None, TERRAINS["polar"])
    inclination_deg = 1.54
    assert polar.scene.sun_elevation_deg < 90 - abs(polar.terrain.latitude_deg) + inclination_deg


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"source": "mars"}, r"Scene: source: got mars, expected mare \(nearest known\)"),
        ({"source": "nowhere"}, "source: got nowhere, expected one of mare, highland, polar, tiny"),
        ({"source": 3}, "source: got int"),
        ({"seed": "x"}, "dataset.seed"),
        ({"seed": True}, "seed: got True, expected a number"),
        ({"sun_elevation_deg": 95}, "sun_elevation_deg: got 95, expected at most 90"),
        ({"engine": "povray"}, "dataset.render.engine: got 'povray'"),
        ({"settings": ["dataset.cammera.width_px=3"]}, "cammera"),
        ({"settings": ["dataset.survey={}"]}, "dataset.survey"),
    ],
)
def test_what_is_no_scene_is_refused(given, message):
    with pytest.raises(perilune.UserError, match=message):
        perilune.Scene(**{"source": "mare", **given})


def test_a_dataset_takes_no_other_settings(quick):
    with pytest.raises(perilune.UserError, match="since both come from the dataset"):
        perilune.Scene(quick / "nav", seed=3)
    with pytest.raises(perilune.UserError, match="sun_elevation_deg: got 99"):
        perilune.Scene(quick / "nav", sun_elevation_deg=99)


def test_poses_that_cannot_be_rendered_are_refused(scene):
    with pytest.raises(perilune.UserError, match="pose: got 'up'"):
        scene.render("up")
    with pytest.raises(perilune.UserError, match=r"pose: got array"):
        scene.render([np.zeros(3)])
    for pose in (perilune.look_down(800, 85), perilune.look_down(50_000)):
        with pytest.raises(perilune.UserError):
            scene.render(pose)
