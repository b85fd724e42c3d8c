"""Read a camera from a file: settings, a calibration of OpenCV, ROS, Kalibr or EuRoC, or CAHV, CAHVOR, CAHVORE.

In these calibrations the centre of the top-left pixel is at (0, 0). In perilune it is at (0.5, 0.5), so half a pixel is
added to the principal point. An equidistant distortion (Kannala and Brandt 2006, doi 10.1109/TPAMI.2006.153) is
replaced by the best-fitting Brown-Conrady distortion if the fit error is at most 0.05 px. Otherwise it is kept as the
lens model `kannala_brandt`.

CAHV, CAHVOR and CAHVORE are read from text files as JPL's programs write them, lines `Model = CAHVORE3,0.5 = general`,
`Dimensions = width height` and `C = x y z` to `E = x y z`. O_C has its z axis along A and its y axis along V's part
normal to A.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from perilune_shared.config.yaml_text import parse_yaml
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import NO_DISTORTION, Camera, Distortion
from perilune_shared.geometry.frames import Array

_LARGEST_FILE_BYTES = 100_000
_MATRIX = ("camera_matrix", "k", "cameramatrix", "intrinsic_matrix", "m1", "mtx")
_COEFFICIENTS = ("distortion_coefficients", "distortion_coeffs", "d", "dist_coeffs", "distcoeffs", "d1", "dist")
_WIDTH, _HEIGHT = ("image_width", "width"), ("image_height", "height")
_SIZE = ("resolution", "image_size", "imagesize")
_BROWN = ("plumb_bob", "radtan", "radial-tangential", "rational_polynomial", "brown_conrady", "none")
_EQUIDISTANT = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4")
_LARGEST_SIDE_PX = 100_000
_LARGEST_FIT_PX = 0.05
"""Maximum fit error of a Brown-Conrady distortion that replaces an equidistant distortion, pixels."""
_WIDEST_RAD = np.radians(80)
_HALF_PX = 0.5
_LARGEST_XI = 1000.0
_LARGEST_COEFFICIENT = 1e6
_UNIT_TOLERANCE = 1e-3
_SMALL_SKEW_PX = 1e-4
"""Skew that is ignored in a CAHV model, pixels; the text values are rounded."""
_CAHV = re.compile(r"^\s*Model\s*=\s*CAHV", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera from a calibration file of another program."""

    camera: Camera
    """Intrinsics."""
    rotation_camera_from_body: Array | None
    """Rotation (3, 3) from the frame of the inertial unit to the camera; None if the file states none."""
    position_in_body_m: tuple[float, float, float]
    """Centre of projection in the frame of the inertial unit, metres; zeros if the file states none."""


def read_camera_file(path: Path) -> Calibration | dict[str, Any]:
    """Return the calibration in a file, or the mapping in the file if it has settings of perilune.

    The mapping is not validated. Raises UserError if the file is not YAML or its calibration is not supported.
    """
    text = _text(path)
    if _CAHV.search(text):
        return _cahvore(path, text)
    content = _mapping(path, text)
    keys = {key.lower(): key for key in content}
    cameras = [key for key in content if re.fullmatch(r"cam\d+", key)]
    if len(cameras) > 1:
        raise UserError(path, "camera", f"several cameras: {', '.join(cameras)}", "a file with one of these sections")
    if cameras:
        section = content[cameras[0]]
        if not isinstance(section, dict):
            raise UserError(path, cameras[0], type(section).__name__, "a mapping")
        return _kalibr(path, section)
    if any(re.match(r"camera\d?\.(fx|type|name)", key) for key in keys):
        raise UserError(path, "camera", "settings of ORB-SLAM", "a calibration of OpenCV, ROS or Kalibr, or fx_px ...")
    if "intrinsics" in keys and not isinstance(content[keys["intrinsics"]], dict):
        return _kalibr(path, content)
    if any(name in keys for name in _MATRIX):
        return _opencv(path, {key.lower(): value for key, value in content.items()})
    return content


def _text(path: Path) -> str:
    if not path.is_file():
        raise UserError(path, "camera", "a folder" if path.is_dir() else "no such file", "a YAML file")
    if path.stat().st_size > _LARGEST_FILE_BYTES:
        expected = f"at most {_LARGEST_FILE_BYTES}; keep intrinsics and distortion alone"
        raise UserError(path, "camera", f"{path.stat().st_size} bytes", expected)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(path, "camera", "bytes that are not UTF-8", "a YAML file") from None


