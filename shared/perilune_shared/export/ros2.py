"""ROS 2 messages of a descent. Needs rosbags: `pip install "perilune-shared[mcap]"`.

Frames of reference follow REP-103 and REP-105: `map` (x east, y north, z up) -> `site` (O_L) -> `base_link` (O_B) ->
`<camera>_optical_frame` (O_C: x right, y down, z forward). In ROS, the centre of the top-left pixel is (0, 0), so the
principal point and the detections are 0.5 px smaller than in the manifest. Foxglove's annotations have the manifest's
origin, the outer corner of this pixel.
"""

import functools
import math
from typing import Any

import numpy as np
import pandas as pd

from perilune_shared.dataset.metadata import CameraRecord
from perilune_shared.errors import UserError
from perilune_shared.export.coco import polygons_of
from perilune_shared.geometry.frames import Array, quaternion_from_matrix

EPOCH_NS = 946_684_800 * 10**9
"""ROS time of the first frame, nanoseconds: 2000-01-01T00:00:00 UTC. A dataset has no date; tf2 reserves time 0."""
MAP, SITE, BODY, ALTIMETER = "map", "site", "base_link", "altimeter_link"
_MAP_FROM_SITE = np.diag([-1.0, -1.0, 1.0])
_BODY_FROM_ALTIMETER = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""A sensor_msgs/Range is measured along the x axis of its frame; the altimeter looks along -Z_B."""
_INFRARED = 1
_LINE_LOOP = 2
_GREEN = (0.31, 0.86, 0.31, 1.0)
_DEFINITIONS = {
    # vision_msgs 4, and the fields that all versions of foxglove_msgs have
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\n"
        "string id"
    ),
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
    "foxglove_msgs/msg/Point2": "float64 x\nfloat64 y",
    "foxglove_msgs/msg/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a",
    "foxglove_msgs/msg/CircleAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nfloat64 diameter\nfloat64 thickness\n"
        "foxglove_msgs/Color fill_color\nfoxglove_msgs/Color outline_color"
    ),
    "foxglove_msgs/msg/PointsAnnotation": (
        "uint8 UNKNOWN=0\nuint8 POINTS=1\nuint8 LINE_LOOP=2\nuint8 LINE_STRIP=3\nuint8 LINE_LIST=4\n"
        "builtin_interfaces/Time timestamp\nuint8 type\nfoxglove_msgs/Point2[] points\n"
        "foxglove_msgs/Color outline_color\nfoxglove_msgs/Color[] outline_colors\nfoxglove_msgs/Color fill_color\n"
        "float64 thickness"
    ),
    "foxglove_msgs/msg/TextAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nstring text\nfloat64 font_size\n"
        "foxglove_msgs/Color text_color\nfoxglove_msgs/Color background_color"
    ),
    "foxglove_msgs/msg/ImageAnnotations": (
        "foxglove_msgs/CircleAnnotation[] circles\nfoxglove_msgs/PointsAnnotation[] points\n"
        "foxglove_msgs/TextAnnotation[] texts"
    ),
}


@functools.cache
def message_types() -> Any:
    """Return rosbags' type store with the messages of ROS 2 Jazzy, vision_msgs and foxglove_msgs.

    Raises UserError if rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise UserError("--format mcap", "rosbags", "not installed", 'pip install "perilune-shared[mcap]"') from None
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def stamp_ns(time_s: float) -> int:
    """Return the ROS time in nanoseconds of a time in seconds since the first frame."""
    return EPOCH_NS + round(time_s * 1e9)


def transform(time_ns: int, parent: str, child: str, position_m: Any, rotation_parent_from_child: Array) -> Any:
    """Return a TransformStamped: the pose of the frame `child` in `parent`; position (3,), metres, rotation (3, 3)."""
    x, y, z = (float(value) for value in position_m)
    return _new(
        "geometry_msgs/msg/TransformStamped",
        header=_header(time_ns, parent),
        child_frame_id=child,
        transform=_new(
            "geometry_msgs/msg/Transform",
            translation=_new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=_quaternion(rotation_parent_from_child),
        ),
    )


