"""`perilune-train detect predict`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.detect.cli.tiling_options import BoxMargin, Overlap, Scales, TileSide
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.shipped.models import shipped_run


def predict(
    images: Annotated[list[Path], typer.Argument(help="PNG, TIFF or JPEG of any size.")],
    run: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("predictions"),
    threshold: Annotated[
        float | None, typer.Option(help="Minimum score. [default: the run's, chosen on its validation split]")
    ] = None,
    scale: Scales = None,
    tile: TileSide = Tiling.tile_px,
    overlap: Overlap = Tiling.overlap_px,
    box_margin: BoxMargin = Tiling.box_margin_px,
) -> None:
    """Find craters in images.

    Writes detections.parquet and detections.csv (one row per crater, in pixels of the image, from the outer corner of
    its top-left pixel), <image>.overlay.png, and detections.geojson if an image has a georeference.
    """
    if threshold is not None and not 0 < threshold <= 1:
        raise UserError("--threshold", "score", threshold, "above 0, at most 1")
    run = run or shipped_run("detect")
    config = config_of_run(run, ())
    # Importing torch takes seconds; check the options first.
    from perilune_train.detect.images.predict import predict_images

    count = predict_images(
        images, run, config, out, threshold, Tiling(tile, overlap, tuple(scale or config.evaluation.scales), box_margin)
    )
    places = ", detections.geojson" if (out / "detections.geojson").is_file() else ""
    written = f"detections.parquet, detections.csv{places}, *.overlay.png"
    say(f"{out}: {count} craters in {len(images)} images; {written}")
