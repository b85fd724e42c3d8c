"""Fly the filter over random draws of every descent of a split, in parallel."""

import json
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_shared.storage.files import new_folder, write_text
from perilune_shared.storage.store import Address
from perilune_shared.threads import usable_cores
from perilune_train.landing.craters.catalogue import MIN_DIAMETER_M, exact_catalogue
from perilune_train.landing.filter.flight import Estimate, Instruments, fly_together, together
from perilune_train.landing.filter.propagate import start_sigmas
from perilune_train.landing.methods.detector_errors import matches_of, measured_errors
from perilune_train.landing.methods.flights import START_M, START_MPS, Start, lander_of, mounting_of, row_of, table_of
from perilune_train.landing.methods.seen import SeenDescent, seen_descents
from perilune_train.landing.monte_carlo.consistency import by_altitude, of_descents
from perilune_train.landing.monte_carlo.draw import Site, drawn
from perilune_train.landing.monte_carlo.motion import true_motion
from perilune_train.landing.monte_carlo.page import Run, page_of
from perilune_train.landing.monte_carlo.pictures import draw_bands, draw_consistency, draw_ellipses, draw_miss
from perilune_train.landing.monte_carlo.scenario import Draws
from perilune_train.motion.data.trajectories import load_split
from perilune_train.records.markdown import write_markdown
from perilune_train.records.marks import mark_files
from perilune_train.records.provenance import EvaluatedSplit, check_terrain, read_provenance
from perilune_train.training.runs import RunFolder, load_weights

