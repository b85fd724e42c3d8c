"""The detector from Python finds what `perilune-train detect predict` finds, in whatever form the image is given."""

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image
from tests.helpers import in_process
from tests.helpers.stored_run import THRESHOLD, store_run

import perilune
from perilune_train.cli.main import main


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return store_run(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def detector(run):
    return perilune.load_detector(run)


@pytest.fixture(scope="module")
def pixels():
    return np.random.default_rng(1).integers(0, 256, (96, 128), np.uint8)


@pytest.fixture
def picture(pixels, tmp_path):
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), pixels)
    return path


def test_it_finds_what_the_command_finds(detector, run, picture, tmp_path):
    done = in_process.call(main, "detect", "predict", picture, "--run", run, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    expected = pd.read_parquet(tmp_path / "out/detections.parquet")
    craters = detector(picture)
    assert len(craters) == len(expected) > 0
    pd.testing.assert_frame_equal(craters.table[expected.columns], expected)
    assert detector.threshold == THRESHOLD


def test_every_form_of_an_image_gives_the_same_craters(detector, picture, pixels):
    expected = detector(str(picture)).table.drop(columns="image")
    forms = [
        pixels,
        Image.fromarray(pixels),
        np.repeat(pixels[..., None], 3, axis=2),
        Image.open(picture).convert("RGB"),
    ]
    for found in detector(forms):
        pd.testing.assert_frame_equal(found.table.drop(columns="image"), expected)
        np.testing.assert_array_equal(found.image, pixels)


def test_a_pillow_image_is_turned_upright_as_a_file_is(detector, pixels, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / "turned.png", exif=exif)
    from_file = detector(tmp_path / "turned.png")
    with Image.open(tmp_path / "turned.png") as image:
        opened = detector(image)
    assert from_file.image.shape == pixels.shape[::-1] == opened.image.shape
    np.testing.assert_array_equal(opened.image, from_file.image)
    np.testing.assert_array_equal(opened["x0_px"], from_file["x0_px"])


def test_deep_pixels_are_stretched_as_in_a_file(detector, tmp_path):
    deep = np.random.default_rng(2).integers(100, 4000, (96, 96), np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    np.testing.assert_array_equal(detector(deep).image, detector(tmp_path / "deep.png").image)
    assert detector(deep.astype(np.float64)).image.max() == 255


def test_the_ellipse_of_an_old_detector_is_the_axis_aligned_one_inside_the_box(pixels, tmp_path):
    craters = perilune.load_detector(store_run(tmp_path, "ellipses=false"))(pixels, threshold=0.0)
    assert len(craters) > 20 and np.isnan(craters["sigma_x_px"]).all()
    theta = craters["ellipse_theta_rad"]
    assert set(theta) <= {0.0, np.pi / 2} and (craters["ellipse_a_px"] >= craters["ellipse_b_px"]).all()
    half_width = np.where(theta == 0, craters["ellipse_a_px"], craters["ellipse_b_px"])
    np.testing.assert_allclose(craters["ellipse_cx_px"] + half_width, craters["x1_px"])
    np.testing.assert_allclose(np.sqrt(craters["ellipse_a_px"] * craters["ellipse_b_px"]), craters["radius_px"])


def test_the_ellipse_is_the_one_in_the_box(detector, pixels):
    craters = detector(pixels, threshold=0.0)
    a, b, theta = (craters[f"ellipse_{name}"] for name in ("a_px", "b_px", "theta_rad"))
    assert len(craters) > 20 and ((theta >= 0) & (theta < np.pi)).all() and len(np.unique(theta)) > 10
    for low, high, half in (
        ("x0_px", "x1_px", np.hypot(a * np.cos(theta), b * np.sin(theta))),
        ("y0_px", "y1_px", np.hypot(a * np.sin(theta), b * np.cos(theta))),
    ):
        np.testing.assert_allclose(craters[high] - craters[low], 2 * half, rtol=1e-6)
    np.testing.assert_allclose(craters["angle_deg"], np.degrees(theta))
    assert (craters["sigma_semi_minor_px"] > 0).all()


def test_craters_can_be_drawn_and_printed(detector, pixels, monkeypatch):
    craters = detector(pixels)
    drawn = np.asarray(craters.plot())
    assert (drawn[..., 0] != drawn[..., 2]).any()
    shown = []
    monkeypatch.setattr(Image.Image, "show", lambda picture: shown.append(picture))
    craters.show()
    assert np.array_equal(np.asarray(shown[0]), drawn)
    assert repr(craters).startswith(f"Craters({len(craters)} in 128 x 96 px, score 0.0")
    assert repr(detector) == "CraterDetector(stored: score at least 0.005, on cpu, float32)"
    assert repr(detector(pixels, threshold=1.0)) == "Craters(0 in 128 x 96 px)"


def test_a_file_of_a_run_or_a_name_loads_too(run, pixels):
    file = run / "checkpoints/best.ckpt"
    assert len(perilune.load_detector(file)(pixels)) == len(perilune.load_detector(str(run))(pixels))
    assert perilune.load_detector("crater-detector").run == perilune.load_detector().run


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (3, "image: got int, expected a path, a NumPy array, a Pillow image"),
        ("missing.png", "missing.png"),
        (np.zeros((2, 3, 4, 5)), "got float64 of shape"),
        (np.zeros((0, 4), np.uint8), "got shape"),
        (np.array([["a"]]), "expected numbers"),
    ],
)
def test_what_is_no_image_is_refused(detector, image, message):
    with pytest.raises(perilune.UserError, match=message):
        detector(image)


def test_what_is_no_run_is_refused(tmp_path, picture, detector, pixels):
    for given in (tmp_path / "none", tmp_path, picture):
        with pytest.raises(perilune.UserError):
            perilune.load_detector(given)
    with pytest.raises(perilune.UserError, match="threshold: got 2, expected 0 to 1"):
        detector(pixels, threshold=2)