def _mapping(path: Path, text: str) -> dict[str, Any]:
    if text.lstrip().startswith("<"):
        raise UserError(path, "camera", "an XML file of OpenCV", "YAML: give cv::FileStorage a name that ends in .yaml")
    if "CAMERA_ID" in text and text.lstrip().startswith("#"):
        raise UserError(path, "camera", "COLMAP's cameras.txt", "a calibration of OpenCV, ROS or Kalibr, or fx_px ...")
    content = parse_yaml(_plain(text), path)
    if not isinstance(content, dict):
        raise UserError(path, "camera", type(content).__name__, "a mapping with the settings of a camera")
    return content


def _plain(text: str) -> str:
    """Return YAML text without OpenCV's directive and tags and without document markers."""
    lines = text.replace("!!opencv-matrix", "").splitlines()
    while lines and (not lines[0].strip() or re.match(r"%YAML|---\s*$", lines[0])):
        del lines[0]
    while lines and (not lines[-1].strip() or re.match(r"(---|\.\.\.)\s*$", lines[-1])):
        del lines[-1]
    return "\n".join(lines)


def _kalibr(path: Path, content: dict[str, Any]) -> Calibration:
    """Return the camera in a camchain file of Kalibr or a sensor.yaml of EuRoC."""
    model = str(content.get("camera_model", "pinhole"))
    if model not in ("pinhole", "omni"):
        raise UserError(path, "camera_model", model, "pinhole or omni")
    *xi, fx, fy, cx, cy = _numbers(path, "intrinsics", content.get("intrinsics"), (4 + (model == "omni"),))
    size = _numbers(path, "resolution", content.get("resolution"), (2,))
    name = "distortion_coeffs" if "distortion_coeffs" in content else "distortion_coefficients"
    coefficients = _numbers(path, name, content.get(name, []), (0, 4, 5, 8))
    stated = str(content.get("distortion_model", "none" if not any(coefficients) else ""))
    camera = _camera(path, size, (fx, fy, cx, cy), stated, coefficients, is_omni=model == "omni")
    if xi:
        if not 0 <= xi[0] <= _LARGEST_XI:
            raise UserError(path, "intrinsics: xi", xi[0], f"0 to {_LARGEST_XI:g}")
        camera = replace(camera, model="unified", parameters=(xi[0],))
    rotation, position = None, np.zeros(3)
    for name, is_inverse in (("T_cam_imu", False), ("T_BS", True)):
        if content.get(name) is not None:
            matrix = _numbers(path, name, content[name], (16,))
            pose = np.array(matrix).reshape(4, 4)
            rotation = pose[:3, :3].T if is_inverse else pose[:3, :3]
            position = pose[:3, 3] if is_inverse else -pose[:3, :3].T @ pose[:3, 3]
    x, y, z = position.tolist()
    return Calibration(camera, rotation, (x, y, z))


def _opencv(path: Path, content: dict[str, Any]) -> Calibration:
    """Return the camera in a file of OpenCV (FileStorage) or ROS (camera_calibration, camera_info).

    The keys of `content` are in lower case.
    """
    name = next(name for name in _MATRIX if name in content)
    fx, skew, cx, zero, fy, cy, *last = _numbers(path, name, content[name], (9,))
    if skew or zero or last != [0, 0, 1]:
        raise UserError(path, name, f"{[fx, skew, cx, zero, fy, cy, *last]}", "fx, 0, cx, 0, fy, cy, 0, 0, 1")
    size = next((content[key] for key in _SIZE if key in content), None)
    if size is None:
        size = [next((content[key] for key in keys if key in content), None) for keys in (_WIDTH, _HEIGHT)]
        if None in size:
            missing = "image_width" if size[0] is None else "image_height"
            raise UserError(path, missing, "nothing", "the size of the image, image_width and image_height")
    coefficients = _coefficients(path, content)
    stated = str(content.get("distortion_model", ""))
    if content.get("fisheye_model") == 1:
        stated = stated or "equidistant"
    region = content.get("roi")
    for name in ("binning_x", "binning_y"):
        if content.get(name) not in (None, 0, 1):
            raise UserError(path, name, content[name], "0 or 1: a calibration without binning")
    if isinstance(region, dict) and any(region.get(key) for key in ("x_offset", "y_offset", "width", "height")):
        raise UserError(path, "roi", region, "zeros: a calibration of the whole image")
    pair = _numbers(path, "image size", size, (2,))
    return Calibration(_camera(path, pair, (fx, fy, cx, cy), stated, coefficients), None, (0.0, 0.0, 0.0))


def _coefficients(path: Path, content: dict[str, Any]) -> list[float]:
    name = next((name for name in _COEFFICIENTS if name in content), None)
    return [] if name is None else _numbers(path, name, content[name], (0, 4, 5, 8, 12, 14))


