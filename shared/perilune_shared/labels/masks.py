"""Compute the masks of the craters in a frame: the interior of the rim (amodal) and its visible part.

A pixel belongs to a crater if the ray through the pixel's centre intersects the disc inside the rim circle. This is
exact, with and without lens distortion. The pixel is visible unless the terrain in the frame's EXR (depth, channel Z)
is nearer than the disc; the crater's floor lies behind the disc. The terrain around the disc is rough. Therefore it
hides a pixel only if it is nearer than the disc by more than a tenth of the radius and by more than two pixel widths,
as for `visible_fraction`. Use:

    depth_m = perilune_render.imaging.exr.read_exr(dataset.file(frame.exr_path))["Z"]
    for mask in frame_masks(dataset, frame_id, depth_m=depth_m):
        picture[mask.window][mask.visible] = 255
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.schema import ANGULAR_VELOCITY
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.ellipse import project_circles, rim_points
from perilune_shared.geometry.frames import Array, matrix_from_quaternion
from perilune_shared.geometry.rolling_shutter import Moving

SLACK_RADII, SLACK_PX = 0.1, 2.0
"""Tolerances of the depth test, in crater radii and in pixel widths at the crater; the larger one applies."""
_N_RIM = 64
"""Number of rim points whose images bound a mask of a lens model."""
_CRATER = ["crater_id", "x_m", "y_m", "z_m", "normal_x", "normal_y", "normal_z", "diameter_m"]


@dataclass(frozen=True, slots=True)
class CraterMask:
    """Masks of one crater in a window: a rectangle around the crater, cut off at the image edge."""

    crater_id: int
    """Id of the crater in the frame's scene."""
    row: int
    """First row of the window, pixels from the top of the image."""
    column: int
    """First column of the window, pixels from the left of the image."""
    amodal: NDArray[np.bool_]
    """Whether each pixel's centre is inside the rim, even if terrain hides it (h, w)."""
    visible: NDArray[np.bool_] | None
    """Whether each pixel is in `amodal` and no terrain hides it (h, w); None if no depth was given."""

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the window, to index the image."""
        height, width = self.amodal.shape
        return slice(self.row, self.row + height), slice(self.column, self.column + width)


def frame_masks(
    dataset: Dataset,
    frame_id: str,
    crater_ids: Sequence[int] | None = None,
    depth_m: NDArray[np.floating] | None = None,
    image: Literal["png", "exr"] = "png",
) -> list[CraterMask]:
    """Return the masks of craters in a frame, in the order of `crater_ids`.

    Without `crater_ids`, returns the masks of the frame's labelled craters, in the order of the labels.

    With `image` "png", the masks are in pixels of `camera` in dataset.json, like the labels. With "exr", they are in
    pixels of `exr_camera`; the two differ if the lens has distortion. `depth_m` (h, w) is always the EXR's channel Z,
    infinite where no terrain is hit; for "png" it is sampled at the nearest pixel. Raises UserError if the frame or a
    crater is unknown, or if `depth_m` has another size than the EXR.
    """
    scene_id, trajectory_id = [*frame_id.split("/"), ""][:2]
    columns = ["frame_id", "scene_id", "position_m", "rotation_wxyz", "velocity_mps", "camera", *ANGULAR_VELOCITY]
    frames = dataset.table("frames", columns, scene_id, trajectory_id).to_pandas()
    frame = frames[frames["frame_id"] == frame_id]
    if len(frame) != 1:
        raise UserError(dataset.store, "frame_id", frame_id, "a frame of the dataset")
    pose = frame.iloc[0]
    if crater_ids is None:
        labels = dataset.table("labels", ["frame_id", "crater_id"], scene_id, trajectory_id).to_pandas()
        crater_ids = labels.loc[labels["frame_id"] == frame_id, "crater_id"].tolist()
    craters = dataset.table("craters", _CRATER, scene_id=pose["scene_id"]).to_pandas().set_index("crater_id")
    unknown = [crater for crater in crater_ids if crater not in craters.index]
    if unknown:
        raise UserError(dataset.store, "crater_id", unknown[0], f"a crater of {pose['scene_id']}")
    rows = craters.loc[list(crater_ids)]
    camera, exr_camera = dataset.camera_of(pose), dataset.exr_camera_of(pose)
    if depth_m is not None:
        if depth_m.shape != (exr_camera.height_px, exr_camera.width_px):
            expected = f"{exr_camera.width_px} x {exr_camera.height_px} pixels, the size of the EXRs"
            raise UserError(frame_id, "depth_m", f"{depth_m.shape[::-1]}", expected)
        if image == "png" and camera != exr_camera:
            depth_m = _resampled(depth_m, camera, exr_camera)
    rotation = matrix_from_quaternion(pose["rotation_wxyz"])
    points = rows[["x_m", "y_m", "z_m"]].to_numpy(np.float64)
    centres = camera_from_site(points, pose["position_m"], rotation)
    normals = rows[["normal_x", "normal_y", "normal_z"]].to_numpy(np.float64)
    recipe = dataset.table("scenes", ["recipe"], scene_id=pose["scene_id"])["recipe"][0].as_py()
    row_s = dataset.info.row_time_s(recipe)
    if row_s:
        speeds = pose["velocity_mps"], np.nan_to_num(pose[list(ANGULAR_VELOCITY)].to_numpy(np.float64))
        moving = Moving(*(np.asarray(each, np.float64)[None] for each in (pose["position_m"], rotation, *speeds)))
        time = moving.row_times_s(points, camera, row_s)
        centres, turned = moving.seen_at(points, time), moving.rotations_at(time)
        normals = np.einsum("nij,nj->ni", turned, normals)
    else:
        normals = normals @ rotation.T
    radii = rows["diameter_m"].to_numpy(np.float64) / 2
    return crater_masks(camera if image == "png" else exr_camera, crater_ids, centres, normals, radii, depth_m)


def crater_masks(
    camera: Camera,
    crater_ids: Sequence[int],
    centres_camera_m: Array,
    normals_camera: Array,
    radii_m: Array,
    depth_m: NDArray[np.floating] | None = None,
) -> list[CraterMask]:
    """Return the masks of the craters with the given rim circles.

    The N circles are in O_C: centres (N, 3) and radii (N,) in metres, unit normals (N, 3). Masks and `depth_m` (h, w)
    are in the pixels of `camera`; the depth is metres as `Camera.points` takes it. A mask has no pixels if the rim
    is outside the image or not wholly in front of the camera.
    """
    pixels = camera.pixel_centres()
    rays, starts = camera.rays(pixels), camera.ray_starts(pixels)
    size = np.array([camera.width_px, camera.height_px])
    boxes = project_circles(camera, centres_camera_m, normals_camera, radii_m).bounding_boxes()
    # With distortion, the ellipse is only fitted to the rim's image, which may reach beyond the ellipse's box.
    margin = 1 if camera.distorts else 0
    if camera.lens is not None and len(boxes):
        rims = camera.project(rim_points(centres_camera_m, normals_camera, radii_m, _N_RIM))
        boxes = np.where(np.isnan(boxes), np.nan, np.concatenate([rims.min(axis=1), rims.max(axis=1)], axis=1))
    without_box = np.isnan(boxes).any(axis=1, keepdims=True)
    first = np.clip(np.where(without_box, 0, np.floor(boxes[:, :2]) - margin), 0, size).astype(int)
    last = np.clip(np.where(without_box, 0, np.ceil(boxes[:, 2:]) + margin), first, size).astype(int)
    masks = []
    for k, crater_id in enumerate(crater_ids):
        (x0, y0), (x1, y1) = first[k], last[k]
        centre, normal, radius = centres_camera_m[k], normals_camera[k], radii_m[k]
        ray, start = rays[y0:y1, x0:x1], starts[y0:y1, x0:x1]
        with np.errstate(divide="ignore", invalid="ignore"):
            plane_m = (centre @ normal - start @ normal) / (ray @ normal)
            off = ray * plane_m[..., None] + start - centre
            amodal = (plane_m > 0) & (np.einsum("ijk,ijk->ij", off, off) <= radius**2)
        visible = None
        if depth_m is not None:
            slack_m = max(SLACK_RADII * radius, SLACK_PX * camera.depth_m(centre) / camera.scale_px)
            depth = depth_m[y0:y1, x0:x1]
            visible = amodal & np.isfinite(depth) & (depth >= np.where(amodal, plane_m, np.inf) - slack_m)
        masks.append(CraterMask(int(crater_id), int(y0), int(x0), amodal, visible))
    return masks


def _resampled(depth_m: NDArray[np.floating], camera: Camera, source: Camera) -> NDArray[np.floating]:
    """Resample a depth image of camera `source` to the pixels of `camera`, which has the same pose."""
    pixel = np.floor(source.project(camera.rays(camera.pixel_centres())))
    column = np.clip(pixel[..., 0], 0, source.width_px - 1).astype(int)
    row = np.clip(pixel[..., 1], 0, source.height_px - 1).astype(int)
    return depth_m[row, column]
