"""Record which terrain a network was fitted to, and check whether a test split shares it.

Every checkpoint records the terrain on which the network was trained, selected or calibrated, by content hash
(`perilune_shared.content`). The record includes the terrain of the network's parents: the network that provided the
initial weights, and the teacher. A test on recorded terrain measures memorisation, not generalisation. Such a test
raises an error, unless the splits of the dataset share terrain by protocol, or the user allows the test. All output of
an allowed test is marked.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from perilune_shared.console.progress import say
from perilune_shared.content import terrain_of
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address
from perilune_train.records.metrics_file import Metrics

RECORD = "terrain"
"""Key of the record in a checkpoint."""
Use = Literal["trained", "selected", "calibrated", "tested"]
Status = Literal["disjoint", "by protocol", "overlap", "unknown"]
_USE_OF_SPLIT: dict[str, Use] = {"train": "trained", "val": "selected", "test": "tested"}
_MAX_USES = 1_000_000
_MAX_NAMED = 4
_SHA256 = re.compile(r"[0-9a-f]{64}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+,:()/-]{0,199}")
_NAME_EXPECTED = "at most 200 letters, digits, spaces and ._+,:()/-"
_PROTOCOLS = {
    "scene": "held-out scenes",
    "trajectory": "held-out descents, shared terrain",
    "frame": "paper (random frames, shared terrain)",
}


@dataclass(frozen=True, slots=True, order=True)
class TerrainUse:
    """The terrain of one scene and how it was used."""

    dataset: str
    """Name of the dataset."""
    scene_id: str
    """Identifier of the scene in the dataset."""
    use: str
    """trained, selected (best epoch or threshold, on validation), calibrated (threshold or int8), or tested."""
    sha256: str
    """Content hash of the terrain (`terrain_of`)."""
    group: str
    """Name of the group of datasets that share terrain by protocol; the dataset's name if it belongs to no group."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """All terrain that a network was fitted to, by training, selection or calibration."""

    uses: frozenset[TerrainUse] = frozenset()
    """The terrain and its uses. Includes the test scenes of the training dataset (`tested`), which later calibration
    must avoid."""
    known: bool = True
    """False if a parent has no record."""

    def joined(self, parents: Iterable["Provenance"]) -> "Provenance":
        """This record joined with the parents' records, without the parents' test terrain."""
        parents = list(parents)
        inherited = {use for parent in parents for use in parent.uses if use.use != "tested"}
        return Provenance(self.uses | inherited, self.known and all(parent.known for parent in parents))

    def plain(self) -> dict[str, Any]:
        """The record as plain lists and strings, for a checkpoint or a JSON file."""
        rows = [[use.dataset, use.scene_id, use.use, use.sha256, use.group] for use in sorted(self.uses)]
        return {"known": self.known, "uses": rows}


UNKNOWN = Provenance(known=False)


def read_provenance(content: Mapping[str, Any], path: Path) -> Provenance:
    """Read the record in a checkpoint's content; `UNKNOWN` if it is missing. Raises UserError if it is malformed."""
    if RECORD not in content:
        return UNKNOWN
    record, expected = content[RECORD], "a record of scenes, as training writes it"
    if not isinstance(record, dict) or set(record) != {"known", "uses"} or not isinstance(record["known"], bool):
        raise UserError(path, RECORD, type(record).__name__, expected)
    rows = record["uses"]
    if not isinstance(rows, list) or len(rows) > _MAX_USES:
        raise UserError(path, f"{RECORD}.uses", type(rows).__name__, expected)
    for number, row in enumerate(rows):
        valid = isinstance(row, list) and len(row) == 5 and all(isinstance(cell, str) for cell in row)
        if not valid or row[2] not in get_args(Use) or not _SHA256.fullmatch(row[3]):
            raise UserError(path, f"{RECORD}.uses.{number}", "a malformed row", expected)
        if not all(_NAME.fullmatch(row[k]) for k in (0, 1, 4)):
            raise UserError(path, f"{RECORD}.uses.{number}", "an invalid name", _NAME_EXPECTED)
    return Provenance(frozenset(TerrainUse(*row) for row in rows), record["known"])


def split_terrain(dataset: Dataset, split: str, use: Use) -> frozenset[TerrainUse]:
    """The terrain under the frames of a split; empty if it has no frames. Raises UserError on an invalid scene_id."""
    scene_ids = set(dataset.table("frames", ["scene_id"], split=split)["scene_id"].to_pylist())
    rows = dataset.table("scenes", ["scene_id", "dem_source", "content_sha256"]).to_pylist()
    for row in rows:
        if not _NAME.fullmatch(row["scene_id"]):
            raise UserError(dataset.store, "scene_id", repr(row["scene_id"]), _NAME_EXPECTED)
    name, group = dataset.info.name, _group(dataset.info)
    return frozenset(
        TerrainUse(name, row["scene_id"], use, terrain_of(row["dem_source"], row["content_sha256"]), group)
        for row in rows
        if row["scene_id"] in scene_ids
    )


def served_terrain(where: object, dataset: str, scene: int, dem_source: str, content_sha256: str) -> TerrainUse:
    """The terrain of a scene that an image server rendered for training, from the values that the server sent.

    Raises UserError if a value is not valid in a record.
    """
    name, sha256 = f"{dataset} (served)", terrain_of(dem_source, content_sha256)
    if not _NAME.fullmatch(name):
        raise UserError(where, "dataset", repr(dataset), _NAME_EXPECTED)
    if not _SHA256.fullmatch(sha256):
        raise UserError(where, f"content_sha256 of scene {scene}", repr(sha256), "64 hexadecimal digits")
    return TerrainUse(name, f"scene-{scene:04d}", "trained", sha256, name)