PAGE, TABLE, FRAMES, DESCENTS = "monte_carlo.md", "draws.parquet", "consistency.parquet", "consistency.json"
PICTURES = ("errors.png", "consistency.png", "ellipses.png", "miss.png")
DETECTOR = "detector_errors.json"
REFERENCE: InertialGrade = "navigation"
"""Grade of the inertial measurements that are taken as the true motion. Their errors are smaller than the errors of
the inertial units of a run by factors of 6 (noise of the specific force) to 1000."""
_TOGETHER = 20
"""Number of draws of a descent that are flown in one batch."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Job:
    """Inputs that all draws share."""

    sites: list[Site]
    """All descents."""
    rotation_camera_from_body: Array
    """Mounting of the camera (3, 3)."""
    draws: Draws
    """Settings of the draws."""

    @property
    def sigmas(self) -> Array:
        """Standard deviations (15,) at the start, as in `Start.sigmas`."""
        return start_sigmas(START_M, START_MPS, self.draws.attitude_deg, self.draws.sensors.inertial)


def fly_draws(
    evaluated: EvaluatedSplit, detector: Path, out: Path, draws: Draws, workers: int | None = None
) -> pd.DataFrame:
    """Fly the filter over random draws of every descent of a split; returns a row per draw and frame.

    `detector` is the folder of a run; its detector processes every frame once. Writes monte_carlo.md, draws.parquet,
    consistency.parquet, consistency.json and pictures to the new folder `out`; if detections are drawn, also
    detector_errors.json. Writes nothing if it fails. The result does not depend on the number of workers,
    which is one per core by default. Raises UserError if the detector was fitted to the terrain of the split (unless
    `evaluated` allows overlap), or if the dataset lacks frames or inertial measurements.
    """
    dataset, split = open_single(evaluated.dataset), evaluated.split
    best = RunFolder(detector).best
    check = check_terrain(read_provenance(load_weights(best), best), dataset, split, evaluated.allow_overlap)
    with new_folder(out) as folder:
        sites = sites_of(dataset, split, detector, evaluated.dataset)
        if draws.detections == "drawn":
            sites = sites_with_errors(sites, evaluated.dataset)
        job = Job(sites, mounting_of(dataset), draws)
        begun = time.perf_counter()
        rows = pd.concat(all_draws(job, workers or usable_cores()), ignore_index=True)
        seconds = time.perf_counter() - begun
        rows = rows.sort_values(["scene_id", "trajectory_id", "draw", "time_s"], ignore_index=True)
        rows.to_parquet(folder / TABLE, index=False)
        frames = by_altitude(rows)
        frames.to_parquet(folder / FRAMES, index=False)
        descents = of_descents(rows, frames)
        write_text(folder / DESCENTS, descents.to_json(orient="records", indent=1) + "\n")
        draw_bands(folder / PICTURES[0], rows)
        draw_consistency(folder / PICTURES[1], frames)
        draw_ellipses(folder / PICTURES[2], rows)
        draw_miss(folder / PICTURES[3], rows)
        errors = sites[0].errors
        if errors is not None:
            write_text(folder / DETECTOR, json.dumps(errors.table(), indent=1) + "\n")
        run = Run(dataset.info.name, split, draws, seconds, PICTURES, DETECTOR)
        write_markdown(folder / PAGE, page_of(run, rows, frames, descents))
        files = (PAGE, TABLE, FRAMES, DESCENTS, *PICTURES, *([] if errors is None else [DETECTOR]))
        mark_files(folder, files, str(check.metrics()["terrain/mark"]))
    return rows


def sites_of(dataset: Dataset, split: str, detector: Path, address: Address) -> list[Site]:
    """The descents of a split, with the craters that the detector of a run finds in their frames."""
    trajectories = load_split(dataset, split)
    references = {trajectory.ids: _reference(dataset, trajectory.ids, address) for trajectory in trajectories}
    descents, _ = seen_descents(dataset, trajectories, detector)
    return [site_of(dataset, descent, references[descent.ids]) for descent in descents]


def sites_with_errors(sites: Sequence[Site], address: Address) -> list[Site]:
    """The descents with the errors of their recorded detections, from which detections are drawn."""
    errors = measured_errors([(site.descent, site.matches) for site in sites], str(address))
    return [replace(site, errors=errors) for site in sites]


def site_of(dataset: Dataset, descent: SeenDescent, reference: Instruments) -> Site:
    """One descent with recorded detections."""
    catalogue = exact_catalogue(dataset, descent.ids[0], MIN_DIAMETER_M)
    rows = dataset.table("frames", ["time_s", "velocity_mps"], *descent.ids).sort_by("time_s")
    velocity_mps = np.array(rows["velocity_mps"].to_pylist())
    motion = true_motion(descent, velocity_mps, reference.inertial, mounting_of(dataset))
    return Site(descent, reference, catalogue, motion, matches_of(descent, catalogue))


def _reference(dataset: Dataset, ids: tuple[str, str], address: Address) -> Instruments:
    """Measurements that are taken as the true motion."""
    instruments = Instruments.of_trajectory(dataset, ids, REFERENCE)
    if not len(instruments.inertial):
        expected = f"measurements of the grade {REFERENCE} (see the setting dataset.nav.instruments.inertial_grades)"
        raise UserError(str(address), f"inertial of {'/'.join(ids)}", "nothing", expected)
    return instruments


def flown_draws(job: Job, number: int, draws: Sequence[int]) -> list[pd.DataFrame]:
    """Fly draws of one descent together.

    `number` is the index of the descent. The random numbers of a draw depend on the seed, the descent's identifiers and
    the draw. The other draws in the batch change the results by rounding errors only.
    """
    site, sigmas, unit = job.sites[number], job.sigmas, job.draws.sensors.inertial
    landers, drawn_descents = [], []
    for draw in draws:
        draw_of_descent = drawn(site, job.draws, sigmas, draw)
        start = Start(unit, sigmas, draw_of_descent.start_error)
        landers.append(
            lander_of(draw_of_descent.descent, job.rotation_camera_from_body, draw_of_descent.catalogue, start)
        )
        drawn_descents.append(draw_of_descent)
    instruments = together([draw_of_descent.instruments for draw_of_descent in drawn_descents])
    seen = zip(*(draw_of_descent.descent.sightings for draw_of_descent in drawn_descents), strict=True)
    rows: list[list[dict[str, object]]] = [[] for _ in draws]
    for estimates in fly_together(landers, instruments, site.descent.time_s, seen):
        for rows_of_draw, estimate in zip(rows, estimates, strict=True):
            rows_of_draw.append(row_of(site.descent, estimate, job.rotation_camera_from_body) | _further(estimate))
    return [
        table_of(site.descent, rows_of_draw).assign(draw=draw) for rows_of_draw, draw in zip(rows, draws, strict=True)
    ]


def _further(estimate: Estimate) -> dict[str, object]:
    """Columns of a Monte Carlo run in addition to those of `row_of`."""
    state = estimate.state
    return {
        "covariance_xy_m2": float(state.covariance[0, 1]),
        "innovation_squared": state.innovation_squared,
        "n_innovations": state.n_innovations,
    }


def all_draws(job: Job, workers: int) -> list[pd.DataFrame]:
    """Tables of all flights, in any order; computed in this process if there is one worker."""
    draws = range(job.draws.first, job.draws.first + job.draws.count)
    batches = [
        (number, draws[first : first + _TOGETHER])
        for first in range(0, len(draws), _TOGETHER)
        for number in range(len(job.sites))
    ]
    tables = []
    with progress_bar() as progress:
        task = progress.add_task("filter", total=len(draws) * len(job.sites), unit="flights", note=job.draws.scenario)
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
