"""Poses from a file: formats, frames, and what is refused."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.helpers.scenes import config_with, flat_scene

from perilune_render.config.scene import SceneConfig, ViewConfig
from perilune_render.flight.pose_checks import check_trajectories
from perilune_render.poses.file import read_poses
from perilune_render.poses.plan import given_plan
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import matrix_from_quaternion, selenographic_from_site

SITE = (-45.5, 177.6)
HEADER = "# frame: O_L\ntime_s,x_m,y_m,z_m,qw,qx,qy,qz\n"
NAMES = HEADER.split()[-1].split(",")
TURNED = (0.1, 0.9, 0.3, 0.2)
"""A quaternion that is not of length 1 and no half turn, so that its direction matters."""


def unit(q):
    return np.array(q) / np.linalg.norm(q)


def write(tmp_path, text, name="poses.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def row(time, place, q):
    return ",".join(f"{value:.17g}" for value in (time, *place, *q)) + "\n"


def test_a_csv_in_the_landing_frame(tmp_path):
    q = unit(TURNED)
    found = read_poses(write(tmp_path, HEADER + row(0, (1, 2, 300), q) + row(1.5, (4, 5, 200), -q)), *SITE)
    assert found.time_s.tolist() == [0, 1.5]
    assert found.position_m.tolist() == [[1, 2, 300], [4, 5, 200]]
    assert np.allclose(found.rotation_wxyz, [q, q], rtol=0, atol=1e-15)
    assert found.velocity_mps.tolist() == [[0, 0, 0]] * 2
    assert found.sun_deg is None


def test_a_tum_file_has_the_opposite_direction_of_rotation(tmp_path):
    w, x, y, z = unit(TURNED)
    text = f"# frame: O_L\n# timestamp tx ty tz qx qy qz qw\n7 1 2 300 {x!r} {y!r} {z!r} {w!r}\n".replace(
        "np.float64", ""
    )
    found = read_poses(write(tmp_path, text.replace("(", "").replace(")", ""), "poses.tum"), *SITE)
    expected = matrix_from_quaternion(unit(TURNED)).T
    assert np.allclose(matrix_from_quaternion(found.rotation_wxyz[0]), expected, rtol=0, atol=1e-14)


def test_the_same_poses_in_parquet_and_in_other_frames_are_equal(tmp_path):
    q, place = unit(TURNED), np.array([120.0, -340.0, 500.0])
    given = read_poses(write(tmp_path, HEADER + row(0, place, q)), *SITE)
    world = f"# frame: O_W\n# origin_m: 100 -300 1500\n{HEADER.splitlines()[1]}\n" + row(
        0, place - [100, -300, 1500], q
    )
    latitude, longitude = selenographic_from_site(place[0], place[1], *SITE)
    selenographic = "# frame: selenographic\ntime_s,latitude_deg,longitude_deg,height_m,qw,qx,qy,qz\n"
    selenographic += row(0, (latitude, longitude, place[2]), q)
    table = pd.read_csv(write(tmp_path, HEADER + row(0, place, q)), comment="#")
    parquet = tmp_path / "poses.parquet"
    pq.write_table(pa.Table.from_pandas(table).replace_schema_metadata({"frame": "O_L"}), parquet)
    others = [write(tmp_path, world, "w.csv"), write(tmp_path, selenographic, "s.csv"), parquet]
    for other in others:
        found = read_poses(other, *SITE)
        assert np.allclose(found.position_m, given.position_m, rtol=0, atol=1e-6), other
        assert np.allclose(found.rotation_wxyz, given.rotation_wxyz, rtol=0, atol=1e-15), other


def test_columns_of_velocity_sun_and_trajectory(tmp_path):
    names = HEADER.strip() + ",vx_mps,vy_mps,vz_mps,sun_azimuth_deg,sun_elevation_deg,trajectory\n"
    rows = [f"{t},0,0,300,0,1,0,0,1,2,-{t},90,{20 + t},{name}\n" for t, name in ((0, "b"), (1, "b"), (0, "a"))]
    found = read_poses(write(tmp_path, names + "".join(rows)), *SITE)
    assert found.velocity_mps[1].tolist() == [1, 2, -1]
    assert found.sun_deg[:, 1].tolist() == [20, 21, 20]
    assert found.trajectory.tolist() == [0, 0, 1]


GOOD = "0,0,0,300,0,1,0,0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEADER.replace("# frame: O_L\n", "") + GOOD, "frame: got not stated"),
        (HEADER.replace("O_L", "O_X") + GOOD, "frame: got O_X"),
        (HEADER.replace("O_L", "O_W") + GOOD, "origin_m: got not stated"),
        (HEADER.replace("z_m", "zm") + GOOD, "column: got zm, expected z_m"),
        (HEADER.replace(",qz", "") + "0,0,0,300,0,1,0\n", "column: got no qz"),
        (HEADER.replace("qz", "qz,vx_mps") + "0,0,0,300,0,1,0,0,1\n", "column: got no vy_mps"),
        (HEADER, "poses: got 0"),
        ("", "table: got no line"),
        (HEADER + "0,0,nan,300,0,1,0,0\n", ":3: y_m: got nothing"),
        (HEADER + GOOD + "1,0,inf,300,0,1,0,0\n", ":4: y_m: got inf"),
        (HEADER + "0,0,down,300,0,1,0,0\n", ":3: y_m: got down"),
        (HEADER + "0,0,0,300,0,1,0\n", ":3: values: got 7, expected 8"),
        (HEADER + GOOD.strip() + ",0\n", ":3: values: got 9, expected 8"),
        (HEADER + GOOD + "\n\n1,0,0,300,0,1,0,0,0\n", ":6: values: got 9, expected 8"),
        (HEADER + GOOD + "\n1,0,nan,300,0,1,0,0\n", ":5: y_m: got nothing"),
        (HEADER + "\n" + GOOD + "1,,0,300,0,1,0,0\n", ":5: x_m: got nothing"),
        (HEADER.strip() + ",qz\n" + GOOD.strip() + ",0\n", "column: got qz twice"),
        (HEADER + "0,0,0,300,0,0,0,0\n", ":3: quaternion: got length 0"),
        (HEADER + "0,0,0,300,0,2,0,0\n", ":3: quaternion: got length 2"),
        (HEADER + GOOD + GOOD, ":4: time_s: got 0 after 0"),
        (HEADER + "0,0,0,3e7,0,1,0,0\n", ":3: position: got 3e+07 m from the site"),
        (HEADER.replace("# frame", "# rotation: up\n# frame") + GOOD, "rotation: got up"),
        (
            HEADER.strip() + ",vx_mps,vy_mps,vz_mps\n" + GOOD.strip() + ",1e25,0,0\n",
            ":3: velocity: got 1e+25 m/s, expected at most 12000 m/s",
        ),
        (
            HEADER.strip() + ",wx_radps,wy_radps,wz_radps\n" + GOOD.strip() + ",0,99,99\n",
            ":3: angular velocity: got 140 rad/s, expected at most 100 rad/s",
        ),
        (
            HEADER.strip() + ",sun_azimuth_deg,sun_elevation_deg\n" + GOOD.strip() + ",0,-3\n",
            ":3: sun_elevation_deg: got -3",
        ),
        (
            HEADER.strip() + ",trajectory\n" + "".join(f"{k},{GOOD[2:-1]},{n}\n" for k, n in enumerate("aba")),
            ":5: trajectory: got a again",
        ),
    ],
)
def test_a_faulty_file_is_refused_with_its_line(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(UserError) as raised:
        read_poses(path, *SITE)
    assert str(raised.value).startswith(f"{path}{message}" if message.startswith(":") else f"{path}: {message}")


def test_the_lines_of_a_tum_file_count_comments_and_blank_lines(tmp_path):
    path = write(tmp_path, "# frame: O_L\n0 0 0 300 1 0 0 0\n# turn\n\n1 0 nan 300 1 0 0 0\n", "poses.tum")
    with pytest.raises(UserError, match=":5: y_m: got nothing"):
        read_poses(path, *SITE)


@pytest.mark.parametrize(("height_m", "message"), [(-3, "line 5: pose at 1 s: got z -3.0 m"), (1e-3, "line 5: got a")])
def test_a_pose_that_does_not_fit_the_ground_is_refused_with_its_line(tmp_path, height_m, message):
    path = write(tmp_path, HEADER + GOOD + f"\n1,0,0,{height_m},0,1,0,0\n")
    views = (ViewConfig(height_m=100, reach_m=200), ViewConfig(height_m=300, reach_m=300))
    stated = config_with(scene=SceneConfig(views=views) if height_m > 0 else SceneConfig())
    with pytest.raises(UserError, match=message) as raised:
        plan, _ = given_plan(read_poses(path, *SITE), stated, "nav", path)
        check_trajectories(plan, plan.trajectories, flat_scene(1000.0, 51), path)
    assert str(raised.value).startswith(str(path))


def test_frames_of_one_sun_share_a_scene_and_keep_the_times_of_the_whole_trajectory(tmp_path):
    names = HEADER.strip() + ",sun_azimuth_deg,sun_elevation_deg,trajectory\n"
    suns = [(0, 20), (359.98, 20.02), (30, 10), (0.02, 20), (30, 10), (0, 20)]
    rows = [f"{7 + 2 * t},{t},0,300,0,1,0,0,{sun[0]},{sun[1]},{t // 5}\n" for t, sun in enumerate(suns)]
    found, _ = given_plan(read_poses(write(tmp_path, names + "".join(rows)), *SITE), config_with(), "nav", "file")
    assert [(scene.sun_azimuth_deg, scene.sun_elevation_deg) for scene in found.scenes] == [(0, 20), (30, 10)]
    parts = {f"{each.scene_id}/{each.trajectory_id}": each for each in found.trajectories}
    assert {key: (list(each.frame_index), each.flight.time_s.tolist()) for key, each in parts.items()} == {
        "scene-0000/trajectory-0000": ([0, 1, 3], [0, 2, 6]),
        "scene-0000/trajectory-0001": ([0], [0]),
        "scene-0001/trajectory-0000": ([2, 4], [4, 8]),
    }
    part = parts["scene-0001/trajectory-0000"]
    assert part.flight.position_m[:, 0].tolist() == [2, 4]
    assert np.allclose(part.flight.nominal.position_at(part.flight.time_s), part.flight.position_m)
    assert [part.origin(k) for k in range(2)] == ["line 5", "line 7"]


def test_a_row_of_parquet_is_named(tmp_path):
    path, table = tmp_path / "poses.parquet", pd.DataFrame([[0, 0, 0, 3e7, 0, 1, 0, 0]], columns=NAMES)
    pq.write_table(pa.Table.from_pandas(table).replace_schema_metadata({"frame": "O_L"}), path)
    with pytest.raises(UserError, match="position: row 0: got"):
        read_poses(path, *SITE)


def test_a_missing_file_another_format_and_damaged_files_are_refused(tmp_path):
    (tmp_path / "damaged.parquet").write_bytes(b"PAR1 and no more")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    short = write(tmp_path, "# frame: O_L\n0 1 2 3\n", "short.tum")
    for name, field in (("missing.csv", "file"), ("damaged.parquet", "content"), ("binary.csv", "format")):
        with pytest.raises(UserError, match=f"{name}: {field}"):
            read_poses(tmp_path / name, *SITE)
    with pytest.raises(UserError, match=r"short.tum:2: values: got 4, expected timestamp"):
        read_poses(short, *SITE)
    with pytest.raises(UserError, match=r"format: got .md"):
        read_poses(write(tmp_path, "", "poses.md"), *SITE)
