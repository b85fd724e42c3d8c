"""Options shared by several commands of `perilune-train`."""

from pathlib import Path
from typing import Annotated

import typer

Preset = Annotated[str, typer.Option(help="Preset with the values of all settings: tiny, demo, small, paper or large.")]
ConfigFile = Annotated[
    Path | None, typer.Option(help="YAML file whose section (detect, navigate or explain) overrides the preset.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="One setting, for example detect.attention=none; overrides the configuration file and the preset. "
        "Repeatable.",
    ),
]
RunsFolder = Annotated[Path, typer.Option("--out", "--runs", help="Folder that holds all runs.")]
RunName = Annotated[str | None, typer.Option(help="Name of the run. [default: the preset]")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace runs of this name.")]
AllowOverlap = Annotated[
    bool,
    typer.Option(
        "--allow-overlap",
        help="Allow test terrain that the network was trained on; all output is then marked.",
    ),
]
