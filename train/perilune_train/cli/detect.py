"""`perilune-train detect`: train, evaluate, find craters in images, export for flight."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from perilune_shared.config.resolve import parse_setting, resolve, resolve_over
from perilune_shared.console.command_line import OverwriteFolder, add_renamed
from perilune_shared.console.terminal import say, say_page
from perilune_shared.errors import UserError
from perilune_shared.storage.replacement import replaceable
from perilune_train.cli.options import (
    AllowOverlap,
    ConfigFile,
    Overwrite,
    Preset,
    RunName,
    RunsFolder,
    Settings,
)
from perilune_train.detect.config import MIN_COARSE_RADIUS_PX, DetectConfig
from perilune_train.detect.finished_run import check_output, config_of_run
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.shipped.models import shipped_run

app = typer.Typer(
    help="Crater detection: train, evaluate, find craters in images, export for flight.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

Scales = Annotated[
    list[float] | None,
    typer.Option(
        "--scale",
        help="Factor by which images are resized before detection. Repeatable; detections at all scales are merged."
        " [default for images: chosen from the size of each image; for a dataset: the run's scales]",
    ),
]
TileSide = Annotated[
    int, typer.Option("--tile", help="Side of the tiles, pixels; best is the side of the training frames.")
]
BoxMargin = Annotated[
    float,
    typer.Option(
        help="Margin added to every side of the detected boxes, pixels. Without it, boxes end at the crest of the rim."
        " Use 0.5 to compare them with labels that are boxes of whole pixels."
    ),
]
NoData = Annotated[
    float | None,
    typer.Option(
        help="Value of pixels without data, if the files do not declare it. [default: values far from all others]"
    ),
]
Overlap = Annotated[int, typer.Option(help="Minimum overlap of two tiles, pixels.")]


def tiling_of(config: DetectConfig, scale: list[float] | None, tile: int, overlap: int, box_margin: float) -> Tiling:
    """Tiling for images by the options of a command. Without scales, a pyramid from the finest scale of the run."""
    scales, finest = tuple(scale) if scale else None, max(config.evaluation.scales)
    return Tiling(tile, overlap, scales, box_margin, finest, MIN_COARSE_RADIUS_PX)


def check_nodata(value: float | None) -> None:
    """Raise UserError if the value of pixels without data is not a finite number."""
    if value is not None and not abs(value) < float("inf"):
        raise UserError("--nodata", "", value, "a finite number; infinite values and NaN always count as no data")


@app.command("train")
def train(
    preset: Preset = "small",
    config: ConfigFile = None,
    set_: Settings = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Dataset: a folder, s3://bucket/prefix or gs://bucket/prefix. [default: data/<preset>/detect]"
        ),
    ] = None,
    stream_scenes: Annotated[
        str | None,
        typer.Option(
            help="Address tcp://host:port of `perilune-render serve`, which renders the training frames during"
            " training. Sets detect.fresh.address."
        ),
    ] = None,
    runs: RunsFolder = Path("runs"),
    name: RunName = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Overwrite = False,
) -> None:
    """Train the crater detector (attention YOLOv3) and evaluate it on the test split.

    Writes runs/detect/<name>/ with config.yaml, checkpoints/best.ckpt and last.ckpt, metrics.json, report.md,
    detections.parquet, detections.png, precision_recall.png and .parquet, reliability.png, bins.png and TensorBoard
    events. The same command resumes an interrupted run and leaves a finished run unchanged; --overwrite replaces it.

    To train the baseline without attention: perilune-train detect train --set detect.attention=none --name small-plain
    """
    own = [*(set_ or ()), *([f"detect.fresh.address={json.dumps(stream_scenes)}"] if stream_scenes is not None else [])]
    settings = resolve(DetectConfig, "detect", "perilune_train", preset, config, tuple(own))
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.detect.train.detect_run import run_detect

    run_detect(settings, dataset or Path("data", preset, "detect"), runs, name or preset, overwrite, allow_overlap)


_FOR_DATASETS = ("dataset", "allow_overlap", "detectability")
_FOR_IMAGES = ("min_size", "tile", "overlap", "box_margin", "category", "image_folder", "nodata")


@app.command("evaluate")
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
    split: Annotated[
        str, typer.Option(help="train, val or test. With --images, only for images that have splits.")
    ] = "test",
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
            help="Choose a new threshold on the validation split, for settings other than the run's.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write into. [default: <run>/evaluation, with --images <run>/images; needed without --run]"
        ),
    ] = None,
    allow_overlap: AllowOverlap = False,
    detectability: Annotated[
        Path | None,
        typer.Option(
            help="Table of `perilune-render detectability` over the split: recall and AP by d', and an ideal observer."
        ),
    ] = None,
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
    """Evaluate a run's best weights; writes report.md, metrics.json, detections.parquet and pictures.

    The run chose its score threshold on the validation split of its training dataset. --threshold sets another one,
    and --choose-threshold chooses a new one.
    """
    from perilune_shared.dataset.names import SPLITS

    if split not in SPLITS:
        raise UserError("--split", "", split, "one of " + ", ".join(SPLITS))
    if threshold is not None and not 0 <= threshold <= 1:
        raise UserError("--threshold", "", threshold, "a number from 0 to 1")
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
            raise UserError("--out", "", "none", "a folder to write into, since --run is not given")
        if dataset is None and images is None:
            raise UserError("--dataset", "", "none", "a dataset or --images, since --run is not given")
    config = config_of_run(run, tuple(set_ or ()))
    if images is not None:
        for text in set_ or ():
            keys, _ = parse_setting(text)
            if keys[1] == "labels":
                raise UserError("--set", ".".join(keys), "together with --images", "--min-size instead")
        from perilune_train.detect.images.evaluate import ImageSettings, evaluate_images
        from perilune_train.detect.images.labelled import Request

        folder = out or run / "images"
        tiling = tiling_of(config, scale, tile, overlap, box_margin)
        source = context.get_parameter_source("split")
        chosen = split if source is not None and source.name == "COMMANDLINE" else None
        check_nodata(nodata)
        request = Request(chosen, tuple(category or ()), image_folder)
        settings = ImageSettings(tiling, min_size, threshold, nodata, request)
        evaluate_images(run, config, images, folder, settings)
        say(f"{folder}: metrics.json, report.md, detections.parquet, *.png")
        return
    if scale:
        values = config.model_dump(mode="json")
        values["evaluation"]["scales"] = scale
        config = resolve_over(DetectConfig, "detect", "--scale", values)
    # Importing torch takes seconds; check the settings first.
    from perilune_train.detect.evaluate_runs import evaluate_again
    from perilune_train.records.provenance import EvaluatedSplit

    address = dataset or Path("data", run.resolve().name, "detect")
    score: float | Literal["run", "validation"] = (
        "validation" if choose_threshold else "run" if threshold is None else threshold
    )
    folder = evaluate_again(run, config, EvaluatedSplit(address, split, allow_overlap), score, out, detectability)
    say(f"{folder}: metrics.json, report.md, detections.parquet, *.png")


@app.command("calibrate")
def calibrate(
    run: Annotated[Path, typer.Option(help="Folder of a finished detect run.")],
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Dataset with the training and validation frames: a folder, s3://bucket/prefix or gs://bucket/prefix."
            " [default: data/<name of the run>/detect]"
        ),
    ] = None,
) -> None:
    """Make the scores of a finished run probabilities, and add the alarm for images unlike its training frames.

    Training does this at its end; runs of earlier releases need it once. Fits the calibration of the scores on
    validation frames (metrics.json of the run) and the features of training frames (novelty.json). The order of
    detections, AP and the reported detections do not change. Give the dataset on which the run was trained.
    """
    config = config_of_run(run)
    # Importing torch takes seconds; check the run first.
    from perilune_train.detect.calibrate import calibrate_run

    entries = calibrate_run(run, config, dataset or Path("data", run.resolve().name, "detect"))
    before, after, raw, threshold = (
        float(str(entries[f"calibration/{key}"])) for key in ("ece_before", "ece_after", "raw_threshold", "threshold")
    )
    say(
        f"{run / 'metrics.json'}: expected calibration error on {entries['calibration/frames']} {before:.3f} before, "
        f"{after:.3f} after; the threshold of {raw:.3f} is a probability of {threshold:.3f}"
    )
    alarm = entries.get("novelty") or f"from the features of {entries['novelty/frames']} training frames"
    say(f"{run / 'novelty.json'}: alarm for images unlike the training: {alarm}")


@app.command("benchmark")
def benchmark(
    run: Annotated[
        Path | None, typer.Option(help="Folder of a finished detect run. [default: the detector that is installed]")
    ] = None,
    detections: Annotated[
        Path | None, typer.Option(help="Parquet or CSV table of another detector's detections, in place of --run.")
    ] = None,
    threshold: Annotated[
        float | None, typer.Option(help="With --detections: score threshold of precision, recall and F1.")
    ] = None,
    data: Annotated[str, typer.Option(help="Folder or address of the rendered benchmark.")] = "data/benchmark",
    manifests: Annotated[str, typer.Option(help="Folder or address of the shared manifests.")] = "data_manifests",
    out: Annotated[
        Path | None, typer.Option(help="Folder to write into. [default: runs/benchmark/<name of the run or table>]")
    ] = None,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Score a detector on the locked benchmark; writes benchmark.md, benchmark.json and pictures."""
    if run is not None and detections is not None:
        raise UserError("benchmark", "options", "both --run and --detections", "one of them")
    if (threshold is None) != (detections is None):
        expected = "--threshold, chosen on other frames" if detections else "none: a run has its own threshold"
        raise UserError("--threshold", "", threshold, expected)
    if threshold is not None and not 0 <= threshold <= 1:
        raise UserError("--threshold", "", threshold, "a number from 0 to 1")
    from perilune_train.detect.benchmark.score_run import FIGURES, PAGE, score_run, score_submission

    if detections is not None and threshold is not None:
        folder = out or Path("runs/benchmark", detections.stem)
        scores = score_submission(detections, detections.stem, threshold, data, manifests, folder)
    else:
        run = run or shipped_run("detect")
        folder = out or Path("runs/benchmark", run.resolve().name)
        check_output(folder, run)
        scores = score_run(run, config_of_run(run), data, manifests, folder, allow_overlap)
    selection, rule, value = scores.least("ap50_paper")
    chosen = f"labels by {selection}, {rule}"
    say(f"AP {value:.3f} by the least favourable scoring rule ({chosen}); {folder}: {PAGE}, {FIGURES}")


