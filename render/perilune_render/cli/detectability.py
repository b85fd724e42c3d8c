"""The command `perilune-render detectability`."""

import time
from pathlib import Path
from typing import Annotated

import typer

import perilune_shared as ps
from perilune_shared.console.terminal import answer, progress_bar
from perilune_shared.dataset.names import Split
from perilune_shared.errors import UserError


def detectability(
    dataset: Annotated[str, typer.Option(help="Folder or address of a rendered dataset.")],
    out: Annotated[Path, typer.Option(help="Parquet table to write.")],
    split: Annotated[Split, typer.Option(help="Split whose labels are measured.")] = "test",
    frames_per_trajectory: Annotated[
        int, typer.Option(min=1, help="Largest number of frames of each trajectory, evenly spaced in the split.")
    ] = 1_000_000,
    dem: Annotated[Path | None, typer.Option(help="Elevation model that the dataset's recipe names.")] = None,
    catalogue: Annotated[Path | None, typer.Option(help="Crater catalogue that the dataset's recipe names.")] = None,
) -> None:
    """Measure how detectable each label is: render its frame with and without the crater.

    The table has a row for each label of a generated crater, with the detectability d' of an ideal observer in sensor
    noise and local clutter. The engine is `heightfield`. Finished parts are kept in OUT.parts until the table is
    complete: run the same command again to resume.
    """
    if out.suffix != ".parquet":
        raise UserError("--out", "format", out.suffix or "none", ".parquet")
    if out.exists():
        raise UserError("--out", "", "a file that exists", "a new file")
    source = ps.open_dataset(dataset)
    import pyarrow.parquet as pq

    from perilune_render.dataset.from_manifest import plan_from_manifest
    from perilune_render.detectability.measure import labels_of, measure, parts_of
    from perilune_render.flight.counterfactual import part_of
    from perilune_shared.storage.files import written_aside

    plan, config, _ = plan_from_manifest(source, dem, catalogue)
    if config.survey is not None or config.counterfactual is not None:
        found = "a survey" if config.survey is not None else "a counterfactual"
        raise UserError(dataset, "recipe", found, "frames over unchanged ground")
    plan = part_of(plan, split, frames_per_trajectory)
    labels = labels_of(source, plan, split)
    parts, start_s = out.with_name(out.name + ".parts"), time.monotonic()
    with progress_bar() as progress:
        table = measure(labels, plan, config, parts, progress)
    with written_aside(out) as aside:
        pq.write_table(table, aside, compression="zstd")
    for path in parts_of(parts):
        path.unlink()
    parts.rmdir()
    n_frames = len(labels.rows["frame_id"].unique())
    answer(f"{out}: {len(table)} labels in {n_frames} frames, {time.monotonic() - start_s:.0f} s")
