"""Poses in the formats of other programs: read, or refused with the name of the format."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.progress import Progress
from tests.helpers import in_process
from tests.helpers.scenes import config_with

from perilune_render.cli.main import main
from perilune_render.config.scene import SceneConfig, ViewConfig
from perilune_render.poses.file import read_poses
from perilune_render.poses.plan import given_plan
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.export.trajectory import export_kitti, export_tum
from perilune_shared.geometry.frames import matrix_from_quaternion, matrix_from_rotation_vector, quaternion_from_matrix

SITE = (-45.5, 177.6)
START_NS = 1_403_715_524_907_143_168
STEPS_NS = (0, 50_000_001, 1_000_000_000)
PLACES = np.array([[10.0, -20, 800], [11, -20, 790], [12, -21, 780]])
DOWN = np.diag([1.0, -1, -1])
"""rotation_camera_from_site of a camera that looks down, with OpenCV's axes."""
EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
EUROC_MORE = ", v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]" + "".join(
    f", b_{kind}_RS_S_{axis} [{unit}]" for kind, unit in (("w", "rad s^-1"), ("a", "m s^-2")) for axis in "xyz"
)
OPENCV = np.eye(3)
BLENDER = np.diag([1.0, -1, -1])
"""Rotation to OpenCV's axes from those of a camera in Blender."""


def rotations(more=0.0):
    """rotation_camera_from_site of three views of the ground, tilted; `more` turns them about the vertical."""
    tilts = ([0.3, 0.1, 0], [-0.2, 0.3, 0], [0.1, -0.3, 0])
    turns = [matrix_from_rotation_vector([0, 0, angle + more]) for angle in (2.6, 3.0, -2.8)]
    return [matrix_from_rotation_vector(tilt) @ turn @ DOWN for tilt, turn in zip(tilts, turns, strict=True)]


def quaternions(matrices):
    return np.stack([quaternion_from_matrix(each) for each in matrices])


def table(*columns):
    return [[repr(float(value)) for value in row] for row in np.column_stack(columns)]


def lines(rows, separator=" "):
    return "".join(separator.join(row) + "\n" for row in rows)


def site_from_camera(axes=OPENCV):
    """Quaternions w x y z from a camera with these axes to the site."""
    return quaternions([(axes.T @ each).T for each in rotations()])


def euroc(more=False):
    rows = table(PLACES, site_from_camera(), *([np.arange(9).reshape(3, 3) / 8, np.zeros((3, 6))] if more else []))
    rows = [[str(START_NS + step), *row] for step, row in zip(STEPS_NS, rows, strict=True)]
    return EUROC + (EUROC_MORE if more else "") + "\n" + lines(rows, ",")


def tum(order=(1, 2, 3, 0), axes=OPENCV):
    return lines(table(np.arange(3), PLACES, site_from_camera(axes)[:, order]))


def kitti(matrices=None):
    matrices = [each.T for each in rotations()] if matrices is None else matrices
    return lines(table(np.concatenate([np.array(matrices), PLACES[:, :, None]], axis=2).reshape(3, 12)))


def read(tmp_path, text, name, axes=None, header="# frame: O_L\n"):
    path = tmp_path / name
    path.write_text(header + text)
    return read_poses(path, *SITE, axes)


