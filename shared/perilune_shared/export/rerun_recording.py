"""Export to Rerun: each descent as a recording with a time line, which the Rerun viewer opens.

Needs rerun-sdk and, for the terrain of a hazard map, rasterio: `pip install "perilune-shared[rerun]"`. Rerun's image
coordinates have their origin at the outer corner of the top-left pixel, as in the manifest. All entities are below
`site`, in O_L (x west, y south, z up).
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import LARGEST_IMAGE_PX, CameraRecord
from perilune_shared.errors import UserError
from perilune_shared.export.coco import polygons_of
from perilune_shared.export.descents import Descent, Shot, count_descent_frames, descents_of, shots_of
from perilune_shared.export.estimates import Estimates, estimates_of
from perilune_shared.export.rows import Choice
from perilune_shared.geometry.ellipse import rim_points
from perilune_shared.geometry.frames import Array, quaternion_from_matrix
from perilune_shared.storage import files
from perilune_shared.storage.new_store import new_files
from perilune_shared.storage.rasters import opened_raster, raster_files
from perilune_shared.storage.store import Address

TIMELINE = "time"
"""Name of the time line: seconds since the first frame."""
_MAX_SIDE = 512
"""Largest number of vertices on a side of the terrain mesh."""
_MAX_RIMS = 600
_RIM_POINTS = 32
_SIGMAS = 3.0
"""Half axes of the covariance ellipsoid, in standard deviations."""
_IMAGE_DISTANCE_M = 100.0
"""Distance at which the viewer draws an image in the scene, metres."""
_SAME_TIME_S = 1e-3
_THIN = -0.75
"""Half the width of a line; negative values are in pixels of the screen."""
_GREEN, _ORANGE, _BLUE = (80, 220, 80), (255, 140, 60), (90, 160, 255)


def export_rerun(
    dataset: Dataset,
    out: Address,
    progress: Progress,
    split: str | None = None,
    choose: Choice | None = None,
    trajectory: str | None = None,
    estimates: Path | None = None,
) -> int:
    """Write `out`/<scene_id>/<trajectory_id>.rrd for each descent; return the number of descents.

    A recording is in memory until it is complete, so memory use grows with the longest descent, but not with the number
    of descents. Only labels that `choose` selects are written. `trajectory` (scene_id/trajectory_id) selects one
    descent, and `estimates` is the filter's output for this descent (see `read_estimates`). Raises UserError if `out`
    is not empty, an image or a hazard map cannot be read, no frame is selected or rerun-sdk is not installed.
    """
    _library("rerun", "rerun-sdk")
    task = progress.add_task("rerun", total=count_descent_frames(dataset, split, trajectory), unit="frames")
    n_descents = 0
    with new_files(out) as folder:
        for descent in descents_of(dataset, split, choose, trajectory):
            flight = None if estimates is None else estimates_of(dataset, descent, estimates)
            path = files.inside(folder, f"{descent.name}.rrd")
            path.parent.mkdir(parents=True, exist_ok=True)
            recording = _Recording(descent.name)
            recording.stream.send_blueprint(_blueprint(dataset, flight is not None))
            _log_ground(recording, dataset, descent)
            _log_cameras(recording, dataset)
            truth = []
            for shot in shots_of(dataset, descent):
                _log_frame(recording, dataset, shot)
                truth.append([shot.row["time_s"], *shot.position_m])
                progress.advance(task)
            _log_path(recording, "site/path", np.array(truth)[:, 1:], _GREEN)
            if flight is not None:
                _log_estimates(recording, flight, np.array(truth))
            files.write_bytes(path, recording.content(), durable=False)
            n_descents += 1
    return n_descents


def _library(name: str, package: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise UserError("--format rerun", package, "not installed", 'pip install "perilune-shared[rerun]"') from None


class _Recording:
    """A recording in memory. rerun-sdk 0.22 is the last version for NumPy 1; three calls have changed since."""

    def __init__(self, name: str):
        import rerun as rr

        self._rr = rr
        self.stream = getattr(rr, "new_recording", rr.RecordingStream)("perilune", recording_id=name)
        # Not `save`: its thread does not report a full disk, and `flush` then waits for ever.
        self._bytes = self.stream.binary_stream()

    def at(self, time_s: float) -> None:
        """Set the time of the entities that are logged next, seconds."""
        if hasattr(self.stream, "set_time"):
            self.stream.set_time(TIMELINE, duration=time_s)
        else:
            self.stream.set_time_seconds(TIMELINE, time_s)

    def log(self, entity: str, part: Any, *, static: bool = False) -> None:
        """Log an archetype of an entity, at the current time or for all times."""
        self.stream.log(entity, part, static=static)

    def scalar(self, entity: str, value: float) -> None:
        """Log a number for a plot."""
        scalar = getattr(self._rr, "Scalars", None) or self._rr.Scalar
        self.log(entity, scalar(value))

    def content(self) -> bytes:
        """Return the file. Raises UserError if Rerun's logging is switched off, so that it is empty."""
        content = self._bytes.read(flush=True)
        if not content:
            raise UserError("RERUN", "environment variable", "logging is off", "on, so that the export has content")
        return bytes(content)


