"""Crater detections in frames of a descent, from a run's network, a user's function or a table."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from perilune_shared.console.terminal import say
from perilune_shared.errors import UserError
from perilune_shared.storage.tables.columns import Kind
from perilune_shared.storage.tables.limits import DETECTIONS
from perilune_shared.storage.tables.read import read_table
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.finished_run import config_of_run, raw_threshold
from perilune_train.detect.images.predict import above
from perilune_train.detect.images.read import read_grey
from perilune_train.detect.images.suspect import Suspicion, suspicion_of
from perilune_train.detect.inference.detector import open_run
from perilune_train.detect.inference.tiles import detect_image
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.detect.novelty import NO_ALARM
from perilune_train.landing.craters.sightings import MAX_SIGHTINGS

Detect = Callable[[Path], Detections]
"""Function that detects the craters in an image file. It raises UnreadableFrame if the image cannot be decoded."""
Detector = Callable[[NDArray[np.uint8]], ArrayLike | Any]
"""A user's function that takes a grey image (height, width) and returns craters; see `by_function`."""
_BOX = ("x0_px", "y0_px", "x1_px", "y1_px")
_COLUMNS: dict[str, Kind] = {"image": "text", **dict.fromkeys((*_BOX, "score"), "number")}
_ROW = ("x", "y", "width", "height", "score")
_SCALES, _TILE_PX = (1.0, 2.0), 512
"""Factors by which frames are resized, and the side of a tile: a frame of 256 px at scale 2 is one tile."""
SIGMA_COLUMNS = ("sigma_x_px", "sigma_y_px")
_MAX_SIGMA_PX = 100.0
"""Largest standard deviation of a centre in a table, pixels."""
_SIGMA_TEXT = f"a number above 0, up to {_MAX_SIGMA_PX:g}"
_FAR_PX = 1e6
"""Largest coordinate of a box, pixels."""
_NO_CRATERS = Detections(np.zeros((0, 4)), np.zeros(0))
_MAX_PER_FRAME = 10_000
"""Maximum number of craters in a frame. Matching needs only a few dozen."""


class UnreadableFrame(UserError):
    """An image cannot be decoded. The flight continues without craters from this frame."""


def flight_config(run: Path) -> DetectConfig:
    """The settings of a detect run, with the scales at which the filter needs detections.

    At scale 2 the detector finds two to four times as many craters as at scale 1, and their centres are more accurate.
    Where the catalogue lacks the largest craters of the frame, only these small craters make a fix possible.
    """
    config = config_of_run(run)
    evaluation = config.evaluation.model_copy(update={"scales": _SCALES, "max_detections": MAX_SIGHTINGS})
    return config.model_copy(update={"evaluation": evaluation})


def by_network(run: Path, suspicions: dict[Path, Suspicion] | None = None) -> Detect:
    """Detect craters with the network of a detect run, at the score threshold chosen by the run.

    Scores are the network's, without calibration: the filter derives the error of a centre from them
    (`Sightings.noise_px`), and a probability says less about this error. `suspicions` receives the reason for each
    frame that may not show regolith.
    """
    config, threshold = flight_config(run), raw_threshold(run)
    detector = replace(open_run(run, config), calibration=None)
    if detector.training_features is None:
        say(NO_ALARM)
    tiling = Tiling(_TILE_PX, scales=_SCALES)

    def detect(path: Path) -> Detections:
        image = _grey(path)
        found = detect_image(detector, image, tiling, lambda n: None)
        if suspicions is not None:
            _check_picture(path, image, found, suspicions)
        return above(found, threshold)

    return detect


def by_function(detector: Detector, suspicions: dict[Path, Suspicion] | None = None) -> Detect:
    """Detect craters with a user's function.

    It takes a grey image, uint8 (height, width), and returns an array (N, 5) of x, y, width, height, score: the centre
    and the size of the box around the rim, pixels from the outer corner of the first pixel, and a score from 0 to 1.
    It may also return a table with the columns x0_px, y0_px, x1_px, y1_px and score, and optionally sigma_x_px and
    sigma_y_px as in `by_table`, or an object with this table as its attribute `table`, such as the craters that
    `perilune.load_detector()` returns. Other values raise UserError.

    `suspicions` receives the reason for each frame that may not show regolith. Only grey levels are checked, since the
    scores of a user's function can mean anything.
    """

    def detect(path: Path) -> Detections:
        image = _grey(path)
        if suspicions is not None:
            _check_picture(path, image, _NO_CRATERS, suspicions)
        return _checked(detector(image), path)

    return detect