def check(found, time_s=(0, 1, 2)):
    assert np.allclose(found.time_s, time_s, rtol=0, atol=1e-12)
    assert np.allclose(found.position_m, PLACES, rtol=0, atol=1e-12)
    assert np.allclose(matrix_from_quaternion(found.rotation_wxyz), rotations(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("more", [False, True])
@pytest.mark.parametrize("name", ["data.csv", "data.txt"])
def test_euroc_nanoseconds_keep_their_digits_and_w_is_first(tmp_path, name, more):
    found = read(tmp_path, euroc(more), name)
    check(found, np.array(STEPS_NS) / 1e9)
    assert np.allclose(found.velocity_mps, np.arange(9).reshape(3, 3) / 8 if more else 0)


def test_an_euroc_header_before_the_frame_or_without_a_number_sign_is_read_too(tmp_path):
    head, *rest = euroc().splitlines(keepends=True)
    check(read(tmp_path, "".join([head, "# frame: O_L\n", *rest]), "a.csv", header=""), np.array(STEPS_NS) / 1e9)
    check(read(tmp_path, euroc()[1:], "b.csv"), np.array(STEPS_NS) / 1e9)


@pytest.mark.parametrize("name", ["poses.tum", "poses.TUM", "poses.txt"])
def test_tum_with_comments_between_rows_commas_and_capitals(tmp_path, name):
    text = tum().replace("\n", "\n# a remark\n", 1)
    check(read(tmp_path, text, name))
    check(read(tmp_path, "timestamp,tx,ty,tz,qx,qy,qz,qw\n" + text.replace(" ", ","), "with_header.csv"))
    check(read(tmp_path, tum().replace(" ", ","), name))


def test_csv_with_comments_between_rows_commas_at_the_end_and_spaces(tmp_path):
    rows = [", ".join(row) for row in table(np.arange(3), PLACES, quaternions(rotations()))]
    names = "time_s , x_m, y_m, z_m, qw, qx, qy, qz"
    check(read(tmp_path, "\n".join([names, rows[0], "# a remark", "", *rows[1:]]), "a.csv"))
    check(read(tmp_path, "\n".join(f"{row}," for row in [names, *rows]), "B.CSV"))
    check(read(tmp_path, "\n".join([names, *(f"{row},,," for row in rows)]).replace(",", ";"), "c.csv"))


@pytest.mark.parametrize("times", ["poses.times.txt", "times.txt"])
def test_kitti_matrices_with_times_beside_them(tmp_path, times):
    (tmp_path / times).write_text("0.0\n0.5\n1.25\n")
    check(read(tmp_path, kitti(), "poses.txt"), (0, 0.5, 1.25))


@pytest.mark.parametrize("stated", [True, False])
def test_axes_of_blender_are_converted(tmp_path, stated):
    header = "# frame: O_L\n" + ("# camera_axes: blender\n" if stated else "")
    check(read(tmp_path, tum(axes=BLENDER), "poses.tum", None if stated else "x,-y,-z", header))


def test_axes_turn_the_angular_velocity_too_and_parquet_states_them(tmp_path):
    names = ["time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz", "wx_radps", "wy_radps", "wz_radps"]
    turns = np.arange(9).reshape(3, 3) / 100
    values = np.column_stack([np.arange(3), PLACES, quaternions([BLENDER.T @ each for each in rotations()]), turns])
    data = pa.Table.from_pandas(pd.DataFrame(values, columns=names))
    path = tmp_path / "poses.parquet"
    pq.write_table(data.replace_schema_metadata({"frame": "O_L", "camera_axes": "x,-y,-z"}), path)
    found = read_poses(path, *SITE)
    check(found)
    assert np.allclose(found.angular_velocity_radps, turns * [1, -1, -1])
    with pytest.raises(UserError, match="--camera-axes: got opencv, expected x,-y,-z"):
        read_poses(path, *SITE, "opencv")


CSV = "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("data.csv", euroc().replace("q_RS_w", "q_RS_u"), "column of an EuRoC file: got q_RS_u, expected q_RS_"),
        ("data.csv", EUROC.split(", q_RS")[0] + "\n1,2,3,4\n", "column of an EuRoC file: got no q_RS_w"),
        ("data.csv", euroc().replace(str(START_NS), "soon"), "data.csv:3: timestamp: got soon, expected an integer"),
        (
            "data.csv",
            euroc().replace(str(START_NS + STEPS_NS[1]), str(START_NS)),
            f"data.csv:4: time_s: got {START_NS} ns after {START_NS} ns",
        ),
        ("00.txt", kitti(), "times of a KITTI file: got no such file, expected 00.times.txt or times.txt"),
        (
            "00.txt",
            kitti(np.array([1.1 * np.eye(3)] * 3)),
            "00.txt:2: matrix_11: got 1.1, expected the matrix of a rot",
        ),
        ("00.txt", kitti(np.array([np.diag([1, 1, -1])] * 3)), "expected the matrix of a rotation"),
        ("00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "poses of a KITTI file: got the identity at the first pose"),
        ("00.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n", "00.txt:2: values: got 16, expected timestamp tx"),
        ("poses.csv", "time_s,x_m,y_m,z_m,roll,pitch,yaw\n0,0,0,9,0,0,0\n", "rotation: got Euler angles (column roll)"),
        ("poses.csv", "time_s,x_m,y_m,z_m,r11,r12\n0,0,0,9,1,0\n", "rotation: got a rotation matrix (column r11)"),
        ("poses.csv", "0,0,0,800,0,1,0,0\n", "poses.csv:2: header: got 0, 0, 0, 800"),
        ("poses.csv", CSV + "0,0,0,800,0,1,0\n", "poses.csv:3: values: got 7, expected 8"),
        (
            "images.txt",
            "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n1 1 0 0 0 0 0 0 1 a.png\n",
            "COLMAP",
        ),
        ("transforms.json", "{}", "format: got JSON, as of NeRF or Blender"),
        ("poses.bag", "#ROSBAG V2.0\n", "format: got a ROS bag"),
        (
            "poses.tum",
            f"{START_NS} 0 0 800 1 0 0 0\n",
            "time_s: got 1.4037155249071432e+18, expected seconds; these may",
        ),
        ("poses.csv", CSV + f"{START_NS},0,0,800,0,1,0,0\n", "expected seconds; these may be nanoseconds"),
        (
            "poses.csv",
            CSV + "1403715524.907143,0,0,800,0,1,0,0\n" * 2,
            "poses.csv:4: time_s: got 1403715524.907143 after 1403715524.907143, expected increasing times",
        ),
        (
            "poses.csv",
            "# camera_axes: x,y\n" + CSV,
            "camera axes: got x,y, expected three axes of a right-handed frame",
        ),
        ("poses.tum", "# rotation: camera_from_site\n" + tum(), "rotation: got camera_from_site, expected site_from"),
    ],
)
def test_what_is_refused_names_the_format_or_the_place(tmp_path, name, text, message):
    with pytest.raises(UserError) as raised:
        # Axes are read last.
        read(tmp_path, text + ("0,0,0,800,0,1,0,0\n" if text.startswith("# camera_axes") else ""), name)
    assert message in str(raised.value)


@pytest.mark.parametrize(("text", "name"), [(euroc(), "EuRoC"), (tum(), "TUM"), (CSV + "0,0,0,800,0,1,0,0\n", "CSV")])
def test_a_file_that_states_no_frame_is_named_with_its_format(tmp_path, text, name):
    with pytest.raises(UserError, match=f"frame: got not stated in this {name} file"):
        read(tmp_path, text, "poses.tum" if name == "TUM" else "poses.csv", header="")


def csv(order=(0, 1, 2, 3), axes=OPENCV, more=0.0):
    q = quaternions([axes.T @ each for each in rotations(more)])
    return CSV + lines(table(np.arange(3), PLACES, q[:, order]), ",")


@pytest.mark.parametrize(
    "views", [(), (ViewConfig(height_m=700, reach_m=2000), ViewConfig(height_m=900, reach_m=2000))]
)
@pytest.mark.parametrize(
    ("text", "name", "hint"),
    [
        (tum(order=(0, 1, 2, 3)), "poses.tum", "quaternions with w first (qw qx qy qz)"),
        (tum(axes=BLENDER), "poses.tum", "--camera-axes blender"),
        (csv(order=(1, 2, 3, 0), more=np.pi), "poses.csv", "quaternions with w last (qx qy qz qw)"),
        (csv(axes=BLENDER), "poses.csv", "--camera-axes blender"),
    ],
)
def test_views_that_leave_the_ground_name_the_readings_that_would_show_it(tmp_path, text, name, hint, views):
    given = read(tmp_path, text, name)
    config = config_with(scene=SceneConfig(views=views))
    with pytest.raises(UserError) as raised:
        given_plan(given, config, "nav", tmp_path / name)
    assert "a view with the horizon, as in " in str(raised.value) and hint in str(raised.value)
    assert len(given_plan(read(tmp_path, csv(), "right.csv"), config, "nav", "right.csv")[0].trajectories) == 1


def test_with_a_horizon_a_view_of_the_sky_alone_names_the_axes(tmp_path):
    config = config_with(scene=SceneConfig(horizon=True))
    with pytest.raises(UserError, match="--camera-axes blender"):
        given_plan(read(tmp_path, csv(axes=BLENDER), "poses.csv"), config, "nav", "poses.csv")
    given = read(tmp_path, csv(), "poses.csv", "blender")
    with pytest.raises(UserError, match="--camera-axes opencv"):
        given_plan(given, config, "nav", "poses.csv")


def test_two_mistakes_together_are_named(tmp_path):
    """Blender writes matrices and quaternions from the camera to the world, with its own axes."""
    up = [matrix_from_rotation_vector([0.1, 0, 1.5])]
    q = quaternions([(BLENDER.T @ each @ DOWN).T for each in up])
    text = CSV + lines(table([0], PLACES[:1], q), ",")
    found = read(tmp_path, "# rotation: site_from_camera\n" + text, "right.csv", "blender")
    assert matrix_from_quaternion(found.rotation_wxyz)[0, 2, 2] < -0.9


def test_a_view_that_no_other_reading_repairs_is_refused_as_before(tmp_path):
    given = read(tmp_path, csv() + "3,0,0,800,0.7071067811865476,0.7071067811865476,0,0\n", "poses.csv")
    with pytest.raises(UserError, match="a view with the horizon, expected a view of the ground alone; state"):
        given_plan(given, config_with(scene=SceneConfig()), "nav", "poses.csv")


def test_the_commands_have_the_option(tmp_path):
    path = tmp_path / "poses.tum"
    path.write_text("# frame: O_L\n0 0 0 800 1 0 0 0\n")
    out = ["--out", tmp_path / "out", "--preset", "tiny", "--set", "dataset.render.engine=heightfield"]
    for axes, message in (("x,y", "--camera-axes: got x,y"), ("blender", "--camera-axes opencv")):
        done = in_process.call(main, "frames", "--poses", path, *out, "--camera-axes", axes)
        assert done.returncode == 2 and message in done.stderr, done.stderr
    done = in_process.call(main, "preview", "--out", tmp_path / "a.png", "--camera-axes", "blender")
    assert done.returncode == 2 and "got no --poses" in done.stderr
    assert sorted(each.name for each in tmp_path.iterdir()) == ["poses.tum"]


def test_the_export_of_a_dataset_is_read_as_it_lies(quick, tmp_path):
    dataset = open_dataset(quick / "nav")
    with Progress(disable=True) as progress:
        export_tum(dataset, tmp_path / "tum", progress)
        export_kitti(dataset, tmp_path / "kitti", progress)
    (row, *_) = dataset.table("trajectories", ["scene_id", "trajectory_id"]).to_pylist()
    truth = dataset.table("frames", None, row["scene_id"], row["trajectory_id"]).sort_by("time_s")
    found = read_poses(tmp_path / "tum" / row["scene_id"] / f"{row['trajectory_id']}.txt", *SITE)
    assert np.array_equal(found.position_m, np.array(truth["position_m"].to_pylist()))
    assert np.allclose(
        matrix_from_quaternion(found.rotation_wxyz), matrix_from_quaternion(truth["rotation_wxyz"].to_pylist())
    )
    kitti_file = tmp_path / "kitti" / row["scene_id"] / f"{row['trajectory_id']}.txt"
    with pytest.raises(UserError, match="poses of a KITTI file: got the identity at the first pose"):
        read_poses(kitti_file, *SITE)
