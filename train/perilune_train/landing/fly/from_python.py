"""Fly the filter from Python with any detector (`perilune.fly`).

estimates = fly("descent", detector=lambda image: my_network(image))
"""

from dataclasses import asdict
from os import PathLike
from pathlib import Path

import pandas as pd

from perilune_shared.console.progress import say
from perilune_shared.errors import UserError
from perilune_train.detect.images.suspect import Suspicion
from perilune_train.landing.fly.detections import Detector, by_function, by_network
from perilune_train.landing.fly.run import (
    DescentFiles,
    disagreement_of,
    doubts_of,
    fly_descent,
    novelty_of,
    read_descent,
    suspects_of,
)
from perilune_train.shipped.models import shipped_run


def fly(
    files: DescentFiles | str | PathLike[str], detector: Detector | None = None, out: str | PathLike[str] | None = None
) -> pd.DataFrame:
    """Estimate position, velocity and attitude at each frame from craters and other measurements.

    Args:
        files: The files of the descent, or the folder that `perilune-train navigate descent` has written.
        detector: A function that finds craters; the installed detector if None. It takes a grey image, uint8 (height,
            width), and returns an array (N, 5) of x, y, width, height, score: the centre and the size of the box around
            each rim, pixels from the outer corner of the first pixel, and a score from 0 to 1. It may also return what
            `perilune.load_detector()` returns, or a table with the columns x0_px, y0_px, x1_px, y1_px, score and,
            optionally, sigma_x_px and sigma_y_px, the standard deviations of the centre.
        out: New folder for estimates.parquet, estimates.csv and flight.png; nothing is written if None.

    Returns:
        One row per frame: `file`, `time_s`, `status` (tracking, coasting or lost), position and velocity in the frame
        O_L (`x_m`, `velocity_x_mps`, ...), attitude (`rotation_w`, ...), standard deviations (`sigma_x_m`, ...),
        number of matched craters (`n_matched`), the reason why a frame may not show regolith (`suspect`, or empty)
        and, if truth.csv exists, errors (`error_x_m`, ..., `error_attitude_deg`).

    Raises:
        UserError: A file is missing or invalid, or the detector returns an invalid value.

    Example:
        def detect(image):
            return my_network(image)  # x, y, width, height, score of each crater

        estimates = perilune.fly("descent", detector=detect)
        estimates[["time_s", "status", "x_m", "y_m", "z_m"]]
    """
    if isinstance(files, DescentFiles):
        files = DescentFiles(**{name: path and Path(path) for name, path in asdict(files).items()})
    else:
        files = DescentFiles.of_folder(files)
    if detector is not None and not callable(detector):
        raise UserError("fly", "detector", type(detector).__name__, "a function of an image")
    descent = read_descent(files)
    for doubt in doubts_of(descent):
        say(f"warning: {files.imu}: {doubt}")
    suspicions: dict[Path, Suspicion] = {}
    detect = by_network(shipped_run("detect"), suspicions) if detector is None else by_function(detector, suspicions)
    table = fly_descent(descent, detect, None if out is None else Path(out), suspicions=suspicions)
    for warning in (suspects_of(table), disagreement_of(table), novelty_of(table)):
        if warning is not None:
            say(f"warning: {warning}")
    return table
