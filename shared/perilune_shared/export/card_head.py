"""The YAML head of a dataset card, in Hugging Face's format.

Format: https://huggingface.co/docs/hub/datasets-cards and datasets-manual-configuration. `DatasetCardData` of
huggingface_hub writes the same mapping, but huggingface_hub would add 13 packages (30 MB, including an HTTP client) to
every installation. The tests read the head with `DatasetCardData`.
"""

from typing import Any

from perilune_shared.config.yaml_text import to_yaml_text
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import NOT_STATED
from perilune_shared.dataset.names import SPLITS
from perilune_shared.dataset.packed import FOLDER, shards_of
from perilune_shared.dataset.schema import TABLES

_TASKS = {"detect": "object-detection", "nav": "other"}
_HUB_LICENCES = {
    "CC0-1.0",
    "CC-BY-4.0",
    "CC-BY-SA-4.0",
    "CC-BY-NC-4.0",
    "CC-BY-NC-SA-4.0",
    "Apache-2.0",
    "MIT",
    "CDLA-Permissive-2.0",
}
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))


def head_of(dataset: Dataset, configs: list[dict[str, Any]]) -> str:
    """Return the YAML head: licence, name, tags, size, and `configs`, the result of `table_configs`."""
    info = dataset.info
    head = {
        **_licence(info.licence),
        "pretty_name": info.name,
        "task_categories": [_TASKS[info.kind]],
        "tags": ["moon", "craters", "lunar-landing", "synthetic", "perilune"],
        "size_categories": [next((name for most, name in _SIZES if info.counts.frames < most), "n>1M")],
        "configs": configs,
    }
    return "---\n" + to_yaml_text(head) + "---"


def _licence(licence: str) -> dict[str, str]:
    """Return the entries for a licence; if the hub has an identifier for the licence, it is used."""
    if licence == NOT_STATED:
        return {"license": "unknown"}
    if licence in _HUB_LICENCES:
        return {"license": licence.lower()}
    return {"license": "other", "license_name": licence}


def table_configs(dataset: Dataset) -> list[dict[str, Any]]:
    """Return the configurations: one per table with rows, and one for packed frames if there are any.

    A configuration states which files `datasets.load_dataset` loads for each split. Without configurations, `datasets`
    treats every image in the folder as training data. The configuration of packed frames is the default and has the
    splits of the dataset. A part of a table may contain rows of all splits, so each table has the single split `mixed`;
    the column `split` of frames states the split of each frame. For frames in separate files, use `export_hugging_face`
    to write files for each split.
    """
    counts = dataset.info.counts
    names = ["frames", *(name for name in TABLES if name != "frames")]
    configs = [_config(name, {"mixed": f"manifest/{name}/*.parquet"}) for name in names if getattr(counts, name)]
    if dataset.info.images == "packed":
        splits = [split for split in SPLITS if shards_of(dataset.store, split)]
        configs.insert(0, _config("packed", {split: f"{FOLDER}/{split}-*.parquet" for split in splits}))
    return [{**configs[0], "default": True}, *configs[1:]] if configs else []


def _config(name: str, files: dict[str, str]) -> dict[str, Any]:
    return {"config_name": name, "data_files": [{"split": split, "path": path} for split, path in files.items()]}
