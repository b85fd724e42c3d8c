"""A layout for Foxglove, for the topics of an export: image with labels, scene, heights and errors."""

from typing import Any

LAYOUT_NAME = "foxglove-layout.json"
_IMAGE, _INFO, _ANNOTATIONS = "/image/compressed", "/camera_info", "/annotations"
_SCENE = "3D!scene"


def foxglove_layout(topics: dict[str, str]) -> dict[str, Any]:
    """Return a layout that names only the given topics; `topics` has the message type of each topic.

    In Foxglove, choose "Import from file" in the menu of layouts.
    """
    cameras = [topic.removesuffix(_IMAGE) for topic in topics if topic.endswith(_IMAGE)]
    panels: dict[str, dict[str, Any]] = {_SCENE: _scene(topics, cameras)}
    for camera in cameras:
        panels[f"Image!{camera.strip('/').replace('/', '-')}"] = {
            "imageMode": {
                "imageTopic": camera + _IMAGE,
                "calibrationTopic": camera + _INFO,
                "annotations": {camera + _ANNOTATIONS: {"visible": True}},
            }
        }
    poses = {"true": "/truth/pose.pose", "estimated": "/estimate/pose.pose.pose"}
    known = {name: path for name, path in poses.items() if path.split(".")[0] in topics}
    heights = {f"{name} height, m": f"{path}.position.z" for name, path in known.items()}
    if "/altimeter/range" in topics:
        heights["measured range, m"] = "/altimeter/range.range"
    panels["Plot!height"] = _plot("Height above the site", heights)
    sideways = {f"{name} {axis}, m": f"{path}.position.{axis}" for name, path in known.items() for axis in "xy"}
    panels["Plot!sideways"] = _plot("Position, x west and y south", sideways)
    for topic in topics:
        if topic.startswith("/imu/"):
            rates = {f"{axis}, rad/s": f"{topic}.angular_velocity.{axis}" for axis in "xyz"}
            panels[f"Plot!{topic.split('/')[2]}"] = _plot(f"Angular rate, {topic.split('/')[2]}", rates)
    names = list(panels)
    middle = 1 + len(cameras)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _column(names[:middle]),
            "second": _column(names[middle:]),
            "splitPercentage": 60,
        },
    }


def _scene(topics: dict[str, str], cameras: list[str]) -> dict[str, Any]:
    shown: list[str] = [topic for topic in ("/truth/pose", "/estimate/pose") if topic in topics]
    shown += [camera + _INFO for camera in cameras]
    return {
        "followMode": "follow-none",
        "followTf": "map",
        "cameraState": {"distance": 3000, "perspective": True, "phi": 60, "thetaOffset": 45, "near": 1, "far": 100000},
        "scene": {"transforms": {"axisScale": 50}},
        "topics": {topic: {"visible": True} for topic in shown},
        "layers": {"grid": {"layerId": "foxglove.Grid", "instanceId": "grid", "visible": True, "frameId": "map",
                            "label": "Ground plane", "size": 4000, "divisions": 20}},
    }  # fmt: skip


def _plot(title: str, paths: dict[str, str]) -> dict[str, Any]:
    series = [
        {"value": path, "label": label, "enabled": True, "timestampMethod": "headerStamp"}
        for label, path in paths.items()
    ]
    return {"foxglovePanelTitle": title, "paths": series, "xAxisVal": "timestamp", "showLegend": True,
            "isSynced": True}  # fmt: skip


def _column(names: list[str]) -> Any:
    """Return a column of panels of equal height, as Foxglove's tree of pairs."""
    if len(names) == 1:
        return names[0]
    rest = _column(names[1:])
    return {"direction": "column", "first": names[0], "second": rest, "splitPercentage": 100 / len(names)}
