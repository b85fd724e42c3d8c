"""The command line `perilune-render`: datasets, previews and meshes from a configuration."""

import tempfile
from pathlib import Path
from typing import Annotated, get_args

import typer

import perilune_render
import perilune_shared as ps
from perilune_render.cli.counterfactual import counterfactual
from perilune_render.cli.dataset import dataset
from perilune_render.cli.detectability import detectability
from perilune_render.cli.frames import CameraAxes, frames, with_camera
from perilune_render.cli.options import (
    Catalogue,
    Config,
    Dem,
    OneKind,
    Preset,
    Setting,
    Unit,
    resolved_config,
    warn_of_size,
    was_given,
    with_unit,
)
from perilune_render.cli.serve import serve
from perilune_render.cli.spice import spice
from perilune_render.cli.status import status
from perilune_render.cli.sun import warn_of_sun, warn_of_suns
from perilune_render.cli.survey import survey
from perilune_render.config.dataset import DatasetConfig
from perilune_shared.config.page import annotated_yaml
from perilune_shared.config.resolve import resolve, to_yaml
from perilune_shared.console.command_line import OverwriteFolder, add_renamed, new_program, run_command_line
from perilune_shared.console.terminal import answer, answer_page, progress_bar
from perilune_shared.errors import EXIT_USER_ERROR, UserError
from perilune_shared.storage.replacement import replaceable

app = new_program(
    "perilune-render",
    perilune_render.__version__,
    "Generate lunar terrain and trajectories, and render labelled frames.",
)


@app.command()
def config(
    preset: Preset = "small",
    config: Config = None,
    settings: Setting = None,
    show: Annotated[
        bool, typer.Option("--show/--plain", help="Print meaning, unit and default of each setting, or only values.")
    ] = True,
) -> None:
    """Print all settings as a configuration file to start from."""
    resolved = resolve(DatasetConfig, "dataset", "perilune_render", preset, config, tuple(settings or ()))
    answer_page(annotated_yaml("dataset", resolved) if show else to_yaml("dataset", resolved))


app.command()(dataset)
app.command()(frames)
app.command()(spice)
app.command()(serve)
app.command()(status)
app.command()(survey)
app.command()(counterfactual)
app.command()(detectability)


@app.command()
def develop(
    dataset: Annotated[str, typer.Option(help="Folder or address of a dataset with EXRs (dataset.render.exr=true).")],
    out: Annotated[str, typer.Option(help="Folder or address of the new dataset.")],
    config: Annotated[
        Path | None, typer.Option(help="YAML file whose dataset.sensor and dataset.camera override the source's.")
    ] = None,
    setting: Setting = None,
) -> None:
    """Make a dataset with a different sensor or camera from the EXRs of another dataset, without Blender."""
    from perilune_render.dataset.develop import develop_dataset

    with progress_bar() as progress:
        developed = develop_dataset(ps.open_dataset(dataset), out, progress, config, tuple(setting or ()))
    counts = developed.info.counts
    answer(f"{out}: {counts.frames} frames, {counts.labels} labels; look at {developed.store.at('overview.png')}")


