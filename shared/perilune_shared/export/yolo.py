"""Export to YOLO: one text file per image, with a line `class cx cy w h` per crater.

Centre and size of the box are fractions of the image size. Boxes are clipped to the image. The format has no ignored
objects, so labels that are not selected are omitted. Trainers expect the labels of `images/a/b.png` in
`labels/a/b.txt`. Format: https://docs.ultralytics.com/datasets/detect (read by all tools derived from Darknet).
"""

from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import SPLITS
from perilune_shared.export.coco import are_in_image
from perilune_shared.export.rows import Choice, clipped_boxes, count_scenes, frame_sizes, scenes_of
from perilune_shared.storage import files
from perilune_shared.storage.new_store import new_files
from perilune_shared.storage.store import Address

CRATER_CLASS = 0


def export_yolo(
    dataset: Dataset,
    out: Address,
    progress: Progress,
    split: str | None = None,
    choose: Choice | None = None,
    *,
    link: bool = False,
) -> int:
    """Write images/, labels/, <split>.txt and data.yaml into `out`; return the number of boxes.

    Images are copied. With `link`, they are hard links if the file system allows it. An image without craters has an
    empty label file. Raises UserError if `out` is not empty, an image is missing or the split has no frames.
    """
    task = progress.add_task("yolo", total=count_scenes(dataset, split), unit="scenes")
    lists: dict[str, list[str]] = defaultdict(list)
    n_boxes = 0
    with new_files(out) as folder:
        for scene in scenes_of(dataset, split, choose):
            labels = scene.labels[scene.labels["chosen"]]
            boxes = clipped_boxes(labels, scene.frames) / np.tile(frame_sizes(labels, scene.frames), 2)
            # The 8 decimals below resolve 0.001 px in the widest image (100,000 px).
            size, centre = boxes[:, 2:] - boxes[:, :2], (boxes[:, 2:] + boxes[:, :2]) / 2
            not_empty = are_in_image(labels, scene.frames)
            lines: dict[str, list[str]] = defaultdict(list)
            for frame_id, (x, y), (w, h) in zip(
                labels["frame_id"][not_empty], centre[not_empty], size[not_empty], strict=True
            ):
                lines[frame_id].append(f"{CRATER_CLASS} {x:.8f} {y:.8f} {w:.8f} {h:.8f}\n")
            n_boxes += int(not_empty.sum())
            for frame_id, frame_split in zip(scene.frames["frame_id"], scene.frames["split"], strict=True):
                files.write_text(
                    files.inside(folder, f"labels/{frame_id}.txt"), "".join(lines[frame_id]), durable=False
                )
                lists[frame_split].append(f"./images/{frame_id}.png\n")
            _write_images(dataset, scene.frames, folder, link=link)
            progress.advance(task)
        for name, entries in lists.items():
            files.write_text(folder / f"{name}.txt", "".join(entries))
        # Without the key `path`, readers look for the lists next to data.yaml, so the folder can be moved.
        present = [f"{name}: {name}.txt\n" for name in SPLITS if name in lists]
        files.write_text(folder / "data.yaml", "".join(present) + f"names:\n  {CRATER_CLASS}: crater\n")
    return n_boxes


def _write_images(dataset: Dataset, frames: pd.DataFrame, folder: Path, *, link: bool) -> None:
    rows = frames[["frame_id", "png_path"]]
    if dataset.info.images == "files" and dataset.store.is_local:
        for row in rows.to_dict("records"):
            to = files.inside(folder, f"images/{row['frame_id']}.png")
            files.copy_or_link(dataset.file(row["png_path"]), to, link=link)
        return
    for frame_id, png in dataset.pngs(pa.Table.from_pandas(rows, preserve_index=False)):
        files.write_bytes(files.inside(folder, f"images/{frame_id}.png"), png, durable=False)
