"""Read the state of a rendering from the files of its dataset."""

import json
import time
from dataclasses import dataclass

from perilune_render.dataset.work import committed
from perilune_render.jobs import records
from perilune_shared.dataset.info_file import INFO_NAME
from perilune_shared.dataset.names import KINDS
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store

SILENT_S = 300.0
"""Age of a process's record above which the process counts as ended, seconds."""


@dataclass(frozen=True, slots=True)
class Status:
    """The state of a dataset that is being rendered."""

    complete: bool
    """Whether the dataset is finished."""
    n_trajectories: int
    """Number of trajectories."""
    n_done: int
    """Number of finished trajectories."""
    n_frames: int
    """Number of frames."""
    frames_done: int
    """Number of frames in finished trajectories, estimated from the mean number of frames per trajectory."""
    running: tuple[str, ...]
    """Trajectories that are being rendered."""
    n_silent: int
    """Number of processes whose record is older than SILENT_S seconds."""
    failed: dict[str, str]
    """Error of each trajectory that failed repeatedly."""
    frames_per_s: float
    """Frames per second of all running processes, including the time to generate ground."""

    @property
    def left_s(self) -> float | None:
        """Remaining time at the rate `frames_per_s`, seconds; None if the rate is 0."""
        return (self.n_frames - self.frames_done) / self.frames_per_s if self.frames_per_s > 0 else None


def datasets_below(store: Store) -> list[Store]:
    """The dataset at an address and the datasets `detect` and `nav` below it, as far as they exist.

    Raises UserError if no dataset exists.
    """
    stores = [each for each in (store, *map(store.sub, KINDS)) if each.exists(INFO_NAME)]
    if not stores:
        raise UserError(store.address, INFO_NAME, "no such file", "the address of a dataset that was begun")
    return stores


def status_of(store: Store) -> Status:
    """The state of one dataset.

    Raises UserError if the dataset is unfinished and the record of its plan is missing.
    """
    complete, counts = _info(store)
    if complete:
        n_trajectories, n_frames = counts.get("trajectories", 0), counts.get("frames", 0)
        return Status(True, n_trajectories, n_trajectories, n_frames, n_frames, (), 0, {}, 0.0)
    plan = records.read_plan(store)
    if plan is None:
        expected = "the record of its plan: run its `perilune-render dataset` command again"
        raise UserError(store.at(f"{records.FOLDER}/plan.json"), "plan", "no such record", expected)
    n_done = len(committed(store))
    processes, now = records.running(store), time.time()
    alive = [process for process in processes if now - process["updated"] < SILENT_S]
    return Status(
        False,
        plan["trajectories"],
        n_done,
        plan["frames"],
        round(n_done * plan["frames"] / max(plan["trajectories"], 1)),
        tuple(sorted(process["trajectory"] for process in alive)),
        len(processes) - len(alive),
        records.failures(store),
        sum(process["frames"] / max(process["updated"] - process["since"], 1.0) for process in alive),
    )


def _info(store: Store) -> tuple[bool, dict[str, int]]:
    """Fields `complete` and `counts` of dataset.json."""
    try:
        content = json.loads(store.read(INFO_NAME))
        return content["complete"] is True, dict(content["counts"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(store.at(INFO_NAME), "content", error, "the dataset.json of a dataset") from None
