"""Export to COCO: boxes, and ellipses as polygons, one file per split.

Format: https://cocodataset.org/#format-data. COCO's coordinates have their origin at the outer corner of the top-left
pixel, as in perilune. Boxes and polygons are clipped to the image, as usual in COCO; ellipses are not clipped.
Labels that are not selected are marked `iscrowd`, so that evaluators ignore detections that match them.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import NOT_STATED
from perilune_shared.errors import UserError
from perilune_shared.export.rows import (
    LABEL_MEASURES,
    Choice,
    SceneRows,
    clipped_boxes,
    count_scenes,
    frame_sizes,
    scenes_of,
)
from perilune_shared.storage.new_store import new_files
from perilune_shared.storage.store import Address

CATEGORY = {"id": 1, "name": "crater", "supercategory": "crater"}
_N_CORNERS = 32
_DECIMALS = 3
"""Decimals of pixel coordinates in the file; no label is accurate to 0.001 px."""
_ANGLES = 2 * np.pi * np.arange(_N_CORNERS) / _N_CORNERS
_POLYGON = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
# A polygon with corners on the ellipse has a smaller area than the ellipse; enlarging it by 0.3 % makes them equal.
_POLYGON *= np.sqrt(2 * np.pi / _N_CORNERS / np.sin(2 * np.pi / _N_CORNERS))


def export_coco(
    dataset: Dataset, out: Address, progress: Progress, split: str | None = None, choose: Choice | None = None
) -> int:
    """Write `out`/instances_<split>.json for one split, or for all splits if `split` is None.

    Returns the number of selected labels that were written. `file_name` is the frame's png_path, so give COCO tools the
    dataset's folder as the image folder. Raises UserError if `out` is not empty, the dataset is a plan, a png_path is
    outside the dataset or the split has no frames.
    """
    if dataset.info.images == "planned":
        raise UserError(dataset.store, "images", "planned", "a rendered dataset: a plan has no labels")
    task = progress.add_task("coco", total=count_scenes(dataset, split), unit="scenes")
    opened: dict[str, _SplitFile] = {}
    with new_files(out) as folder:
        try:
            for scene in scenes_of(dataset, split, choose):
                annotations = _annotations(scene)
                for name, frames in scene.frames.groupby("split"):
                    if name not in opened:
                        opened[str(name)] = _SplitFile(folder / f"instances_{name}.json", dataset)
                    opened[str(name)].add(frames, annotations)
                progress.advance(task)
        finally:
            for file in opened.values():
                file.close()
    return sum(file.n_chosen for file in opened.values())


def polygons_of(labels: pd.DataFrame) -> NDArray[np.float64]:
    """Return a polygon for the ellipse of each label (N, 32, 2), pixels.

    A polygon has the same area as its ellipse. It is not clipped to the image.
    """
    cos, sin = np.cos(labels["ellipse_theta_rad"].to_numpy()), np.sin(labels["ellipse_theta_rad"].to_numpy())
    along = labels["ellipse_a_px"].to_numpy()[:, None] * _POLYGON[:, 0]
    across = labels["ellipse_b_px"].to_numpy()[:, None] * _POLYGON[:, 1]
    x = labels["ellipse_cx_px"].to_numpy()[:, None] + along * cos[:, None] - across * sin[:, None]
    y = labels["ellipse_cy_px"].to_numpy()[:, None] + along * sin[:, None] + across * cos[:, None]
    return np.stack([x, y], axis=-1)


def clip_to_image(polygon: NDArray[np.float64], width_px: float, height_px: float) -> NDArray[np.float64]:
    """Clip a convex polygon (M, 2) to the image; the result is empty if they do not overlap.

    Clips at one edge after the other (Sutherland & Hodgman 1974, doi 10.1145/360767.360802).
    """
    for axis, edge, sign in ((0, 0.0, 1.0), (0, width_px, -1.0), (1, 0.0, 1.0), (1, height_px, -1.0)):
        if not len(polygon):
            break
        inside = sign * (polygon[:, axis] - edge)
        corners = []
        for start, end, d_start, d_end in zip(
            polygon, np.roll(polygon, -1, axis=0), inside, np.roll(inside, -1), strict=True
        ):
            if d_start >= 0:
                corners.append(start)
            if d_start * d_end < 0:
                crossing = start + (end - start) * (d_start / (d_start - d_end))
                crossing[axis] = edge
                corners.append(crossing)
        polygon = np.array(corners).reshape(-1, 2)
    return polygon


def area_of(polygon: NDArray[np.float64]) -> float:
    """Return the area of a polygon (M, 2), by the shoelace formula."""
    x, y = polygon.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def _annotations(scene: SceneRows) -> dict[int, list[dict[str, Any]]]:
    """Return a scene's annotations by image_id. Labels wholly outside their image are omitted."""
    labels = scene.labels
    boxes, size, polygons = clipped_boxes(labels, scene.frames), frame_sizes(labels, scene.frames), polygons_of(labels)
    boxes[:, 2:] -= boxes[:, :2]
    is_inside = ((polygons >= 0) & (polygons <= size[:, None])).all(axis=(1, 2))
    columns = ["ellipse_cx_px", "ellipse_cy_px", "ellipse_a_px", "ellipse_b_px", "ellipse_theta_rad"]
    ellipses = labels[columns].to_numpy(np.float64)
    image_ids = scene.frames.set_index("frame_id")["image_id"].loc[labels["frame_id"]].to_list()
    names = zip(image_ids, labels["label_id"], labels["crater_id"], labels["chosen"], strict=True)
    measures = {name: labels[name].to_numpy(np.float64) for name in LABEL_MEASURES if name in labels}
    annotations: dict[int, list[dict[str, Any]]] = {}
    for k, (image_id, label_id, crater_id, chosen) in enumerate(names):
        polygon = polygons[k] if is_inside[k] else clip_to_image(polygons[k], *size[k])
        area = area_of(polygon) if len(polygon) > 2 else 0.0
        if area <= 0 or boxes[k, 2:].min() <= 0:
            continue
        annotations.setdefault(image_id, []).append(
            {
                "id": label_id,
                "image_id": image_id,
                "category_id": CATEGORY["id"],
                "bbox": np.round(boxes[k], _DECIMALS).tolist(),
                "segmentation": [np.round(polygon, _DECIMALS).ravel().tolist()],
                "area": round(area, _DECIMALS),
                "iscrowd": int(not chosen),
                "crater_id": crater_id,
                "ellipse": np.round(ellipses[k], 6).tolist(),
                **{name: _number(values[k]) for name, values in measures.items()},
            }
        )
    return annotations


