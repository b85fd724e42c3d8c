"""YOLO folders, parsed according to the format, give the boxes of the manifest."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.progress import Progress

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.export.yolo import export_yolo
from perilune_shared.storage.files import sha256_of


def exported(root, out, **choice):
    with Progress(disable=True) as progress:
        export_yolo(open_dataset(root), out, progress, **choice)
    return out


def parsed(folder) -> dict:
    """Return boxes (N, 5) by split and image path, read as trainers do: data.yaml, list, image, label file."""
    data = yaml.safe_load((folder / "data.yaml").read_text())
    assert data["names"] == {0: "crater"} and "path" not in data
    found = {}
    for split in ("train", "val", "test"):
        if split not in data:
            continue
        found[split] = {}
        for line in (folder / data[split]).read_text().splitlines():
            image = folder / line.removeprefix("./")
            assert image.is_file()
            label = str(image).replace("/images/", "/labels/").replace(".png", ".txt")
            rows = [[float(word) for word in row.split()] for row in Path(label).read_text().splitlines()]
            found[split][image] = np.array(rows).reshape(-1, 5)
    return found


@pytest.mark.parametrize("kind", ["crowded", "crowded_packed"])
def test_boxes_and_images_equal_the_manifest(kind, request, tmp_path):
    dataset = open_dataset(request.getfixturevalue(kind))
    found = parsed(exported(dataset.store.folder, tmp_path / "yolo"))
    frames = dataset.table("frames").to_pandas()
    labels = dataset.table("labels").to_pandas().sort_values(["frame_id", "crater_id"])
    assert {split: len(images) for split, images in found.items()} == frames.groupby("split").size().to_dict()
    n_cut = 0
    for frame in frames.itertuples():
        image = tmp_path / "yolo/images" / f"{frame.frame_id}.png"
        boxes = found[frame.split][image]
        assert sha256_of(image) == frame.png_sha256
        own = labels[labels["frame_id"] == frame.frame_id]
        assert len(boxes) == len(own) and (boxes[:, 0] == 0).all() and (boxes >= 0).all() and (boxes <= 1).all()
        whole = own[["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]].to_numpy()
        expected = np.clip(whole, 0, 128)
        n_cut += int((whole != expected).any(axis=1).sum())
        corners = np.hstack([boxes[:, 1:3] - boxes[:, 3:] / 2, boxes[:, 1:3] + boxes[:, 3:] / 2]) * 128
        assert np.allclose(corners, expected, atol=1e-5)
    assert n_cut > 0


def test_one_split_and_a_choice(crowded, tmp_path):
    dataset = open_dataset(crowded)
    none = exported(crowded, tmp_path / "none", split="val", choose=lambda _d, _s, labels: np.zeros(len(labels), bool))
    found = parsed(none)
    assert list(found) == ["val"] and len(found["val"]) == 5
    assert all(len(boxes) == 0 for boxes in found["val"].values())
    assert not (tmp_path / "none/images/s000").exists()
    assert sum(map(len, parsed(exported(crowded, tmp_path / "all"))["val"].values())) == len(
        dataset.table("labels", split="val")
    )


def test_a_dataset_without_frames_is_refused(crowded, tmp_path):
    dataset = open_dataset(crowded)
    dataset.info = dataset.info.model_copy(update={"images": "absent"})
    with Progress(disable=True) as progress, pytest.raises(UserError, match="regenerate"):
        export_yolo(dataset, tmp_path / "yolo", progress)
    assert not list(tmp_path.iterdir())