def _blueprint(dataset: Dataset, with_filter: bool) -> Any:
    import rerun.blueprint as rrb

    # Boxes hide small craters; the viewer shows them when they are added to the view.
    shown = ["$origin/**", "- $origin/image/boxes"]
    images = [rrb.Spatial2DView(origin=_camera(name), contents=shown, name=name) for name in _cameras(dataset)]
    plots = [rrb.TimeSeriesView(origin="height_m", name="Height above the site, m")]
    if with_filter:
        plots += [
            rrb.TimeSeriesView(origin=f"filter/{axis}", name=f"Error of the filter, {side}, and {_SIGMAS:g} sigma, m")
            for axis, side in (("x", "west"), ("y", "south"), ("z", "up"))
        ]
    scene = rrb.Spatial3DView(origin="site", name="Site: X west, Y south, Z up")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, *images[1:]),
            rrb.Vertical(images[0], *plots, row_shares=[3, *[1] * len(plots)]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def _cameras(dataset: Dataset) -> dict[str, CameraRecord]:
    return {str(name): each for name, each in (dataset.info.cameras or {"camera": dataset.info.camera}).items()}


def _camera(name: str) -> str:
    return f"site/lander/{name}"


def _log_ground(recording: _Recording, dataset: Dataset, descent: Descent) -> None:
    """Log the terrain of the hazard map, if the dataset has one, and the rims of the labelled craters."""
    import rerun as rr

    recording.log("site", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    path = dataset.table("scenes", ["hazard_path"], descent.scene_id)["hazard_path"][0].as_py()
    if path is not None and dataset.store.is_local:
        sun = np.array(descent.frames["sun_direction"][0])
        vertices, triangles, grey = _terrain(dataset.file(path), sun)
        colours = np.repeat(grey[:, None], 3, axis=1)
        mesh = rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, vertex_colors=colours)
        recording.log("site/terrain", mesh, static=True)
    ids = np.unique(np.concatenate([np.zeros(0, np.int64), *(rows["crater_id"] for rows in descent.labels.values())]))
    craters = dataset.table("craters", None, descent.scene_id).to_pandas()
    craters = craters[craters["crater_id"].isin(ids)].nlargest(_MAX_RIMS, "diameter_m")
    centre_m, normal = (
        craters[names].to_numpy() for names in (["x_m", "y_m", "z_m"], ["normal_x", "normal_y", "normal_z"])
    )
    rims = rim_points(centre_m, normal, craters["diameter_m"].to_numpy() / 2, _RIM_POINTS)
    closed = np.concatenate([rims, rims[:, :1]], axis=1)
    recording.log("site/craters", rr.LineStrips3D(closed, colors=[_GREEN], radii=[_THIN]), static=True)


def _terrain(path: Path, sun: Array) -> tuple[Array, NDArray[np.int64], NDArray[np.uint8]]:
    """Return vertices (n, 3), O_L, metres, triangles (m, 3) and grey values (n,) of a hazard map's heights.

    Rows of the map go south (y of O_L), columns east (-x of O_L). `sun` (3,) shades the terrain.
    """
    _library("rasterio", "rasterio")
    with opened_raster(raster_files(path, ("GTiff",), "hazard map"), "hazard map") as raster:
        if raster.width < 2 or raster.height < 2 or raster.width * raster.height > LARGEST_IMAGE_PX:
            raise UserError(path, "size", f"{raster.width} x {raster.height}", f"2 x 2 to {LARGEST_IMAGE_PX} pixels")
        step = -(-max(raster.width, raster.height) // _MAX_SIDE)
        pixel_m = float(raster.transform.a)
        height_m = raster.read(1)[::step, ::step].astype(np.float64)
        south, east = ((np.arange(0, n, step) + 0.5 - n / 2) * pixel_m for n in (raster.height, raster.width))
    height_m[~np.isfinite(height_m)] = 0.0
    slope_south, slope_east = np.gradient(height_m, south[1] - south[0], east[1] - east[0])
    normal = np.stack([slope_east, -slope_south, np.ones_like(height_m)], axis=-1)
    light = normal @ sun / np.linalg.norm(normal, axis=-1)
    grey = (40 + 190 * np.clip(light / max(2 * float(sun[2]), 1e-3), 0, 1)).astype(np.uint8)
    y, x = np.meshgrid(south, -east, indexing="ij")
    corner = np.arange(height_m.size).reshape(height_m.shape)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangles = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, c, b), (b, c, d))])
    return np.stack([x, y, height_m], axis=-1).reshape(-1, 3), triangles, grey.ravel()


