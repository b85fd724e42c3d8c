"""Cameras from the files of OpenCV, ROS, Kalibr and EuRoC, against OpenCV's own projection."""

import json

import cv2
import numpy as np
import pytest

from perilune_shared.errors import UserError
from perilune_shared.geometry.calibration import Calibration, read_camera_file
from perilune_shared.geometry.frames import matrix_from_rotation_vector

K = np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]])
RADTAN = np.array([-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.01])
EQUIDISTANT = np.array([-0.013, 0.02, -0.012, 0.0025])
SIZE = (752, 480)
NARROW = np.array([[700.0, 0, 367.215], [0, 702.0, 248.375], [0, 0, 1]])
"""About 30 degrees from the axis to the corner."""
RAYS = np.random.default_rng(0).uniform([-0.5, -0.35, 1], [0.5, 0.35, 1], (200, 3))


def write(tmp_path, text, name="camera.yaml"):
    path = tmp_path / name
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    return path


def seen_by_opencv(rays, matrix, coefficients, *, fisheye=False):
    """Pixels with the centre of the first one at (0, 0)."""
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return project(rays[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]


def matrix_of(values, rows, cols):
    return {"rows": rows, "cols": cols, "data": np.asarray(values).ravel().tolist()}


def ros(matrix=K, coefficients=RADTAN, model="plumb_bob", **more):
    return {
        "image_width": SIZE[0],
        "image_height": SIZE[1],
        "camera_name": "lander",
        "camera_matrix": matrix_of(matrix, 3, 3),
        "distortion_model": model,
        "distortion_coefficients": matrix_of(coefficients, 1, len(coefficients)),
        "rectification_matrix": matrix_of(np.eye(3), 3, 3),
        "projection_matrix": matrix_of(np.eye(3, 4), 3, 4),
        **more,
    }


def camera_info(upper=True):
    message = {
        "header": {"seq": 5, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "camera"},
        "height": SIZE[1],
        "width": SIZE[0],
        "distortion_model": "plumb_bob",
        "D": RADTAN.tolist(),
        "K": K.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": np.eye(3, 4).ravel().tolist(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }
    message = message if upper else {key.lower(): value for key, value in message.items()}
    return "".join(f"{key}: {json.dumps(value)}\n" for key, value in message.items()) + "---\n"


def kalibr(matrix=K, coefficients=RADTAN[:4], model="radtan", **more):
    section = {
        "cam_overlaps": [],
        "camera_model": "pinhole",
        "distortion_coeffs": list(coefficients),
        "distortion_model": model,
        "intrinsics": [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]],
        "resolution": list(SIZE),
        "rostopic": "/cam0/image_raw",
        **more,
    }
    return {"cam0": section}


def opencv_text(tmp_path, matrix=K, coefficients=RADTAN):
    storage = cv2.FileStorage(str(tmp_path / "opencv.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Thu 01 Jan")
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", coefficients[:, None])
    storage.write("avg_reprojection_error", 0.19)
    storage.release()
    text = (tmp_path / "opencv.yml").read_text()
    assert text.startswith("%YAML:1.0") and "!!opencv-matrix" in text
    return text


@pytest.mark.parametrize("form", ["opencv", "ros", "camera_info", "camera_info of ROS 2", "kalibr", "nested"])
def test_a_calibration_projects_as_opencv_does(tmp_path, form):
    coefficients = RADTAN if form != "kalibr" else RADTAN[:4]
    texts = {
        "opencv": lambda: opencv_text(tmp_path),
        "ros": ros,
        "camera_info": camera_info,
        "camera_info of ROS 2": lambda: camera_info(upper=False),
        "kalibr": kalibr,
        "nested": lambda: {"K": K.tolist(), "D": RADTAN.tolist(), "image_size": list(SIZE)},
    }
    found = read_camera_file(write(tmp_path, texts[form]()))
    assert isinstance(found, Calibration) and found.rotation_camera_from_body is None
    assert (found.camera.width_px, found.camera.height_px) == SIZE
    assert np.allclose(found.camera.project(RAYS), seen_by_opencv(RAYS, K, coefficients) + 0.5, rtol=0, atol=1e-9)


@pytest.mark.parametrize("form", ["ros", "kalibr"])
def test_an_equidistant_camera_is_fitted_within_a_twentieth_of_a_pixel(tmp_path, form):
    text = ros(NARROW, EQUIDISTANT, "equidistant") if form == "ros" else kalibr(NARROW, EQUIDISTANT, "equidistant")
    found = read_camera_file(write(tmp_path, text))
    truth = seen_by_opencv(RAYS, NARROW, EQUIDISTANT, fisheye=True)
    inside = found.camera.inside(truth + 0.5)
    assert inside.sum() > 100
    assert np.abs(found.camera.project(RAYS) - truth - 0.5)[inside].max() < 0.05
    # The two models differ by far more without the fit.
    assert np.abs(seen_by_opencv(RAYS, NARROW, EQUIDISTANT) - truth)[inside].max() > 1


@pytest.mark.parametrize(("matrix", "coefficients"), [(K, EQUIDISTANT), (K / [[4], [4], [1]], [0.0] * 4)])
def test_an_equidistant_camera_without_a_good_fit_keeps_its_model(tmp_path, matrix, coefficients):
    camera = read_camera_file(write(tmp_path, kalibr(matrix, coefficients, "equidistant"))).camera
    assert camera.model == "kannala_brandt" and camera.parameters == tuple(coefficients)
    truth = seen_by_opencv(RAYS, matrix, np.array(coefficients), fisheye=True)
    assert np.abs(camera.project(RAYS) - truth - 0.5).max() < 1e-9


def test_an_omnidirectional_camera_of_kalibr_is_read(tmp_path):
    text = kalibr(camera_model="omni", intrinsics=[1.2, 500.0, 501.0, 320.0, 240.0])
    camera = read_camera_file(write(tmp_path, text)).camera
    assert (camera.model, camera.parameters) == ("unified", (1.2,)) and camera.distortion == (*RADTAN[:4], 0.0)
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (500.0, 501.0, 320.5, 240.5)


def cahvore(model="CAHVORE3,0.2 = general", **changes):
    """A model in the text form of JPL's programs, in a turned and shifted frame."""
    turned = matrix_from_rotation_vector([0.4, -0.7, 1.1])
    vectors = {
        "C": [0.86, 0.27, -1.9],
        "A": turned[2],
        "H": 400 * turned[0] + 0.2 * turned[1] + 319.5 * turned[2],
        "V": 402 * turned[1] + 239.5 * turned[2],
        "O": turned.T @ (np.array([0.01, -0.02, 1.0]) / np.linalg.norm([0.01, -0.02, 1.0])),
        "R": [1e-4, 0.05, -0.01],
        "E": [0.004, 0.002, 0.0],
    }
    lines = {name: " ".join(f"{value:.15f}" for value in vector) for name, vector in vectors.items()}
    lines = {"Model": model, "Dimensions": "640 480", **lines, "S": "not a number", **changes}
    kept = (f"{name} = {value}" for name, value in lines.items() if value is not None)
    return "# a comment with = in it\n\n" + "\n".join(kept) + "\n", turned, vectors


@pytest.mark.parametrize(
    ("stated", "model", "linearity"),
    [
        ("CAHV = perspective, linear", "cahvor", None),
        ("CAHVOR = perspective, distortion", "cahvor", None),
        ("CAHVORE1 = perspective, distortion, pupil", "cahvore", 1.0),
        ("CAHVORE2 = fish-eye", "cahvore", 0.0),
        ("CAHVORE3,-0.3 = general", "cahvore", -0.3),
    ],
)
def test_planetary_camera_models_are_read(tmp_path, stated, model, linearity):
    text, turned, vectors = cahvore(stated)
    found = read_camera_file(write(tmp_path, text))
    camera = found.camera
    assert camera.model == model and (camera.width_px, camera.height_px) == (640, 480)
    assert np.allclose(found.rotation_camera_from_body, turned, atol=1e-12)
    assert found.position_in_body_m == tuple(vectors["C"])
    if linearity is not None:
        assert camera.parameters[-1] == linearity
    # A far point on the axis O is seen where H and V put it, in any model; its pixel counts from the outer corner.
    o = vectors["O"] if "OR" in stated else turned[2]
    expected = np.array([vectors["H"] @ o, vectors["V"] @ o]) / (vectors["A"] @ o) + 0.5
    assert np.allclose(camera.project(turned @ o * 1e7), expected, atol=1e-6)
    if stated.startswith("CAHV ="):
        point = np.array([0.3, -0.2, 5.0]) @ turned
        expected = np.array([vectors["H"] @ point, vectors["V"] @ point]) / (vectors["A"] @ point) + 0.5
        assert np.allclose(camera.project(turned @ point), expected, atol=1e-9)


def test_a_cahv_model_with_perpendicular_axes_is_a_pinhole(tmp_path):
    text, _, _ = cahvore("CAHV", H=" ".join(map(str, (400 * matrix_from_rotation_vector([0.4, -0.7, 1.1])[0]))))
    camera = read_camera_file(write(tmp_path, text)).camera
    assert camera.model == "pinhole" and camera.cx_px == pytest.approx(0.5) and camera.fx_px == pytest.approx(400)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "CAHVORE4 = new"}, "Model: got CAHVORE4, expected CAHV, CAHVOR, CAHVORE1"),
        ({"model": "CAHVORE = general"}, "Model: got CAHVORE, expected"),
        ({"model": "CAHVORE3 = general"}, "Model: got CAHVORE3, expected"),
        ({"model": "CAHVORE3,half = general"}, "Model: got CAHVORE3,half, expected"),
        ({"model": "CAHVORE3,2 = general"}, "with P from -1 to 1"),
        ({"Dimensions": None}, "Dimensions: got nothing, expected 2 numbers"),
        ({"Dimensions": "640.5 480"}, "Dimensions: got [640.5, 480.0]"),
        ({"Dimensions": "1e9 480"}, "Dimensions: got [1000000000.0, 480.0]"),
        ({"O": None}, "O: got nothing, expected 3 numbers"),
        ({"R": "0.1 0.2"}, "R: got 0.1 0.2, expected 3 numbers"),
        ({"R": "0.1 nan 0.2"}, "R: got 0.1 nan 0.2, expected 3 numbers"),
        ({"A": "0 0 2"}, "A: got length 2, expected a unit vector"),
        ({"O": "0 0 0"}, "O: got length 0, expected a unit vector"),
        ({"V": "0 0 0"}, "H: got"),
        ({"R": "0.0 -1.5 0.0"}, "R: got coefficients that fold the image at"),
    ],
)
def test_a_wrong_planetary_model_is_refused_in_one_line(tmp_path, changes, message):
    with pytest.raises(UserError) as refused:
        read_camera_file(write(tmp_path, cahvore(**changes)[0]))
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_mountings_of_kalibr_and_euroc_are_read(tmp_path):
    rotation, place = matrix_from_rotation_vector([0.3, -1.2, 0.4]), np.array([0.1, -0.2, 0.3])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place
    found = read_camera_file(write(tmp_path, kalibr(T_cam_imu=pose.tolist())))
    assert np.allclose(found.rotation_camera_from_body, rotation)
    assert np.allclose(found.position_in_body_m, -rotation.T @ place)
    sensor = {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": np.linalg.inv(pose).ravel().tolist()},
        "rate_hz": 20,
        "resolution": list(SIZE),
        "camera_model": "pinhole",
        "intrinsics": [458.654, 457.296, 367.215, 248.375],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": RADTAN[:4].tolist(),
    }
    text = "#Default imu sensor yaml file\n" + "".join(f"{key}: {json.dumps(value)}\n" for key, value in sensor.items())
    euroc = read_camera_file(write(tmp_path, text))
    assert np.allclose(euroc.rotation_camera_from_body, rotation)
    assert np.allclose(euroc.position_in_body_m, -rotation.T @ place)


