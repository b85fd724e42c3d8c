"""`perilune-train navigate`: train, evaluate and compare navigators, and run the filter on descents."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.config.resolve import resolve
from perilune_shared.console.command_line import OverwriteFolder, add_renamed
from perilune_shared.console.terminal import answer, answer_page, say, say_page
from perilune_shared.dataset.names import SPLITS
from perilune_shared.errors import UserError
from perilune_shared.geometry.inertial_grades import GRADES
from perilune_shared.storage.files import new_folder
from perilune_shared.storage.replacement import replaceable
from perilune_train.cli.options import AllowOverlap, ConfigFile, Overwrite, Preset, RunName, RunsFolder, Settings
from perilune_train.landing.monte_carlo.scenario import ALTIMETERS, DETECTIONS, SCENARIOS, UNITS, Draws, Sensors
from perilune_train.motion.config import NavigateConfig
from perilune_train.shipped.models import shipped_run

app = typer.Typer(
    help="Landing navigation: train the networks, evaluate, compare and export runs, fly the filter over a descent.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@app.command("train")
def train(
    preset: Preset = "small",
    config: ConfigFile = None,
    set_: Settings = None,
    dataset: Annotated[
        str | None,
        typer.Option(help="Dataset: a folder, s3://bucket/prefix or gs://bucket/prefix. [default: data/<preset>/nav]"),
    ] = None,
    runs: RunsFolder = Path("runs"),
    name: RunName = None,
    allow_overlap: AllowOverlap = False,
    overwrite: Overwrite = False,
) -> None:
    """Train the navigation networks and compare them with the nominal motion, mean motions and KLT tracks.

    Writes runs/navigate/<name>/ (fusion warp) and runs/navigate/<name>-stack/ (fusion stack, the paper's network), each
    with config.yaml, checkpoints/best.ckpt and last.ckpt, metrics.json, navigation.parquet (one row per method),
    errors.parquet (one row per pair), descent.png, errors.png and TensorBoard events. With navigate.stack.target=pose
    the stack run has pose.md (the table) instead of descent.png. The stack network starts from the
    backbone of runs/detect/<name> if the architectures are equal. The same command resumes an interrupted run and
    leaves finished runs unchanged; --overwrite replaces them.
    """
    settings = resolve(NavigateConfig, "navigate", "perilune_train", preset, config, tuple(set_ or ()))
    # Importing torch and Lightning takes seconds; check the settings first.
    from perilune_train.motion.train.navigate_run import navigate_run
    from perilune_train.training.runs import NamedRun

    name = name or preset
    detector = runs / "detect" / name / "checkpoints" / "best.ckpt"
    address = dataset or Path("data", preset, "nav")
    for run in navigate_run(settings, address, NamedRun(runs, name, overwrite), detector, allow_overlap):
        say(f"{run.root}: metrics.json, navigation.parquet, errors.png")


@app.command("evaluate")
def evaluate(
    dataset: Annotated[str, typer.Option(help="Dataset: a folder, s3://bucket/prefix or gs://bucket/prefix.")],
    run: Annotated[
        Path | None,
        typer.Option(help="Folder of a finished navigate run. [default: direct alignment, which needs no training]"),
    ] = None,
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder to write into. [default: <run>/evaluation; runs/evaluation/alignment without --run]"),
    ] = None,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Evaluate a run's best weights or direct alignment, and compare them with KLT tracks and the nominal motion.

    Writes metrics.json, navigation.parquet (one row per method), errors.parquet (one row per pair), descent.png and
    errors.png. A run that estimates poses (navigate.stack.target=pose) is evaluated over the landing area on which it
    was trained, and compared with the mean pose; pose.md then replaces descent.png.
    """
    if split not in SPLITS:
        raise UserError("--split", "", split, "one of " + ", ".join(SPLITS))
    # torch takes seconds to load.
    from perilune_train.motion.evaluate_runs import evaluate_alignment, evaluate_navigator
    from perilune_train.records.provenance import EvaluatedSplit

    evaluated = EvaluatedSplit(dataset, split, allow_overlap)
    if run is None:
        folder = evaluate_alignment(evaluated, out or Path("runs/evaluation/alignment"))
    else:
        folder = evaluate_navigator(run, evaluated, out or run / "evaluation")
    say(f"{folder}: metrics.json, navigation.parquet, errors.parquet, errors.png")


@app.command("benchmark")
def benchmark(
    run: Annotated[
        Path | None,
        typer.Option(help="Folder of a finished navigate run. [default: direct alignment, which needs no training]"),
    ] = None,
    data: Annotated[str, typer.Option(help="Folder or address of the rendered benchmark.")] = "data/benchmark",
    manifests: Annotated[str, typer.Option(help="Folder or address of the shared manifests.")] = "data_manifests",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write into. [default: runs/benchmark/<name of the run>-navigate;"
            " runs/benchmark/alignment-navigate without --run]"
        ),
    ] = None,
    allow_overlap: AllowOverlap = False,
) -> None:
    """Score a navigator or direct alignment on the locked benchmark.

    Writes benchmark.md, benchmark.json, error tables and pictures.
    """
    # torch takes seconds to load.
    from perilune_train.motion.benchmark import FIGURES, HEADLINE, PAGE, score_navigator

    name = run.resolve().name if run else "alignment"
    folder = out or Path("runs/benchmark", f"{name}-navigate")
    figures = score_navigator(run, data, manifests, folder, allow_overlap)
    say(f"position RMSE {figures[f'headline/{HEADLINE}']:.3f} m; {folder}: {PAGE}, {FIGURES}")


