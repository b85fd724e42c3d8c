"""Datasets developed from another one's EXRs, through the command line."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.helpers import in_process
from tests.helpers.s3_server import uploaded

from perilune_render.cli.main import main
from perilune_render.dataset.work import committed
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.storage.store import open_store
from perilune_shared.validation.validate import validate

RENDER = str(Path(sys.executable).parent / "perilune-render")
SAME_TABLES = ("craters", "boulders", "trajectories")


def settings(*changes):
    return [part for change in changes for part in ("--set", f"dataset.{change}")]


def develop(source, out, *arguments):
    return in_process.call(main, "develop", "--dataset", source, "--out", out, *arguments)


@pytest.fixture(scope="module")
def developed(quick, tmp_path_factory):
    """The tiny detection dataset developed with its own settings, in a process that tells what it loaded. Read only."""
    out = tmp_path_factory.mktemp("developed") / "new"
    arguments = ["develop", "--dataset", str(quick / "detect"), "--out", str(out)]
    program = (
        "import sys; from perilune_render.cli.main import app\n"
        f"app({arguments!r}, standalone_mode=False)\n"
        "assert 'perilune_render.dataset.develop' in sys.modules and 'bpy' not in sys.modules"
    )
    return out, subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)


def images(root):
    dataset = open_dataset(root)
    paths = dataset.table("frames", ["png_path"])["png_path"].to_pylist()
    return [cv2.imread(str(dataset.file(path)), cv2.IMREAD_UNCHANGED) for path in paths]


def assert_labels_differ_in_contrast_alone(old, new):
    """The contrast is that of the sensor; all else is kept to the last bit."""
    before, after = (d.table("labels").drop_columns(["contrast"]) for d in (old, new))
    assert after.equals(before)


def test_developed_alike_the_frames_are_the_same_bytes(quick, developed):
    """What the renderer wrote in one go and what comes of its EXRs afterwards."""
    old, new = open_dataset(quick / "detect"), open_dataset(developed[0])
    assert validate(new) == []
    for table in SAME_TABLES:
        assert new.table(table).equals(old.table(table))
    assert new.table("scenes").drop_columns("recipe").equals(old.table("scenes").drop_columns("recipe"))
    assert set(new.table("scenes")["recipe"].to_pylist()) == set(new.info.recipes) != set(old.info.recipes)
    assert_labels_differ_in_contrast_alone(old, new)
    contrast = [d.table("labels")["contrast"].to_numpy() for d in (old, new)]
    # Developing starts from ellipses rounded to float32.
    np.testing.assert_allclose(contrast[1], contrast[0], rtol=1e-3, atol=1e-4)
    before, after = old.table("frames"), new.table("frames")
    assert after["exr_path"].null_count == len(after)
    exr = ["exr_path", "exr_sha256", "exr_bytes"]
    assert after.drop_columns(exr).equals(before.drop_columns(exr))
    recipe = new.info.recipe()
    assert new.info.exr_camera is None and recipe.developed_from.name == old.info.name
    assert recipe.config == old.info.recipe().config and new.info.camera == old.info.camera
    assert not list(developed[0].rglob("*.exr"))


@pytest.mark.slow
def test_an_object_store_gets_the_same_bytes_and_its_frames_are_verified(quick, developed, s3_bucket):
    source, out = uploaded(quick / "detect", f"{s3_bucket}/moon"), f"{s3_bucket}/developed"
    done = develop(source, out)
    assert done.returncode == 0, done.stderr
    store, folder = open_store(out), open_store(developed[0])
    assert [(item.path, store.read(item.path)) for item in store.list()] == [
        (item.path, folder.read(item.path)) for item in folder.list()
    ]
    verified = in_process.call(main, "regenerate", "--manifest", source, "--verify", "--sample", "1")
    assert verified.returncode == 0 and "1 frames: 1 identical" in verified.stdout, verified.stderr


def test_another_sensor_changes_the_pixels_and_of_the_labels_their_contrast(quick, tmp_path):
    file = tmp_path / "sensor.yaml"
    file.write_text("dataset: {sensor: {bits: 12, read_noise_e: 100.0}}\n")
    changes = settings("sensor.psf_sigma_px=1.5", "sensor.black_level_share=0.05")
    assert develop(quick / "detect", tmp_path / "new", "--config", file, *changes).returncode == 0
    new = open_dataset(tmp_path / "new")
    assert validate(new) == []
    sensor = new.info.recipe().config["sensor"]
    assert (sensor["bits"], sensor["read_noise_e"], sensor["psf_sigma_px"]) == (12, 100.0, 1.5)
    old = open_dataset(quick / "detect")
    assert_labels_differ_in_contrast_alone(old, new)
    for old, image in zip(images(quick / "detect"), images(tmp_path / "new"), strict=True):
        # Twelve bits in the upper bits of sixteen.
        assert image.dtype == np.uint16 and (image & 0xF == 0).all() and len(np.unique(image)) > 300
        assert np.corrcoef(old.ravel(), image.ravel())[0, 1] > 0.8
        assert np.percentile(image, 99) / 65535 == pytest.approx(0.8, abs=0.05)


def test_a_noisier_sensor_lowers_every_contrast(quick, tmp_path):
    assert develop(quick / "detect", tmp_path / "new", *settings("sensor.read_noise_e=1500.0")).returncode == 0
    old, new = open_dataset(quick / "detect"), open_dataset(tmp_path / "new")
    assert_labels_differ_in_contrast_alone(old, new)
    before, after = (d.table("labels")["contrast"].to_numpy() for d in (old, new))
    assert (np.abs(after) < np.abs(before)).all() and (after < 4).mean() > (before < 4).mean() + 0.1


def test_another_camera_makes_new_labels_that_fit(quick, tmp_path):
    lens = settings(
        "camera.width_px=96", "camera.height_px=80", "camera.focal_length_px=137.5", "camera.principal_x_px=45"
    )
    lens += settings("camera.distortion.k1=-0.12", "camera.distortion.p1=0.002")
    assert develop(quick / "detect", tmp_path / "new", *lens).returncode == 0
    old, new = open_dataset(quick / "detect"), open_dataset(tmp_path / "new")
    assert validate(new) == [] and new.info.camera.distortion == (-0.12, 0.0, 0.002, 0.0, 0.0)
    for table in SAME_TABLES:
        assert new.table(table).equals(old.table(table))
    assert all(image.shape == (80, 96) for image in images(tmp_path / "new"))
    labels, before = (d.table("labels").to_pandas() for d in (new, old))
    assert 0.2 * len(before) < len(labels) < 0.9 * len(before)
    both = labels.merge(before, on=["frame_id", "crater_id"], suffixes=("", "_old"))
    whole = both[(both.visible_fraction == 1) & (both.visible_fraction_old == 1) & (both.radius_px > 5)]
    # What is seen and lit is so in either camera.
    assert len(whole) > 20 and np.abs(whole.sunlit_fraction - whole.sunlit_fraction_old).mean() < 0.05
    # The ellipses are where the craters are: a frame's image and the undistorted one of the old camera agree there.
    frames = old.table("frames").to_pandas().set_index("frame_id")
    plain = old.info.camera.intrinsics()
    row = whole.iloc[0]
    pose = frames.loc[row.frame_id]
    crater = old.table("craters", scene_id=pose.scene_id).to_pandas().set_index("crater_id").loc[row.crater_id]
    rotation = matrix_from_quaternion(pose.rotation_wxyz)
    centre = (crater[["x_m", "y_m", "z_m"]].to_numpy(float) - pose.position_m) @ rotation.T
    normal = crater[["normal_x", "normal_y", "normal_z"]].to_numpy(float) @ rotation.T
    again = project_circles(plain, centre[None], normal[None], np.array([crater.diameter_m / 2]))
    assert again.cx_px[0] == pytest.approx(row.ellipse_cx_px_old)
    assert abs(row.ellipse_cx_px - row.ellipse_cx_px_old) > 1


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (settings("camera.principal_x_px=66"), ["dataset.camera", "EXRs"]),
        (settings("camera.focal_length_px=100"), ["dataset.camera", "EXRs"]),
        (settings("camera.distortion.k1=-0.1"), ["dataset.camera", "EXRs"]),
        (settings("camera.distortion.k1=-3"), ["dataset.camera.distortion", "fold"]),
        (settings("seed=5"), ["seed", "new rendering"]),
        (settings("labels.min_radius_px=4"), ["min_radius_px", "new rendering"]),
        (settings("sensor.bit=12"), ["dataset.sensor.bit", "bits (nearest known)"]),
        (settings("sensor.black_level_share=0.4", "sensor.exposure_level=0.3"), ["exposure_level above"]),
    ],
)
def test_what_needs_a_new_rendering_is_refused(quick, tmp_path, arguments, parts):
    result = develop(quick / "detect", tmp_path / "new", *arguments)
    assert result.returncode == 2 and len(result.stderr.strip().splitlines()) == 1
    assert all(part in result.stderr for part in parts) and not (tmp_path / "new").exists()


def test_a_dataset_without_exrs_is_refused(developed, tmp_path):
    again = develop(developed[0], tmp_path / "again")
    assert again.returncode == 2 and "exr_path" in again.stderr and not (tmp_path / "again").exists()


def test_a_damaged_exr_is_named_and_the_rest_goes_on_once_it_is_whole(quick_detect, tmp_path):
    exr = sorted(quick_detect.rglob("*.exr"))[-1]
    whole = exr.read_bytes()
    exr.write_bytes(whole[: len(whole) // 2])
    broken = develop(quick_detect, tmp_path / "new")
    assert broken.returncode == 2 and exr.name in broken.stderr and "Traceback" not in broken.stderr
    new = open_dataset(tmp_path / "new")
    finished = [name.replace(".", "/") for name in committed(new.store)]
    assert not new.info.complete and new.info.index == () and 0 < len(finished) < 3
    exr.write_bytes(whole)
    frames = [path for name in finished for path in (tmp_path / "new/frames" / name).glob("*.png")]
    done = {path: path.stat().st_mtime_ns for path in frames}
    assert develop(quick_detect, tmp_path / "new").returncode == 0
    assert validate(open_dataset(tmp_path / "new")) == []
    assert done and all(path.stat().st_mtime_ns == stamp for path, stamp in done.items())


@pytest.mark.slow
def test_stopped_it_looks_incomplete_and_goes_on(quick, tmp_path):
    command = [RENDER, "develop", "--dataset", str(quick / "nav"), "--out", str(tmp_path / "new")]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not any(tmp_path.rglob("*.png")) and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not open_dataset(tmp_path / "new").info.complete
    assert develop(quick / "nav", tmp_path / "new").returncode == 0
    new = open_dataset(tmp_path / "new")
    hashes = [d.table("frames")["png_sha256"].to_pylist() for d in (new, open_dataset(quick / "nav"))]
    assert validate(new) == [] and hashes[0] == hashes[1]


def test_blender_is_not_loaded(developed):
    assert developed[1].returncode == 0, developed[1].stderr


@pytest.mark.slow
def test_a_distorted_dataset_is_rendered_labelled_and_developed(tmp_path):
    """From the lens to the label: an EXR of the wider pinhole, frames and ellipses of the distorted camera."""
    lens = settings("camera.distortion.k1=-0.2", "camera.distortion.p2=0.003", "camera.principal_y_px=60")
    quick = ["--preset", "tiny", "--kind", "detect"]
    quick += settings("terrain.spacing_px=2", "detect.n_scenes=1", "detect.val_share=0", "detect.test_share=0")
    made = in_process.call(main, "dataset", "--workers", 0, *quick, *lens, "--out", tmp_path)
    assert made.returncode == 0, made.stderr
    dataset = open_dataset(tmp_path / "detect")
    assert validate(dataset) == []
    camera, exr_camera = dataset.camera, dataset.info.exr_camera.intrinsics()
    assert exr_camera == camera.covering_pinhole() and exr_camera.width_px > camera.width_px == 128
    # Developed for the pinhole itself and distorted by OpenCV's own means, the frame is the same.
    plain = settings(
        "sensor.read_noise_e=0",
        "sensor.gain_nonuniformity=0",
        "sensor.full_well_e=3e6",
        "sensor.hot_pixel_share=0",
        "sensor.longest_exposure_s=10",
        "sensor.psf_sigma_px=0",
    )
    pinhole = settings(
        f"camera.width_px={exr_camera.width_px}",
        f"camera.height_px={exr_camera.height_px}",
        f"camera.focal_length_px={exr_camera.fx_px}",
        f"camera.principal_x_px={exr_camera.cx_px}",
        f"camera.principal_y_px={exr_camera.cy_px}",
        "camera.distortion.k1=0",
        "camera.distortion.p2=0",
    )
    assert develop(tmp_path / "detect", tmp_path / "bent", *plain).returncode == 0
    assert develop(tmp_path / "detect", tmp_path / "straight", *plain, *pinhole).returncode == 0
    pixels = camera.pixel_centres().reshape(-1, 1, 2)
    lens_xy = cv2.undistortPoints(pixels, camera.matrix, np.array(camera.distortion), None, exr_camera.matrix)
    place = (lens_xy.reshape(128, 128, 2) - 0.5).astype(np.float32)
    for bent, straight in zip(images(tmp_path / "bent"), images(tmp_path / "straight"), strict=True):
        expected = cv2.remap(straight.astype(np.float32), place[..., 0], place[..., 1], cv2.INTER_LINEAR)
        inner = np.s_[4:-4, 4:-4]
        top, left = int(exr_camera.cy_px - camera.cy_px), int(exr_camera.cx_px - camera.cx_px)
        unbent = straight[top : top + 128, left : left + 128]
        alike, apart = (np.corrcoef(bent[inner].ravel(), image[inner].ravel())[0, 1] for image in (expected, unbent))
        assert alike > 0.97 and 1 - alike < 0.25 * (1 - apart)


def test_a_source_that_is_not_complete_is_refused(quick_detect, tmp_path):
    path = quick_detect / "dataset.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "complete": False}))
    result = develop(quick_detect, tmp_path / "new")
    assert result.returncode == 2 and "complete" in result.stderr and not (tmp_path / "new").exists()
    shutil.rmtree(quick_detect)
    assert develop(quick_detect, tmp_path / "new").returncode == 2
