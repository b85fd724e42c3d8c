"""Commands `perilune-manifest export` and `card`: other formats and the dataset card."""

from pathlib import Path
from typing import Annotated, Literal

import typer

import perilune_shared as ps
from perilune_shared.cli.edit import DatasetArgument, LinkOption
from perilune_shared.console.command_line import OverwriteFolder
from perilune_shared.console.terminal import answer, progress_bar
from perilune_shared.errors import UserError
from perilune_shared.storage.replacement import replaceable

ExportFormat = Literal["coco", "yolo", "tum", "kitti", "croissant", "huggingface", "mcap", "rerun"]
_WITH_LABELS = ("coco", "yolo", "huggingface", "mcap", "rerun")
_WITH_TIME_LINE = ("mcap", "rerun")
_KNOWN_BY = {
    "coco": ("instances_*.json",),
    "yolo": ("data.yaml", "labels/**/*.txt"),
    "tum": ("*/trajectory-*.txt",),
    "kitti": ("*/*.times.txt",),
    "huggingface": ("README.md", "data/*/*.parquet"),
    "mcap": ("foxglove-layout.json", "*/*/*.mcap"),
    "rerun": ("*/*.rrd",),
}
"""Files that identify a folder as an export in each format."""


def add_to(app: typer.Typer) -> None:
    """Register the commands of this file."""
    app.command()(export)
    app.command()(card)


def export(
    dataset: DatasetArgument,
    format: Annotated[
        ExportFormat,
        typer.Option(
            help="coco, yolo: boxes and ellipses; tum, kitti: camera poses; huggingface: frames with pose and labels; "
            "croissant: metadata; mcap: descents as ROS 2 messages for Foxglove; rerun: descents for the Rerun viewer."
        ),
    ],
    out: Annotated[
        str | None,
        typer.Option(
            help="New folder or address; for croissant a .json file in the dataset, by default croissant.json."
        ),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Only this split: train, val or test (not for croissant).")] = None,
    selection: Annotated[
        str,
        typer.Option(
            help="Labels to export: all, paper or visible. coco marks the others as iscrowd, huggingface marks "
            "the selected ones, the other formats omit the others."
        ),
    ] = "all",
    trajectory: Annotated[
        str | None,
        typer.Option(metavar="SCENE/TRAJECTORY", help="Only this descent, as scene_id/trajectory_id (mcap, rerun)."),
    ] = None,
    estimates: Annotated[
        Path | None,
        typer.Option(
            help="The landing filter's output for the descent: the folder that `perilune-train navigate trace` (full "
            "covariance) or `navigate fly` wrote, or its table frames or estimates (mcap, rerun)."
        ),
    ] = None,
    link: LinkOption = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Export labels, trajectories or metadata in the format of another tool."""
    from perilune_shared.config.errors import nearest
    from perilune_shared.dataset.keys import check_keys
    from perilune_shared.dataset.names import SPLITS
    from perilune_shared.export.coco import export_coco
    from perilune_shared.export.croissant import export_croissant
    from perilune_shared.export.hugging_face import export_hugging_face
    from perilune_shared.export.mcap import export_mcap
    from perilune_shared.export.rerun_recording import export_rerun
    from perilune_shared.export.rows import by_selection
    from perilune_shared.export.trajectory import export_kitti, export_tum
    from perilune_shared.export.yolo import export_yolo
    from perilune_shared.labels.thresholds import SELECTIONS

    opened = ps.open_dataset(dataset)
    check_keys(opened)
    if split is not None and split not in SPLITS:
        raise UserError("--split", "", split, "one of " + ", ".join(SPLITS))
    if selection not in SELECTIONS:
        raise UserError("--selection", "", selection, nearest(selection, tuple(SELECTIONS)))
    choose = by_selection(SELECTIONS[selection]) if selection != "all" else None
    if choose is not None and format not in _WITH_LABELS:
        raise UserError(
            "--selection", "selection", selection, f"--format {', '.join(_WITH_LABELS)}: other formats have no labels"
        )
    if link and format != "yolo":
        raise UserError("--link", "--format", format, "yolo: other formats have no image files")
    for option, value in (("--trajectory", trajectory), ("--estimates", estimates)):
        if value is not None and format not in _WITH_TIME_LINE:
            raise UserError(option, "--format", format, " or ".join(_WITH_TIME_LINE))
    if estimates is not None and trajectory is None and opened.info.counts.trajectories != 1:
        found = f"{opened.info.counts.trajectories} descents in the dataset"
        raise UserError("--estimates", "", found, "--trajectory SCENE/TRAJECTORY, the descent of the estimates")
    if format == "croissant":
        if split is not None:
            raise UserError("--split", "", split, "no --split: Croissant describes the whole dataset")
        with progress_bar() as progress:
            written = export_croissant(opened, out, progress)
        answer(f"{written}: written")
        return
    if out is None:
        raise UserError("--out", "", "none", f"a new folder for the {format} files")
    inputs = (dataset,) if estimates is None else (dataset, estimates)
    known = replaceable(out, _KNOWN_BY[format], overwrite=overwrite, inputs=inputs)
    with known as folder, progress_bar() as progress:
        match format:
            case "coco":
                done = f"{export_coco(opened, folder, progress, split, choose)} annotations"
                done += "" if choose is None else " of selected labels; the others are marked iscrowd"
            case "yolo":
                done = f"{export_yolo(opened, folder, progress, split, choose, link=link)} boxes"
            case "huggingface":
                done = f"{export_hugging_face(opened, folder, progress, split, choose)} frames"
            case "tum":
                done = f"{export_tum(opened, folder, progress, split)} trajectories"
            case "kitti":
                done = f"{export_kitti(opened, folder, progress, split)} trajectories"
            case "mcap":
                done = f"{export_mcap(opened, folder, progress, split, choose, trajectory, estimates)} descents"
            case "rerun":
                done = f"{export_rerun(opened, folder, progress, split, choose, trajectory, estimates)} descents"
    answer(f"{out}: {done}")


def card(
    dataset: DatasetArgument,
    out: Annotated[
        str | None,
        typer.Option(help="Path or address of the Markdown file; by default README.md in the dataset."),
    ] = None,
    licence: Annotated[
        str | None,
        typer.Option(
            help="Licence under which you publish the dataset, as an SPDX expression such as CC-BY-4.0. If the card is "
            "written in the dataset, the licence is also written into dataset.json, for exports and merges. [default: "
            "the licence in dataset.json; a dataset that you rendered states none]"
        ),
    ] = None,
) -> None:
    """Write a dataset card: counts, histograms, labelled frames, licence, and how to reproduce the data."""
    from perilune_shared.export.card import write_card

    with progress_bar() as progress:
        page, picture = write_card(ps.open_dataset(dataset), out, progress, licence)
    answer(f"{page}, {picture}: written")
