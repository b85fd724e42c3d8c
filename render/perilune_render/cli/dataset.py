"""The command `perilune-render dataset`."""

import contextlib
import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

import perilune_shared as ps
from perilune_render.cli.options import (
    Catalogue,
    Config,
    Dem,
    KindChoice,
    Preset,
    Setting,
    Unit,
    resolved_config,
    warn_of_size,
    was_given,
    with_unit,
)
from perilune_render.cli.sun import warn_of_suns
from perilune_render.config.dataset import DatasetConfig
from perilune_shared.console.interrupts import ended_by_interrupt
from perilune_shared.console.terminal import answer, progress_bar, say
from perilune_shared.dataset.names import KINDS
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store, open_store

if TYPE_CHECKING:
    from perilune_render.jobs.job import Job
    from perilune_render.jobs.run import MakeExecutor, RenderingFailed
    from perilune_render.jobs.worker import Worker
    from perilune_shared.dataset.manifest import Dataset


_ENDED_S = 2.0
"""Time after Ctrl-C at which the process ends even if a call of Blender still runs, seconds. Finished trajectories are
kept even if the process is killed."""
_UNITS = ((12, "TB"), (9, "GB"), (6, "MB"), (3, "kB"), (0, "bytes"))


@dataclass(frozen=True, slots=True)
class JobOptions:
    """Options of a command that renders: which processes to use, and what part of the work to do."""

    executor: Literal["local", "ray"]
    """`local` for processes on this machine, `ray` for actors of Ray."""
    address: str | None
    """Address of a running Ray cluster; None starts Ray on this machine."""
    workers: int | None
    """Number of worker processes; 0 renders in this process; None uses as many as cores and memory allow."""
    threads: int | None
    """Number of threads of each process; None divides the cores among the workers."""
    shard: tuple[int, int] | None
    """Number of the shard, from 1, and number of all shards; None renders all trajectories."""
    finish: bool
    """Whether to render nothing and finish a dataset whose shards are all rendered."""
    dry_run: bool
    """Whether to render no dataset and only estimate time and size."""

    @classmethod
    def of(
        cls,
        executor: Literal["local", "ray"],
        address: str | None,
        workers: int | None,
        threads: int | None,
        shard: str | None,
        finish: bool,
        dry_run: bool,
    ) -> "JobOptions":
        """Return the options after checking them.

        Raises UserError on a malformed shard or on conflicting options.
        """
        chosen = [name for name, is_set in (("--shard", shard), ("--finish", finish), ("--dry-run", dry_run)) if is_set]
        if len(chosen) > 1:
            raise UserError("dataset", "options", " and ".join(chosen), "one of them")
        matched = re.fullmatch(r"([1-9]\d{0,6})/([1-9]\d{0,6})", shard) if shard is not None else None
        numbers = (int(matched[1]), int(matched[2])) if matched is not None else None
        if shard is not None and (numbers is None or numbers[0] > numbers[1]):
            raise UserError("--shard", "", shard, "a number and the count of shards, such as 3/64")
        if address is not None and executor != "ray":
            raise UserError("--address", "", executor, "--executor ray, which connects to that cluster")
        if workers == 0 and executor == "ray":
            raise UserError("--workers", "", workers, "1 or more with --executor ray")
        return cls(executor, address, workers, threads, numbers, finish, dry_run)


def dataset(
    context: typer.Context,
    preset: Preset = "small",
    config: Config = None,
    setting: Setting = None,
    dem: Dem = None,
    height_unit: Unit = None,
    catalogue: Catalogue = None,
    kind: Annotated[
        KindChoice, typer.Option(help="Datasets of the preset: detect (crater detection), nav (navigation) or both.")
    ] = "both",
    out: Annotated[
        str | None,
        typer.Option(
            help="Folder or address (s3://, gs://) of the datasets `detect` and `nav`; default: data/<preset>."
        ),
    ] = None,
    manifest: Annotated[
        str | None,
        typer.Option(help="Folder or address of a manifest or plan to render into --out, in place of a preset."),
    ] = None,
    executor: Annotated[
        Literal["local", "ray"], typer.Option(help="Processes on this machine, or Ray (extra `ray`).")
    ] = "local",
    address: Annotated[
        str | None, typer.Option(help="Running Ray cluster, as host:6379; by default Ray is started on this machine.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=1024,
            help="Worker processes; 0 renders in the command's own process. [default: one for each core, as memory "
            "allows; with Ray one for each core of the cluster]",
        ),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1, max=1024, help="Threads of each process. [default: the cores, divided by the workers; with Ray 1]"
        ),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(help="Render one part of the trajectories, such as 3/64; run with --finish after all parts."),
    ] = None,
    finish: Annotated[bool, typer.Option("--finish", help="Finish the datasets whose shards are rendered.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Estimate frames, hours and bytes from a few frames; write nothing.")
    ] = False,
) -> None:
    """Render the datasets of a preset or a manifest. Run the same command again to resume."""
    options = JobOptions.of(executor, address, workers, threads, shard, finish, dry_run)
    if manifest is not None:
        other_options = [
            name for name in ("preset", "config", "setting", "height_unit", "kind") if was_given(context, name)
        ]
        _render_manifest(manifest, out, dem, catalogue, other_options, options)
        return
    resolved = resolved_config(preset, config, with_unit(setting, height_unit), dem, catalogue)
    if kind != "nav":
        warn_of_size(resolved)
    store, failed = open_store(out if out is not None else f"data/{preset}"), False
    with first_worker(options, resolved) as early:
        # Import late, after the settings are checked: importing pyarrow and Numba takes seconds.
        from perilune_render.jobs.job import Job
        from perilune_render.jobs.run import RenderingFailed

        kinds = KINDS if kind == "both" else (kind,)
        warn_of_suns(resolved, kinds)
        for name in kinds:
            try:
                finished = _run_job(Job.planned(resolved, name, preset), store.sub(name), options, early)
            except RenderingFailed as error:
                _print_failures(error)
                failed = True
                continue
            if finished is not None:
                counts = finished.info.counts
                answer(
                    f"{finished.store}: {counts.frames} frames, {counts.labels} labels, {counts.scenes} scenes; "
                    f"look at {finished.store.at('overview.png')}"
                )
    if failed:
        raise typer.Exit(1)


