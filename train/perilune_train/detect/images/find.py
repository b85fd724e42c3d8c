"""Find craters from Python: `perilune.load_detector`.

detector = load_detector()
craters = detector("photo.png")
craters["score"], craters.table, craters.plot()
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, overload

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image, ImageOps

from perilune_shared.console.terminal import say
from perilune_shared.dataset.frame import ELLIPSE_COLUMNS
from perilune_shared.errors import UserError, one_line
from perilune_shared.pictures import display, with_ellipses
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.finished_run import chosen_threshold, config_of_run
from perilune_train.detect.images.predict import above, flagged, table_of
from perilune_train.detect.images.read import grey_of_array, read_grey
from perilune_train.detect.images.suspect import Suspicion, suspicion_of
from perilune_train.detect.inference.detector import Detector, open_run
from perilune_train.detect.inference.tiles import detect_image
from perilune_train.detect.inference.tiling import Tiling
from perilune_train.detect.novelty import is_novel, novelty_text
from perilune_train.shipped.models import shipped_models, shipped_run
from perilune_train.training.runs import RunFolder

ImageLike = str | PathLike[str] | NDArray[Any] | Image.Image
"""A file, pixels (height, width) or (height, width, 3), or a Pillow image."""
Images = list[Any] | tuple[Any, ...]
"""Several images, each an `ImageLike`."""


@dataclass(frozen=True, slots=True, eq=False)
class Craters:
    """The craters that a detector finds in one image, best first."""

    table: pd.DataFrame
    """One row per crater: the box `x0_px`, `y0_px`, `x1_px`, `y1_px`, then `centre_x_px`, `centre_y_px`, `radius_px`
    (half of sqrt(w h)), `score`, `suspect` (the reason of `suspicion`, or empty), `novelty`, and the ellipse columns of
    the table `labels`. Pixels count from the outer corner of the first pixel. Further columns have the ellipse in other
    units, and its standard deviations (`semi_major_px`, `semi_minor_px`, `angle_deg`, `sigma_...`). If the detector
    predicts only boxes, the ellipse is the axis-aligned ellipse inside the box, and the standard deviations are NaN."""
    image: NDArray[np.uint8]
    """The upright image in 8-bit grey (height, width), before normalisation."""
    suspicion: Suspicion | None = None
    """Why the image may not show regolith at a usable scale; None if nothing is suspicious. A warning tells it too."""
    novelty: float | None = None
    """How unlike the training frames the image is: above 1, detections are unreliable, and a warning says so. None if
    the detector has no features of its training frames."""

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, column: str) -> NDArray[Any]:
        """Return a column of the table as an array (N,). Raises UserError if there is no such column."""
        if column not in self.table:
            raise UserError("craters", "column", column, "one of " + ", ".join(self.table.columns))
        return self.table[column].to_numpy()

    def plot(self) -> Image.Image:
        """Return a picture of the image with the ellipses."""
        return with_ellipses(self.image, self.table[ELLIPSE_COLUMNS].to_numpy())

    def show(self) -> None:
        """Show the picture made by `plot` in the notebook, or in the system's viewer."""
        display(self.plot())

    def __repr__(self) -> str:
        height, width = self.image.shape
        scores = f", score {self['score'].min():.2f} to {self['score'].max():.2f}" if len(self) else ""
        return f"Craters({len(self)} in {width} x {height} px{scores})"


