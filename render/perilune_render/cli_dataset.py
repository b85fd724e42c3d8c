"""The command `perilune-render dataset`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

import perilune_shared as ps
from perilune_render.cli_options import (
    Catalogue,
    Config,
    Dem,
    KindChoice,
    Preset,
    Setting,
    resolved_config,
    warn_of_size,
)
from perilune_shared.dataset.names import KINDS
from perilune_shared.errors import UserError
from perilune_shared.terminal import console, progress_bar


def dataset(
    context: typer.Context,
    preset: Preset = "small",
    config: Config = None,
    setting: Setting = None,
    dem: Dem = None,
    catalogue: Catalogue = None,
    kind: Annotated[KindChoice, typer.Option(help="Crater detection, navigation, or both.")] = "both",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the datasets `detect` and `nav`; default: data/<preset>."),
    ] = None,
    manifest: Annotated[
        Path | None,
        typer.Option(help="Manifest or plan to render into --out, in place of a preset."),
    ] = None,
) -> None:
    """Render the datasets of a preset or a manifest. Run the same command again to resume."""
    if manifest is not None:
        given = [name for name in ("preset", "config", "setting", "kind") if _was_given(context, name)]
        _render_manifest(manifest, out, dem, catalogue, given)
        return
    resolved = resolved_config(preset, config, setting, dem, catalogue)
    if kind != "nav":
        warn_of_size(resolved)
    folder = out or Path("data") / preset
    # Importing Blender takes seconds; check the settings first.
    from perilune_render.jobs.here import Here
    from perilune_render.jobs.run import RenderingFailed, make_dataset

    failed = False
    for name in KINDS if kind == "both" else (kind,):
        try:
            with progress_bar() as progress:
                made = make_dataset(resolved, name, preset, folder / name, progress, Here)
        except RenderingFailed as error:
            failed = True
            _print_failures(error.out, error.errors)
            continue
        counts = made.info.counts
        Console().print(
            f"{folder / name}: {counts.frames} frames, {counts.labels} labels, {counts.scenes} scenes; "
            f"look at {folder / name / 'overview.png'}",
            soft_wrap=True,
        )
    if failed:
        raise typer.Exit(1)


def _print_failures(out: Path, errors: dict[str, str]) -> None:
    for name, error in errors.items():
        console.print(f"error: {out}: {name}: {error}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"{len(errors)} trajectories failed; run the same command again to try them again", soft_wrap=True)


def _was_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _render_manifest(
    manifest: Path, out: Path | None, dem: Path | None, catalogue: Path | None, others: list[str]
) -> None:
    if out is None or others:
        found = "no --out" if out is None else " and ".join(f"--{name.replace('setting', 'set')}" for name in others)
        expected = (
            "--out, and --dem and --catalogue if the recipe names them; all other settings come from the manifest"
        )
        raise UserError("--manifest", "options", found, expected)
    given = ps.open_dataset(manifest)
    from perilune_render.dataset.from_manifest import compare_hashes, plan_from_manifest
    from perilune_render.jobs.here import Here
    from perilune_render.jobs.job import Job
    from perilune_render.jobs.run import RenderingFailed, render_job

    job = Job(*plan_from_manifest(given, dem, catalogue), str(manifest))
    try:
        with progress_bar() as progress:
            made = render_job(job, out, progress, Here)
    except RenderingFailed as error:
        _print_failures(error.out, error.errors)
        raise typer.Exit(1) from None
    same, known, other_scenes = compare_hashes(given, made)
    comparison = f"; {same} of {known} frames are byte-identical to the manifest's" if known else ""
    comparison += f"; terrain hash mismatch in {other_scenes} scenes" if other_scenes else "; terrain hashes match"
    Console().print(
        f"{out}: {made.info.counts.frames} frames, {made.info.counts.labels} labels{comparison}", soft_wrap=True
    )
