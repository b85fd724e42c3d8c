"""Validation frames in TensorBoard."""

from pathlib import Path

import lightning
import numpy as np
import pytest
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.detect.config import DetectConfig, LabelSettings
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.train.detect_run import build_network
from perilune_train.detect.train.preview_images import preview_images
from perilune_train.detect.train.task import DetectTask


@pytest.fixture(scope="module")
def split(few):
    return load_split(open_dataset(few), "val", LabelSettings())


def test_marks_lie_on_labels_and_detections(split):
    box = np.array([[10.0, 20.0, 30.0, 50.0], [0.0, 0.0, 96.0, 96.0]])
    found = [Detections(box, np.array([0.9, 0.1]))] * len(split)
    images = preview_images(split, found, threshold=0.5)
    assert list(images) == split.frames.table["frame_id"].tolist()
    image = images[split.frames.table["frame_id"][0]]
    assert image.shape == (480, 480, 3)  # 5 times 96
    # Lines of labels are smoothed; only they are redder than blue.
    blue, yellow = (image == (86, 180, 233)).all(axis=2), image[:, :, 0] > image[:, :, 2].astype(int) + 40
    rows, columns = np.nonzero(blue)
    # The weak detection is not drawn.
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (50, 150, 100, 250)
    labels = split.labels[0]
    cx, cy, a, b, theta = labels.ellipses[labels.selected][0]
    t = np.linspace(0, 2 * np.pi, 100)
    x = 5 * (cx + a * np.cos(t) * np.cos(theta) - b * np.sin(t) * np.sin(theta))
    y = 5 * (cy + a * np.cos(t) * np.sin(theta) + b * np.sin(t) * np.cos(theta))
    inside = (x > 3) & (x < 477) & (y > 3) & (y < 477)
    hit = [
        yellow[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2].any()
        for u, v in zip(x[inside], y[inside], strict=True)
    ]
    assert np.mean(hit) > 0.8


def test_validation_logs_images_for_tensorboard(split, tmp_path: Path):
    config = DetectConfig(width=0.125, in_channels=1)
    task = DetectTask(build_network(config, split.label_sizes_px, tmp_path), config, split, split, frozen_epochs=0)
    trainer = lightning.Trainer(
        logger=TensorBoardLogger(tmp_path, name="", version=""),
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
    )
    trainer.validate(task, verbose=False)
    events = EventAccumulator(str(tmp_path)).Reload()
    names = split.frames.table["frame_id"].tolist()
    assert sorted(events.Tags()["images"]) == sorted(f"val/{name}" for name in names)
    assert (events.Images(f"val/{names[0]}")[0].width, events.Images(f"val/{names[0]}")[0].height) == (480, 480)
