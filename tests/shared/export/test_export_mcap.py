"""Bags with ROS 2 messages, read by two other readers, give the images, poses and measurements of the dataset."""

import json
import shutil
import sys
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
import tests.shared.export.test_estimates as estimates
from rich.progress import Progress
from tests.helpers import in_process
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.metadata import CameraRecord
from perilune_shared.editing.pack import pack
from perilune_shared.errors import UserError
from perilune_shared.export import ros2
from perilune_shared.export.mcap import export_mcap
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import matrix_from_quaternion, matrix_from_rotation_vector

pytest.importorskip("rosbags", reason="the extra `mcap` is not installed")
EPOCH_S = 946_684_800


@pytest.fixture(scope="module")
def descents(tmp_path_factory) -> Path:
    """Dataset for navigation: two descents of 5 frames with inertial measurements and ranges."""
    root = tmp_path_factory.mktemp("descents") / "set"
    return build_dataset(root, "nav", splits={"train": 1, "test": 1}, n_frames=5, side_px=64, craters=400)


@pytest.fixture(scope="module")
def bags(descents, tmp_path_factory) -> Path:
    return exported(open_dataset(descents), tmp_path_factory.mktemp("bags") / "out")


def exported(dataset, out, **choice) -> Path:
    with Progress(disable=True) as progress:
        export_mcap(dataset, out, progress, **choice)
    return out


def by_mcap(path: Path) -> list:
    """Topic, log time (ns) and message, decoded by the definitions in the file (mcap, mcap-ros2-support)."""
    pytest.importorskip("mcap_ros2", reason="a reader for tests only")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        return [(c.topic, m.log_time, message) for _, c, m, message in reader.iter_decoded_messages()]


