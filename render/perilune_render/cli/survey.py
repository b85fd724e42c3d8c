"""The command `perilune-render survey`."""

from pathlib import Path
from typing import Annotated

import typer

import perilune_shared as ps
from perilune_render.cli.dataset import JobOptions, finished_or_exit
from perilune_render.config.derived import SurveyConfig
from perilune_shared.config.resolve import resolve_over
from perilune_shared.console.terminal import answer
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store

_DEFAULT = SurveyConfig()


def survey(
    manifest: Annotated[str, typer.Option(help="Folder or address of a dataset, manifest or plan of descents.")],
    out: Annotated[str, typer.Option(help="Folder or address of the new dataset.")],
    altitude_m: Annotated[float, typer.Option(help="Height of the cameras, metres.")] = _DEFAULT.altitude_m,
    pixel_m: Annotated[float, typer.Option(help="Size of a pixel on the ground, metres.")] = _DEFAULT.pixel_m,
    convergence_deg: Annotated[
        float, typer.Option(help="Angle between the two camera axes, degrees.")
    ] = _DEFAULT.convergence_deg,
    sun_azimuth_offset_deg: Annotated[
        float, typer.Option(help="Azimuth of the Sun, relative to the descents' Sun, degrees.")
    ] = _DEFAULT.sun_azimuth_offset_deg,
    sun_elevation_deg: Annotated[
        float, typer.Option(help="Elevation of the Sun, degrees.")
    ] = _DEFAULT.sun_elevation_deg,
    dem: Annotated[Path | None, typer.Option(help="Elevation model that the manifest's recipe names.")] = None,
    catalogue: Annotated[Path | None, typer.Option(help="Crater catalogue that the manifest's recipe names.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=0, max=1024, help="Worker processes. [default: one for each core]")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Threads of each process. [default: cores / workers]")
    ] = None,
) -> None:
    """Render each scene of a dataset twice from orbit under another Sun, to map its craters.

    The new dataset has two frames per scene, one from the east and one from the west, with labels. Run the same command
    again to resume.
    """
    values = {
        "altitude_m": altitude_m,
        "pixel_m": pixel_m,
        "convergence_deg": convergence_deg,
        "sun_azimuth_offset_deg": sun_azimuth_offset_deg,
        "sun_elevation_deg": sun_elevation_deg,
    }
    settings = resolve_over(SurveyConfig, "survey", "survey", values)
    options = JobOptions.of("local", None, workers, threads, None, finish=False, dry_run=False)
    source, store = ps.open_dataset(manifest), open_store(out)
    from perilune_render.dataset.begin import new_info
    from perilune_render.dataset.from_manifest import plan_from_manifest
    from perilune_render.flight.survey import survey_plan
    from perilune_render.jobs.job import Job
    from perilune_render.provenance.recipe import recipe_of

    plan, config, info = plan_from_manifest(source, dem, catalogue)
    if config.survey is not None:
        raise UserError(manifest, "recipe", "a survey", "descents")
    config = config.model_copy(update={"survey": settings})
    plan = survey_plan(plan, config)
    recipe = recipe_of(config, info.kind, info.recipe().preset)
    metadata = {
        "name": f"{info.name}-survey",
        "split_by": info.split_by,
        "history": info.history,
        "licence": info.licence,
    }
    begun = new_info(config, plan, recipe).model_copy(update=metadata)
    dataset = finished_or_exit(Job(plan, config, begun, manifest), store, options)
    if dataset is not None:
        counts = dataset.info.counts
        answer(
            f"{dataset.store}: {counts.frames} frames of {plan.camera.width_px} px over {counts.scenes} scenes; "
            f"make catalogues from them with `perilune-train navigate map --dataset {dataset.store}`"
        )
