"""`perilune-train detect evaluate`: evaluate a finished run again, also on another dataset or other labels."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.config import parse_setting, resolve_over
from perilune_shared.errors import UserError
from perilune_shared.terminal import say
from perilune_train.cli_options import AllowOverlap
from perilune_train.detect.cli.tiling_options import BoxMargin, NoData, Overlap, Scales, TileSide, check_nodata
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.shipped.models import shipped_run

_FOR_DATASETS = ("dataset", "allow_overlap")
_FOR_IMAGES = ("min_size", "tile", "overlap", "box_margin", "category", "image_folder", "nodata")


def evaluate(
    context: typer.Context,
    run: Annotated[
        Path | None,
        typer.Option(help="Folder of a finished detect run. [default: the detector that is installed]"),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Dataset: a folder, s3://bucket/prefix or gs://bucket/prefix. [default: data/<name of the run>/detect]"
        ),
    ] = None,
    split: Annotated[str, typer.Option(help="train, val or test; with --images of a source that has splits.")] = "test",
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="One setting of detect.evaluation or detect.labels in place of the run's. Repeatable."
        ),
    ] = None,
    threshold: Annotated[
        float | None, typer.Option(help="Score threshold. [default: the run's, chosen on its validation split]")
    ] = None,
    choose_threshold: Annotated[
        bool,
        typer.Option(
            "--choose-threshold",
            help="Choose a new threshold on the validation split, for settings other than those of the run.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write into. [default: <run>/evaluation, with --images <run>/images; needed without --run]"
        ),
    ] = None,
    allow_overlap: AllowOverlap = False,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Labelled images in place of a dataset: a folder or a label file of COCO, YOLO, CVAT, Pascal VOC,"
            " LabelMe or tables of boxes."
        ),
    ] = None,
    category: Annotated[
        list[str] | None,
        typer.Option(help="With --images: name of a category that is craters. Repeatable. [default: crater, craters]"),
    ] = None,
    image_folder: Annotated[
        Path | None,
        typer.Option(
            help="With --images: folder of the images that a label file names. [default: those near the file]"
        ),
    ] = None,
    nodata: NoData = None,
    min_size: Annotated[
        float, typer.Option(help="With --images: minimum size sqrt(w h) of a crater to find, pixels.")
    ] = 8.0,
    scale: Scales = None,
    tile: TileSide = Tiling.tile_px,
    overlap: Overlap = Tiling.overlap_px,
    box_margin: BoxMargin = Tiling.box_margin_px,
) -> None:
    """Evaluate a run's best weights: report.md, metrics.json, detections.parquet and pictures.

    The threshold is the run's own, chosen on the validation split of its training dataset, unless --threshold sets one
    or --choose-threshold chooses a new one.
    """
    from perilune_shared.dataset.names import SPLITS

    if split not in SPLITS:
        raise UserError("--split", "split", split, "one of " + ", ".join(SPLITS))
    if threshold is not None and not 0 <= threshold <= 1:
        raise UserError("--threshold", "score", threshold, "a number from 0 to 1")
    if choose_threshold and (threshold is not None or images is not None or split == "val"):
        other = "--threshold" if threshold is not None else "--images" if images is not None else "--split val"
        raise UserError("--choose-threshold", "options", f"together with {other}", "only one of them")
    for name in _FOR_IMAGES if images is None else _FOR_DATASETS:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = "--" + name.replace("_", "-")
            if images is None:
                raise UserError(option, "options", "no --images", f"--images, or no {option}")
            raise UserError(option, "options", "together with --images", "only one of them")
    if run is None:
        run = shipped_run("detect")
        if out is None:
            raise UserError("--out", "folder", "none", "a folder to write into, since --run is not given")
        if dataset is None and images is None:
            raise UserError("--dataset", "address", "none", "a dataset or --images, since --run is not given")
    config = config_of_run(run, tuple(set_ or ()))
    if images is not None:
        for text in set_ or ():
            keys, _ = parse_setting(text)
            if keys[1] == "labels":
                raise UserError("--set", ".".join(keys), "together with --images", "--min-size instead")
        from perilune_train.detect.images.evaluate import ImageSettings, evaluate_images
        from perilune_train.detect.images.labelled import Request

        folder = out or run / "images"
        tiling = Tiling(tile, overlap, tuple(scale or config.evaluation.scales), box_margin)
        source = context.get_parameter_source("split")
        chosen = split if source is not None and source.name == "COMMANDLINE" else None
        check_nodata(nodata)
        request = Request(chosen, tuple(category or ()), image_folder)
        settings = ImageSettings(tiling, min_size, threshold, nodata, request)
        evaluate_images(run, config, images, folder, settings)
        say(f"{folder}: metrics.json, report.md, precision_recall.png, bins.png, detections.png, crops.png")
        return
    if scale:
        own = config.model_dump(mode="json")
        own["evaluation"]["scales"] = scale
        config = resolve_over(DetectConfig, "detect", "--scale", own)
    # Importing torch takes seconds; check the settings first.
    from perilune_train.detect.evaluate_run import evaluate_again

    address = dataset or Path("data", run.resolve().name, "detect")
    folder = evaluate_again(run, config, address, split, threshold, out, choose_threshold, allow_overlap)
    say(f"{folder}: metrics.json, report.md, precision_recall.png, bins.png, detections.png")
