"""The identity of a plan: one hash, so that a dataset is resumed with the plan that it was begun with.

Two manifests with the same settings may differ in scenes, trajectories, frames and splits.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator

import numpy as np

from perilune_render.dataset.from_manifest import Recorded
from perilune_render.flight.plan import Plan, TrajectoryPlan
from perilune_render.jobs import records
from perilune_render.jobs.job import Job
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store

_EXPECTED = "the plan or manifest that the dataset was started with"


def begin_plan(store: Store, job: Job) -> None:
    """Record size and identity of a job in the dataset that it begins, or compare them with the record.

    Raises UserError if the dataset was begun with another plan.
    """
    places = range(len(job.plan.trajectories))
    sizes = {"trajectories": len(places), "frames": sum(map(job.n_frames, places))}
    plan = {**sizes, "plan": _hash(_ordered(job.plan), positions=_is_recorded(job.plan))}
    if records.read_plan(store) is None:
        records.write_plan(store, plan)
    elif records.read_plan(store) != plan:
        raise UserError(store.at(f"{records.FOLDER}/plan.json"), "plan", "that of another dataset", _EXPECTED)


def check_finished(store: Store, plan: Plan) -> None:
    """Raise UserError if a finished dataset has another plan."""
    made: Dataset = open_dataset(store)
    recorded = Recorded.of(made, made.scene_ids())
    positions = _is_recorded(plan)
    if _hash(recorded, positions=positions) != _hash(_ordered(plan), positions=positions):
        raise UserError(store, "trajectories", "those of another plan", _EXPECTED)


def _is_recorded(plan: Plan) -> bool:
    return len(plan.trajectories) > 0 and not plan.trajectories[0].is_drawn


def _ordered(plan: Plan) -> Iterator[TrajectoryPlan]:
    """The trajectories of a plan, ordered by scene and name as in a manifest."""
    for scene_id in sorted(plan.places):
        yield from sorted(plan.of_scene(scene_id), key=lambda trajectory: trajectory.trajectory_id)


def _hash(trajectories: Iterable[TrajectoryPlan], *, positions: bool) -> str:
    """SHA-256 of trajectories, hexadecimal; with `positions`, also of the position of each frame.

    The positions of a drawn flight follow from seed, settings and code, which the recipe contains.
    """
    digest = hashlib.sha256()
    for each in trajectories:
        named = [each.scene_id, each.trajectory_id, each.seed, ",".join(each.splits)]
        digest.update(json.dumps(named).encode())
        digest.update(np.asarray(each.frame_index, np.int64).tobytes())
        if positions:
            digest.update(np.ascontiguousarray(each.flight.position_m, np.float64).tobytes())
    return digest.hexdigest()