def test_settings_of_perilune_are_given_back(tmp_path):
    content = {"width_px": 64, "distortion": {"k1": 0.1}}
    assert read_camera_file(write(tmp_path, content)) == content


def without(content, *names):
    return {key: value for key, value in content.items() if key not in names}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (kalibr(camera_model="omni"), "intrinsics: got 4 values, expected 5 numbers"),
        (kalibr(camera_model="omni", intrinsics=[-1, 9, 9, 9, 9]), "intrinsics: xi: got -1.0, expected 0 to 1000"),
        (
            kalibr(camera_model="omni", intrinsics=[1, 9, 9, 9, 9], model="equidistant"),
            "distortion_model: got equidistant, expected radtan or none with camera_model omni",
        ),
        (kalibr(camera_model="ds"), "camera_model: got ds, expected pinhole or omni"),
        (kalibr(model="fov", coefficients=[1.0, 0, 0, 0]), "distortion_model: got fov, expected one of plumb_bob"),
        (kalibr() | {"cam1": {}}, "camera: got several cameras: cam0, cam1"),
        ({"cam0": 3}, "cam0: got int, expected a mapping"),
        (kalibr(intrinsics=[1, 2, 3]), "intrinsics: got 3 values, expected 4 numbers"),
        (kalibr(resolution=None), "resolution: got nothing, expected 2 numbers"),
        (
            kalibr(model="equidistant", coefficients=[-0.5, 0, 0, 0]),
            "distortion_model equidistant: got coefficients that fold the image at 46.78 degrees from the axis",
        ),
        (ros(coefficients=[0.1] * 8, model="rational_polynomial"), "rational_polynomial: got coefficients beyond k3"),
        (ros(coefficients=[0.1, 0.1, 0, 0], model=""), "distortion_model: got no model for four coefficients"),
        (ros(coefficients=[0.1] * 3), "distortion_coefficients: got 3 values, expected 0 or 4 or 5"),
        (ros(binning_x=2), "binning_x: got 2"),
        (ros(binning_y=2), "binning_y: got 2"),
        (ros(roi={"width": 20, "height": 20}), "roi: got"),
        (ros(np.array([[1, 0.1, 2], [0, 1, 2], [0, 0, 1]])), "camera_matrix: got"),
        (without(ros(), "image_width"), "image_width: got nothing"),
        (ros(image_width=0.5), "image size: got [0.5, 480.0]"),
        (ros(camera_matrix={"data": ["a"] * 9}), "camera_matrix: got"),
        (ros(camera_matrix={"data": [float("inf")] * 9}), "camera_matrix: got"),
        ({"Camera.fx": 458.0, "Camera.fy": 457.0}, "camera: got settings of ORB-SLAM"),
        ("<?xml version='1.0'?><opencv_storage></opencv_storage>", "camera: got an XML file of OpenCV"),
        ("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 PINHOLE 1 1 1\n", "camera: got COLMAP's cameras.txt"),
        ("- 1\n", "camera: got list"),
        ("a: " + "x" * 100_000, "expected at most 100000"),
        ("K: &a [1]\nD: *a\n", "syntax: got an alias or anchor"),
    ],
)
def test_what_is_refused_is_named(tmp_path, content, message):
    path = write(tmp_path, content)
    with pytest.raises(UserError) as raised:
        read_camera_file(path)
    assert str(raised.value).startswith(str(path)) and message in str(raised.value)


def test_missing_files_folders_and_other_bytes(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    for name, message in (("none.yaml", "no such file"), (".", "a folder"), ("binary.yaml", "not UTF-8")):
        with pytest.raises(UserError, match=message):
            read_camera_file(tmp_path / name)
