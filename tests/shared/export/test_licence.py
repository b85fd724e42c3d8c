"""Exports of a dataset without a stated licence state none; merging keeps it beside the others."""

import json
import shutil
from pathlib import Path

import mlcroissant
import pytest
from pycocotools.coco import COCO

from perilune_shared.console.progress import NO_PROGRESS
from perilune_shared.dataset.info_file import write_info
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.metadata import NOT_STATED
from perilune_shared.editing.licence import joined_licence
from perilune_shared.export.coco import export_coco
from perilune_shared.export.croissant import export_croissant


def with_licence(source: Path, folder: Path, licence: str) -> Dataset:
    """A copy of a dataset under another licence."""
    opened = open_dataset(shutil.copytree(source, folder))
    write_info(opened.store, opened.info.model_copy(update={"licence": licence}))
    return open_dataset(folder)


@pytest.mark.parametrize(
    ("licence", "entry"),
    [
        (NOT_STATED, None),
        ("MIT", "https://spdx.org/licenses/MIT.html"),
        ("LicenseRef-mine", "LicenseRef-mine"),
        (f"CC-BY-4.0 AND {NOT_STATED}", f"CC-BY-4.0 AND {NOT_STATED}"),
    ],
)
def test_croissant(little, tmp_path, licence, entry):
    path = export_croissant(with_licence(little, tmp_path / "set", licence))
    assert json.loads(Path(path).read_text()).get("license") == entry
    assert mlcroissant.Dataset(path).metadata.name


@pytest.mark.parametrize(("licence", "names"), [(NOT_STATED, []), ("MIT", ["MIT"])])
def test_coco(little, tmp_path, licence, names):
    export_coco(with_licence(little, tmp_path / "set", licence), tmp_path / "out", NO_PROGRESS)
    (path, *_) = sorted((tmp_path / "out").rglob("*.json"))
    content = json.loads(path.read_text())
    assert [each["name"] for each in content["licenses"]] == names
    assert all(("license" in image) == bool(names) for image in content["images"]) and COCO(path).imgs


def test_merging_keeps_that_a_part_is_not_stated():
    joined = joined_licence([("a", "CC-BY-4.0"), ("b", NOT_STATED)])
    assert set(joined.split(" AND ")) == {"CC-BY-4.0", NOT_STATED}
    assert joined_licence([("a", NOT_STATED), ("b", NOT_STATED)]) == NOT_STATED
