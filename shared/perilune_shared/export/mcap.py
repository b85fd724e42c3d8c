"""Export to MCAP: each descent as a bag of ROS 2 messages, which Foxglove and `ros2 bag` open.

The folder of a bag has an MCAP file, with all message definitions, and metadata.yaml. Messages are written in temporal
order. rosbags writes the file (needs `pip install "perilune-shared[mcap]"`). Format: https://mcap.dev/spec
"""

import heapq
import json
import re
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import CameraRecord
from perilune_shared.errors import UserError
from perilune_shared.export import ros2
from perilune_shared.export.descents import Descent, count_descent_frames, descents_of, measurements, shots_of
from perilune_shared.export.estimates import Estimates, estimates_of
from perilune_shared.export.foxglove import LAYOUT_NAME, foxglove_layout
from perilune_shared.export.rows import Choice
from perilune_shared.storage import files
from perilune_shared.storage.new_store import new_files
from perilune_shared.storage.store import Address

TRUTH, ESTIMATE, RANGE, TF, TF_STATIC = "/truth/pose", "/estimate/pose", "/altimeter/range", "/tf", "/tf_static"
_TOPIC_PART = re.compile("[A-Za-z][A-Za-z0-9_]{0,63}")
_Message = tuple[int, str, Any]
"""Time in nanoseconds, topic, message."""


def export_mcap(
    dataset: Dataset,
    out: Address,
    progress: Progress,
    split: str | None = None,
    choose: Choice | None = None,
    trajectory: str | None = None,
    estimates: Path | None = None,
) -> int:
    """Write `out`/<scene_id>/<trajectory_id>/<trajectory_id>.mcap for each descent, and a layout for Foxglove.

    Returns the number of descents. Only labels that `choose` selects are written. `trajectory` (scene_id/trajectory_id)
    selects one descent, and `estimates` is the filter's output for this descent (see `read_estimates`). Raises
    UserError if `out` is not empty, an image is missing, no frame is selected, ROS has no name for a camera's lens
    model, or rosbags is not installed.
    """
    ros2.message_types()
    _check_cameras(dataset)
    task = progress.add_task("mcap", total=count_descent_frames(dataset, split, trajectory), unit="frames")
    topics: dict[str, str] = {}
    n_descents = 0
    with new_files(out) as folder:
        for descent in descents_of(dataset, split, choose, trajectory):
            flight = None if estimates is None else estimates_of(dataset, descent, estimates)
            bag = files.inside(folder, descent.name)
            for topic, kind in _write_bag(bag, dataset, descent, flight, lambda: progress.advance(task)):
                topics.setdefault(topic, kind)
            n_descents += 1
        text = json.dumps(foxglove_layout(topics), indent=2)
        files.write_text(folder / LAYOUT_NAME, text + "\n")
    return n_descents


def _write_bag(bag: Path, dataset: Dataset, descent: Descent, flight: Estimates | None, advance: Any) -> list[Any]:
    """Write one bag; return its topics with their types."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store = ros2.message_types()
    streams = [
        _frames(dataset, descent, advance),
        _inertial(dataset, descent),
        _ranges(dataset, descent),
        _estimates(flight),
    ]
    writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for time_ns, topic, message in heapq.merge(*streams, key=itemgetter(0)):
            kind = message.__msgtype__
            if topic not in connections:
                profiles = [_latched()] if topic == TF_STATIC else []
                connections[topic] = writer.add_connection(topic, kind, typestore=store, offered_qos_profiles=profiles)
            writer.write(connections[topic], time_ns, store.serialize_cdr(message, kind))
    return [(topic, each.msgtype) for topic, each in connections.items()]


def _frames(dataset: Dataset, descent: Descent, advance: Any) -> Iterator[_Message]:
    cameras = _cameras(dataset)
    for number, shot in enumerate(shots_of(dataset, descent)):
        now = ros2.stamp_ns(shot.row["time_s"])
        if number == 0:
            yield now, TF_STATIC, ros2.fixed_transforms(now, cameras)
        name = shot.row["camera"] if dataset.info.cameras else "camera"
        base = f"/camera/{name}" if dataset.info.cameras else "/camera"
        body = ros2.transform(now, ros2.SITE, ros2.BODY, shot.position_m, shot.rotation_site_from_body)
        yield now, TF, ros2.transforms(body)
        yield now, TRUTH, ros2.pose_stamped(now, shot.position_m, shot.rotation_site_from_body)
        yield now, f"{base}/camera_info", ros2.camera_info(now, name, shot.camera)
        yield now, f"{base}/image/compressed", ros2.compressed_image(now, name, shot.png, shot.bits)
        yield now, f"{base}/labels", ros2.detections(now, name, shot.labels)
        yield now, f"{base}/annotations", ros2.annotations(now, shot.labels)
        advance()


def _check_cameras(dataset: Dataset) -> None:
    """Raise UserError for a lens model that ROS cannot describe."""
    for record in _cameras(dataset).values():
        if ros2.distortion_of(record) is None:
            expected = f"pinhole, {' or '.join(ros2.FISHEYES)}, which ROS can describe"
            raise UserError(dataset.store.at("dataset.json"), "camera.model", record.model, expected)


def _cameras(dataset: Dataset) -> dict[str, CameraRecord]:
    return {str(name): each for name, each in (dataset.info.cameras or {"camera": dataset.info.camera}).items()}


def _inertial(dataset: Dataset, descent: Descent) -> Iterator[_Message]:
    rows = measurements(dataset, descent, "inertial")
    for grade in sorted(set(rows["grade"])):
        if not _TOPIC_PART.fullmatch(grade):
            raise UserError(dataset.store, "inertial: grade", grade, "letters, digits and _, which topics may have")
    names = ("time_s", "grade", "angular_rate_radps", "specific_force_mps2")
    for time_s, grade, rate, force in zip(*(rows[name] for name in names), strict=True):
        now = ros2.stamp_ns(time_s)
        yield now, f"/imu/{grade}/data_raw", ros2.imu(now, rate, force)


def _ranges(dataset: Dataset, descent: Descent) -> Iterator[_Message]:
    rows = measurements(dataset, descent, "ranges")
    for time_s, range_m in zip(rows["time_s"], rows["range_m"], strict=True):
        now = ros2.stamp_ns(time_s)
        yield now, RANGE, ros2.laser_range(now, range_m)


def _estimates(flight: Estimates | None) -> Iterator[_Message]:
    for k in range(0 if flight is None else len(flight.time_s)):
        assert flight is not None
        now = ros2.stamp_ns(flight.time_s[k])
        pose = flight.position_m[k], flight.rotation_site_from_body[k], flight.covariance[k]
        yield now, ESTIMATE, ros2.pose_with_covariance(now, *pose)


def _latched() -> Any:
    """The quality of service of /tf_static: subscribers that start later receive the last message."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    unlimited = QosTime(0, 0)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        unlimited,
        unlimited,
        QosLiveliness.SYSTEM_DEFAULT,
        unlimited,
        False,
    )