@app.command("benchmark-landing")
def benchmark_landing(
    detector: Annotated[
        Path | None, typer.Option(help="Folder of a finished detect run. [default: the detector that is installed]")
    ] = None,
    data: Annotated[str, typer.Option(help="Folder or address of the rendered benchmark.")] = "data/benchmark",
    manifests: Annotated[str, typer.Option(help="Folder or address of the shared manifests.")] = "data_manifests",
    maps: Annotated[
        Path | None,
        typer.Option("--maps", help="Folder with a map by `navigate map` for each part of the benchmark, named as it."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="New folder. [default: runs/benchmark/<name of the run>-landing]")
    ] = None,
    allow_overlap: AllowOverlap = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Score poses from craters, and the filter, on the locked benchmark.

    Writes benchmark.md, benchmark.json and frames.parquet.
    """
    # torch takes seconds to load.
    from perilune_train.landing.methods.benchmark import FIGURES, PAGE, POSITION, score_landing

    run = detector or shipped_run("detect")
    folder = out or Path("runs/benchmark", f"{run.resolve().name}-landing")
    inputs = (run, data, manifests) if maps is None else (run, data, manifests, maps)
    with replaceable(folder, (FIGURES, "frames.parquet"), overwrite=overwrite, inputs=inputs) as new:
        figures = score_landing(run, data, manifests, new, maps, allow_overlap)
    if f"filter/{POSITION}" in figures:
        say(f"filter: position RMSE {figures[f'filter/{POSITION}']:.3f} m")
    say(f"{folder}: {PAGE}, {FIGURES}, frames.parquet")


@app.command("calibrate")
def calibrate(
    run: Annotated[Path, typer.Option(help="Folder of a finished navigate run with a warp network.")],
    dataset: Annotated[
        str, typer.Option(help="Dataset of descents: a folder, s3://bucket/prefix or gs://bucket/prefix.")
    ],
    split: Annotated[str, typer.Option(help="train, val or test: the descents to fit to.")] = "val",
) -> None:
    """Fit the covariance of a warp network to its errors on validation descents; writes covariance.json.

    Descents over test terrain are refused. Training runs this step at its end. Use the command for runs of earlier
    versions, or for another camera.
    """
    if split not in SPLITS:
        raise UserError("--split", "", split, "one of " + ", ".join(SPLITS))
    # torch takes seconds to load.
    from perilune_shared.dataset.manifest import open_single
    from perilune_train.motion.covariance import FILE
    from perilune_train.motion.covariance import calibrate as fit
    from perilune_train.motion.data.trajectories import load_split
    from perilune_train.motion.evaluate_runs import fusion_of
    from perilune_train.motion.network import load_navigator
    from perilune_train.records.provenance import check_calibration, read_provenance, split_terrain
    from perilune_train.training.runs import RunFolder, load_weights

    best = RunFolder(run).best
    fusion = fusion_of(best, load_weights(best)["architecture"])
    if fusion != "warp":
        raise UserError(best, "fusion", fusion, "warp; the paper's network states no covariance")
    opened = open_single(dataset)
    check_calibration(read_provenance(load_weights(best), best), split_terrain(opened, split, "calibrated"), opened)
    network, architecture = load_navigator(best, fusion)
    fit(run, network, architecture, load_split(opened, split))
    say(f"{run / FILE}")


@app.command("compare")
def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs, or of evaluations.")],
    out: Annotated[Path, typer.Option(help="Folder to write into.")] = Path("runs/navigate/compare"),
    allow_overlap: AllowOverlap = False,
) -> None:
    """Compare runs or evaluations: writes compare.md (a table) and errors.png."""
    # matplotlib takes seconds to load.
    from perilune_train.motion.evaluate_runs import compare_folders

    say_page(compare_folders(folders, out, allow_overlap))
    say(f"{out}: compare.md, errors.png")


@app.command("deploy")
def deploy(
    out: Annotated[Path, typer.Option(help="New folder for the files.")],
    run: Annotated[Path | None, typer.Option(help="Folder of a finished navigate run; required.")] = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Dataset (folder or address). The file is for its camera, and is compared on its validation frames."
        ),
    ] = None,
    overwrite: OverwriteFolder = False,
) -> None:
    """Write a trained navigator as an ONNX file, for flight.

    The file maps one pair of frames and a state to the motion and the new state. Writes navigator.onnx, navigator.json
    (sizes, camera, normalisation) and README.md with an example program. Runs the file pair by pair and compares the
    result with torch, which runs over the whole sequence at once. Both use validation frames, or noise if no dataset is
    given.
    """
    if run is None:
        expected = "the folder of a navigate run; direct alignment, the default method, has no network to deploy"
        raise UserError("--run", "", "not given", expected)
    # torch takes seconds to load.
    from perilune_train.motion.deploy.export import export_navigator

    inputs = (run,) if dataset is None else (run, dataset)
    with replaceable(out, ("navigator.json", "README.md"), overwrite=overwrite, inputs=inputs) as folder:
        largest = export_navigator(run, folder, dataset)
    say(f"{out}: README.md explains how to use the files; difference from torch {largest:.1e}")


add_renamed(app, "export", "deploy", deploy)


@app.command("methods")
def methods(
    dataset: Annotated[
        str, typer.Option(help="Dataset of descents: a folder, s3://bucket/prefix or gs://bucket/prefix.")
    ],
    run: Annotated[
        Path | None,
        typer.Option(help="Folder of a finished navigate run, to compare. [default: only methods without training]"),
    ] = None,
    detector: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("runs/navigate/methods"),
    maps: Annotated[
        Path | None, typer.Option("--map", help="Folder of a map by `navigate map`, used as a further catalogue.")
    ] = None,
    allow_overlap: AllowOverlap = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Run all methods on a split: relative motion, poses from craters (with and without a prior), filter.

    Writes methods.md (tables and pictures), navigation.parquet (one row per method), frames.parquet (one row per
    frame and absolute method), deviations.parquet (stated and measured errors of detected centres), altitude.png,
    flights.png, matches_high.png, matches_low.png, inputs.json and metrics.json (hashes, command, commit, versions).
    Catalogues, priors and initial states use a fixed random seed. If the detector predicts standard deviations, the
    filter flies with and without them.
    """
    if split not in SPLITS:
        raise UserError("--split", "", split, "one of " + ", ".join(SPLITS))
    # torch takes seconds to load.
    from perilune_train.landing.methods.fly_methods import PAGE, TABLE, fly_methods
    from perilune_train.records.provenance import EvaluatedSplit

    detector = detector or shipped_run("detect")
    inputs: tuple[str | Path, ...] = (dataset, detector, *(path for path in (run, maps) if path is not None))
    with replaceable(out, (PAGE, TABLE), overwrite=overwrite, inputs=inputs) as folder:
        fly_methods(EvaluatedSplit(dataset, split, allow_overlap), run, detector, folder, maps)
    say(f"{out / PAGE}: tables and pictures; navigation.parquet, frames.parquet")


@app.command("monte-carlo")
def monte_carlo(
    dataset: Annotated[
        str, typer.Option(help="Dataset of descents: a folder, s3://bucket/prefix or gs://bucket/prefix.")
    ],
    detector: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    scenario: Annotated[str, typer.Option(help="What goes wrong: " + ", ".join(SCENARIOS) + ".")] = "nominal",
    draws: Annotated[int, typer.Option(min=1, max=100_000, help="Number of random draws for each descent.")] = 200,
    attitude_deg: Annotated[
        float,
        typer.Option(min=0.001, max=10, help="Standard deviation of the initial attitude error on each axis, degrees."),
    ] = 0.5,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of all draws.")] = 0,
    first_draw: Annotated[
        int, typer.Option(min=0, help="Number of the first draw, to repeat single draws or to add further draws.")
    ] = 0,
    imu: Annotated[str, typer.Option(help="Inertial unit: " + ", ".join(UNITS) + ".")] = "tactical",
    scale_ppm: Annotated[
        float | None,
        typer.Option(
            min=0, max=100_000, help="Standard deviation of its scale factors, millionths. [default: of the unit]"
        ),
    ] = None,
    misalignment_arcsec: Annotated[
        float | None,
        typer.Option(
            min=0, max=100_000, help="Standard deviation of its misalignments, seconds of arc. [default: of the unit]"
        ),
    ] = None,
    altimeter: Annotated[str, typer.Option(help="Ranges: " + ", ".join(ALTIMETERS) + ".")] = "drawn",
    star_tracker_hz: Annotated[
        float, typer.Option(min=0, max=100, help="Attitudes of a star tracker per second; 0: no star tracker.")
    ] = 0.0,
    doppler_hz: Annotated[
        float, typer.Option(min=0, max=100, help="Speeds of a Doppler lidar per second and beam; 0: no Doppler lidar.")
    ] = 0.0,
    detections: Annotated[str, typer.Option(help="Errors of detections: " + ", ".join(DETECTIONS) + ".")] = "recorded",
    star_tracker_outage_s: Annotated[
        float, typer.Option(min=0, max=1e5, help="Seconds without star tracker, at a random time.")
    ] = 0.0,
    altimeter_outage_s: Annotated[
        float, typer.Option(min=0, max=1e5, help="Seconds without ranges, at a random time.")
    ] = 0.0,
    detections_outage_s: Annotated[
        float, typer.Option(min=0, max=1e5, help="Seconds without detections, at a random time.")
    ] = 0.0,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of processes. [default: one per core]")] = None,
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("runs/navigate/monte-carlo"),
    allow_overlap: AllowOverlap = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Run the filter on each descent with random initial states, catalogues and sensor errors.

    The detector runs once on every frame. Writes monte_carlo.md (tables and pictures), draws.parquet (one row per draw
    and frame), consistency.parquet (one row per frame), consistency.json (one object per descent), errors.png,
    consistency.png, ellipses.png and miss.png; with --detections drawn also detector_errors.json.
    """
    if split not in SPLITS:
        raise UserError("--split", "", split, "one of " + ", ".join(SPLITS))
    if scenario not in SCENARIOS:
        raise UserError("--scenario", "", scenario, "one of " + ", ".join(SCENARIOS))
    if imu not in UNITS:
        raise UserError("--imu", "", imu, "one of " + ", ".join(UNITS))
    if altimeter not in ALTIMETERS:
        raise UserError("--altimeter", "", altimeter, "one of " + ", ".join(ALTIMETERS))
    if detections not in DETECTIONS:
        raise UserError("--detections", "", detections, "one of " + ", ".join(DETECTIONS))
    if star_tracker_outage_s and not star_tracker_hz:
        raise UserError("--star-tracker-outage-s", "", star_tracker_outage_s, "a star tracker (--star-tracker-hz)")
    if altimeter_outage_s and altimeter == "none":
        raise UserError("--altimeter-outage-s", "", altimeter_outage_s, "an altimeter (--altimeter drawn)")
    # torch takes seconds to load.
    from perilune_train.landing.monte_carlo.fly_draws import PAGE, fly_draws
    from perilune_train.records.provenance import EvaluatedSplit

    network = detector or shipped_run("detect")
    sensors = Sensors(
        imu, scale_ppm, misalignment_arcsec, altimeter, star_tracker_hz, doppler_hz,
        star_tracker_outage_s, altimeter_outage_s, detections_outage_s,
    )  # fmt: skip
    drawn = Draws(scenario, draws, attitude_deg, seed, first_draw, sensors, detections)
    with replaceable(out, (PAGE, "draws.parquet"), overwrite=overwrite, inputs=(dataset, network)) as folder:
        fly_draws(EvaluatedSplit(dataset, split, allow_overlap), network, folder, drawn, workers)
    say(f"{out / PAGE}: tables and pictures; draws.parquet, consistency.parquet, consistency.json")


@app.command("map")
def make_map(
    dataset: Annotated[str, typer.Option(help="Dataset that `perilune-render survey` has made.")],
    detector: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    out: Annotated[Path, typer.Option(help="New folder for the catalogues.")] = Path("runs/navigate/map"),
    allow_overlap: AllowOverlap = False,
    overwrite: OverwriteFolder = False,
) -> None:
    """Make a crater catalogue of each scene by running the detector on two images taken from orbit.

    Writes <scene_id>.parquet (x_m, y_m, z_m, diameter_m, score) for `navigate fly` and `navigate methods --map`,
    map.json (stated errors), map.md and errors.parquet (errors against the terrain's true craters), and map.png.
    """
    # torch takes seconds to load.
    from perilune_train.landing.map.map_scenes import PAGE, map_scenes

    detector = detector or shipped_run("detect")
    with replaceable(out, ("map.json", PAGE), overwrite=overwrite, inputs=(dataset, detector)) as folder:
        map_scenes(dataset, detector, folder, allow_overlap)
    say(f"{out / PAGE}: errors and picture; one catalogue per scene beside it")


@app.command("fly")
def fly(
    frames: Annotated[Path, typer.Option(help="Folder of images with frames.csv (columns file, time_s).")],
    camera: Annotated[Path, typer.Option(help="Intrinsics and mounting: camera.yaml.")],
    catalogue: Annotated[Path, typer.Option(help="Craters of the landing site, Parquet or CSV.")],
    prior: Annotated[
        Path, typer.Option(help="Expected state at the first frame, and standard deviations of all inputs: prior.yaml.")
    ],
    imu: Annotated[Path | None, typer.Option(help="Inertial measurements: imu.csv.")] = None,
    no_imu: Annotated[bool, typer.Option("--no-imu", help="Fly without inertial measurements.")] = False,
    ranges: Annotated[Path | None, typer.Option(help="Ranges of a laser altimeter: ranges.csv.")] = None,
    star_tracker: Annotated[Path | None, typer.Option(help="Attitudes of a star tracker: star_tracker.csv.")] = None,
    doppler_lidar: Annotated[
        Path | None, typer.Option(help="Speeds and ranges along the beams of a Doppler lidar: doppler_lidar.csv.")
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="True poses, for errors beside the estimates: truth.csv.")] = None,
    run: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    detections: Annotated[
        Path | None,
        typer.Option(
            help="Craters of another detector, in place of --run: a Parquet or CSV table with image (name of the"
            " frame's file), x0_px, y0_px, x1_px, y1_px (pixels from the outer corner of the first pixel) and score (0"
            " to 1), as detections.parquet of `detect predict`; sigma_x_px and sigma_y_px (standard deviations of the"
            " centre) are optional."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("flight"),
    live: Annotated[Path | None, typer.Option(help="Picture that is drawn again after each frame, *.png.")] = None,
    overwrite: OverwriteFolder = False,
) -> None:
    """Estimate position, velocity and attitude at each frame of a descent from craters and other sensors.

    Prints one line per frame to standard output: time, status (tracking, coasting or lost), position in O_L and its
    standard deviations, largest standard deviation of the attitude, and number of matched craters. Writes
    estimates.parquet, estimates.csv and flight.png. `navigate descent` writes examples of all input files.
    """
    if live is not None and live.suffix.lower() != ".png":
        raise UserError("--live", "", live, "a name that ends in .png")
    if run is not None and detections is not None:
        raise UserError("--detections", "options", "together with --run", "one of them")
    if (imu is None) != no_imu:
        got = "missing" if imu is None else "together with --no-imu"
        raise UserError("--imu", "options", got, "--imu FILE, or --no-imu to fly without inertial measurements")
    source = detections or run or shipped_run("detect")
    # torch takes seconds to load.
    from perilune_train.detect.images.suspect import Suspicion
    from perilune_train.landing.fly.detections import by_network, by_table
    from perilune_train.landing.fly.run import (
        DescentFiles,
        disagreement_of,
        doubts_of,
        fly_descent,
        novelty_of,
        read_descent,
        suspects_of,
    )

    optional = ranges, truth, star_tracker, doppler_lidar
    descent = read_descent(DescentFiles(frames, camera, catalogue, imu, prior, *optional))
    suspicions: dict[Path, Suspicion] = {}
    detect = by_table(source, descent.frames.paths) if detections else by_network(source, suspicions)
    for doubt in doubts_of(descent):
        say(f"warning: {imu}: {doubt}")
    inputs = (frames, camera, catalogue, prior, source, *(path for path in (imu, *optional) if path is not None))
    with replaceable(out, ("estimates.parquet", "flight.png"), overwrite=overwrite, inputs=inputs) as folder:
        table = fly_descent(descent, detect, folder, answer_page, live, suspicions)
    counts = ", ".join(f"{count} {status}" for status, count in table["status"].value_counts().items())
    written = "estimates.parquet, estimates.csv, flight.png"
    say(f"{out}: {len(table)} frames ({counts}); {written}")
    if n_refused := int(table["n_refused"].sum()):
        say(f"refused {n_refused} ranges, speeds and attitudes that contradict the state: column n_refused by frame")
    for warning in (suspects_of(table), disagreement_of(table), novelty_of(table)):
        if warning is not None:
            say(f"warning: {warning}")
    if (table["status"] == "lost").any():
        for doubt in doubts_of(descent, is_lost=True):
            say(f"a possible cause of the status lost: {imu}: {doubt}")
    if "error_x_m" in table:
        length = (table[[f"error_{axis}_m" for axis in "xyz"]] ** 2).sum(axis=1)
        rms, end = length.mean() ** 0.5, length.iloc[-1] ** 0.5
        answer_page(f"position error: {rms:.2f} m r.m.s., {end:.2f} m at the last frame")


@app.command("trace")
def trace(
    descent: Annotated[
        Path,
        typer.Option(
            help="Folder that `navigate descent` has written, or the folder `inputs` of a trace. With"
            " detections.parquet, no images are read."
        ),
    ],
    out: Annotated[Path, typer.Option(help="New folder for the trace.")] = Path("trace"),
    overwrite: OverwriteFolder = False,
) -> None:
    """Write every input, intermediate and output of the filter over a descent, to check another implementation.

    Writes inputs/ (what the filter reads, with all defaults), and the tables steps.parquet (state and covariance after
    each propagation and update), frames.parquet, sightings.parquet, rounds.parquet, matches.parquet and
    craters.parquet. The page "Interface control: landing filter" describes each column.
    """
    if not descent.is_dir():
        raise UserError("--descent", "folder", descent, "a folder that `navigate descent` has written")
    # torch takes seconds to load.
    from perilune_train.landing.trace.write import write_trace

    with (
        replaceable(out, ("steps.parquet", "inputs"), overwrite=overwrite, inputs=(descent,)) as replaced,
        new_folder(replaced) as folder,
    ):
        tables = write_trace(descent, folder)
    outcomes = tables["frames"]["outcome"].value_counts().items()
    counts = ", ".join(f"{count} {outcome}" for outcome, count in outcomes)
    say(f"{out}: {len(tables['steps'])} steps, {len(tables['frames'])} frames ({counts})")


@app.command("check-trace")
def check_trace(
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="Folder that `navigate trace` has written.")],
    other: Annotated[
        Path, typer.Argument(metavar="TRACE", help="Folder with some or all of the tables, as Parquet or CSV.")
    ],
    tolerance: Annotated[
        float, typer.Option(min=0, max=1, help="Largest accepted difference, divided by the scale of the column.")
    ] = 1e-9,
) -> None:
    """Compare the trace of another implementation with a reference trace. Exit code 1 if they differ.

    Prints one line per table: the largest difference, divided by the scale of its column. Stops at the first table with
    a difference beyond the tolerance and names its first row and column.
    """
    # pyarrow takes a second to load.
    from perilune_train.landing.trace.compare import compare_traces

    compared = compare_traces(reference, other, tolerance)
    for each in compared:
        if each.difference:
            answer(each.difference)
            raise typer.Exit(1)
        columns = f"{each.n_columns} of {each.of_columns} columns"
        answer(f"{each.table}: {each.n_rows} rows, {columns}, largest difference {each.largest:.1e}")


@app.command("descent")
def descent(
    dataset: Annotated[
        str, typer.Option(help="Dataset of descents: a folder, s3://bucket/prefix or gs://bucket/prefix.")
    ],
    trajectory: Annotated[str, typer.Option(help="scene_id/trajectory_id, for example scene-0000/trajectory-0000.")],
    out: Annotated[Path, typer.Option(help="New folder for the files.")] = Path("descent"),
    grade: Annotated[str, typer.Option(help="Grade of the inertial unit.")] = "tactical",
    exact: Annotated[bool, typer.Option("--exact", help="Write the catalogue without errors.")] = False,
    position_m: Annotated[
        float, typer.Option(help="Standard deviation of the prior's position error on each axis, m.")
    ] = 60.0,
    velocity_mps: Annotated[
        float, typer.Option(help="Standard deviation of the prior's velocity error on each axis, m/s.")
    ] = 1.0,
    attitude_deg: Annotated[
        float, typer.Option(help="Standard deviation of the prior's attitude error on each axis, degrees.")
    ] = 0.5,
    seed: Annotated[int, typer.Option(help="Random seed of the errors of the prior and the catalogue.")] = 0,
    overwrite: OverwriteFolder = False,
) -> None:
    """Write a descent as files for `navigate fly`.

    Writes frames/, camera.yaml, catalogue.parquet, imu.csv, ranges.csv, prior.yaml and truth.csv, and star_tracker.csv
    and doppler_lidar.csv if the dataset has such measurements. The prior has random errors. The catalogue has the
    errors of a catalogue made from orbit: 1 m in position, 3 % in diameter, one in ten craters missing, one in twenty
    false.
    """
    ids = tuple(trajectory.split("/"))
    if len(ids) != 2:
        raise UserError("--trajectory", "", trajectory, "scene_id/trajectory_id")
    if grade not in GRADES:
        raise UserError("--grade", "", grade, "one of " + ", ".join(GRADES))
    offset = (position_m, velocity_mps, attitude_deg)
    for name, value in zip(("--position-m", "--velocity-mps", "--attitude-deg"), offset, strict=True):
        if not 0 < value < 1e4:
            raise UserError(name, "deviation", value, "above 0, below 10000")
    # pyarrow and pandas take a second to load.
    from perilune_shared.dataset.manifest import open_single
    from perilune_train.landing.fly.unpack import unpack_descent

    with replaceable(out, ("camera.yaml", "prior.yaml"), overwrite=overwrite, inputs=(dataset,)) as folder:
        count = unpack_descent(open_single(dataset), (ids[0], ids[1]), folder, grade, exact, offset, seed)
    say(f"{out}: {count} frames; {', '.join(sorted(path.name for path in out.iterdir()))}")


add_renamed(app, "unpack", "descent", descent)