def by_rosbags(path: Path) -> list:
    """The same by rosbags, which takes the definitions of messages that it does not know from the file."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        return [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]


def of_topic(messages: list, topic: str) -> list:
    return [message for name, _, message in messages if name == topic]


def seconds(message) -> float:
    """Seconds since the first frame, by the header of a message."""
    return message.header.stamp.sec - EPOCH_S + message.header.stamp.nanosec / 1e9


def matrix(transform) -> np.ndarray:
    q, t = transform.rotation, transform.translation
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix_from_quaternion([q.w, q.x, q.y, q.z]), [t.x, t.y, t.z]
    return pose


def chain(messages: list, child: str, parent: str, time_s: float = 0.0) -> np.ndarray:
    """The pose of one frame in another, as tf2 finds it: the transforms at a time, and the static ones."""
    known = {}
    for message in of_topic(messages, "/tf_static") + of_topic(messages, "/tf"):
        for each in message.transforms:
            if each.child_frame_id not in known or seconds(each) == time_s:
                known[each.child_frame_id] = (each.header.frame_id, matrix(each.transform))
    pose = np.eye(4)
    while child != parent:
        child, step = known[child]
        pose = step @ pose
    return pose


@pytest.mark.parametrize("read", [by_mcap, by_rosbags])
@pytest.mark.parametrize("name", ["s000/t000", "s001/t001"])
def test_a_bag_equals_the_manifest(descents, bags, read, name):
    dataset = open_dataset(descents)
    scene, trajectory = name.split("/")
    messages = read(bags / name / f"{trajectory}.mcap")
    times = [time for _, time, _ in messages]
    assert times == sorted(times)
    frames = dataset.table("frames", None, scene, trajectory).to_pandas().sort_values("time_s")
    images = of_topic(messages, "/camera/image/compressed")
    infos = of_topic(messages, "/camera/camera_info")
    assert len(images) == len(infos) == len(frames) == 5
    for row, image, info in zip(frames.itertuples(), images, infos, strict=True):
        assert bytes(image.data) == (descents / row.png_path).read_bytes()
        assert image.format.startswith("mono8; png") and image.header.frame_id == "camera_optical_frame"
        assert seconds(image) == pytest.approx(row.time_s, abs=1e-9) and seconds(info) == seconds(image)
        assert (info.width, info.height, info.distortion_model) == (64, 64, "plumb_bob")
        expected = [row.fx_px, 0, row.cx_px - 0.5, 0, row.fy_px, row.cy_px - 0.5, 0, 0, 1]
        assert np.allclose(info.k, expected) and np.allclose(np.reshape(info.p, (3, 4))[:, :3].ravel(), expected)
        pose = chain(messages, "camera_optical_frame", "site", seconds(image))
        assert np.allclose(pose[:3, :3].T, matrix_from_quaternion(row.rotation_wxyz), atol=1e-9)
        assert np.allclose(pose[:3, 3], row.position_m, atol=1e-9)
    truth = of_topic(messages, "/truth/pose")
    assert {message.header.frame_id for message in truth} == {"site"}
    assert np.allclose([[m.pose.position.x, m.pose.position.z] for m in truth], np.stack(frames["position_m"])[:, ::2])
    inertial = dataset.table("inertial", None, scene, trajectory).to_pandas()
    imu = of_topic(messages, "/imu/tactical/data_raw")
    assert [seconds(message) for message in imu] == pytest.approx(inertial["time_s"].tolist(), abs=1e-9)
    for measured, kind in (("angular_rate_radps", "angular_velocity"), ("specific_force_mps2", "linear_acceleration")):
        found = [[getattr(getattr(message, kind), axis) for axis in "xyz"] for message in imu]
        assert np.allclose(found, np.stack(inertial[measured]), atol=0, rtol=1e-15)
    assert all(message.orientation_covariance[0] == -1 for message in imu)
    ranges = dataset.table("ranges", None, scene, trajectory).to_pandas()
    found = [message.range for message in of_topic(messages, "/altimeter/range")]
    assert np.allclose(found, ranges["range_m"], rtol=1e-6)


@pytest.mark.parametrize("read", [by_mcap, by_rosbags])
def test_labels_are_detections_and_annotations(descents, bags, read):
    dataset = open_dataset(descents)
    messages = read(bags / "s000/t000/t000.mcap")
    labels = dataset.table("labels", None, "s000", "t000").to_pandas().sort_values(["frame_id", "crater_id"])
    assert len(labels) > 20
    found, loops = [], []
    for boxes, drawn in zip(
        of_topic(messages, "/camera/labels"), of_topic(messages, "/camera/annotations"), strict=True
    ):
        assert len(boxes.detections) == len(drawn.points)
        for each, loop in zip(boxes.detections, drawn.points, strict=True):
            box = each.bbox
            centre = [box.center.position.x + 0.5, box.center.position.y + 0.5]
            found.append([int(each.id), *centre, box.size_x / 2, box.size_y / 2, box.center.theta])
            assert each.results[0].hypothesis.class_id == "crater"
            assert loop.type == 2
            loops.append(np.mean([[point.x, point.y] for point in loop.points], axis=0))
    names = ["crater_id", *(f"ellipse_{n}" for n in ("cx_px", "cy_px", "a_px", "b_px", "theta_rad"))]
    assert np.allclose(found, labels[names].to_numpy(np.float64), atol=1e-6)
    assert np.allclose(loops, labels[names[1:3]], atol=1e-4)


def test_a_crater_projects_by_camera_info_and_tf_to_its_detection(descents, bags):
    """The convention of pixels in ROS: the centre of the top-left pixel is (0, 0)."""
    messages = by_rosbags(bags / "s000/t000/t000.mcap")
    craters = open_dataset(descents).table("craters", None, "s000").to_pandas().set_index("crater_id")
    info, boxes = of_topic(messages, "/camera/camera_info")[2], of_topic(messages, "/camera/labels")[2]
    pose = np.linalg.inv(chain(messages, "camera_optical_frame", "map", seconds(info)))
    k = np.reshape(info.k, (3, 3))
    camera = Camera(64, 64, k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    for each in boxes.detections[:5]:
        crater = craters.loc[int(each.id)]
        # `map` points east and north, the manifest's O_L west and south.
        centre = pose[:3, :3] @ [-crater["x_m"], -crater["y_m"], crater["z_m"]] + pose[:3, 3]
        normal = pose[:3, :3] @ [-crater["normal_x"], -crater["normal_y"], crater["normal_z"]]
        ellipse = project_circles(camera, [centre], [normal], [crater["diameter_m"] / 2])
        assert ellipse.cx_px[0] == pytest.approx(each.bbox.center.position.x, abs=1e-3)
        assert ellipse.cy_px[0] == pytest.approx(each.bbox.center.position.y, abs=1e-3)


def test_any_mounting_lens_and_several_cameras(descents, tmp_path):
    dataset = open_dataset(descents)
    record = CameraRecord.of(
        Camera(64, 64, 90.0, 91.0, 31.0, 33.0, (-0.1, 0.02, 1e-3, -2e-3, 0.01)),
        matrix_from_rotation_vector([2.5, 0.2, -0.7]),
        (1.0, -2.0, 0.5),
    )
    dataset.info = dataset.info.model_copy(update={"camera": record})
    messages = by_rosbags(exported(dataset, tmp_path / "one", trajectory="s000/t000") / "s000/t000/t000.mcap")
    info = of_topic(messages, "/camera/camera_info")[1]
    assert np.allclose(info.d, record.distortion)
    row = dataset.table("frames", None, "s000", "t000").to_pandas().sort_values("time_s").iloc[1]
    pose = chain(messages, "camera_optical_frame", "site", seconds(info))
    assert np.allclose(pose[:3, :3].T, matrix_from_quaternion(row["rotation_wxyz"]), atol=1e-9)
    assert np.allclose(pose[:3, 3], row["position_m"], atol=1e-9)
    body = chain(messages, "base_link", "site", seconds(info))
    assert np.linalg.norm(body[:3, 3] - row["position_m"]) == pytest.approx(np.sqrt(5.25))
    dataset.info = dataset.info.model_copy(update={"cameras": {"down": record, "side": record}})
    frames = dataset.table

    def with_names(table, *arguments, **options):
        rows = frames(table, *arguments, **options)
        if table != "frames" or "camera" not in rows.column_names:
            return rows
        place = rows.column_names.index("camera")
        return rows.set_column(place, rows.schema.field("camera"), [["down", "side", "down", "side", "down"]])

    dataset.table = with_names
    bag = exported(dataset, tmp_path / "two", trajectory="s000/t000") / "s000/t000/t000.mcap"
    messages = by_rosbags(bag)
    assert len(of_topic(messages, "/camera/down/image/compressed")) == 3
    assert len(of_topic(messages, "/camera/side/camera_info")) == 2
    assert of_topic(messages, "/camera/side/labels")[0].header.frame_id == "side_optical_frame"
    check_layout(tmp_path / "two", {topic for topic, _, _ in messages})


@pytest.mark.parametrize("model, coefficients", [("kannala_brandt", (0.1, -0.02, 3e-3, 0.0)), ("equidistant", ())])
def test_a_fisheye_is_equidistant_in_ros(descents, tmp_path, model, coefficients):
    dataset = open_dataset(descents)
    camera = Camera(64, 64, 40.0, 41.0, 31.0, 33.0, model=model, parameters=coefficients)
    dataset.info = dataset.info.model_copy(update={"camera": CameraRecord.of(camera, np.eye(3), (0.0, 0.0, 0.0))})
    messages = by_rosbags(exported(dataset, tmp_path / "one", trajectory="s000/t000") / "s000/t000/t000.mcap")
    info = of_topic(messages, "/camera/camera_info")[0]
    assert info.distortion_model == "equidistant" and np.allclose(info.d, coefficients or np.zeros(4))
    # OpenCV's fisheye, with pixel centres at whole numbers.
    point = np.array([[0.4, -0.3, 1.0]])
    drawn, _ = cv2.fisheye.projectPoints(point[:, None], np.zeros(3), np.zeros(3), info.k.reshape(3, 3), info.d)
    assert np.allclose(drawn.ravel() + 0.5, camera.project(point)[0], atol=1e-9)


def test_a_lens_without_a_name_in_ros_is_refused(descents, tmp_path):
    dataset = open_dataset(descents)
    camera = Camera(64, 64, 40.0, 41.0, 31.0, 33.0, model="unified", parameters=(1.2,))
    dataset.info = dataset.info.model_copy(update={"camera": CameraRecord.of(camera, np.eye(3), (0.0, 0.0, 0.0))})
    with pytest.raises(UserError, match=r"camera.model: got unified, expected pinhole, equidistant or kannala_brandt"):
        exported(dataset, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_altimeter_looks_down(descents, bags):
    messages = by_rosbags(bags / "s000/t000/t000.mcap")
    reading = of_topic(messages, "/altimeter/range")[0]
    axis = chain(messages, reading.header.frame_id, "base_link")[:3, 0]
    assert np.allclose(axis, [0, 0, -1])
    assert np.isposinf(ros2.laser_range(0, float("nan")).range)


def test_the_filter_and_its_covariance(descents, tmp_path):
    covariance = estimates.covariance_9()
    estimates.trace(covariance, (0.0, 10.0)).to_parquet(tmp_path / "frames.parquet")
    out = tmp_path / "out"
    words = ["export", str(descents), "--format", "mcap", "--out", str(out), "--trajectory", "s001/t001"]
    done = in_process.call(main, *words, "--estimates", str(tmp_path / "frames.parquet"))
    assert done.returncode == 0 and "1 descents" in done.stdout
    messages = by_rosbags(out / "s001/t001")
    poses = of_topic(messages, "/estimate/pose")
    assert [seconds(pose) for pose in poses] == [0, 10]
    found = np.reshape(poses[0].pose.covariance, (6, 6))
    assert np.allclose(found[:3, :3], covariance[:3, :3])
    turned = estimates.SITE_FROM_BODY @ covariance[6:, 6:] @ estimates.SITE_FROM_BODY.T
    assert np.allclose(found[3:, 3:], turned) and poses[0].pose.pose.position.z == 300
    check_layout(out, {topic for topic, _, _ in messages})


def check_layout(out: Path, topics: set[str]) -> None:
    """Every topic that the layout names exists, and every panel of the tree is configured."""
    layout = json.loads((out / "foxglove-layout.json").read_text())

    def texts(value):
        if isinstance(value, dict):
            return [text for k, v in value.items() for text in (k, *texts(v))]
        return [text for each in value for text in texts(each)] if isinstance(value, list) else [value]

    def panels(tree):
        return [tree] if isinstance(tree, str) else panels(tree["first"]) + panels(tree["second"])

    named = {text.split(".")[0] for text in texts(layout) if isinstance(text, str) and text.startswith("/")}
    assert named and named <= topics
    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    assert {name.split("!")[0] for name in layout["configById"]} == {"3D", "Image", "Plot"}


def test_the_layout_names_only_topics_of_the_export(descents, bags, crowded, tmp_path):
    check_layout(bags, {topic for topic, _, _ in by_rosbags(bags / "s000/t000")})
    one = exported(open_dataset(crowded), tmp_path / "few", trajectory="s000/t000")
    topics = {topic for topic, _, _ in by_rosbags(one / "s000/t000")}
    assert not any(topic.startswith(("/imu", "/altimeter", "/estimate")) for topic in topics)
    check_layout(one, topics)


def test_a_packed_dataset_a_split_and_a_choice(descents, bags, tmp_path):
    pack(open_dataset(descents), tmp_path / "packed", shard_mb=0.01)
    packed = exported(open_dataset(tmp_path / "packed"), tmp_path / "all")
    for name in ("s000/t000/t000.mcap", "s001/t001/t001.mcap", "foxglove-layout.json"):
        assert (packed / name).read_bytes() == (bags / name).read_bytes()
    none = exported(
        open_dataset(descents),
        tmp_path / "none",
        split="test",
        choose=lambda _dataset, _scene, labels: np.zeros(len(labels), bool),
    )
    assert [path.name for path in none.glob("*/*/*.mcap")] == ["t001.mcap"]
    messages = by_rosbags(none / "s001/t001")
    assert len(of_topic(messages, "/camera/labels")) == 5
    assert not any(message.detections for message in of_topic(messages, "/camera/labels"))


def test_metadata_describe_the_bag_for_ros2(bags):
    yaml = pytest.importorskip("yaml")
    info = yaml.safe_load((bags / "s000/t000/metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert info["storage_identifier"] == "mcap" and info["relative_file_paths"] == ["t000.mcap"]
    profiles = {
        each["topic_metadata"]["name"]: each["topic_metadata"]["offered_qos_profiles"]
        for each in info["topics_with_message_count"]
    }
    assert profiles["/tf_static"][0]["durability"] == "transient_local" and profiles["/tf"] == []
    assert info["starting_time"]["nanoseconds_since_epoch"] == EPOCH_S * 10**9


def test_memory_does_not_depend_on_the_number_of_descents(crowded, tmp_path):
    def peak(**choice) -> int:
        dataset = open_dataset(crowded)
        tracemalloc.start()
        exported(dataset, tmp_path / choice.get("trajectory", "all"), **choice)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    names = [f"s{k:03d}/t{k:03d}" for k in range(4)]
    exported(open_dataset(crowded), tmp_path / "first", trajectory=names[0])  # loads libraries
    assert peak() < 1.1 * max(peak(trajectory=name) for name in names)


def test_a_failed_export_leaves_no_files(descents, tmp_path):
    dataset = open_dataset(descents)
    frames = dataset.table("frames", ["png_path"], "s001").to_pylist()
    copy = tmp_path / "copy"
    shutil.copytree(descents, copy)
    (copy / frames[-1]["png_path"]).write_bytes(b"\x89PNG")
    with pytest.raises(UserError, match="image: got not a PNG file, expected a grey PNG of 64 x 64 pixels"):
        exported(open_dataset(copy), tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy"]


@pytest.mark.parametrize("value", [float("nan"), 1e12])
def test_times_out_of_range_are_refused(descents, tmp_path, value):
    dataset = open_dataset(descents)
    read = dataset.table

    def damaged(table, *arguments, **options):
        rows = read(table, *arguments, **options)
        if table != "inertial":
            return rows
        place = rows.column_names.index("time_s")
        return rows.set_column(place, rows.schema.field("time_s"), [[value, *rows["time_s"].to_pylist()[1:]]])

    dataset.table = damaged
    with pytest.raises(UserError, match="inertial: time_s"):
        exported(dataset, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def refused(*words) -> str:
    done = in_process.call(main, "export", *map(str, words))
    assert done.returncode == 2 and done.stderr.strip().count("\n") == 0 and "Traceback" not in done.stderr
    return done.stderr


def test_mistakes_are_reported_in_one_line(descents, tmp_path, monkeypatch):
    out = tmp_path / "out"
    line = refused(descents, "--format", "mcap", "--out", out, "--trajectory", "s000/t999")
    assert "got s000/t999, expected one of 2 of the dataset: s000/t000, s001/t001" in line
    line = refused(descents, "--format", "mcap", "--out", out, "--estimates", tmp_path)
    assert "2 descents in the dataset, expected --trajectory" in line
    line = refused(descents, "--format", "tum", "--out", out, "--trajectory", "s000/t000")
    assert "--trajectory: --format: got tum, expected mcap or rerun" in line
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "rosbags.typesys", None)
        ros2.message_types.cache_clear()
        line = refused(descents, "--format", "mcap", "--out", out)
        assert 'pip install "perilune-shared[mcap]"' in line
    ros2.message_types.cache_clear()
    assert not list(tmp_path.iterdir())