def _log_cameras(recording: _Recording, dataset: Dataset) -> None:
    import rerun as rr

    for name, record in _cameras(dataset).items():
        rotation_body_from_camera = np.array(record.rotation_camera_from_body).T
        mounting = rr.Transform3D(translation=record.position_in_body_m, mat3x3=rotation_body_from_camera)
        recording.log(_camera(name), mounting, static=True)
        if record.model != "pinhole":
            # Rerun has no lens models: show the image without its frustum.
            continue
        pinhole = rr.Pinhole(
            image_from_camera=record.intrinsics().matrix,
            resolution=[record.width_px, record.height_px],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_IMAGE_DISTANCE_M,
        )
        recording.log(_camera(name), pinhole, static=True)


def _log_frame(recording: _Recording, dataset: Dataset, shot: Shot) -> None:
    import rerun as rr

    recording.at(shot.row["time_s"])
    turn = _quaternion(shot.rotation_site_from_body)
    recording.log("site/lander", rr.Transform3D(translation=shot.position_m, quaternion=turn))
    recording.scalar("height_m/true", shot.position_m[2])
    image = _camera(shot.row["camera"] if dataset.info.cameras else "camera") + "/image"
    recording.log(image, rr.EncodedImage(contents=shot.png, media_type="image/png"))
    polygons = polygons_of(shot.labels)
    closed = np.concatenate([polygons, polygons[:, :1]], axis=1)
    recording.log(
        f"{image}/ellipses", rr.LineStrips2D(closed, colors=[_GREEN] * len(closed), radii=[_THIN] * len(closed))
    )
    boxes = shot.labels[["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]].to_numpy(np.float64)
    corners = {"mins": boxes[:, :2], "sizes": boxes[:, 2:] - boxes[:, :2]}
    names = shot.labels["crater_id"].astype(str).to_list()
    recording.log(f"{image}/boxes", rr.Boxes2D(**corners, colors=[_BLUE] * len(boxes), labels=names, show_labels=False))


def _log_path(recording: _Recording, entity: str, position_m: Array, colour: tuple[int, int, int]) -> None:
    import rerun as rr

    recording.log(entity, rr.LineStrips3D([position_m], colors=[colour]), static=True)


def _log_estimates(recording: _Recording, flight: Estimates, truth: Array) -> None:
    """Log the filter's estimates; `truth` (n, 4) has time, s, and position, m, of the exported frames."""
    import rerun as rr

    _log_path(recording, "site/estimate/path", flight.position_m, _ORANGE)
    for time_s, position_m, covariance in zip(flight.time_s, flight.position_m, flight.covariance, strict=True):
        recording.at(time_s)
        spread = covariance[:3, :3]
        variances, axes = np.linalg.eigh(spread)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        ellipsoid = rr.Ellipsoids3D(
            centers=[position_m],
            half_sizes=[_SIGMAS * np.sqrt(np.clip(variances, 0, None))],
            quaternions=[_quaternion(axes)],
            colors=[_ORANGE],
        )
        recording.log("site/estimate/covariance", ellipsoid)
        recording.scalar("height_m/estimated", position_m[2])
        same = np.flatnonzero(np.abs(truth[:, 0] - time_s) < _SAME_TIME_S)
        for k, axis in enumerate("xyz"):
            if len(same):
                recording.scalar(f"filter/{axis}/error", position_m[k] - truth[same[0], 1 + k])
            sigma_m = float(np.sqrt(spread[k, k]))
            recording.scalar(f"filter/{axis}/above", _SIGMAS * sigma_m)
            recording.scalar(f"filter/{axis}/below", -_SIGMAS * sigma_m)


def _quaternion(rotation: Array) -> Any:
    import rerun as rr

    w, x, y, z = quaternion_from_matrix(rotation)
    return rr.Quaternion(xyzw=[x, y, z, w])
