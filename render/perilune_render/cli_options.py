"""Options shared by several commands of `perilune-render`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from perilune_shared.dataset.names import Kind
from perilune_shared.errors import UserError

KindChoice = Literal[Kind, "both"]
"""One of a preset's two datasets, or both."""
Preset = Annotated[
    str,
    typer.Option(
        help="tiny (seconds, for tests), small (minutes), paper (the paper's protocol), large (343 terrains)."
    ),
]
Config = Annotated[Path | None, typer.Option(help="YAML file whose section `dataset` overrides the preset.")]
Setting = Annotated[
    list[str] | None, typer.Option("--set", help="One setting, as dataset.key.key=value; may be repeated.")
]
Dem = Annotated[
    Path | None,
    typer.Option(help="GeoTIFF elevation model as the base; craters below its resolution are added."),
]
Catalogue = Annotated[
    Path | None,
    typer.Option(help="CSV of the elevation model's own craters (longitude_deg, latitude_deg, diameter_m)."),
]


def first_kind(kind: KindChoice) -> Kind:
    """The kind itself; `detect` for `both`."""
    return "detect" if kind == "both" else kind


def one_kind(kind: KindChoice) -> Kind:
    """The kind itself. Raises UserError for `both`."""
    if kind == "both":
        raise UserError("--kind", "kind", "both", "detect or nav (one dataset)")
    return first_kind(kind)