@app.command()
def plan(
    context: typer.Context,
    out: Annotated[str, typer.Option(help="New folder or address of the manifest.")],
    preset: Preset = "small",
    config: Config = None,
    setting: Setting = None,
    dem: Dem = None,
    height_unit: Unit = None,
    catalogue: Catalogue = None,
    kind: OneKind = "detect",
    manifest: Annotated[
        str | None,
        typer.Option(
            help="Manifest without the table `frames`, such as those in `data_manifests`: write it again with this "
            "table, computed from its recipe."
        ),
    ] = None,
    overwrite: OverwriteFolder = False,
) -> None:
    """Write the plan of a dataset as a manifest without frames, with the hash of every generated scene."""
    from perilune_render.dataset.manifest_only import write_left_out_frames, write_manifest_only

    if manifest is not None:
        options = ("preset", "config", "setting", "dem", "height_unit", "catalogue", "kind")
        other_options = [
            name.replace("_", "-").replace("setting", "set") for name in options if was_given(context, name)
        ]
        if other_options:
            raise UserError(
                "--manifest", "options", f"--{other_options[0]}", "--out alone: the rest comes from the manifest"
            )
        replaced = replaceable(out, ("dataset.json",), overwrite=overwrite, inputs=(manifest,))
        with replaced as folder, progress_bar() as progress:
            write_left_out_frames(ps.open_dataset(manifest), folder, progress)
    else:
        resolved = resolved_config(preset, config, with_unit(setting, height_unit), dem, catalogue)
        if kind != "nav":
            warn_of_size(resolved)
        warn_of_suns(resolved, (kind,))
        with replaceable(out, ("dataset.json",), overwrite=overwrite) as folder, progress_bar() as progress:
            write_manifest_only(resolved, kind, preset, folder, progress)
    counts = ps.open_dataset(out).info.counts
    answer(f"{out}: {counts.scenes} scenes, {counts.trajectories} trajectories, {counts.frames} frames planned")


@app.command()
def regenerate(
    manifest: Annotated[str, typer.Option(help="Folder or address of a dataset or of its manifest alone.")],
    frames: Annotated[
        list[str] | None, typer.Option(help="A frame_id such as scene-0000/trajectory-0000/000003; may be repeated.")
    ] = None,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify", help="Compare frames, then delete them. Without --frames or --all, a sample is compared."
        ),
    ] = False,
    sample: Annotated[int, typer.Option(min=1, help="Number of frames in the sample, evenly spread.")] = 12,
    everything: Annotated[bool, typer.Option("--all", help="All frames of the manifest.")] = False,
    out: Annotated[str | None, typer.Option(help="Folder or address for the frames; optional with --verify.")] = None,
    dem: Annotated[Path | None, typer.Option(help="Local copy of the elevation model that the recipe names.")] = None,
    catalogue: Annotated[
        Path | None, typer.Option(help="Local copy of the crater catalogue that the recipe names.")
    ] = None,
) -> None:
    """Render frames from a manifest and compare them with its hashes; exit code 2 on a difference."""
    if not verify and (out is None or not (frames or everything)):
        raise UserError("regenerate", "--frames (or --all) and --out", "not given", "both, or --verify")
    dataset = ps.open_dataset(manifest)
    from perilune_render.dataset.regenerate import State, spread
    from perilune_render.dataset.regenerate import regenerate as regenerate_frames

    if frames and everything:
        raise UserError("regenerate", "options", "--frames and --all", "one of them")
    ids = list(dict.fromkeys(frames or ())) or spread(dataset, dataset.info.counts.frames if everything else sample)
    with tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        outcomes = regenerate_frames(dataset, ids, out or folder, progress, dem, catalogue)
    counts = {state: sum(o.state == state for o in outcomes) for state in get_args(State)}
    for outcome in outcomes:
        if outcome.state != "identical" and not verify:
            answer(f"{outcome.png_path}: {outcome.state}")
    states = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    ground = "" if all(o.same_ground for o in outcomes) else "; terrain hash mismatch"
    answer(f"{len(outcomes)} frames: {states}{ground}")
    if counts["different"] or ground:
        raise typer.Exit(EXIT_USER_ERROR)


