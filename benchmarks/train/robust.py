"""AP of a detector on rendered validation frames changed as published pictures are, one factor at a time.

`python -m benchmarks.train.robust DATASET` takes a dataset and, with --run, a detect run (default: the installed
detector). It changes the frames of the validation split by JPEG, gamma, stretch, grey levels, depth, blur or noise, and
never two at once. Labels, scales and threshold stay. Random numbers depend on the frame only, so that every strength of
noise adds the same pattern. Prints a Markdown table and writes runs/bench/robust.json.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.figures import write_figures
from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.dataset.manifest import open_dataset
from perilune_train.detect.data.split import DetectSplit, load_split
from perilune_train.detect.evaluate.matching import match_split
from perilune_train.detect.evaluate.metrics import at_threshold, curve
from perilune_train.detect.finished_run import chosen_threshold, config_of_run
from perilune_train.detect.images.read import grey_of_array
from perilune_train.detect.inference.detector import Detector, open_detector
from perilune_train.detect.inference.scales import detect_split
from perilune_train.shipped.models import shipped_run
from perilune_train.training.runs import RunFolder

Image = NDArray[np.uint8]
Variation = Callable[[Image, np.random.Generator], Image]


def rounded(values: NDArray) -> Image:
    """Grey levels as 8 bits."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def jpeg(quality: int) -> Variation:
    """Compression by JPEG, with its blocks of 8 px."""

    def change(image: Image, rng: np.random.Generator) -> Image:
        _, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        return np.asarray(cv2.imdecode(content, cv2.IMREAD_GRAYSCALE), np.uint8)

    return change


def gamma(power: float) -> Variation:
    """Grey values between 0 and 1 raised to a power; below 1 lifts the shadows."""
    return lambda image, rng: rounded(255 * (image / 255) ** power)


def stretch(black: float, white: float) -> Variation:
    """Linear stretch after which these fractions of the pixels are black and white."""

    def change(image: Image, rng: np.random.Generator) -> Image:
        low, high = np.quantile(image, [black, 1 - white])
        return rounded(255 * (image - low) / max(high - low, 1))

    return change


def grey_levels(count: int) -> Variation:
    """The same range in fewer grey levels, as of an 8-bit file that uses a small part of its range."""
    return lambda image, rng: rounded(np.rint(image * ((count - 1) / 255)) * (255 / (count - 1)))


def sixteen_bits(image: Image, rng: np.random.Generator) -> Image:
    """16 bits, of which the values use a sixteenth, read as `detect predict` reads them."""
    return grey_of_array((20_000 + 16.0 * image + rng.uniform(-8, 8, image.shape)).astype(np.uint16))


def blur(sigma_px: float) -> Variation:
    """A wider point spread."""
    return lambda image, rng: rounded(cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px))


def noise(sigma: float) -> Variation:
    """Gaussian noise, grey levels."""
    return lambda image, rng: rounded(image + sigma * rng.standard_normal(image.shape))


def unchanged(image: Image, rng: np.random.Generator) -> Image:
    """The frame as it was rendered."""
    return image


VARIATIONS: dict[str, Variation] = {
    "as rendered": unchanged,
    "JPEG, quality 90": jpeg(90),
    "JPEG, quality 75": jpeg(75),
    "JPEG, quality 50": jpeg(50),
    "JPEG, quality 25": jpeg(25),
    "gamma 0.45": gamma(0.45),
    "gamma 0.7": gamma(0.7),
    "gamma 1.4": gamma(1.4),
    "gamma 2.2": gamma(2.2),
    "stretch, 2 % black and 2 % white": stretch(0.02, 0.02),
    "stretch, 10 % black and 10 % white": stretch(0.1, 0.1),
    "stretch, 25 % black": stretch(0.25, 0.001),
    "32 grey levels": grey_levels(32),
    "12 grey levels": grey_levels(12),
    "16 bits": sixteen_bits,
    "blur, 0.6 px": blur(0.6),
    "blur, 1 px": blur(1.0),
    "blur, 1.5 px": blur(1.5),
    "noise, 3 levels": noise(3.0),
    "noise, 8 levels": noise(8.0),
}


def varied(split: DetectSplit, change: Variation) -> DetectSplit:
    """The split with changed pixels."""
    images = np.stack([change(image, np.random.default_rng([0, k])) for k, image in enumerate(split.frames.images)])
    return replace(split, frames=replace(split.frames, images=images))


def measure(detector: Detector, split: DetectSplit, threshold: float) -> dict[str, float]:
    """Figures of the detector on a split: AP, and precision, recall and F1 at the threshold."""
    found, _ = detect_split(detector, split, "frames")
    height, width = split.frames.images.shape[1:]
    matches = match_split(found, split.labels, (width, height), 0.5, split.radius_px)
    precision, recall, f1 = at_threshold(matches, threshold)
    return {"ap50_paper": curve(matches).ap_paper(), "precision": precision, "recall": recall, "f1": f1}


def every_nth(split: DetectSplit, step: int) -> DetectSplit:
    """Every `step`-th frame of a split."""
    frames = replace(split.frames, table=split.frames.table.iloc[::step], images=split.frames.images[::step])
    labels = [split.labels[k] for k in range(0, len(split), step)]
    return replace(split, frames=frames, labels=labels, n_frames=len(labels))


def main(
    dataset: Path,
    run: Annotated[Path | None, typer.Option(help="Folder of a detect run. [default: the installed detector]")] = None,
    every: Annotated[int, typer.Option(min=1, help="Use every n-th validation frame.")] = 1,
    out: Path = Path("runs/bench"),
) -> None:
    """Measure the detector under every variation."""
    run = run or shipped_run("detect")
    config, threshold = config_of_run(run), chosen_threshold(run)
    split = every_nth(load_split(open_dataset(dataset), "val", config.labels), every)
    detector = open_detector(RunFolder(run).best, config)
    rows = {}
    for name, change in VARIATIONS.items():
        rows[name] = measure(detector, varied(split, change), threshold)
        figures = " | ".join(f"{value:.3f}" for value in rows[name].values())
        change_of_ap = rows[name]["ap50_paper"] - rows["as rendered"]["ap50_paper"]
        print(f"| {name} | {figures} | {change_of_ap:+.3f} |", flush=True)
    labels = int(sum(part.selected.sum() for part in split.labels))
    content = {"frames": len(split), "labels": labels, "threshold": threshold, "variations": rows}
    write_figures(out / "robust.json", content)


if __name__ == "__main__":
    run_command_line(one_command(main))