def transforms(*items: Any) -> Any:
    """Return a TFMessage of several transforms."""
    return _new("tf2_msgs/msg/TFMessage", transforms=list(items))


def fixed_transforms(time_ns: int, cameras: dict[str, CameraRecord]) -> Any:
    """Return a TFMessage: the site, the altimeter and the cameras (by the prefix of their frame)."""
    mounted = [
        transform(
            time_ns, BODY, optical_frame(name), each.position_in_body_m, np.array(each.rotation_camera_from_body).T
        )
        for name, each in cameras.items()
    ]
    site = transform(time_ns, MAP, SITE, np.zeros(3), _MAP_FROM_SITE)
    return transforms(site, transform(time_ns, BODY, ALTIMETER, np.zeros(3), _BODY_FROM_ALTIMETER), *mounted)


def optical_frame(camera: str) -> str:
    """Return the name of a camera's frame."""
    return f"{camera}_optical_frame"


def pose_stamped(time_ns: int, position_m: Array, rotation_site_from_body: Array) -> Any:
    """Return a PoseStamped of the body in O_L."""
    pose = _pose(position_m, rotation_site_from_body)
    return _new("geometry_msgs/msg/PoseStamped", header=_header(time_ns, SITE), pose=pose)


def pose_with_covariance(time_ns: int, position_m: Array, rotation_site_from_body: Array, covariance: Array) -> Any:
    """Return a PoseWithCovarianceStamped of the body in O_L; covariance (6, 6), m and rad about the axes of O_L."""
    pose = _pose(position_m, rotation_site_from_body)
    both = _new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance.ravel())
    return _new("geometry_msgs/msg/PoseWithCovarianceStamped", header=_header(time_ns, SITE), pose=both)


def compressed_image(time_ns: int, camera: str, png: bytes, bits: int) -> Any:
    """Return a CompressedImage with a PNG file; `bits` is 8 or 16."""
    return _new(
        "sensor_msgs/msg/CompressedImage",
        header=_header(time_ns, optical_frame(camera)),
        format=f"mono{bits}; png compressed ",  # as image_transport's plugin `compressed` writes it
        data=np.frombuffer(png, np.uint8),
    )


FISHEYES = ("equidistant", "kannala_brandt")
"""Lens models that ROS calls equidistant, with the coefficients k1 to k4 of OpenCV's fisheye."""


