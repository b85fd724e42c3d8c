"""`perilune-train detect predict`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.detect.cli.tiling_options import BoxMargin, NoData, Overlap, Scales, TileSide, check_nodata
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.shipped.models import shipped_run


def predict(
    images: Annotated[list[Path], typer.Argument(help="Images of any size, or folders of images.")],
    run: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("predictions"),
    threshold: Annotated[
        float | None, typer.Option(help="Minimum score. [default: the run's, chosen on its validation split]")
    ] = None,
    min_size: Annotated[float, typer.Option(help="Minimum size sqrt(w h) of a crater in the results, pixels.")] = 0.0,
    nodata: NoData = None,
    scale: Scales = None,
    tile: TileSide = Tiling.tile_px,
    overlap: Overlap = Tiling.overlap_px,
    box_margin: BoxMargin = Tiling.box_margin_px,
) -> None:
    """Find craters in images.

    Writes detections.parquet and detections.csv (one row per crater, in pixels of the upright image, from the outer
    corner of its top-left pixel), <image>.overlay.png, and detections.geojson if an image has a georeference.
    """
    if threshold is not None and not 0 < threshold <= 1:
        raise UserError("--threshold", "score", threshold, "above 0, at most 1")
    if not 0 <= min_size < float("inf"):
        raise UserError("--min-size", "pixels", min_size, "at least 0")
    check_nodata(nodata)
    run = run or shipped_run("detect")
    config = config_of_run(run, ())
    # Importing torch takes seconds; check the options first.
    from perilune_train.detect.images.predict import PredictSettings, predict_images

    tiling = Tiling(tile, overlap, tuple(scale or config.evaluation.scales), box_margin)
    settings = PredictSettings(tiling, threshold, min_size, nodata)
    count = predict_images(images, run, config, out, settings)
    n_images = len(list(out.glob("*.overlay.png")))
    places = ", detections.geojson" if (out / "detections.geojson").is_file() else ""
    written = f"detections.parquet, detections.csv{places}, *.overlay.png"
    say(f"{out}: {count} craters in {n_images} images; {written}")
