"""Time of a Monte Carlo run of the navigation filter.

    python -m benchmarks.train.monte_carlo data/shipped/nav [--split val] [--draws 200] [--workers 2]

Flies the draws of all descents of a split as `perilune-train navigate monte-carlo` does, after the installed detector
has seen their frames once; then one group of draws of each descent again, in this process, for the processor time of a
flight. Writes runs/bench/monte_carlo.json.
"""

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import pandas as pd
import torch
import typer

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.dataset.manifest import open_single
from perilune_train.landing.methods.flights import mounting_of
from perilune_train.landing.monte_carlo.fly_draws import Job, all_draws, sites_of
from perilune_train.landing.monte_carlo.page import run_summary
from perilune_train.landing.monte_carlo.scenario import Draws
from perilune_train.shipped.models import shipped_run

_TIMED_DRAWS = 20


def main(
    dataset: Annotated[Path, typer.Argument(help="Dataset of descents.")],
    split: Annotated[str, typer.Option(help="train, val or test.")] = "val",
    draws: Annotated[int, typer.Option(min=1, help="Draws of each descent.")] = 200,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Path = Path("runs/bench"),
) -> None:
    """Fly all draws and write the times."""
    opened = open_single(str(dataset))
    sites = sites_of(opened, split, shipped_run("detect"), str(dataset))
    job = Job(sites, mounting_of(opened), Draws(count=draws))
    few = replace(job, draws=Draws(count=min(draws, _TIMED_DRAWS)))
    began = os.getloadavg()[0]
    begun = time.perf_counter()
    rows = pd.concat(all_draws(job, workers), ignore_index=True)
    seconds = time.perf_counter() - begun
    torch.set_num_threads(1)
    begun = time.process_time()
    all_draws(few, 1)
    processor_s = time.process_time() - begun
    flights = draws * len(sites)
    figures = {
        "flights": flights,
        "frames": len(rows),
        "workers": workers,
        "wall_s": seconds,
        "minutes_of_1200_flights": seconds / flights * 1200 / 60,
        "processor_s_per_flight": processor_s / (few.draws.count * len(sites)),
        "load_before": began,
        **{key: value for key, value in run_summary(rows).items() if value == value},
    }
    write_figures(out / "monte_carlo.json", figures)


if __name__ == "__main__":
    run_command_line(one_command(main))
