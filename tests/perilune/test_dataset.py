"""Datasets from Python: slices, pictures, and frames with labels for PyTorch."""

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader

import perilune
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_train.data.frames import frame_table


@pytest.fixture(scope="module")
def dataset(quick):
    return perilune.open_dataset(quick / "detect")


def test_a_slice_is_a_list_of_frames(dataset):
    assert [frame.frame_id for frame in dataset[:3]] == dataset.frames["frame_id"][:3].tolist()
    assert [frame.frame_id for frame in dataset[-2:]] == dataset.frames["frame_id"][-2:].tolist()
    np.testing.assert_array_equal(dataset[1:2][0].image, dataset[1].image)
    assert dataset[len(dataset) :] == []


def test_a_frame_and_a_dataset_can_be_drawn_and_printed(dataset, monkeypatch):
    frame = dataset[0]
    drawn = np.asarray(frame.plot())
    assert drawn.shape == (1024, 1024, 3) and (drawn[..., 0] != drawn[..., 1]).any()
    shown = []
    monkeypatch.setattr(Image.Image, "show", lambda picture: shown.append(picture))
    frame.show()
    assert len(shown) == 1
    assert repr(frame).startswith(f"Frame({frame.frame_id}: ") and f"{len(frame.labels)} labels" in repr(frame)
    assert f"{len(dataset)} frames of 128 x 128 px" in repr(dataset)


@pytest.mark.parametrize("selection", ["all", "paper", "visible"])
def test_targets_are_the_selected_labels(dataset, selection):
    frames = dataset.torch(split="train", selection=selection)
    table = frame_table(dataset, "train")
    assert len(frames) == len(table) > 2
    labels = read_labels(dataset, ["crater_id", "bbox_x0_px", "ellipse_a_px"], "train")
    labels = labels[selected(labels, SELECTIONS[selection])]
    for place in (0, 1, -1):
        image, target = frames[place]
        frame = dataset[table["frame_id"].iloc[place]]
        assert target["frame_id"] == frame.frame_id
        np.testing.assert_allclose(image[0].numpy() * 255, frame.image, atol=1e-4)
        own = labels[labels["frame_id"] == frame.frame_id]
        assert target["crater_id"].tolist() == own["crater_id"].tolist()
        np.testing.assert_allclose(target["boxes"][:, 0], own["bbox_x0_px"], rtol=1e-6)
        np.testing.assert_allclose(target["ellipses"][:, 2], own["ellipse_a_px"], rtol=1e-6)
        np.testing.assert_allclose(target["position_m"], frame.row["position_m"], rtol=1e-6)
    n_labels = sum(len(target["boxes"]) for _, target in (frames[k] for k in range(len(frames))))
    assert n_labels == len(labels) > 0
    assert repr(frames).endswith(f"{len(frames)} frames of train, {n_labels} labels by {selection})")
    with pytest.raises(IndexError):
        frames[len(frames)]


def test_batches_are_collated(dataset):
    frames = dataset.torch(split="train")
    batches = list(DataLoader(frames, batch_size=3, collate_fn=frames.collate))
    assert sum(len(targets) for _, targets in batches) == len(frames)
    images, targets = batches[0]
    assert images.shape == (3, 1, 128, 128) and images.dtype == torch.float32 and 0 <= images.min() <= images.max() <= 1
    assert all(target["boxes"].shape == (len(target["crater_id"]), 4) for target in targets)


@pytest.mark.parametrize(
    ("given", "message"),
    [({"split": "tain"}, r"split: got tain, expected train"), ({"selection": "most"}, "selection: got most")],
)
def test_other_names_are_refused(dataset, given, message):
    with pytest.raises(perilune.UserError, match=message):
        dataset.torch(**given)
