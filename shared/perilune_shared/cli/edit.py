"""Commands of `perilune-manifest` that edit or compare datasets."""

from contextlib import AbstractContextManager
from typing import Annotated

import typer

import perilune_shared as ps
from perilune_shared.console.command_line import OverwriteFolder
from perilune_shared.console.terminal import answer, answer_table, progress_bar
from perilune_shared.dataset.names import ImageChoice, ImageMode, SplitUnit
from perilune_shared.errors import UserError
from perilune_shared.storage.replacement import replaceable

EXIT_DIFFERENT = 1


DatasetArgument = Annotated[
    str,
    typer.Argument(help="Folder of a dataset (contains dataset.json), or its address: s3://bucket/prefix, gs://..."),
]
OutOption = Annotated[str, typer.Option(help="New folder or address for the result.")]
ImagesOption = Annotated[
    ImageChoice,
    typer.Option(help="copy: copy the frames; none: omit them; plan: omit craters, boulders and labels too."),
]

LinkOption = Annotated[
    bool,
    typer.Option("--link", help="Hard-link frames instead of copying them: an edit in one dataset changes both."),
]


def _mode(images: ImageChoice, link: bool) -> ImageMode:
    if link and images != "copy":
        raise UserError("--link", "--images", images, "copy: other modes write no frames")
    return "link" if link else images


def add_to(app: typer.Typer) -> None:
    """Register the commands of this file."""
    for command in (merge, subset, split, diff, migrate, pack, unpack, attach):
        app.command()(command)


def _new_dataset(out: str, overwrite: bool, *inputs: str) -> AbstractContextManager[str]:
    """Return a context manager with the address to write to; `inputs` are the source datasets."""
    return replaceable(out, ("dataset.json",), overwrite=overwrite, inputs=inputs)


def _print_counts(out: str) -> None:
    """Print the counts of the new dataset and whether its splits share terrain."""
    info = ps.open_dataset(out).info
    counts = info.counts
    text = f"{counts.scenes} scenes, {counts.trajectories} trajectories, {counts.frames} frames, {counts.labels} labels"
    line = f"{out}: {text}, frames {info.images}, split by {info.split_by}{info.leak}"
    answer(line)


def merge(
    datasets: Annotated[
        list[str], typer.Argument(help="Folders or addresses of two or more datasets of the same kind and camera.")
    ],
    out: OutOption,
    name: Annotated[str, typer.Option(help="Name of the result.")] = "merged",
    images: ImagesOption = "copy",
    link: LinkOption = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Merge several datasets into one. A scene or frame that is in several datasets is written once."""
    from perilune_shared.editing.merge import merge as merge_datasets

    with _new_dataset(out, overwrite, *datasets) as folder, progress_bar() as progress:
        merge_datasets([ps.open_dataset(path) for path in datasets], folder, name, _mode(images, link), progress)
    _print_counts(out)


def subset(
    dataset: DatasetArgument,
    out: OutOption,
    where: Annotated[
        list[str] | None,
        typer.Option(help='Condition on columns, for example "radius_px > 5" or "split == \'test\'"; may be repeated.'),
    ] = None,
    frames: Annotated[int | None, typer.Option(help="Maximum number of frames.")] = None,
    mb: Annotated[float | None, typer.Option(help="Maximum total size of the PNGs, 10^6 bytes.")] = None,
    images: ImagesOption = "copy",
    link: LinkOption = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Copy part of a dataset: by conditions on columns, number of frames or size."""
    from perilune_shared.editing.subset import Limit
    from perilune_shared.editing.subset import subset as choose

    limit = None if frames is None and mb is None else Limit(frames, mb)
    with _new_dataset(out, overwrite, dataset) as folder, progress_bar() as progress:
        choose(ps.open_dataset(dataset), folder, tuple(where or ()), limit, _mode(images, link), progress)
    _print_counts(out)


def split(
    dataset: DatasetArgument,
    out: OutOption,
    by: Annotated[
        SplitUnit, typer.Option(help="Assign whole scenes, trajectories or frames. With `frame`, splits share terrain.")
    ] = "scene",
    val: Annotated[float, typer.Option(help="Share of scenes, trajectories or frames in val.")] = 0.1,
    test: Annotated[float, typer.Option(help="Share of scenes, trajectories or frames in test.")] = 0.1,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the split.")] = 0,
    images: ImagesOption = "copy",
    link: LinkOption = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Re-split a dataset into train, val and test, by scene, trajectory or frame."""
    from perilune_shared.editing.split import Split, split_dataset

    parts = Split(by, val, test, seed)
    with _new_dataset(out, overwrite, dataset) as folder, progress_bar() as progress:
        split_dataset(ps.open_dataset(dataset), folder, parts, _mode(images, link), progress)
    _print_counts(out)


def diff(first: DatasetArgument, second: DatasetArgument) -> None:
    """Show the differences between two datasets. Exit code 1 if there are any."""
    from perilune_shared.editing.diff import differences

    differing = differences(ps.open_dataset(first), ps.open_dataset(second))
    if not differing:
        answer("no difference")
        return
    rows = [(each.table, each.column, each.rows, each.example, each.first, each.second) for each in differing]
    answer_table(("where", "column", "rows", "example", "first", "second"), rows)
    raise typer.Exit(EXIT_DIFFERENT)


def migrate(
    dataset: DatasetArgument, out: OutOption, link: LinkOption = False, overwrite: OverwriteFolder = False
) -> None:
    """Convert a dataset of an older schema version to the current one."""
    from perilune_shared.editing.migrate import migrate as migrate_dataset

    with _new_dataset(out, overwrite, dataset) as folder, progress_bar() as progress:
        migrate_dataset(dataset, folder, progress, link=link)
    _print_counts(out)


def pack(
    dataset: DatasetArgument,
    out: OutOption,
    shard_mb: Annotated[float, typer.Option(help="Approximate size of a shard, megabytes.")] = 128,
    overwrite: OverwriteFolder = False,
) -> None:
    """Pack a dataset for streaming: frames, poses and labels into shards, each table into one file."""
    from perilune_shared.editing.pack import pack as pack_dataset

    with _new_dataset(out, overwrite, dataset) as folder, progress_bar() as progress:
        pack_dataset(ps.open_dataset(dataset), folder, shard_mb, progress)
    _print_counts(out)


def unpack(
    dataset: DatasetArgument, out: OutOption, link: LinkOption = False, overwrite: OverwriteFolder = False
) -> None:
    """Unpack frames from Parquet into one PNG file per frame."""
    from perilune_shared.editing.pack import unpack as unpack_dataset

    with _new_dataset(out, overwrite, dataset) as folder, progress_bar() as progress:
        unpack_dataset(ps.open_dataset(dataset), folder, progress, link=link)
    _print_counts(out)


def attach(
    manifest: DatasetArgument,
    frames: Annotated[str, typer.Option(help="Folder written by `perilune-render regenerate --out`.")],
    out: OutOption,
    rehash: Annotated[
        bool,
        typer.Option(
            "--rehash", help="Accept frames whose hashes differ from the manifest, and record the new hashes."
        ),
    ] = False,
    link: LinkOption = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Combine a manifest without frames and the frames regenerated from it into a dataset."""
    from perilune_shared.editing.attach import attach as attach_frames

    with _new_dataset(out, overwrite, manifest, frames) as folder, progress_bar() as progress:
        attach_frames(ps.open_dataset(manifest), frames, folder, rehash, progress, link=link)
    _print_counts(out)
