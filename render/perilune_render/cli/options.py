"""Options shared by several commands of `perilune-render`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from perilune_render.config.cameras import CameraConfig
from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.terrain import FILE_FIELDS, SITE_FIELDS, ElevationConfig, HeightUnit
from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import say
from perilune_shared.dataset.names import Kind
from perilune_shared.errors import UserError

KindChoice = Literal[Kind, "both"]
"""One of a preset's two datasets, or both."""
OneKind = Annotated[Kind, typer.Option(help="Dataset of the preset: detect (crater detection) or nav (navigation).")]
"""Option of the commands that use one dataset; in all of them the default is `detect`."""
Preset = Annotated[
    str,
    typer.Option(
        help="tiny (seconds, for tests), demo and small (minutes), paper (the paper's protocol), large (343 terrains)."
    ),
]
Config = Annotated[Path | None, typer.Option(help="YAML file whose section `dataset` overrides the preset.")]
Setting = Annotated[
    list[str] | None, typer.Option("--set", help="One setting, as dataset.key.key=value; may be repeated.")
]
Dem = Annotated[
    Path | None,
    typer.Option(
        help="Elevation model (GeoTIFF, JPEG 2000, PDS3, PDS4, ISIS) as base terrain; finer craters are added."
    ),
]
Unit = Annotated[
    HeightUnit | None,
    typer.Option("--height-unit", help="Unit of the elevation model's heights. [default: the one in its file, or m]"),
]
Catalogue = Annotated[
    Path | None,
    typer.Option(help="Catalogue of the craters in the elevation model, CSV or Parquet."),
]


def was_given(context: typer.Context, name: str) -> bool:
    """Whether an option was given on the command line."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def warn_of_size(config: DatasetConfig) -> None:
    """Warn if the detector cannot be trained on frames of the configured size."""
    cameras: dict[str, CameraConfig] = {f"cameras.{name}": each for name, each in config.cameras.items()}
    cameras = cameras or {"camera": config.camera}
    sides = {
        f"{camera}.{name}": getattr(each, name)
        for camera, each in cameras.items()
        for name in ("width_px", "height_px")
    }
    for name, side in sides.items():
        if side % 32:
            line = f"dataset.{name}: {side} is not a multiple of 32: the detector cannot be trained on such frames"
            say(line)


def with_unit(setting: list[str] | None, height_unit: HeightUnit | None) -> list[str]:
    """The values of --set, with --height-unit as a further setting."""
    unit = [] if height_unit is None else [f"dataset.terrain.elevation.height_unit={height_unit}"]
    return [*(setting or []), *unit]


def resolved_config(
    preset: str,
    config: Path | None,
    setting: list[str] | None,
    dem: Path | None,
    catalogue: Path | None,
    *,
    given_scene: bool = False,
) -> DatasetConfig:
    """The settings of a preset with the user's changes.

    `given_scene` is true for commands whose poses come from a file or from clients: they accept `dataset.scene`. Raises
    UserError on invalid settings.
    """
    resolved = resolve(DatasetConfig, "dataset", "perilune_render", preset, config, tuple(setting or ()))
    if resolved.scene is not None and not given_scene:
        raise UserError(
            "configuration", "dataset.scene", "set", "null; it is for `perilune-render frames` and `preview --poses`"
        )
    if resolved.survey is not None:
        raise UserError("configuration", "dataset.survey", "set", "null; `perilune-render survey` renders from orbit")
    if resolved.counterfactual is not None:
        expected = "null; `perilune-render counterfactual` changes the scenes of a dataset"
        raise UserError("configuration", "dataset.counterfactual", "set", expected)
    paths = {name: str(path) for name, path in (("dem", dem), ("catalogue", catalogue)) if path is not None}
    terrain = resolved.terrain.model_copy(update=paths)
    if terrain.catalogue is not None and terrain.dem is None:
        raise UserError(
            "--catalogue", "catalogue", terrain.catalogue, "also --dem, the elevation model of this catalogue"
        )
    for name in (*SITE_FIELDS, *FILE_FIELDS):
        value = getattr(terrain.elevation, name)
        if value != ElevationConfig.model_fields[name].default and terrain.dem is None:
            raise UserError(
                "configuration",
                f"dataset.terrain.elevation.{name}",
                value,
                "to be set only with --dem, an elevation model",
            )
    return resolved.model_copy(update={"terrain": terrain})