class CraterDetector:
    """A crater detector for images of any size; call it with an image or a list of images.

    `load_detector` creates it.
    """

    def __init__(self, run: Path):
        """Load the network of a finished detect run. Raises UserError if the folder is not such a run."""
        config = config_of_run(run)
        self.run = run
        self.threshold = chosen_threshold(run)
        self._tiling = Tiling(
            scales=None,
            finest=max(config.evaluation.scales),
            min_coarse_radius_px=config.evaluation.min_coarse_radius_px,
        )
        self._detector: Detector = open_run(run, config)

    @overload
    def __call__(self, image: ImageLike, *, threshold: float | None = None) -> Craters: ...
    @overload
    def __call__(self, image: Images, *, threshold: float | None = None) -> list[Craters]: ...
    def __call__(self, image: ImageLike | Images, *, threshold: float | None = None) -> Craters | list[Craters]:
        """Return the craters of an image, or the list of the craters of several images.

        An image is a path (PNG, TIFF, JPEG; others with the extra `geo`), a NumPy array (height, width) or (height,
        width, 3), or a Pillow image. Pixels of more than 8 bits are stretched as by `perilune-train detect predict`.
        The detector runs at several scales, which depend on the size of the image (`pyramid` in tiling.py).
        `threshold` is the minimum score; by default the threshold that the run chose on its validation split. Raises
        UserError if `image` is anything else, or if a file cannot be read.
        """
        threshold = self.threshold if threshold is None else threshold
        if not 0 <= threshold <= 1:
            raise UserError("detector", "threshold", threshold, "0 to 1")
        if isinstance(image, list | tuple):
            return [self._craters(each, threshold) for each in image]
        return self._craters(image, threshold)

    def _craters(self, image: ImageLike, threshold: float) -> Craters:
        name, grey = _read(image)
        every = detect_image(self._detector, grey, self._tiling)
        calibrated = self._detector.calibration is not None
        suspicion, detections = suspicion_of(grey, every, calibrated), above(every, threshold)
        if suspicion is not None:
            say(f"warning: {name}: {suspicion.text}")
        if is_novel(every.novelty):
            say(f"warning: {name}: {novelty_text(every.novelty)}")
        table = _with_ellipses(flagged(table_of(name, detections), suspicion, every.novelty), detections)
        return Craters(table, grey, suspicion, every.novelty)

    def __repr__(self) -> str:
        where = f"{self._detector.device}, {'bfloat16' if self._detector.bf16 else 'float32'}"
        return one_line(f"CraterDetector({self.run.name}: score at least {self.threshold:.3f}, on {where})")


def load_detector(run_or_file: str | PathLike[str] | None = None) -> CraterDetector:
    """Load a crater detector: the installed detector, or the detector of a run.

    `run_or_file` is the folder of a detect run, a file in it (such as checkpoints/best.ckpt), or the name of an
    installed network. Raises UserError on other values.

        craters = load_detector()("photo.png")
    """
    if run_or_file is None:
        return CraterDetector(shipped_run("detect"))
    path = Path(run_or_file)
    installed = {model.name: model.folder for model in shipped_models() if model.task == "detect"}
    if not path.exists():
        if str(run_or_file) in installed:
            return CraterDetector(installed[str(run_or_file)])
        known = ", ".join(installed) or "none is installed"
        raise UserError("load_detector", "run_or_file", path, f"the folder of a detect run, or a name ({known})")
    if path.is_dir():
        return CraterDetector(path)
    run = next((folder for folder in list(path.absolute().parents)[:2] if (folder / "config.yaml").is_file()), None)
    if run is None or path.absolute() != RunFolder(run).best:
        raise UserError("load_detector", "run_or_file", path, "the best weights of a detect run, in its folder")
    return CraterDetector(run)


def _read(image: ImageLike) -> tuple[str, NDArray[np.uint8]]:
    """Name and 8-bit grey pixels of an image. Raises UserError if `image` is not an image."""
    if isinstance(image, str | PathLike):
        path = Path(image)
        return path.name, read_grey(path)
    if isinstance(image, Image.Image):
        # As in a file, pixels and craters refer to the upright image.
        image = ImageOps.exif_transpose(image)
        deep = image.mode.startswith(("I", "F"))
        return "image", grey_of_array(np.asarray(image if deep else image.convert("L")))
    if isinstance(image, np.ndarray):
        return "image", grey_of_array(image)
    expected = "a path, a NumPy array, a Pillow image, or a list of these"
    raise UserError("detector", "image", type(image).__name__, expected)


def _with_ellipses(table: pd.DataFrame, detections: Detections) -> pd.DataFrame:
    """Add the ellipses to a table, in the ellipse columns of `labels`."""
    return table.assign(**dict(zip(ELLIPSE_COLUMNS, detections.ellipses.T, strict=True)))