@app.command("compare")
def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs, or of evaluations.")],
    out: Annotated[Path, typer.Option(help="Folder to write into.")] = Path("runs/detect/compare"),
    allow_overlap: AllowOverlap = False,
) -> None:
    """Compare runs or evaluations: writes compare.md (a table) and precision_recall.png."""
    # matplotlib and torch take seconds to load.
    from perilune_train.detect.evaluate_runs import compare_folders

    say_page(compare_folders(folders, out, allow_overlap))
    say(f"{out}: compare.md, precision_recall.png")


@app.command("predict")
def predict(
    images: Annotated[
        list[Path],
        typer.Argument(
            help="Images of any size, folders of images, videos (MP4, AVI, Matroska), TIFF of several pages."
        ),
    ],
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
    min_size: Annotated[
        float, typer.Option(help="Minimum size sqrt(w h) of a crater, pixels; in place of --min-radius-px.")
    ] = 0.0,
    top: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of craters in an image; the highest scores are kept.")
    ] = None,
    nodata: NoData = None,
    scale: Scales = None,
    tile: TileSide = Tiling.tile_px,
    overlap: Overlap = Tiling.overlap_px,
    box_margin: BoxMargin = Tiling.box_margin_px,
    overwrite: OverwriteFolder = False,
) -> None:
    """Find craters in images.

    Writes detections.parquet and detections.csv with one row per crater, <image>.overlay.png, and detections.geojson if
    an image has a georeference. Coordinates are pixels of the upright image, from the outer corner of its top-left
    pixel. In the tables, video frames are named <file>.<index, six digits>.png; the names of TIFF pages end in .tif.
    """
    if min_score is not None and not 0 < min_score <= 1:
        raise UserError("--min-score", "", min_score, "above 0, at most 1")
    for option, pixels in (("--min-radius-px", min_radius_px), ("--min-size", min_size)):
        if not 0 <= pixels < float("inf"):
            raise UserError(option, "", pixels, "at least 0")
    if min_radius_px and min_size:
        raise UserError("--min-size", "options", "together with --min-radius-px", "only one of them")
    check_nodata(nodata)
    run = run or shipped_run("detect")
    config = config_of_run(run, ())
    # Importing torch takes seconds; check the options first.
    from perilune_train.detect.images.predict import PredictSettings, predict_images

    tiling = tiling_of(config, scale, tile, overlap, box_margin)
    settings = PredictSettings(tiling, min_score, max(min_size, 2 * min_radius_px), nodata, top)
    with replaceable(out, ("detections.parquet",), overwrite=overwrite, inputs=(run, *images)) as folder:
        count = predict_images(images, run, config, folder, settings)
    n_images = len(list(out.glob("*.overlay.png")))
    places = ", detections.geojson" if (out / "detections.geojson").is_file() else ""
    written = f"detections.parquet, detections.csv{places}, *.overlay.png"
    say(f"{out}: {count} craters in {n_images} {'image' if n_images == 1 else 'images'}; {written}")


