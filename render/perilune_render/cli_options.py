"""Options shared by several commands of `perilune-render`."""

import enum
from pathlib import Path
from typing import Annotated, Literal

import typer

from perilune_shared.errors import UserError


class Kind(enum.StrEnum):
    """Which of a preset's two datasets."""

    DETECT = "detect"
    NAV = "nav"
    BOTH = "both"


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


def first_kind(kind: Kind) -> Literal["detect", "nav"]:
    """The dataset of this kind; detect for `both`."""
    return "nav" if kind is Kind.NAV else "detect"


def one_kind(kind: Kind) -> Literal["detect", "nav"]:
    """The dataset of this kind. Raises UserError for `both`."""
    if kind is Kind.BOTH:
        raise UserError("--kind", "kind", "both", "detect or nav: one dataset")
    return first_kind(kind)