def are_in_image(labels: pd.DataFrame, frames: pd.DataFrame) -> NDArray[np.bool_]:
    """Return whether each label (N,) has a box and an outline with an area after clipping to its image.

    Labels without an area in the image are not exported.
    """
    boxes, size = clipped_boxes(labels, frames), frame_sizes(labels, frames)
    inside = (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    polygons = polygons_of(labels)
    cut = ~((polygons >= 0) & (polygons <= size[:, None])).all(axis=(1, 2))
    for k in np.flatnonzero(inside & cut):
        polygon = clip_to_image(polygons[k], *size[k])
        inside[k] = len(polygon) > 2 and area_of(polygon) > 0
    return inside


class _SplitFile:
    """Writes the JSON file of one split: annotations when they are added, the images when it is closed."""

    def __init__(self, path: Path, dataset: Dataset):
        info = dataset.info
        self.n_annotations = self.n_chosen = 0
        self._dataset = dataset
        # Number of the image's licence in the list; no entry if no licence is stated.
        self._licence = {"license": 1} if info.licence != NOT_STATED else {}
        self._images: list[dict[str, Any]] = []
        head = {
            "info": {
                "description": info.name,
                "version": info.schema_version,
                "ellipse": "cx_px, cy_px, a_px, b_px, theta_rad; not clipped, unlike bbox and segmentation",
            },
            "licenses": [{"id": 1, "name": info.licence, "url": ""}] if self._licence else [],
            "categories": [CATEGORY],
        }
        self._stream = path.open("w", encoding="utf-8")
        self._stream.write(json.dumps(head)[:-1] + ',\n"annotations": [')

    def add(self, frames: pd.DataFrame, annotations: dict[int, list[dict[str, Any]]]) -> None:
        """Add frames of this split and their annotations."""
        for row in frames.to_dict("records"):
            # Readers append the name to a folder: check that the path stays inside it.
            self._dataset.store.sub(row["png_path"])
            self._images.append(
                {
                    "id": row["image_id"],
                    "file_name": row["png_path"],
                    "width": row["width_px"],
                    "height": row["height_px"],
                    **self._licence,
                    "frame_id": row["frame_id"],
                }
            )
            for annotation in annotations.get(row["image_id"], ()):
                self._stream.write(",\n" if self.n_annotations else "\n")
                self._stream.write(json.dumps(annotation, allow_nan=False))
                self.n_annotations += 1
                self.n_chosen += not annotation["iscrowd"]

    def close(self) -> None:
        """Write the images and close the file."""
        with self._stream:
            self._stream.write(
                '\n],\n"images": [\n' + ",\n".join(json.dumps(image) for image in self._images) + "\n]}\n"
            )


def _number(value: float) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None