@app.command()
def preview(
    config: Annotated[
        Path | None, typer.Argument(help="YAML file whose section `dataset` overrides the preset.")
    ] = None,
    preset: Preset = "small",
    setting: Setting = None,
    dem: Dem = None,
    height_unit: Unit = None,
    catalogue: Catalogue = None,
    kind: OneKind = "detect",
    poses: Annotated[
        Path | None, typer.Option(help="Poses as for `frames`, in place of the descents of the configuration.")
    ] = None,
    scene: Annotated[
        Path | None, typer.Option(help="With --poses: settings of the scene, as for `frames`; equivalent to CONFIG.")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="With --poses: file with the camera, as for `frames`.")] = None,
    camera_axes: CameraAxes = None,
    out: Annotated[Path, typer.Option(help="PNG to write; the map is written beside it, as NAME-map.png.")] = Path(
        "preview.png"
    ),
) -> None:
    """Render frames of a configuration as a contact sheet, and a map of the landing site, in seconds."""
    if poses is None and (scene is not None or camera is not None or camera_axes is not None):
        raise UserError("preview", "--scene, --camera or --camera-axes", "no --poses", "--poses as well")
    if scene is not None and config is not None:
        raise UserError("preview", "--scene", f"{scene} and {config}", "one of them")
    resolved = resolved_config(
        preset, scene or config, with_unit(setting, height_unit), dem, catalogue, given_scene=poses is not None
    )
    resolved = with_camera(resolved, camera)
    if out.suffix.lower() != ".png":
        raise UserError(out, "format", out.suffix or "none", ".png")
    from perilune_render.flight.plan import make_plan
    from perilune_render.poses.file import read_poses
    from perilune_render.poses.plan import given_plan
    from perilune_render.preview.contact_sheet import write_preview
    from perilune_render.terrain.scene import site_of

    if poses is None:
        plan = make_plan(resolved, kind)
    else:
        plan, resolved = given_plan(read_poses(poses, *site_of(resolved), camera_axes), resolved, kind, poses)
    setting_of_sun = "sun_elevation_deg" if poses else f"dataset.{kind}.sun.elevation_deg"
    warn_of_sun(resolved, setting_of_sun, max(each.sun_elevation_deg for each in plan.scenes))
    map_path = out.with_name(f"{out.stem}-map.png")
    write_preview(plan, resolved, poses or f"configuration: dataset.{kind}", out, map_path)
    answer(f"look at {out} and {map_path}")


@app.command()
def ground(
    preset: Preset = "small",
    config: Config = None,
    setting: Setting = None,
    dem: Dem = None,
    height_unit: Unit = None,
    catalogue: Catalogue = None,
    kind: OneKind = "detect",
    step: Annotated[int, typer.Option(min=1, help="Vertex spacing of the mesh, as a multiple of the scene's.")] = 4,
    pixel_m: Annotated[float, typer.Option(min=0.01, help="Pixel size of a GeoTIFF on the ground, metres.")] = 1.0,
    out: Annotated[
        Path, typer.Option(help="File to write: .glb, .ply, .obj or .stl for a mesh, .tif for heights.")
    ] = Path("scene.glb"),
) -> None:
    """Write the ground of a configuration's first scene as a mesh or a GeoTIFF.

    Coordinates are metres in O_L: Z up, Y south, X west.
    """
    resolved = resolved_config(preset, config, with_unit(setting, height_unit), dem, catalogue)
    from perilune_render.flight.plan import make_plan
    from perilune_render.terrain.cache import cached_scene
    from perilune_render.terrain.export import MESH_SUFFIXES, RASTER_SUFFIXES, export_mesh, export_raster

    if out.suffix not in MESH_SUFFIXES + RASTER_SUFFIXES:
        raise UserError(out, "format", out.suffix or "none", "one of " + ", ".join(MESH_SUFFIXES + RASTER_SUFFIXES))
    plan = make_plan(resolved, kind)
    scene = cached_scene(resolved, plan.view, plan.scenes[0].seed)
    if out.suffix in RASTER_SUFFIXES:
        export_raster(scene, out, pixel_m)
    else:
        export_mesh(scene, out, step=step)
    answer(f"{out}: {len(scene.craters)} craters, {len(scene.boulders)} boulders")


add_renamed(app, "export", "ground", ground)


def main() -> None:
    """Entry point of the command line."""
    run_command_line(app)
