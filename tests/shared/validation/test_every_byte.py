"""Validation finds any changed byte, truncated or missing file, and inconsistent rows under a valid index."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from tests.helpers.hostile import digest, edit, pack, put, rewrite, sealed
from tests.sampling import every

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.validation.files import file_faults
from perilune_shared.validation.validate import validate

_HUGE = 2**32


def names_in(root):
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())


def is_named(root, name):
    """Whether a fault or an error names a file."""
    try:
        faults = validate(open_dataset(root))
    except UserError as error:
        return str(root / name) in str(error)
    return any(name in fault.file for fault in faults)


@pytest.fixture(scope="module", params=["files", "packed"])
def whole(request, little, tmp_path_factory):
    """A dataset that each example damages and restores."""
    root = Path(shutil.copytree(little, tmp_path_factory.mktemp("bytes") / "dataset"))
    if request.param == "packed":
        sealed(lambda folder: (pack(folder), shutil.rmtree(folder / "frames")))(root)
    assert validate(open_dataset(root)) == []
    return root


@seed(1)
@settings(max_examples=20, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.integers(0, _HUGE), at=st.integers(0, _HUGE), bits=st.integers(1, 255))
def test_any_flipped_bit_is_found(whole, which, at, bits):
    assert_flipped_bits_are_found(whole, which, at, bits)


@pytest.mark.slow
@seed(1)
@settings(max_examples=150, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.integers(0, _HUGE), at=st.integers(0, _HUGE), bits=st.integers(1, 255))
def test_any_of_more_flipped_bits_is_found(whole, which, at, bits):
    assert_flipped_bits_are_found(whole, which, at, bits)


def assert_flipped_bits_are_found(whole, which, at, bits):
    names = names_in(whole)
    name = names[which % len(names)]
    content = bytearray((whole / name).read_bytes())
    content[at % len(content)] ^= bits
    before = (whole / name).read_bytes()
    (whole / name).write_bytes(content)
    found = is_named(whole, name)
    (whole / name).write_bytes(before)
    assert found


@seed(2)
@settings(max_examples=20, database=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.integers(0, _HUGE), at=st.integers(0, _HUGE))
def test_any_truncated_file_is_found(whole, which, at):
    names = names_in(whole)
    name = names[which % len(names)]
    content = (whole / name).read_bytes()
    (whole / name).write_bytes(content[: at % len(content)])
    found = is_named(whole, name)
    (whole / name).write_bytes(content)
    assert found


@pytest.mark.parametrize("step", [31, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("pattern", ["dataset.json", "index/*.parquet"])
def test_every_byte_of_small_files_is_checked(pattern, step, victim):
    """Opening the dataset and comparing its files with the index, a part of validation, is enough."""
    (path,) = victim.glob(pattern)
    name, content = path.relative_to(victim).as_posix(), path.read_bytes()
    for at in range(0, len(content), step):
        path.write_bytes(content[:at] + bytes([content[at] ^ 0x01]) + content[at + 1 :])
        try:
            faults = [fault.file for fault in file_faults(open_dataset(victim))]
        except UserError as error:
            assert name in str(error)
            continue
        assert name in faults, at


def test_any_missing_file_is_found(whole):
    for name in names_in(whole):
        content = (whole / name).read_bytes()
        (whole / name).unlink()
        try:
            faults = validate(open_dataset(whole))
            assert any(fault.file == name for fault in faults), name
        except UserError as error:
            assert name in str(error)
        (whole / name).write_bytes(content)


def each(table, change):
    """Change every row of a table."""
    return lambda root: rewrite(root, table, lambda rows: [change(row) for row in rows])


def swap(*names):
    """Swap the values of two columns."""

    def change(row):
        row[names[0]], row[names[1]] = row[names[1]], row[names[0]]

    return change


def reorder(name, *order):
    """Reorder the components of a vector."""

    def change(row):
        row[name] = [row[name][k] for k in order]

    return change


def scale(name, factor):
    def change(row):
        row[name] = (np.asarray(row[name]) * factor).tolist()

    return change


def repeated(table, row=0):
    """Repeat a row and adapt the counts."""

    def damage(root):
        rewrite(root, table, lambda rows: rows.insert(row, dict(rows[row])))
        edit(lambda content: content["counts"].update({table: content["counts"][table] + 1}))(root)

    return damage


def without_row(table):
    """Remove a row."""
    return lambda root: rewrite(root, table, lambda rows: rows.pop())


def without_part(table):
    """Remove a table and adapt the counts."""

    def damage(root):
        (root / f"manifest/{table}/all.parquet").unlink()
        edit(lambda content: content["counts"].update({table: 0}))(root)

    return damage


def both(*damages):
    def damage(root):
        for one in damages:
            one(root)

    return damage


def turn_camera(content):
    swap("width_px", "height_px")(content["camera"])


PLACE = "latitude_deg", "longitude_deg"
POSE = "position_m+rotation_wxyz"
ELLIPSE = "ellipse_cx_px"
SWAPS = {
    "x and y of craters": (each("craters", swap("x_m", "y_m")), "craters", "latitude_deg"),
    "x and z of craters": (each("craters", swap("x_m", "z_m")), "craters", "longitude_deg"),
    "x and z of normals": (each("craters", swap("normal_x", "normal_z")), "labels", ELLIPSE),
    "latitude and longitude of craters": (
        each("craters", swap("latitude_deg", "longitude_deg")),
        "craters",
        "latitude",
    ),
    "latitude and longitude of sites": (each("scenes", swap("latitude_deg", "longitude_deg")), "craters", "latitude"),
    "the Sun's azimuth and elevation": (each("scenes", swap("sun_azimuth_deg", "sun_elevation_deg")), "", "sun_"),
    "x and y of positions": (each("frames", reorder("position_m", 1, 0, 2)), "frames", POSE),
    "y and z of positions": (each("frames", reorder("position_m", 0, 2, 1)), "frames", POSE),
    "z upside down": (each("frames", scale("position_m", [1, 1, -1])), "frames", POSE),
    "w behind x, y and z": (each("frames", reorder("rotation_wxyz", 1, 2, 3, 0)), "frames", POSE),
    "the rotation's inverse": (each("frames", scale("rotation_wxyz", [1, -1, -1, -1])), "frames", POSE),
    "x and y of the Sun": (each("frames", reorder("sun_direction", 1, 0, 2)), "frames", "sun_direction"),
    "y and z of the Sun": (each("frames", reorder("sun_direction", 0, 2, 1)), "frames", "sun_direction"),
    "the Sun from below": (each("frames", scale("sun_direction", -1.0)), "frames", "sun_direction"),
    "x and y of ellipses": (each("labels", swap("ellipse_cx_px", "ellipse_cy_px")), "labels", ELLIPSE),
    "axes of ellipses": (each("labels", swap("ellipse_a_px", "ellipse_b_px")), "labels", "ellipse_a_px"),
    "x and y of boxes": (each("labels", swap("bbox_x0_px", "bbox_y0_px")), "labels", "bbox_x0_px"),
    "corners of boxes": (each("labels", swap("bbox_x0_px", "bbox_x1_px")), "labels", "bbox_x0_px"),
    "degrees for radians": (each("labels", scale("ellipse_theta_rad", 180 / np.pi)), "labels", "ellipse_theta_rad"),
    "diameters for radii": (each("craters", scale("diameter_m", 2.0)), "labels", "ellipse_a_px"),
    "kilometres for metres": (each("frames", scale("position_m", 1e-3)), "frames", POSE),
    "milliseconds for seconds, backwards": (each("frames", scale("time_s", -1e3)), "frames", "time_s"),
    "a frame's quaternion twice as long": (each("frames", scale("rotation_wxyz", 2.0)), "frames", "rotation_wxyz"),
    "a frame's quaternion of no length": (each("frames", scale("rotation_wxyz", 0.0)), "frames", "rotation_wxyz"),
    "width and height of frames": (each("frames", swap("width_px", "height_px")), "frames", "width_px"),
    "width and height of the camera": (
        edit(turn_camera),
        "frames",
        "width_px",
    ),
    "width and height of both": (
        both(each("frames", swap("width_px", "height_px")), edit(turn_camera)),
        "frames/s000/t000/000000.png",
        "width_px",
    ),
    "the camera's axes": (edit(lambda c: c["camera"]["rotation_camera_from_body"].reverse()), "dataset.json", "camera"),
    "one scene's craters for another's": (
        each("craters", lambda row: row.update(scene_id={"s000": "s001", "s001": "s000"}[row["scene_id"]])),
        "scenes",
        "content_sha256",
    ),
    "one label's crater": (put("labels", "crater_id", 299), "labels", ELLIPSE),
    "one frame's pose": (put("frames", "position_m", [0.0, 0.0, 500.0]), "frames", POSE),
    "one frame's split": (put("frames", "split", "val"), "trajectories", "split"),
    "a scene in two splits": (
        both(put("frames", "split", "val"), put("trajectories", "split", None)),
        "frames",
        "split",
    ),
    **{
        f"a row of {table} twice": (repeated(table), table, key)
        for table, key in (
            ("scenes", "scene_id"),
            ("craters", "crater_id"),
            ("trajectories", "trajectory_id"),
            ("frames", "frame_id"),
            ("labels", "crater_id"),
        )
    },
    **{
        f"a row less in {table}": (without_row(table), "dataset.json", f"counts.{table}")
        for table in ("craters", "labels")
    },
    "no frames": (without_part("frames"), "trajectories", "n_frames"),
    "no craters": (without_part("craters"), "scenes", "content_sha256"),
    "no trajectories": (without_part("trajectories"), "frames", "frame_id"),
    "no scenes": (without_part("scenes"), "craters", "scene_id"),
}


def crop_frames(root):
    """Crop the frames to 32 x 24 pixels at the lower edge: the same camera, fewer rows."""

    def cut(row):
        path = root / row["png_path"]
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:24])
        content = path.read_bytes()
        row.update(height_px=24, png_bytes=len(content), png_sha256=digest(content))

    each("frames", cut)(root)
    edit(lambda content: content["camera"].update(height_px=24))(root)


@pytest.fixture(scope="module")
def flat(little, tmp_path_factory):
    """A dataset of oblong frames. Do not change it."""
    root = Path(shutil.copytree(little, tmp_path_factory.mktemp("oblong") / "dataset"))
    sealed(crop_frames)(root)
    assert validate(open_dataset(root)) == []
    return root


@pytest.mark.parametrize("name", every(3, SWAPS))
def test_inconsistent_rows_are_found_under_a_valid_index(name, flat, tmp_path):
    damage, file, column = SWAPS[name]
    root = Path(shutil.copytree(flat, tmp_path / "dataset"))
    sealed(damage)(root)
    try:
        faults = validate(open_dataset(root))
    except UserError as error:
        assert file in str(error) and column in str(error)
        return
    assert not any(fault.column == "SHA-256" for fault in faults)
    assert any(file in fault.file and column in fault.column for fault in faults), faults


@pytest.mark.parametrize("table", ["craters", "frames", "labels"])
def test_faults_have_the_row_number_in_the_file(table, flat, tmp_path):
    """Also if one file has the rows of several trajectories."""
    column, value = {
        "craters": ("latitude_deg", -79.0),
        "frames": ("cx_px", 17.0),
        "labels": ("ellipse_cx_px", 1.0),
    }[table]
    root = Path(shutil.copytree(flat, tmp_path / "dataset"))
    row = open_dataset(root).info.counts.model_dump()[table] - 2
    sealed(put(table, column, value, row))(root)
    (fault,) = [fault for fault in validate(open_dataset(root)) if fault.column == column]
    assert (fault.file, fault.row) == (f"manifest/{table}/all.parquet", row)