def training_provenance(dataset: Dataset) -> Provenance:
    """The record of a network that is trained, selected and tested on the splits of one dataset."""
    return Provenance(frozenset().union(*(split_terrain(dataset, *part) for part in _USE_OF_SPLIT.items())))


def _group(info: DatasetInfo) -> str:
    """Name of a dataset's group.

    All datasets rendered from one configuration with `shared_terrain` are one group, the landing area of the paper.
    """
    names = {
        str(recipe.config.get("name")) if recipe.config.get("shared_terrain") is True else ""
        for recipe in info.recipes.values()
    }
    (name,) = names if len(names) == 1 else ("",)
    # Recipes are untrusted input: ignore a name that is not valid in a record.
    return f"landing area of {name}" if name and _NAME.fullmatch(f"landing area of {name}") else info.name


def protocol_of(info: DatasetInfo) -> str:
    """Name of a dataset's protocol: what the test split holds out and what the splits share."""
    return _PROTOCOLS[info.split_by] + info.leak


@dataclass(frozen=True, slots=True)
class EvaluatedSplit:
    """A split of a dataset on which finished networks are evaluated."""

    dataset: Address
    """Folder or address of the dataset."""
    split: str = "test"
    """train, val or test."""
    allow_overlap: bool = False
    """Whether to accept terrain that a network was fitted to. If so, all output is marked."""


@dataclass(frozen=True, slots=True)
class TerrainCheck:
    """Result of comparing the terrain of a test split with a network's record."""

    status: Status
    """disjoint: no shared terrain. by protocol: the splits of the dataset share terrain by its protocol. overlap: any
    other shared terrain, which the user allowed. unknown: the record is missing or incomplete."""
    scenes: tuple[str, ...] = field(default=())
    """Overlapping scenes, each with the recorded scene and use. Only the first few are named."""

    @property
    def mark(self) -> str:
        """Text to mark all output with; empty if the terrain is disjoint or shared by protocol."""
        if self.status == "overlap":
            return f"TERRAIN OVERLAP, no test of unseen terrain: {', '.join(self.scenes)}"
        return "TRAINING TERRAIN UNKNOWN: the checkpoint has no record of it" if self.status == "unknown" else ""

    def metrics(self) -> Metrics:
        """Entries for metrics.json."""
        return {"terrain/status": self.status, "terrain/mark": self.mark}


def check_terrain(
    provenance: Provenance, dataset: Dataset, split: str = "test", allow_overlap: bool = False
) -> TerrainCheck:
    """Compare a record with the terrain of a split.

    A dataset that is split by frame or trajectory shares terrain between its splits by design. Any other overlap with a
    test split raises UserError with the names of the scenes, unless `allow_overlap`.
    """
    fitted = frozenset(use for use in provenance.uses if use.use != "tested")
    # Who evaluates training or validation frames does so on purpose, and the report names the split.
    by_design = dataset.info.split_by != "scene" or split != "test"
    tested = split_terrain(dataset, split, "tested")
    return _compared(fitted, tested, dataset, by_design, provenance.known, allow_overlap or split != "test")


def check_calibration(
    provenance: Provenance, calibrated: frozenset[TerrainUse], dataset: Dataset, allow_overlap: bool = False
) -> TerrainCheck:
    """Compare the terrain of a calibration on `dataset` with the test terrain of the dataset and of the run.

    Like `check_terrain`, any overlap raises UserError with the names of the scenes, unless `allow_overlap`.
    """
    tested = frozenset(use for use in provenance.uses if use.use == "tested") | split_terrain(dataset, "test", "tested")
    by_design = dataset.info.split_by != "scene"
    return _compared(calibrated, tested, dataset, by_design, provenance.known, allow_overlap)


def _compared(
    fitted: frozenset[TerrainUse],
    tested: frozenset[TerrainUse],
    dataset: Dataset,
    by_design: bool,
    known: bool,
    allow_overlap: bool,
) -> TerrainCheck:
    """Check two sets of terrain for overlap. With `by_design`, scenes of one group may be in both."""
    used: dict[str, list[TerrainUse]] = {}
    for use in sorted(fitted):
        used.setdefault(use.sha256, []).append(use)
    overlapping, by_protocol = [], False
    for scene in sorted(tested):
        for use in used.get(scene.sha256, ()):
            if by_design and use.group == scene.group:
                by_protocol = True
            else:
                overlapping.append(f"{scene.dataset}/{scene.scene_id} = {use.dataset}/{use.scene_id} ({use.use})")
    if overlapping:
        more = len(overlapping) - _MAX_NAMED
        named = (*overlapping[:_MAX_NAMED], *([f"{more} more"] if more > 0 else []))
        if not allow_overlap:
            expected = "terrain not used to train, select or calibrate; --allow-overlap accepts it and marks all output"
            raise UserError(dataset.store, "test terrain", ", ".join(named), expected)
        return _reported(TerrainCheck("overlap", named))
    if not known:
        return _reported(TerrainCheck("unknown"))
    return TerrainCheck("by protocol" if by_protocol else "disjoint")


def _reported(check: TerrainCheck) -> TerrainCheck:
    say(check.mark)
    return check
