"""Lens models in the settings of the renderer, and a rendered dataset of a fisheye."""

import json

import numpy as np
import pytest
from tests.helpers.in_process import call
from tests.helpers.scenes import config_with

from perilune_render.cli.frames import read_camera
from perilune_render.cli.main import main as render
from perilune_render.config.cameras import CameraConfig
from perilune_render.config.scene import SceneConfig, ViewConfig
from perilune_render.flight.lens import camera_of
from perilune_render.flight.rig import mounted
from perilune_render.flight.view import scene_view
from perilune_render.imaging.exr import read_exr
from perilune_render.provenance.recipe import config_of, recorded_settings
from perilune_shared.cli.main import main as manifest
from perilune_shared.config.resolve import resolve_over
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import camera_from_site
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.labels.masks import frame_masks

WIDE = {"width_px": 96, "height_px": 80, "horizontal_fov_deg": 180}
POSES = """# frame: O_L
time_s,x_m,y_m,z_m,qw,qx,qy,qz
0,0,0,300,0,1,0,0
1,6,4,260,0,0.98,0,0.19899748742
"""
SETTINGS = (
    "dataset.render.engine=heightfield",
    "dataset.render.exr=true",
    "dataset.terrain.spacing_px=2",
    "dataset.scene.horizon=true",
)


def camera_with(lens, **changes):
    return camera_of(resolve_over(CameraConfig, "camera", "file", {**WIDE, "lens": lens, **changes}))


@pytest.mark.parametrize(
    ("lens", "view_deg"),
    [
        ({"model": "equidistant"}, 180),
        ({"model": "kannala_brandt", "k1": -0.02, "k2": 0.003}, 180),
        ({"model": "unified", "xi": 1.1}, 180),
        ({"model": "cahvor", "r": [0.0, 0.1, 0.0]}, 100),
        ({"model": "cahvore", "linearity": 0.0, "r": [0.0, 0.05, -0.02], "e": [0.01, 0.0, 0.0]}, 180),
    ],
)
def test_the_field_of_view_of_each_model_spans_the_width(lens, view_deg):
    camera = camera_with(lens, horizontal_fov_deg=view_deg)
    edges = camera.rays([[1e-9, 40.0], [96 - 1e-9, 40.0]])
    assert np.degrees(np.arccos(edges[0] @ edges[1])) == pytest.approx(view_deg, abs=1e-5)
    assert camera.model == lens["model"]
    stated = camera_with(lens, focal_length_px=90.0, focal_length_y_px=91.0)
    assert (stated.fx_px, stated.fy_px) == (90.0, 91.0)


@pytest.mark.parametrize(
    ("lens", "changes", "message"),
    [
        ({"model": "fisheye"}, {}, "camera.lens.model: got 'fisheye', expected 'equidistant'"),
        ({"model": "kannala_brandt", "k11": 0.1}, {}, "camera.lens.k11: got an unknown key, expected k1"),
        ({"model": "kannala_brandt", "xi": 0.1}, {}, "expected k1, k2, k3, k4 for model kannala_brandt, not xi"),
        ({"model": "equidistant", "k1": 0.1}, {}, "expected no parameters for model equidistant, not k1"),
        ({"model": "unified"}, {}, "expected xi for model unified"),
        ({"model": "unified", "xi": -1}, {}, "camera.lens.xi: got -1, expected at least 0"),
        ({"model": "cahvor", "o": [0, 0, 0]}, {}, "an axis o that is not zero"),
        ({"model": "cahvore", "linearity": 2}, {}, "camera.lens.linearity: got 2, expected at most 1"),
        ({"model": "equidistant"}, {"horizontal_fov_deg": 181}, "horizontal_fov_deg: got 181, expected at most 180"),
        (None, {"horizontal_fov_deg": 121}, "horizontal_fov_deg of at most 120 without dataset.camera.lens"),
        ({"model": "equidistant"}, {"distortion": {"k1": 0.1}}, "no distortion with lens model equidistant"),
        (
            {"model": "equidistant"},
            {"principal_x_px": 900.0},
            "lens: got an image without a ray within 90 degrees of the axis, expected a principal point nearer",
        ),
        ({"model": "cahvor"}, {}, "horizontal_fov_deg: got 180.0, expected below 180 for lens model cahvor"),
        (
            {"model": "kannala_brandt", "k1": -0.25},
            {},
            "lens: got kannala_brandt k1 -0.25 with horizontal_fov_deg 180, expected a view within 66.16 degrees",
        ),
        (
            {"model": "kannala_brandt", "k1": -0.25},
            {"focal_length_px": 50.0},
            r"lens: got kannala_brandt k1 -0.25, .*folds back within the image \(the model folds at 66.16 degrees",
        ),
        (
            {"model": "unified", "xi": 0.8},
            {"focal_length_px": 50.0, "distortion": {"k1": -1}},
            r"camera.distortion: got .*folds back within the image \(the model folds at",
        ),
    ],
)
def test_wrong_settings_are_refused_in_one_line(lens, changes, message):
    with pytest.raises(UserError, match=message) as refused:
        camera_with(lens, **changes)
    assert "\n" not in str(refused.value)


