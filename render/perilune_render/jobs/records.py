"""Records of a rendering in progress, below work/ in the dataset, for `perilune-render status`.

    work/plan.json                 number of trajectories and frames, identity of the plan
    work/running/<process>.json    one process: the trajectory that it renders, and its number of rendered frames
    work/failed/<trajectory>.json  the error of a trajectory that failed repeatedly

The records do not affect what is rendered; plan.json decides whether a run may resume the dataset. They are removed
with the rest of work/ when the dataset is finished.
"""

import contextlib
import json
import os
import platform
import secrets
import time
from collections.abc import Iterable, Iterator
from typing import Any

from perilune_render.dataset.work import FOLDER
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store

_INTERVAL_S = 10.0
_LARGEST_BYTES = 100_000
_RUNNING = frozenset({"trajectory", "frames", "since", "updated"})
_FAILURE = frozenset({"trajectory", "error"})


def write_plan(store: Store, plan: dict[str, Any]) -> None:
    """Write a job's record: its numbers of `trajectories` and `frames`, and the hash of its `plan`."""
    store.replace(f"{FOLDER}/plan.json", json.dumps(plan).encode())


def read_plan(store: Store) -> dict[str, Any] | None:
    """The record that `write_plan` wrote; None if there is no record."""
    return _read(store, f"{FOLDER}/plan.json") if store.exists(f"{FOLDER}/plan.json") else None


class RunningRecord:
    """The record of this process.

    It is written when a trajectory begins, and after a frame if the last write is more than ten seconds ago.
    """

    def __init__(self, store: Store):
        self._store = store
        self._name = f"running/{secrets.token_hex(8)}"  # process ids are not unique across machines
        self._process = {"host": platform.node(), "pid": os.getpid(), "since": time.time()}
        self._trajectory, self._n_frames, self._updated = "", 0, 0.0

    def begin(self, trajectory: str) -> None:
        """Record that this process begins the trajectory of this name."""
        self._trajectory = trajectory
        self._write()

    def frame(self) -> None:
        """Count a frame."""
        self._n_frames += 1
        if time.time() - self._updated > _INTERVAL_S:
            self._write()

    def remove(self) -> None:
        """Remove the record, if it was written."""
        # An unreachable store has already been reported by an earlier write.
        with contextlib.suppress(OSError, UserError):
            if self._updated:
                self._store.delete(f"{FOLDER}/{self._name}.json")

    def _write(self) -> None:
        self._updated = time.time()
        state = {"trajectory": self._trajectory, "frames": self._n_frames, "updated": self._updated}
        _write(self._store, self._name, {**self._process, **state})


def write_failure(store: Store, trajectory: str, error: str) -> None:
    """Record the error of a trajectory that failed repeatedly, by its name, such as scene-0000/trajectory-0000."""
    _write(store, f"failed/{trajectory.replace('/', '.')}", {"trajectory": trajectory, "error": error[:2000]})


def remove_failures(store: Store, trajectories: Iterable[str]) -> None:
    """Remove the failure records of these trajectories, since they are rendered again."""
    recorded = {content["trajectory"]: path for path, content in _listed(store, "failed", _FAILURE)}
    for trajectory in trajectories:
        if trajectory in recorded:
            store.delete(recorded[trajectory])


def running(store: Store) -> list[dict[str, Any]]:
    """The records of all processes: `trajectory`, `frames`, and the times `since` and `updated`, seconds since 1970."""
    return [content for _, content in _listed(store, "running", _RUNNING)]


def remove_running(store: Store) -> None:
    """Remove the records of processes that were killed."""
    for path, _ in list(_listed(store, "running", _RUNNING)):
        store.delete(path)


def failures(store: Store) -> dict[str, str]:
    """The last error of each trajectory that failed repeatedly, by its name."""
    return {content["trajectory"]: content["error"] for _, content in _listed(store, "failed", _FAILURE)}


def _write(store: Store, name: str, content: dict[str, Any]) -> None:
    # Continue if a record cannot be written: writing the dataset's files will report the cause.
    with contextlib.suppress(OSError, UserError):
        store.replace(f"{FOLDER}/{name}.json", json.dumps(content).encode())


def _listed(store: Store, folder: str, fields: frozenset[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    for item in store.list(f"{FOLDER}/{folder}"):
        if item.path.endswith(".json") and item.size_bytes <= _LARGEST_BYTES:
            content = _read(store, item.path)
            if content is not None and content.keys() >= fields:
                yield item.path, content


def _read(store: Store, path: str) -> dict[str, Any] | None:
    """The record in a file; None if the file was just removed or is damaged."""
    try:
        content = json.loads(store.read(path))
    except (OSError, UserError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None
