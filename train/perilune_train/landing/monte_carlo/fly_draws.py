"""Fly the filter over random draws of every descent of a split, in parallel."""

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import GRADES, InertialGrade
from perilune_shared.storage.files import new_folder
from perilune_shared.storage.store import Address
from perilune_shared.threads import usable_cores
from perilune_train.landing.craters.catalogue import (
    MIN_DIAMETER_M,
    Catalogue,
    CatalogueErrors,
    exact_catalogue,
    with_errors,
)
from perilune_train.landing.filter.flight import Instruments, fly_together, together
from perilune_train.landing.methods.flights import Start, default_sigmas, lander_of, mounting_of, row_of, table_of
from perilune_train.landing.methods.seen import SeenDescent, seen_descents
from perilune_train.landing.monte_carlo.draw import drawn
from perilune_train.landing.monte_carlo.page import draw_bands, draw_consistency, page_of
from perilune_train.landing.monte_carlo.scenario import Draws, Scenario
from perilune_train.motion.data.trajectories import load_split
from perilune_train.records.markdown import write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.provenance import EvaluatedSplit, check_terrain, read_provenance
from perilune_train.training.runs import RunFolder, load_weights

PAGE, TABLE = "monte_carlo.md", "draws.parquet"
PICTURES = ("errors.png", "consistency.png")
REFERENCE: InertialGrade = "navigation"
"""Grade of the inertial measurements that are taken as the true motion. Their errors are smaller than the errors of
`GRADE` by factors of 6 (noise of the specific force) to 1000."""
GRADE: InertialGrade = "tactical"
_TOGETHER = 20
"""Number of draws of a descent that are flown in one batch."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Site:
    """One descent and the inputs of its draws."""

    descent: SeenDescent
    """The descent with the detections in its frames."""
    reference: Instruments
    """Inertial measurements of the grade `REFERENCE`, and ranges."""
    catalogue: Catalogue
    """Craters without errors."""


@dataclass(frozen=True, slots=True)
class Job:
    """Inputs that all draws share."""

    sites: list[Site]
    """All descents."""
    rotation_camera_from_body: Array
    """Mounting of the camera (3, 3)."""
    sigmas: Array
    """Standard deviations at the start, as in `Start.sigmas`."""
    scenario: Scenario
    """The fault that is simulated."""
    seed: int
    """Random seed of all draws."""


def fly_draws(
    evaluated: EvaluatedSplit, detector: Path, out: Path, draws: Draws, workers: int | None = None
) -> pd.DataFrame:
    """Fly the filter over random draws of every descent of a split; returns a row per draw and frame.

    `detector` is the folder of a run; its detector processes every frame once. Writes monte_carlo.md, draws.parquet and
    pictures to the new folder `out`; writes nothing if it fails. The result does not depend on the number of workers,
    which is one per core by default. Raises UserError if the detector was fitted to the terrain of the split (unless
    `evaluated` allows overlap), or if the dataset lacks frames or inertial measurements.
    """
    dataset, split = open_single(evaluated.dataset), evaluated.split
    best = RunFolder(detector).best
    check = check_terrain(read_provenance(load_weights(best), best), dataset, split, evaluated.allow_overlap)
    with new_folder(out) as folder:
        job = Job(
            sites_of(dataset, split, detector, evaluated.dataset),
            mounting_of(dataset),
            default_sigmas(GRADE, draws.attitude_deg),
            draws.scenario,
            draws.seed,
        )
        begun = time.perf_counter()
        rows = pd.concat(all_draws(job, draws.count, workers or usable_cores()), ignore_index=True)
        rows = rows.sort_values(["scene_id", "trajectory_id", "draw", "time_s"], ignore_index=True)
        rows.to_parquet(folder / TABLE, index=False)
        draw_bands(folder / PICTURES[0], rows)
        draw_consistency(folder / PICTURES[1], rows)
        seconds = time.perf_counter() - begun
        write_markdown(folder / PAGE, page_of(dataset.info.name, split, draws, rows, seconds, PICTURES))
        mark_files(folder, (PAGE, TABLE, *PICTURES), str(check.metrics()["terrain/mark"]))
    return rows


def sites_of(dataset: Dataset, split: str, detector: Path, address: Address) -> list[Site]:
    """The descents of a split, with the craters that the detector of a run finds in their frames."""
    trajectories = load_split(dataset, split)
    references = {trajectory.ids: _reference(dataset, trajectory.ids, address) for trajectory in trajectories}
    descents, _ = seen_descents(dataset, trajectories, detector)
    exact = {
        scene: exact_catalogue(dataset, scene, MIN_DIAMETER_M) for scene in {descent.ids[0] for descent in descents}
    }
    return [Site(descent, references[descent.ids], exact[descent.ids[0]]) for descent in descents]


def _reference(dataset: Dataset, ids: tuple[str, str], address: Address) -> Instruments:
    """Measurements that are taken as the true motion."""
    instruments = Instruments.of_trajectory(dataset, ids, REFERENCE)
    if not len(instruments.inertial):
        expected = f"measurements of the grade {REFERENCE} (see the setting dataset.nav.instruments.inertial_grades)"
        raise UserError(str(address), f"inertial of {'/'.join(ids)}", "nothing", expected)
    return instruments


def flown_draws(job: Job, number: int, draws: Sequence[int]) -> list[pd.DataFrame]:
    """Fly draws of one descent together.

    `number` is the index of the descent. The random numbers of a draw depend on the seed, the descent and the draw. The
    other draws in the batch change the results by rounding errors only.
    """
    site, sigmas = job.sites[number], job.sigmas
    landers, drawn_descents = [], []
    for draw in draws:
        rng = np.random.default_rng([job.seed, number, draw])
        catalogue = with_errors(site.catalogue, CatalogueErrors(), rng)
        draw_of_descent = drawn(site.descent, site.reference, GRADE, sigmas, job.scenario, rng)
        landers.append(
            lander_of(
                draw_of_descent.descent,
                job.rotation_camera_from_body,
                catalogue,
                Start(GRADES[GRADE], sigmas, draw_of_descent.start_error),
            )
        )
        drawn_descents.append(draw_of_descent)
    instruments = together([draw_of_descent.instruments for draw_of_descent in drawn_descents])
    seen = zip(*(draw_of_descent.descent.sightings for draw_of_descent in drawn_descents), strict=True)
    rows: list[list[dict[str, object]]] = [[] for _ in draws]
    for estimates in fly_together(landers, instruments, site.descent.time_s, seen):
        for rows_of_draw, estimate in zip(rows, estimates, strict=True):
            rows_of_draw.append(row_of(site.descent, estimate, job.rotation_camera_from_body))
    return [
        table_of(site.descent, rows_of_draw).assign(draw=draw) for rows_of_draw, draw in zip(rows, draws, strict=True)
    ]


def all_draws(job: Job, draws: int, workers: int) -> list[pd.DataFrame]:
    """Tables of all flights, in any order; computed in this process if there is one worker."""
    batches = [
        (number, range(first, min(first + _TOGETHER, draws)))
        for first in range(0, draws, _TOGETHER)
        for number in range(len(job.sites))
    ]
    tables = []
    with progress_bar() as progress:
        task = progress.add_task("filter", total=draws * len(job.sites), unit="flights", note=job.scenario)
        for flown in _flown(job, batches, min(workers, len(batches))):
            tables += flown
            progress.advance(task, len(flown))
    return tables


def _flown(job: Job, batches: list[tuple[int, range]], workers: int) -> Iterator[list[pd.DataFrame]]:
    """Yield the tables of the batches, in any order."""
    if workers == 1:
        yield from (flown_draws(job, *batch) for batch in batches)
        return
    # Use spawn, because torch's threads do not survive a fork.
    with _one_thread(), ProcessPoolExecutor(workers, get_context("spawn"), _begin, (job,)) as pool:
        remaining = iter(batches)
        running = {pool.submit(_of_job, *batch) for batch in islice(remaining, 2 * workers)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                following = next(remaining, None)
                if following is not None:
                    running.add(pool.submit(_of_job, *following))
                yield future.result()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Limit new processes to one linear-algebra thread: threads of several workers slow each other down."""
    before = dict(os.environ)
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name in _THREADS:
            os.environ.pop(name)
            if name in before:
                os.environ[name] = before[name]


_JOB: list[Job] = []
"""The job of a worker process."""


def _begin(job: Job) -> None:
    _JOB.append(job)


def _of_job(number: int, draws: range) -> list[pd.DataFrame]:
    return flown_draws(_JOB[0], number, draws)