def test_the_fold_of_a_pinholes_distortion_is_named_too():
    with pytest.raises(UserError, match=r"dataset.camera.distortion.*the model folds at 25\.24 degrees"):
        camera_of(CameraConfig(distortion={"k1": -1.5}))


def test_recipes_of_pinholes_have_no_lens():
    assert "lens" not in recorded_settings(config_with(), "nav")["camera"]


def test_the_ground_has_the_finest_scale_of_the_lens():
    """At the edge of an equidistant image, the scale along the edge is pi / 2 of the scale at the centre."""
    camera = camera_with({"model": "equidistant"})
    scene = SceneConfig(horizon=True, views=(ViewConfig(height_m=100.0, reach_m=100.0),))
    assert scene_view(scene, camera).focal_px == pytest.approx(camera.fx_px * np.pi / 2, rel=0.02)


def test_a_narrow_lens_sees_the_ground_of_its_view():
    camera = camera_with({"model": "equidistant"}, horizontal_fov_deg=90)
    level = mounted(camera).levelled()
    rays = camera.rays(camera.outline())
    assert level.covers(camera) and level.fx_px == pytest.approx(camera.scale_px)
    assert level.width_px / 2 / level.fx_px == pytest.approx(np.abs(rays[:, :2] / rays[:, 2:]).max(), rel=0.01)
    with pytest.raises(UserError, match=r"lens: got a view with the horizon.*dataset.scene.horizon=true"):
        mounted(camera_with({"model": "equidistant"})).levelled()


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """Two frames of a fisheye over ground up to the horizon."""
    folder = tmp_path_factory.mktemp("wide")
    (folder / "poses.csv").write_text(POSES)
    (folder / "camera.yaml").write_text(json.dumps({**WIDE, "lens": {"model": "kannala_brandt", "k1": -0.02}}))
    options = [part for setting in SETTINGS for part in ("--set", setting)]
    sources = ["--poses", folder / "poses.csv", "--camera", folder / "camera.yaml", "--workers", 0, "--threads", 1]
    done = call(render, "frames", *sources, *options, "--preset", "small", "--out", folder / "made")
    assert done.returncode == 0, done.stderr
    return folder / "made"


def test_a_fisheye_dataset_is_valid_and_states_its_model(wide):
    assert call(manifest, "validate", wide).returncode == 0
    dataset = open_dataset(wide)
    camera = dataset.info.camera
    assert camera.model == "kannala_brandt" and camera.parameters == {"k1": -0.02, "k2": 0.0, "k3": 0.0, "k4": 0.0}
    assert dataset.info.exr_camera == camera
    again = config_of(dataset.info.recipe(), "recipe")
    assert camera_of(again.camera) == camera.intrinsics()
    # Labels lie up to the edge of the hemisphere, and the table projects to itself.
    labels = dataset.table("labels").to_pandas()
    frames = dataset.table("frames").to_pandas().set_index("frame_id")
    craters = dataset.table("craters").to_pandas().set_index("crater_id")
    angles = []
    for label in labels.itertuples():
        pose, crater = frames.loc[label.frame_id], craters.loc[label.crater_id]
        rotation = matrix_from_quaternion(pose["rotation_wxyz"])
        point = camera_from_site(crater[["x_m", "y_m", "z_m"]].to_numpy(float), pose["position_m"], rotation)
        pixel = camera.intrinsics().project(point)
        assert np.linalg.norm(pixel - [label.ellipse_cx_px, label.ellipse_cy_px]) < 0.4 * label.ellipse_a_px
        angles.append(np.degrees(np.arccos(point[2] / np.linalg.norm(point))))
    assert len(angles) > 30 and max(angles) > 70


