"""Terrain records of checkpoints, for tests of terrain overlap."""

from collections.abc import Iterable
from pathlib import Path

import torch

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.records.provenance import Provenance, TerrainUse, Use, split_terrain
from perilune_train.training import runs


def uses_of(dataset: Path, split: str, use: Use = "trained", name: str = "elsewhere") -> frozenset[TerrainUse]:
    """Return the terrain uses of a split, as if a network had used it in another dataset."""
    scenes = split_terrain(open_dataset(dataset), split, use)
    return frozenset(TerrainUse(name, s.scene_id, use, s.sha256, name) for s in scenes)


def store_record(checkpoint: Path, uses: Iterable[TerrainUse]) -> None:
    """Write these uses as the terrain record of a checkpoint; replaces an existing one."""
    content = runs.load_weights(checkpoint)
    torch.save({**content, "terrain": Provenance(frozenset(uses)).plain()}, checkpoint)