def first_worker(options: JobOptions, config: DatasetConfig) -> "contextlib.AbstractContextManager[Worker | None]":
    """Start the first worker process while this process plans the job.

    The context manager yields None if the job needs no worker process on this machine.
    """
    if options.executor != "local" or options.workers == 0 or options.finish:
        return contextlib.nullcontext()
    from perilune_render.jobs.worker import early_worker

    return early_worker(config.render.engine)


def _run_job(job: "Job", out: Store, options: JobOptions, early: "Worker | None" = None) -> "Dataset | None":
    """Estimate, render or finish a job; return the dataset if it is finished, else None.

    Raises RenderingFailed if trajectories failed.
    """
    from perilune_render.jobs.run import Shard, finish_job, render_job, render_shard

    if options.workers is None and options.executor == "local":
        from perilune_render.jobs.local import default_workers

        options = replace(options, workers=default_workers(job, options.threads))
    if options.executor == "local" or options.threads is not None:  # Ray's machines may have different core counts
        job = job.with_threads(options.threads, options.workers or 1)
    if options.finish:
        return finish_job(job, out)
    if options.dry_run:
        _print_estimate(job, out, options, early)
        return None
    with ended_by_interrupt(after_s=_ENDED_S, at_end=_kill_processes), progress_bar() as progress:
        if options.shard is None:
            return render_job(job, out, progress, _executor(options, early))
        n_rendered = render_shard(job, out, Shard(*options.shard), progress, _executor(options, early))
    answer(f"{out}: {n_rendered} trajectories rendered; run with --finish after all shards")
    return None


def finished_or_exit(job: "Job", out: Store, options: JobOptions, early: "Worker | None" = None) -> "Dataset | None":
    """Like `_run_job`, but if trajectories failed, print them and exit with code 1."""
    from perilune_render.jobs.run import RenderingFailed

    try:
        return _run_job(job, out, options, early)
    except RenderingFailed as error:
        _print_failures(error)
        raise typer.Exit(1) from None


def _kill_processes() -> None:
    """Kill all child processes, since Ray's processes would run for another minute."""
    import psutil

    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            process.kill()


def _print_estimate(job: "Job", out: Store, options: JobOptions, early: "Worker | None") -> None:
    from perilune_render.jobs.estimate import estimate

    with progress_bar() as progress:
        estimated = estimate(job, out, progress, _executor(options, early), options.workers or 1)
    hours = f"{estimated.seconds / 3600:.2f} hours" if estimated.seconds > 360 else f"{estimated.seconds:.0f} seconds"
    size = next(f"{estimated.n_bytes / 10**n:.3g} {unit}" for n, unit in _UNITS if estimated.n_bytes >= 10**n or n == 0)
    answer(f"{out}: {estimated.n_frames} frames left, {hours}, {size}")


def _print_failures(error: "RenderingFailed") -> None:
    for name, text in error.errors.items():
        say(f"error: {error.out}: {name}: {text}")
    again = "run the same command again to retry"
    say(f"error: {error.out}: {len(error.errors)} trajectories failed; {again}")


def _executor(options: JobOptions, early: "Worker | None") -> "MakeExecutor":
    if options.workers == 0:
        # This import loads Blender, which takes seconds.
        from perilune_render.jobs.in_process import InProcess

        return InProcess
    if options.executor == "ray":
        try:
            from perilune_render.jobs.ray_actors import RayActors
        except ModuleNotFoundError:
            raise UserError("--executor", "", "not installed", "pip install 'perilune-render[ray]'") from None
        return partial(RayActors, n_workers=options.workers, address=options.address)
    from perilune_render.jobs.local import LocalWorkers

    return partial(LocalWorkers, n_workers=options.workers or 1, early=early)


def _render_manifest(
    manifest: str,
    out: str | None,
    dem: Path | None,
    catalogue: Path | None,
    other_options: list[str],
    options: JobOptions,
) -> None:
    if out is None or other_options:
        found = (
            "no --out" if out is None else " and ".join(f"--{name.replace('setting', 'set')}" for name in other_options)
        )
        expected = (
            "--out, and --dem and --catalogue if the recipe names them; all other settings come from the manifest"
        )
        raise UserError("--manifest", "options", found, expected)
    source, store = ps.open_dataset(manifest), open_store(out)
    from perilune_render.dataset.from_manifest import compare_hashes, plan_from_manifest
    from perilune_render.jobs.job import Job

    finished = finished_or_exit(Job(*plan_from_manifest(source, dem, catalogue), manifest), store, options)
    if finished is None:
        return
    same, known, other_scenes = compare_hashes(source, finished)
    comparison = f"; {same} of {known} frames are byte-identical to the manifest's" if known else ""
    comparison += f"; terrain hash mismatch in {other_scenes} scenes" if other_scenes else "; terrain hashes match"
    answer(f"{store}: {finished.info.counts.frames} frames, {finished.info.counts.labels} labels{comparison}")