@app.command("deploy")
def deploy(
    out: Annotated[Path, typer.Option(help="New folder for the files.")],
    run: Annotated[
        Path | None, typer.Option(help="Folder of a finished run. [default: the detector that is installed]")
    ] = None,
    formats: Annotated[str, typer.Option(help="onnx, openvino, or both separated by a comma.")] = "onnx,openvino",
    size_px: Annotated[int, typer.Option(help="Side of the square images, a multiple of 32.")] = 256,
    dataset: Annotated[
        str | None,
        typer.Option(help="Dataset (folder or address) on whose validation frames the files are compared with torch."),
    ] = None,
    int8: Annotated[bool, typer.Option("--int8", help="Also try 8-bit integers; needs --dataset.")] = False,
    allow_overlap: AllowOverlap = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Write a trained detector as ONNX and OpenVINO files, for flight.

    Writes detector.onnx, detector.xml and .bin, detector.json (anchors, threshold, normalisation) and README.md. Runs
    every file once and compares its output with torch. --int8 quantises the network on training frames and writes
    detector-int8.onnx if that file is faster and loses at most 0.005 of AP on the validation frames.
    """
    asked = tuple(part.strip() for part in formats.split(","))
    if not set(asked) <= {"onnx", "openvino"}:
        raise UserError("options", "--formats", formats, "onnx, openvino or onnx,openvino")
    if size_px <= 0 or size_px % 32:
        raise UserError("options", "--size-px", size_px, "a multiple of 32")
    if int8 and dataset is None:
        raise UserError("options", "--int8", "no --dataset", "a dataset to calibrate and to evaluate on")
    # Importing torch takes seconds; check the options first.
    from perilune_train.detect.deploy.export import ExportedFiles, export_run

    run = run or shipped_run("detect")
    inputs = (run,) if dataset is None else (run, dataset)
    with replaceable(out, ("detector.json", "README.md"), overwrite=overwrite, inputs=inputs) as folder:
        export_run(run, folder, ExportedFiles(asked, size_px, int8), dataset, allow_overlap)
    say(f"{out}: README.md explains how to use the files")


add_renamed(app, "export", "deploy", deploy)


@app.command("weights")
def weights(
    checkpoint: Annotated[
        Path,
        typer.Argument(help="best.ckpt of a detect run. A Darknet file needs a network of width 1, 3 input channels."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="File to write: NAME.safetensors to share, NAME.conv.74 for Darknet's backbone, NAME.weights for the"
            " whole network."
        ),
    ],
) -> None:
    """Write the weights of a run as a file to share, or as a Darknet file; `detect.init_from` reads both.

    NAME.safetensors stores the weights in half precision and contains no code. Rename it to weights.safetensors and put
    it beside config.yaml and metrics.json: this folder is then a run.

    NAME.conv.74 contains the 52 convolutions of the backbone. NAME.weights contains all 75 convolutions; the network
    must have no attention and the strides 8 16 32. Its output layers have 15 filters: x, y, width, height and
    objectness for each of 3 anchors.
    """
    if not out.name.endswith((".safetensors", ".conv.74", ".weights")):
        expected = "a name that ends in .safetensors, .conv.74 or .weights"
        raise UserError(out, "--out", f"the name {out.name}", expected)
    # Importing torch takes seconds; check the name first.
    from perilune_train.detect.inference.detector import check_detector, load_detector
    from perilune_train.detect.train.transfer import darknet_content
    from perilune_train.models.darknet_weights import write_darknet
    from perilune_train.training import runs
    from perilune_train.training.half_weights import write_half

    if out.suffix == ".safetensors":
        stored = runs.load_weights(checkpoint)
        check_detector(stored, checkpoint)
        write_half(out, stored)
        say(f"{out}: {len(stored['state_dict'])} tensors in half precision")
        return
    network = load_detector(checkpoint)
    architecture = runs.load_weights(checkpoint)["architecture"]
    content = darknet_content(network, architecture, checkpoint, whole=out.suffix == ".weights")
    write_darknet(out, content)
    gates = "" if architecture["attention"] == "none" else "; attention gates are not included"
    say(f"{out}: {len(content.values)} floats{gates}")
