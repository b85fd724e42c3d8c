"""Fly the filter over draws of every descent of a split, in parallel, and write table, page and pictures."""

import os
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_shared.storage.files import new_folder, write_text
from perilune_shared.storage.store import Address
from perilune_shared.terminal import progress_bar
from perilune_train.evaluation.marks import mark_files
from perilune_train.evaluation.provenance import check_terrain, read_provenance
from perilune_train.navigate.craters.catalogue import (
    LEAST_DIAMETER_M,
    Catalogue,
    CatalogueErrors,
    exact_catalogue,
    with_errors,
)
from perilune_train.navigate.data.trajectories import load_split
from perilune_train.navigate.filter.flight import Instruments
from perilune_train.navigate.methods.flights import default_sigmas, flight, mounting_of
from perilune_train.navigate.methods.seen import SeenDescent, seen_descents
from perilune_train.navigate.monte_carlo.draw import drawn
from perilune_train.navigate.monte_carlo.figures import draw_bands, draw_consistency
from perilune_train.navigate.monte_carlo.page import page_of
from perilune_train.navigate.monte_carlo.scenario import Scenario
from perilune_train.training.runs import RunFolder, load_weights

PAGE, TABLE = "monte_carlo.md", "draws.parquet"
PICTURES = ("errors.png", "consistency.png")
REFERENCE: InertialGrade = "navigation"
"""Inertial measurements that are taken as the true motion: the errors of this grade are smaller than those of
`GRADE` by factors of 6 (noise of the specific force) to 1000."""
GRADE: InertialGrade = "tactical"


@dataclass(frozen=True, slots=True)
class Site:
    """One descent and what its draws start from."""

    descent: SeenDescent
    """The descent with recorded detections."""
    reference: Instruments
    """Inertial measurements of the grade `REFERENCE`, and ranges."""
    catalogue: Catalogue
    """Craters without errors."""


@dataclass(frozen=True, slots=True)
class Job:
    """What all draws share."""

    sites: list[Site]
    """All descents."""
    mounting: Array
    """rotation_camera_from_body (3, 3)."""
    sigmas: Array
    """Stated errors of the start."""
    scenario: Scenario
    """What goes wrong."""
    seed: int
    """Of all draws."""


def fly_draws(
    address: Address,
    split: str,
    detector: Path,
    out: Path,
    scenario: Scenario = "nominal",
    draws: int = 200,
    attitude_deg: float = 0.5,
    seed: int = 0,
    workers: int | None = None,
    allow_overlap: bool = False,
) -> pd.DataFrame:
    """Fly the filter over `draws` random draws of every descent; returns a row per draw and frame.

    The detector runs once over every frame. Writes monte_carlo.md, draws.parquet and pictures to the new folder `out`,
    or nothing. The result does not depend on the number of workers. Raises UserError if the detector was fitted to the
    terrain of the split, unless `allow_overlap`, or if the dataset lacks frames or inertial measurements.
    """
    dataset = open_single(address)
    best = RunFolder(detector).best
    check = check_terrain(read_provenance(load_weights(best), best), dataset, split, allow_overlap)
    with new_folder(out) as folder:
        trajectories = load_split(dataset, split)
        references = {one.ids: _reference(dataset, one.ids, address) for one in trajectories}
        descents, _ = seen_descents(dataset, trajectories, detector)
        exact = {scene: exact_catalogue(dataset, scene, LEAST_DIAMETER_M) for scene in {one.ids[0] for one in descents}}
        sites = [Site(one, references[one.ids], exact[one.ids[0]]) for one in descents]
        mounting = mounting_of(dataset)
        job = Job(sites, mounting, default_sigmas(GRADE, attitude_deg), scenario, seed)
        begun = time.perf_counter()
        rows = pd.concat(_all_draws(job, draws, workers or os.cpu_count() or 1), ignore_index=True)
        rows = rows.sort_values(["scene_id", "trajectory_id", "draw", "time_s"], ignore_index=True)
        rows.to_parquet(folder / TABLE, index=False)
        draw_bands(folder / PICTURES[0], rows)
        draw_consistency(folder / PICTURES[1], rows)
        about = {"scenario": scenario, "draws": draws, "seed": seed, "attitude_deg": attitude_deg}
        seconds = time.perf_counter() - begun
        write_text(folder / PAGE, page_of(dataset.info.name, split, about, rows, seconds, PICTURES))
        mark_files(folder, (PAGE, TABLE, *PICTURES), str(check.metrics()["terrain/mark"]))
    return rows


def _reference(dataset: Dataset, ids: tuple[str, str], address: Address) -> Instruments:
    """Measurements that are taken as the true motion."""
    found = Instruments.of_trajectory(dataset, ids, REFERENCE)
    if not found.inertial:
        expected = f"measurements of the grade {REFERENCE} (see the setting dataset.nav.instruments.inertial_grades)"
        raise UserError(str(address), f"inertial of {'/'.join(ids)}", "nothing", expected)
    return found


def flown_draw(job: Job, place: int, draw: int) -> pd.DataFrame:
    """One draw of one descent; depends on the seed, the place of the descent and the number of the draw alone."""
    site, rng = job.sites[place], np.random.default_rng([job.seed, place, draw])
    catalogue = with_errors(site.catalogue, CatalogueErrors(), rng)
    one = drawn(site.descent, site.reference, GRADE, job.sigmas, job.scenario, rng)
    flown = flight(one.descent, one.instruments, job.mounting, catalogue, GRADE, job.sigmas, one.off)
    return flown.assign(draw=draw)


def _all_draws(job: Job, draws: int, workers: int) -> list[pd.DataFrame]:
    asked = [(place, draw) for draw in range(draws) for place in range(len(job.sites))]
    tables = []
    with progress_bar() as progress:
        task = progress.add_task("filter", total=len(asked), unit="flights", note=job.scenario)
        for table in _flown(job, asked, min(workers, len(asked))):
            tables.append(table)
            progress.advance(task)
    return tables


def _flown(job: Job, asked: list[tuple[int, int]], workers: int) -> Iterator[pd.DataFrame]:
    """Tables in any order."""
    if workers == 1:
        yield from (flown_draw(job, *one) for one in asked)
        return
    # spawn: torch's threads do not survive a fork.
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin, (job,)) as pool:
        remaining = iter(asked)
        running = {pool.submit(_of_job, *one) for one in islice(remaining, 2 * workers)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                following = next(remaining, None)
                if following is not None:
                    running.add(pool.submit(_of_job, *following))
                yield future.result()


_JOB: list[Job] = []
"""The job of a worker process."""


def _begin(job: Job) -> None:
    _JOB.append(job)


def _of_job(place: int, draw: int) -> pd.DataFrame:
    return flown_draw(_JOB[0], place, draw)
