"""`perilune-train detect predict`."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.storage.replacement import replaceable
from perilune_shared.terminal import say
from perilune_train.cli_options import OverwriteFolder
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
    min_score: Annotated[
        float | None,
        typer.Option(
            "--min-score", "--threshold", help="Minimum score. [default: the run's, chosen on its validation split]"
        ),
    ] = None,
    min_radius_px: Annotated[
        float, typer.Option(help="Minimum radius sqrt(w h) / 2 of a crater in the results, pixels.")
    ] = 0.0,
    min_size: Annotated[float, typer.Option(help="Twice --min-radius-px: minimum sqrt(w h), pixels.")] = 0.0,
    top: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of craters in an image: those of the highest scores.")
    ] = None,
    nodata: NoData = None,
    scale: Scales = None,
    tile: TileSide = Tiling.tile_px,
    overlap: Overlap = Tiling.overlap_px,
    box_margin: BoxMargin = Tiling.box_margin_px,
    overwrite: OverwriteFolder = False,
) -> None:
    """Find craters in images.

    Writes detections.parquet and detections.csv (one row per crater, in pixels of the upright image, from the outer
    corner of its top-left pixel), <image>.overlay.png, and detections.geojson if an image has a georeference.
    """
    if min_score is not None and not 0 < min_score <= 1:
        raise UserError("--min-score", "score", min_score, "above 0, at most 1")
    for option, pixels in (("--min-radius-px", min_radius_px), ("--min-size", min_size)):
        if not 0 <= pixels < float("inf"):
            raise UserError(option, "pixels", pixels, "at least 0")
    if min_radius_px and min_size:
        raise UserError("--min-size", "options", "together with --min-radius-px", "only one of them")
    check_nodata(nodata)
    run = run or shipped_run("detect")
    config = config_of_run(run, ())
    # Importing torch takes seconds; check the options first.
    from perilune_train.detect.images.predict import PredictSettings, predict_images

    tiling = Tiling(tile, overlap, tuple(scale or config.evaluation.scales), box_margin)
    settings = PredictSettings(tiling, min_score, max(min_size, 2 * min_radius_px), nodata, top)
    with replaceable(out, ("detections.parquet",), overwrite=overwrite) as folder:
        count = predict_images(images, run, config, folder, settings)
    n_images = len(list(out.glob("*.overlay.png")))
    places = ", detections.geojson" if (out / "detections.geojson").is_file() else ""
    written = f"detections.parquet, detections.csv{places}, *.overlay.png"
    say(f"{out}: {count} craters in {n_images} images; {written}")
