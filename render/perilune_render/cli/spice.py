"""The command `perilune-render spice`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_render.cli.frames import Scene
from perilune_render.cli.options import Dem, Preset, Setting, Unit, resolved_config, with_unit
from perilune_shared.console.terminal import answer
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text


def spice(
    kernels: Annotated[list[Path], typer.Option(help="Kernel or meta-kernel; may be repeated, later ones override.")],
    spacecraft: Annotated[str, typer.Option(help="Name or NAIF id of the spacecraft (or camera) in the kernels.")],
    camera_frame: Annotated[str, typer.Option(help="Name of the camera's frame in the kernels.")],
    start: Annotated[str, typer.Option(help="UTC of the first frame, such as 2026-03-01T12:00:00.")],
    end: Annotated[str, typer.Option(help="UTC of the last frame.")],
    out: Annotated[Path, typer.Option(help="CSV of poses to write, for `perilune-render frames --poses`.")],
    frames: Annotated[int | None, typer.Option(min=1, help="Number of frames, evenly spaced.")] = None,
    step_s: Annotated[
        float | None, typer.Option(min=0.001, help="Seconds between frames, in place of --frames.")
    ] = None,
    camera_axes: Annotated[
        str, typer.Option(help="Axes of the camera's frame that point right, down and forward in the image.")
    ] = "x,y,z",
    fixed_frame: Annotated[
        str | None,
        typer.Option(help="Frame fixed to the Moon. [default: MOON_ME if the kernels define it, else IAU_MOON]"),
    ] = None,
    site_height_m: Annotated[
        float | None,
        typer.Option(
            min=-20_000, max=20_000, help="Height of the site above 1737.4 km, metres. [default: from --dem, or 0]"
        ),
    ] = None,
    scene: Scene = None,
    preset: Preset = "small",
    setting: Setting = None,
    dem: Dem = None,
    height_unit: Unit = None,
) -> None:
    """Write the poses of a camera and the Sun from SPICE kernels, for the site of a scene."""
    config = resolved_config(preset, scene, with_unit(setting, height_unit), dem, None, given_scene=True)
    if out.suffix.lower() != ".csv":
        raise UserError(out, "format", out.suffix or "none", ".csv")
    from perilune_render.poses.spice import SpiceSource, poses_csv, read_spice
    from perilune_render.terrain.elevation.model import height_of_site_m
    from perilune_render.terrain.scene import model_of, site_of

    source = SpiceSource(tuple(kernels), spacecraft, camera_frame, camera_axes, fixed_frame, start, end, frames, step_s)
    site, model = site_of(config), model_of(config.terrain)
    height = site_height_m if site_height_m is not None else 0.0 if model is None else height_of_site_m(model)
    poses = read_spice(source, *site, height)
    write_text(out, poses_csv(poses, source, *site, height))
    answer(
        f"{out}: {len(poses.time_s)} poses from {poses.start} UTC relative to {poses.fixed_frame}; site at "
        f"{site[0]:.6f}, {site[1]:.6f}, {height:.1f} m above 1737.4 km; height above the site "
        f"{poses.position_m[0, 2]:.1f} to {poses.position_m[-1, 2]:.1f} m; Sun {poses.sun_deg[0, 1]:.2f} degrees high"
    )
