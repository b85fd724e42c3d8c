"""Exports of one dataset agree on the number of craters, and their progress bars reach the end."""

from typing import get_args

import pytest
from rich.progress import Progress
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.cli import export
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.export.coco import export_coco
from perilune_shared.export.hugging_face import export_hugging_face
from perilune_shared.export.mcap import export_mcap
from perilune_shared.export.rows import by_selection
from perilune_shared.export.trajectory import export_kitti, export_tum
from perilune_shared.export.yolo import export_yolo
from perilune_shared.labels.thresholds import SELECTIONS


@pytest.fixture(scope="module")
def drawn_root(tmp_path_factory):
    root = tmp_path_factory.mktemp("counts") / "detect"
    build_dataset(root, "detect", n_frames=2)
    return root


@pytest.mark.parametrize("split", [None, "test"])
def test_coco_and_yolo_count_the_same_craters(drawn_root, tmp_path, split):
    dataset = open_dataset(drawn_root)
    for name, choose in (("all", None), ("visible", by_selection(SELECTIONS["visible"]))):
        counts = {
            export(dataset, tmp_path / f"{name}-{export.__name__}", Progress(disable=True), split, choose)
            for export in (export_coco, export_yolo)
        }
        assert len(counts) == 1 and counts.pop() > 0


@pytest.mark.parametrize(
    "export", [export_coco, export_yolo, export_tum, export_kitti, export_hugging_face, export_mcap]
)
def test_the_progress_bar_of_one_split_reaches_the_end(drawn_root, tmp_path, export):
    progress = Progress(disable=True)
    export(open_dataset(drawn_root), tmp_path / "out", progress, "test")
    (task,) = progress.tasks
    assert task.completed == task.total > 0


def test_every_format_has_the_files_by_which_it_is_known():
    """Croissant is one file beside the dataset."""
    assert set(get_args(export.ExportFormat)) - {"croissant"} == set(export._KNOWN_BY)