def by_table(path: Path, frames: list[Path]) -> Detect:
    """Take craters from a CSV or Parquet table, such as detections.parquet from `detect predict`.

    The columns are image (file name of the frame), x0_px, y0_px, x1_px, y1_px (the box around the rim, pixels from the
    outer corner of the first pixel) and score (0 to 1). The optional columns sigma_x_px and sigma_y_px are predicted
    standard deviations of the centre; a row may lack them. A frame without rows has no craters. Raises UserError if the
    file cannot be read, lacks a column or names an image that is not in the descent. Also raises UserError on a number
    that is not finite, a box without area, a standard deviation that is not above 0, or too many rows for one frame.
    """
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(path, "image", f"two frames named {twice}", "frames with different names")
    table = read_table(path, DETECTIONS, _COLUMNS | dict.fromkeys(SIGMA_COLUMNS, "number"), list(_COLUMNS))
    if not table.n_rows:
        raise UserError(path, "rows", 0, "one row for each crater in a frame")
    box = [table.finite(name, -_FAR_PX, _FAR_PX) for name in _BOX]
    table.check("x1_px", box[2] > box[0], "a number above x0_px")
    table.check("y1_px", box[3] > box[1], "a number above y0_px")
    scores, images = table.finite("score", 0, 1), table.texts("image")
    _check_pair(path, [name for name in SIGMA_COLUMNS if name in table])
    sigmas = np.full((len(scores), 2), np.nan)
    if SIGMA_COLUMNS[0] in table:
        sigmas = np.column_stack([table.numbers(name) for name in SIGMA_COLUMNS])
        missing = np.isnan(sigmas)
        for name, own, other in zip(SIGMA_COLUMNS, sigmas.T, missing.T[::-1], strict=True):
            table.check(name, _is_sigma(own), _SIGMA_TEXT)
            table.check(name, np.isnan(own) == other, "both standard deviations of the centre, or neither")
    number = {name: place for place, name in enumerate(names)}
    frame = np.array([*(number.get(word, -1) for word in images.words), -1])[images.codes]
    table.check("image", frame >= 0, f"a frame of the descent, such as {names[0]}")
    order = np.argsort(frame, kind="stable")
    bounds = np.searchsorted(frame[order], np.arange(len(names) + 1))
    rows = {name: order[start:end] for name, (start, end) in zip(names, pairwise(bounds), strict=True)}
    for name, own in rows.items():
        _check_count(path, name, len(own))
    found = _with_sigmas(Detections(np.column_stack(box), scores), sigmas)
    return lambda frame: found.take(rows[frame.name])


def _is_sigma(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each value is a standard deviation of a centre, or missing."""
    return np.isnan(values) | ((values > 0) & (values <= _MAX_SIGMA_PX))


def _check_pair(where: object, names: list[str]) -> None:
    if len(names) == 1:
        raise UserError(where, "columns", f"{names[0]} alone", f"both of {', '.join(SIGMA_COLUMNS)}, or neither")


def _with_sigmas(detections: Detections, sigmas_px: NDArray[np.float64]) -> Detections:
    """The detections with standard deviations of their centres (D, 2); nothing else of their ellipses is known."""
    if np.isnan(sigmas_px).all():
        return detections
    unknown = np.full((len(sigmas_px), 2), np.nan)
    return replace(detections, shapes=np.column_stack([np.zeros(len(sigmas_px)), sigmas_px, unknown]))


def _check_picture(path: Path, image: NDArray[np.uint8], found: Detections, suspicions: dict[Path, Suspicion]) -> None:
    suspicion = suspicion_of(image, found, calibrated=False)
    if suspicion is not None:
        suspicions[path] = suspicion


def _grey(path: Path) -> NDArray[np.uint8]:
    try:
        return read_grey(path)
    except UserError as error:
        raise UnreadableFrame(error.where, error.field, error.found, error.expected) from None


def _checked(found: Any, path: Path) -> Detections:
    """Check the craters that a user's function has returned for an image."""
    found = getattr(found, "table", found)
    is_table = isinstance(found, pd.DataFrame)
    names, expected = (*_BOX, "score") if is_table else _ROW, f"an array (N, 5) of {', '.join(_ROW)}, or a table"
    if is_table and (missing := [name for name in names if name not in found]):
        raise UserError("detector", path.name, f"a table without {missing[0]}", f"the columns {', '.join(names)}")
    further = [name for name in SIGMA_COLUMNS if is_table and name in found]
    _check_pair(f"detector: {path.name}", further)
    try:
        values = np.asarray(found[list(names)] if is_table else found, np.float64)
        sigmas = np.asarray(found[further], np.float64) if further else np.full((len(values), 2), np.nan)
    except (TypeError, ValueError):
        raise UserError("detector", path.name, f"a {type(found).__name__}", expected) from None
    if values.size == 0:
        return Detections(np.zeros((0, 4)), np.zeros(0))
    if values.ndim != 2 or values.shape[1] != len(names):
        got = f"an array of shape {values.shape}" if values.ndim else f"a {type(found).__name__}"
        raise UserError("detector", path.name, got, expected)
    _check_count("detector", path.name, len(values))
    first, second, scores = values[:, :2], values[:, 2:4], values[:, 4]
    if not is_table:
        first, second = first - second / 2, first + second / 2
    boxes = np.hstack([first, second])
    checks = (
        (np.isfinite(values).all(axis=1) & (np.abs(boxes) <= _FAR_PX).all(axis=1), "finite numbers up to 1000000"),
        ((second > first).all(axis=1), "a box with an area: width and height above 0"),
        ((scores >= 0) & (scores <= 1), "a score from 0 to 1"),
    )
    for fits, wanted in checks:
        if not fits.all():
            row = int(fits.argmin())
            given = ", ".join(f"{name} {value:g}" for name, value in zip(names, values[row], strict=True))
            raise UserError("detector", f"{path.name}: row {row}", given, wanted)
    wrong = ~_is_sigma(sigmas).all(axis=1) | (np.isnan(sigmas).sum(axis=1) == 1)
    if wrong.any():
        row = int(wrong.argmax())
        given = ", ".join(f"{name} {value:g}" for name, value in zip(SIGMA_COLUMNS, sigmas[row], strict=True))
        raise UserError("detector", f"{path.name}: row {row}", given, f"both empty, or each {_SIGMA_TEXT}")
    return _with_sigmas(Detections(boxes, scores), sigmas)


def _check_count(where: object, name: str, count: int) -> None:
    if count > _MAX_PER_FRAME:
        raise UserError(where, name, f"{count} craters", f"at most {_MAX_PER_FRAME} in a frame")