def test_frames_of_a_fisheye_are_rendered_again(wide):
    dataset = open_dataset(wide)
    frame_ids = dataset.table("frames")["frame_id"].to_pylist()
    (found,) = regenerate_all(wide, frame_ids[:1])
    assert "identical" in found


def regenerate_all(folder, frame_ids):
    """The last line that `regenerate --verify` prints about frames."""
    options = [part for frame_id in frame_ids for part in ("--frames", frame_id)]
    done = call(render, "regenerate", "--manifest", folder, "--verify", *options)
    assert done.returncode == 0, done.stderr
    return [line for line in done.stdout.splitlines() if "identical" in line]


def test_masks_of_a_fisheye_show_the_rims(wide):
    dataset = open_dataset(wide)
    frame = dataset.table("frames").to_pandas().iloc[1]
    labels = dataset.table("labels").to_pandas()
    labels = labels[labels["frame_id"] == frame.frame_id]
    exr = read_exr(dataset.file(frame.exr_path))
    masks = frame_masks(dataset, frame.frame_id, depth_m=exr["Z"])
    area = np.array([mask.amodal.sum() for mask in masks])
    large = (labels["radius_px"] > 4).to_numpy() & (labels["bbox_x0_px"] > 0).to_numpy()
    assert large.sum() > 3
    np.testing.assert_allclose(area[large], (np.pi * labels["radius_px"] ** 2).to_numpy()[large], rtol=0.1)
    # Most of a rim that the label calls visible is visible in the mask.
    shown = large & (labels["visible_fraction"] == 1).to_numpy()
    assert min(masks[k].visible.sum() / area[k] for k in np.flatnonzero(shown)) > 0.8
    # The crater index of the EXR agrees with the masks.
    k = int(np.argmax(np.where(large, labels["radius_px"], 0)))
    index = exr["crater"][masks[k].window][masks[k].visible]
    assert (index >= 0).all() and (index == masks[k].crater_id).any()


def test_exrs_of_a_fisheye_are_developed_for_another_sensor_only(wide, tmp_path):
    options = ["develop", "--dataset", wide, "--out"]
    done = call(render, *options, tmp_path / "noisy", "--set", "dataset.sensor.read_noise_e=60")
    assert done.returncode == 0 and open_dataset(tmp_path / "noisy").info.camera == open_dataset(wide).info.camera
    for setting in ("dataset.camera.lens.k1=-0.03", "dataset.camera.lens=null", "dataset.camera.width_px=90"):
        more = ["--set", "dataset.camera.horizontal_fov_deg=90"] if setting.endswith("null") else []
        done = call(render, *options, tmp_path / "other", "--set", setting, *more)
        assert done.returncode == 2 and "dataset.camera.lens: got a camera of the model" in done.stderr
        assert not (tmp_path / "other").exists()


def test_engines_for_pinholes_refuse_a_lens(wide, tmp_path):
    sources = ["--poses", wide.parent / "poses.csv", "--camera", wide.parent / "camera.yaml", "--out", tmp_path / "out"]
    for settings in ((), ("--set", "dataset.render.engine=heightfield", "--set", "dataset.render.device=auto")):
        done = call(render, "frames", *sources, "--set", "dataset.scene.horizon=true", *settings)
        assert done.returncode == 2 and "dataset.camera.lens: got kannala_brandt with" in done.stderr
        assert not (tmp_path / "out").exists()
    done = call(render, "frames", *sources, "--set", "dataset.render.engine=heightfield")
    assert done.returncode == 2 and "a view with the horizon" in done.stderr


def test_a_planetary_model_becomes_settings(tmp_path):
    (tmp_path / "mast.cahvore").write_text(
        "Model = CAHVORE2 = fish-eye\nDimensions = 128 96\nC = 1 2 3\nA = 0 0 1\nH = 70 0.1 63.5\nV = 0 70 47.5\n"
        "O = 0 0 1\nR = 0.001 0.05 -0.01\nE = 0.004 0 0\n"
    )
    camera = camera_of(read_camera(tmp_path / "mast.cahvore"))
    assert (camera.model, camera.fx_px, camera.cx_px, camera.cy_px) == ("cahvore", 70.0, 64.0, 48.0)
    assert camera.parameters == (0.1, 0, 0, 1, 0.001, 0.05, -0.01, 0.004, 0, 0, 0)