def distortion_of(record: CameraRecord) -> tuple[str, list[float]] | None:
    """Name and coefficients of a camera's distortion in ROS; None if ROS has no name for its lens model."""
    if record.model == "pinhole":
        return "plumb_bob", list(record.distortion)  # Brown-Conrady in OpenCV's order, as in the manifest
    if record.model not in FISHEYES:
        return None
    return "equidistant", [record.parameters.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")]


def camera_info(time_ns: int, camera: str, record: CameraRecord) -> Any:
    """Return a CameraInfo. Images are not rectified, so P is K without a stereo baseline.

    `distortion_of` must have a name for the camera's distortion.
    """
    named = distortion_of(record)
    assert named is not None, record.model
    cx, cy = record.cx_px - 0.5, record.cy_px - 0.5
    matrix = np.array([[record.fx_px, 0, cx], [0, record.fy_px, cy], [0, 0, 1.0]])
    region = _new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _new(
        "sensor_msgs/msg/CameraInfo",
        header=_header(time_ns, optical_frame(camera)),
        height=record.height_px,
        width=record.width_px,
        distortion_model=named[0],
        d=np.array(named[1]),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([matrix, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def imu(time_ns: int, angular_rate_radps: Any, specific_force_mps2: Any) -> Any:
    """Return an Imu without orientation; covariances of 0 mean unknown."""
    rate, force = (
        _new("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, each), strict=True)))
        for each in (angular_rate_radps, specific_force_mps2)
    )
    return _new(
        "sensor_msgs/msg/Imu",
        header=_header(time_ns, BODY),
        orientation=_quaternion(np.eye(3)),
        orientation_covariance=np.array([-1.0, *[0.0] * 8]),
        angular_velocity=rate,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=force,
        linear_acceleration_covariance=np.zeros(9),
    )


def laser_range(time_ns: int, range_m: float | None) -> Any:
    """Return a Range; infinity without a return (REP-117)."""
    missing = range_m is None or math.isnan(range_m)
    return _new(
        "sensor_msgs/msg/Range",
        header=_header(time_ns, ALTIMETER),
        radiation_type=_INFRARED,
        field_of_view=0.0,
        min_range=0.0,
        max_range=math.inf,
        range=math.inf if missing else float(range_m or 0.0),
        variance=0.0,
    )


def detections(time_ns: int, camera: str, labels: pd.DataFrame) -> Any:
    """Return a Detection2DArray: boxes along the axes of the ellipses, twice the semi-axes long and wide."""
    header = _header(time_ns, optical_frame(camera))
    unknown = _new("geometry_msgs/msg/PoseWithCovariance", pose=_pose(np.zeros(3), np.eye(3)), covariance=np.zeros(36))
    hypothesis = _new("vision_msgs/msg/ObjectHypothesis", class_id="crater", score=1.0)
    results = [_new("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=unknown)]
    names = ["crater_id", *(f"ellipse_{name}" for name in ("cx_px", "cy_px", "a_px", "b_px", "theta_rad"))]
    found = []
    for crater_id, x, y, a, b, theta in zip(*(labels[name].tolist() for name in names), strict=True):
        centre = _new("vision_msgs/msg/Point2D", x=x - 0.5, y=y - 0.5)
        pose = _new("vision_msgs/msg/Pose2D", position=centre, theta=theta)
        box = _new("vision_msgs/msg/BoundingBox2D", center=pose, size_x=2 * a, size_y=2 * b)
        found.append(_new("vision_msgs/msg/Detection2D", header=header, results=results, bbox=box, id=str(crater_id)))
    return _new("vision_msgs/msg/Detection2DArray", header=header, detections=found)


def annotations(time_ns: int, labels: pd.DataFrame) -> Any:
    """Return foxglove's ImageAnnotations: a polygon of 32 corners for the ellipse of each label."""
    style = {
        "timestamp": _time(time_ns),
        "type": _LINE_LOOP,
        "outline_color": _new("foxglove_msgs/msg/Color", **dict(zip("rgba", _GREEN, strict=True))),
        "outline_colors": [],
        "fill_color": _new("foxglove_msgs/msg/Color", r=0.0, g=0.0, b=0.0, a=0.0),
        "thickness": 1.0,
    }
    point = message_types().types["foxglove_msgs/msg/Point2"]  # a frame has thousands of them
    loops = [
        _new("foxglove_msgs/msg/PointsAnnotation", points=[point(x, y) for x, y in polygon], **style)
        for polygon in polygons_of(labels).tolist()
    ]
    return _new("foxglove_msgs/msg/ImageAnnotations", circles=[], points=loops, texts=[])


def _new(name: str, **fields: Any) -> Any:
    return message_types().types[name](**fields)


def _time(time_ns: int) -> Any:
    return _new("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)


def _header(time_ns: int, frame_id: str) -> Any:
    return _new("std_msgs/msg/Header", stamp=_time(time_ns), frame_id=frame_id)


def _quaternion(rotation: Array) -> Any:
    w, x, y, z = quaternion_from_matrix(rotation).tolist()
    return _new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _pose(position_m: Array, rotation: Array) -> Any:
    x, y, z = (float(value) for value in position_m)
    point = _new("geometry_msgs/msg/Point", x=x, y=y, z=z)
    return _new("geometry_msgs/msg/Pose", position=point, orientation=_quaternion(rotation))