def _camera(
    path: Path,
    size: Sequence[float],
    intrinsics: Sequence[float],
    model: str,
    coefficients: list[float],
    *,
    is_omni: bool = False,
) -> Camera:
    """Return a camera with distortion.

    Without the name of a model, the distortion is Brown-Conrady, but four coefficients then raise UserError.
    """
    width, height = (int(value) for value in size)
    if [width, height] != list(size) or not 1 <= min(size) <= max(size) <= _LARGEST_SIDE_PX:
        raise UserError(path, "image size", list(size), f"two whole numbers from 1 to {_LARGEST_SIDE_PX}")
    fx, fy, cx, cy = intrinsics
    if min(fx, fy) <= 0:
        raise UserError(path, "focal length", min(fx, fy), "above 0, pixels")
    pinhole = Camera(width, height, fx, fy, cx + _HALF_PX, cy + _HALF_PX)
    if not model and len(coefficients) == 4 and any(coefficients):
        expected = "plumb_bob or equidistant: four coefficients fit both"
        raise UserError(path, "distortion_model", "no model for four coefficients", expected)
    name = model.strip().lower() or _BROWN[0]
    if name in _EQUIDISTANT and is_omni:
        raise UserError(path, "distortion_model", model, "radtan or none with camera_model omni")
    if name in _EQUIDISTANT:
        return _fitted(path, pinhole, coefficients or [0.0] * 4)
    if name not in _BROWN:
        raise UserError(path, "distortion_model", model, f"one of {', '.join((*_BROWN, *_EQUIDISTANT))}")
    if any(coefficients[5:]):
        found = f"coefficients beyond k3 ({', '.join(f'{value:g}' for value in coefficients[5:])})"
        raise UserError(path, f"distortion_model {name}", found, "only k1, k2, p1, p2, k3; calibrate with these alone")
    return Camera(*_fields(pinhole), distortion=_five(coefficients) if name != "none" else NO_DISTORTION)


def _five(coefficients: Sequence[float]) -> Distortion:
    k1, k2, p1, p2, k3 = (*coefficients[:5], *[0.0] * (5 - len(coefficients[:5])))
    return k1, k2, p1, p2, k3


def _fields(camera: Camera) -> tuple[int, int, float, float, float, float]:
    return camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px


def _fitted(path: Path, pinhole: Camera, coefficients: Sequence[float]) -> Camera:
    """Return the camera with the Brown-Conrady distortion that best fits an equidistant distortion.

    Returns a camera of the lens model `kannala_brandt` if the fit error is too large. Raises UserError if that folds.
    """
    field = "distortion_model equidistant"
    if len(coefficients) != 4:
        raise UserError(path, field, f"{len(coefficients)} coefficients", "4")
    if max(map(abs, coefficients)) > _LARGEST_COEFFICIENT:
        raise UserError(path, field, f"{max(coefficients, key=abs):g}", f"at most {_LARGEST_COEFFICIENT:g}")
    angle = np.linspace(0, _WIDEST_RAD, 4001)
    square = angle**2
    factor = np.ones_like(angle)
    for power, each in enumerate(coefficients, 1):
        factor = factor + each * square**power
    distorted = angle * factor
    far = pinhole.rays(pinhole.outline())[:, :2]
    largest = float(np.hypot(*far.T).max())
    inside = int(np.argmax(distorted >= largest)) if (distorted >= largest).any() else 0
    exact = replace(pinhole, model="kannala_brandt", parameters=tuple(coefficients))
    if exact.folds_back():
        found = f"coefficients that fold the image at {exact.fold_angle_deg:.2f} degrees from the axis"
        raise UserError(path, field, found, "a fold outside the image")
    if not inside or (np.diff(distorted[: inside + 1]) <= 0).any():
        return exact
    radius, target = np.tan(angle[1 : inside + 1]), distorted[1 : inside + 1]
    powers = np.stack([radius**3, radius**5, radius**7], axis=1)
    weight = np.ones_like(radius)
    # Increase the weights of large errors until the largest error is minimal (Lawson's algorithm).
    for _ in range(60):
        fit = np.linalg.lstsq(powers * weight[:, None], (target - radius) * weight, rcond=None)[0]
        error = np.abs(powers @ fit - (target - radius))
        weight = np.sqrt(weight**2 * (error + 1e-12))
        weight = weight / weight.mean()
    worst_px = float(error.max()) * max(pinhole.fx_px, pinhole.fy_px)
    if not worst_px <= _LARGEST_FIT_PX:
        return exact
    k1, k2, k3 = fit.tolist()
    return Camera(*_fields(pinhole), distortion=(k1, k2, 0.0, 0.0, k3))


