"""`perilune-train navigate fly`: the filter over the files of one descent."""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.errors import UserError
from perilune_shared.terminal import answer_page, say
from perilune_train.shipped.models import shipped_run


def fly(
    frames: Annotated[Path, typer.Option(help="Folder of images with frames.csv: file, time_s.")],
    camera: Annotated[Path, typer.Option(help="Intrinsics and mounting: camera.yaml.")],
    catalogue: Annotated[Path, typer.Option(help="Craters of the landing site, Parquet or CSV.")],
    imu: Annotated[Path, typer.Option(help="Inertial measurements: imu.csv.")],
    prior: Annotated[Path, typer.Option(help="Expected state at the first frame, and errors of all: prior.yaml.")],
    ranges: Annotated[Path | None, typer.Option(help="Ranges of a laser altimeter: ranges.csv.")] = None,
    truth: Annotated[Path | None, typer.Option(help="True poses, for errors beside the estimates: truth.csv.")] = None,
    run: Annotated[
        Path | None, typer.Option(help="Folder of a detect run. [default: the detector that is installed]")
    ] = None,
    out: Annotated[Path, typer.Option(help="New folder for the results.")] = Path("flight"),
    live: Annotated[Path | None, typer.Option(help="Picture that is drawn again after each frame, *.png.")] = None,
) -> None:
    """Estimate position, velocity and attitude at each frame of a descent by craters, inertial unit and ranges.

    Prints one line per frame to standard output: time, status (tracking, coasting or lost), position and its deviations
    in O_L, largest deviation of the attitude, craters matched. Writes estimates.parquet, estimates.csv and flight.png.
    `navigate unpack` writes an example of all files.
    """
    if live is not None and live.suffix.lower() != ".png":
        raise UserError("--live", "name", live, "a name that ends in .png")
    run = run or shipped_run("detect")
    # torch takes seconds to load.
    from perilune_train.navigate.fly.run import doubts_of, fly_descent, read_descent

    descent = read_descent(frames, camera, catalogue, imu, prior, ranges, truth)
    for doubt in doubts_of(descent):
        say(f"warning: {imu}: {doubt}")
    table = fly_descent(descent, run, out, answer_page, live)
    counts = ", ".join(f"{count} {status}" for status, count in table["status"].value_counts().items())
    written = "estimates.parquet, estimates.csv, flight.png"
    say(f"{out}: {len(table)} frames ({counts}); {written}")
    if (table["status"] == "lost").any():
        for doubt in doubts_of(descent, is_lost=True):
            say(f"a possible cause of the status lost: {imu}: {doubt}")
    if "error_x_m" in table:
        length = (table[[f"error_{axis}_m" for axis in "xyz"]] ** 2).sum(axis=1)
        rms, end = length.mean() ** 0.5, length.iloc[-1] ** 0.5
        answer_page(f"position error: {rms:.2f} m r.m.s., {end:.2f} m at the last frame")
