"""The command `perilune-render counterfactual`."""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import perilune_shared as ps
from perilune_render.cli.dataset import JobOptions, finished_or_exit
from perilune_render.config.derived import CounterfactualConfig
from perilune_shared.config.resolve import resolve_over
from perilune_shared.console.progress import say
from perilune_shared.console.terminal import answer
from perilune_shared.dataset.names import Split
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store, open_store

if TYPE_CHECKING:
    import pandas as pd


def counterfactual(
    manifest: Annotated[str, typer.Option(help="Folder or address of a dataset or of its manifest alone.")],
    out: Annotated[str, typer.Option(help="Folder or address of the new dataset.")],
    split: Annotated[Split, typer.Option(help="Split whose frames are rendered again.")] = "test",
    frames_per_trajectory: Annotated[
        int, typer.Option(min=1, help="Frames of each trajectory, evenly spaced in the split.")
    ] = 6,
    craters_per_scene: Annotated[
        int, typer.Option(min=0, max=1000, help="Craters to remove from the ground of each scene.")
    ] = 6,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the choice of craters.")] = 0,
    sun_azimuth_offset_deg: Annotated[
        float, typer.Option(help="Azimuth of the Sun, clockwise from the dataset's Sun, degrees.")
    ] = 0.0,
    depth_share: Annotated[
        float, typer.Option(help="Share of their depth that the chosen craters keep, below 1; 0 removes them.")
    ] = 0.0,
    dem: Annotated[Path | None, typer.Option(help="Elevation model that the manifest's recipe names.")] = None,
    catalogue: Annotated[Path | None, typer.Option(help="Crater catalogue that the manifest's recipe names.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=0, max=1024, help="Worker processes. [default: one for each core]")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Threads of each process. [default: cores / workers]")
    ] = None,
) -> None:
    """Render frames of a dataset again, without some craters, with shallower craters, or with another Sun azimuth.

    Everything else is unchanged; frames and craters keep their ids. The removed or shallower craters are listed in
    OUT.removed.parquet. Run the same command again to resume.
    """
    # Check the options first, since reading the manifest takes seconds.
    for option, value in (("sun_azimuth_offset_deg", sun_azimuth_offset_deg), ("depth_share", depth_share)):
        resolve_over(CounterfactualConfig, "counterfactual", f"--{option.replace('_', '-')}", {option: value})
    options = JobOptions.of("local", None, workers, threads, None, finish=False, dry_run=False)
    source, store, table = ps.open_dataset(manifest), open_store(out), _table_beside(out)
    from perilune_render.dataset.begin import new_info
    from perilune_render.dataset.from_manifest import plan_from_manifest
    from perilune_render.flight.counterfactual import craters_to_remove, part_of
    from perilune_render.jobs.job import Job
    from perilune_render.provenance.recipe import recipe_of

    plan, config, info = plan_from_manifest(source, dem, catalogue)
    if config.survey is not None or config.counterfactual is not None:
        found = "a survey" if config.survey is not None else "a counterfactual"
        raise UserError(manifest, "recipe", found, "descents over unchanged ground")
    plan = part_of(plan, split, frames_per_trajectory, sun_azimuth_offset_deg)
    craters = craters_to_remove(source, plan, craters_per_scene, seed)
    removed: dict[int, list[int]] = {}
    what = "removed" if depth_share == 0 else f"reduced to {depth_share:g} of their depth"
    for scene in plan.scenes:
        ids = craters.loc[craters["seed"] == scene.seed, "crater_id"].tolist()
        n_found = len(ids)
        if ids:
            removed[scene.seed] = ids
        if n_found < craters_per_scene:
            line = (
                f"{scene.scene_id}: {n_found} of {craters_per_scene} craters are {what}; no more are far enough apart"
            )
            say(line, style="yellow")
    values = {"removed": removed, "sun_azimuth_offset_deg": sun_azimuth_offset_deg, "depth_share": depth_share}
    settings = resolve_over(CounterfactualConfig, "counterfactual", manifest, values)
    config = config.model_copy(update={"counterfactual": settings})
    recipe = recipe_of(config, info.kind, info.recipe().preset)
    name = f"{info.name}-counterfactual"
    metadata = {"name": name, "split_by": info.split_by, "history": info.history, "licence": info.licence}
    begun = new_info(config, plan, recipe).model_copy(update=metadata)
    dataset = finished_or_exit(Job(plan, config, begun, manifest), store, options)
    if dataset is not None:
        _write(craters, *table)
        answer(
            f"{dataset.store}: {dataset.info.counts.frames} frames over {dataset.info.counts.scenes} scenes; "
            f"{len(craters)} craters {what}, listed in {table[0].at(table[1])}"
        )


def _table_beside(out: str) -> tuple[Store, str]:
    """Store and name of the table of removed craters.

    The table is beside the dataset's folder, since a dataset may contain only the files of its format.
    """
    if "://" in out:
        above, _, name = out.rstrip("/").rpartition("/")
    else:
        above, name = str(Path(out).parent), Path(out).name
    if not name or above.endswith(":/"):
        raise UserError("--out", "", out, "a folder, or an address below its bucket")
    return open_store(above), f"{name}.removed.parquet"


def _write(craters: "pd.DataFrame", store: Store, name: str) -> None:
    content = io.BytesIO()
    craters.to_parquet(content, index=False)
    store.replace(name, content.getvalue())