def _cahvore(path: Path, text: str) -> Calibration:
    """Return the camera of a file with a CAHV, CAHVOR or CAHVORE model.

    Position and attitude are relative to the frame of the file, which is taken for the frame of the body.
    """
    lines = (line.partition("=") for line in text.splitlines() if not line.lstrip().startswith("#"))
    values = {name.strip(): value.strip() for name, sign, value in lines if sign}
    stated = values["Model"].partition("=")[0].strip()
    match = re.fullmatch(r"(CAHV|CAHVOR)|CAHVORE(?:([123])(?:,(\S+))?)", stated)
    linear = {"1": 1.0, "2": 0.0}.get(match[2] or "") if match else None
    if match and match[2] == "3" and match[3]:
        try:
            linear = float(match[3])
        except ValueError:
            match = None
    if not match or (match[2] and (linear is None or not -1 <= linear <= 1)):
        expected = "CAHV, CAHVOR, CAHVORE1, CAHVORE2 or CAHVORE3,P with P from -1 to 1"
        raise UserError(path, "Model", stated, expected)
    names = {"CAHV": "CAHV", "CAHVOR": "CAHVOR"}.get(match[1] or "", "CAHVORE")
    vectors = {name: np.array(_stated(path, name, values, 3)) for name in names}
    width, height = _stated(path, "Dimensions", values, 2)
    if [width, height] != [int(width), int(height)] or not 1 <= min(width, height) <= max(
        width, height
    ) <= _LARGEST_SIDE_PX:
        raise UserError(path, "Dimensions", [width, height], f"two whole numbers from 1 to {_LARGEST_SIDE_PX}")
    for name in [each for each in "AO" if each in vectors]:
        length = float(np.linalg.norm(vectors[name]))
        if not abs(length - 1) <= _UNIT_TOLERANCE:
            raise UserError(path, name, f"length {length:.6g}", "a unit vector")
        vectors[name] = vectors[name] / length
    a, h, v = vectors["A"], vectors["H"], vectors["V"]
    cy = float(v @ a)
    down = v - cy * a
    fy = float(np.linalg.norm(down))
    y = down / fy if fy > 0 else down
    x = np.cross(y, a)
    fx, skew, cx = (float(h @ each) for each in (x, y, a))
    if not (fx > 0 and fy > 0):
        raise UserError(path, "H", h.tolist(), "A, H and V as in CAHV: A forward, H to the right, V down")
    rotation = np.stack([x, y, a])
    camera = Camera(int(width), int(height), fx, fy, cx + _HALF_PX, cy + _HALF_PX)
    if names != "CAHV" or abs(skew) > _SMALL_SKEW_PX:
        axis, r = rotation @ vectors.get("O", a), vectors.get("R", np.zeros(3))
        parameters = (skew, *axis.tolist(), *r.tolist())
        if names == "CAHVORE":
            parameters = (*parameters, *vectors["E"].tolist(), float(linear or 0.0))
        camera = replace(camera, model="cahvore" if names == "CAHVORE" else "cahvor", parameters=parameters)
    if camera.folds_back():
        found = f"coefficients that fold the image at {camera.fold_angle_deg:.2f} degrees from O"
        raise UserError(path, "R", found, "a fold outside the image")
    cx_m, cy_m, cz_m = vectors["C"].tolist()
    return Calibration(camera, rotation, (cx_m, cy_m, cz_m))


def _stated(path: Path, name: str, values: dict[str, str], count: int) -> list[float]:
    """Return the numbers of a line `name = ...`. Raises UserError unless there are `count` finite numbers."""
    text = values.get(name)
    try:
        numbers = [float(each) for each in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e9:
        raise UserError(path, name, "nothing" if text is None else text[:100], f"{count} numbers: {name} = 1.0 ...")
    return numbers


def _numbers(path: Path, field: str, value: object, lengths: Sequence[int]) -> list[float]:
    """Return the numbers in a list, a list of lists or a mapping with `data`.

    Raises UserError on anything else, on infinite numbers, and unless the count is one of `lengths`.
    """
    if isinstance(value, dict):
        value = value.get("data")
    flat: list[object] = []
    for each in value if isinstance(value, list) else [value]:
        flat += each if isinstance(each, list) else [each]
    are_numbers = all(isinstance(each, int | float) and not isinstance(each, bool) for each in flat)
    if value is None or not are_numbers or len(flat) not in lengths:
        found = "nothing" if value is None else f"{len(flat)} values" if are_numbers else value
        raise UserError(path, field, found, f"{' or '.join(str(length) for length in lengths)} numbers")
    try:
        numbers = [float(each) for each in flat]  # type: ignore[arg-type]
    except OverflowError:
        numbers = [np.inf]
    if not np.isfinite(numbers).all():
        raise UserError(path, field, flat, "finite numbers")
    return numbers
