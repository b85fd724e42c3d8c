"""Agreement of the light on the craters of lunar pictures and of others, and the pictures that `predict` would doubt.

    python -m benchmarks.train.one_light LUNAR_FOLDER... --others FOLDER

Every second picture, by name, is the half on which the threshold was chosen; the others test it.
"""

from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import answer
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.images.find import load_detector
from perilune_train.detect.images.one_light import MIN_AGREEMENT, MIN_CRATERS, agreement_of_light
from perilune_train.detect.images.pictures import pictures_of


def main(
    lunar: Annotated[list[Path], typer.Argument(help="Folders of pictures of the Moon.")],
    others: Annotated[list[Path], typer.Option(help="Folder of pictures of other things. Repeatable.")],
    most: Annotated[int, typer.Option(help="Maximum number of pictures of a folder, evenly spread.")] = 100,
) -> None:
    """Print agreements and counts."""
    detector = load_detector()
    for name, folders in (("lunar", lunar), ("others", others)):
        values: list[tuple[float, int]] = []
        for folder in folders:
            paths = pictures_of(folder, recursive=True)
            for path in paths[:: max(len(paths) // most, 1)][:most]:
                craters = detector(path)
                boxes = craters.table[["x0_px", "y0_px", "x1_px", "y1_px"]].to_numpy()
                values.append(agreement_of_light(craters.image, Detections(boxes, craters["score"])))
        for half, label in ((values[::2], "chosen on"), (values[1::2], "tested on")):
            agreements = [agreement for agreement, count in half if count >= MIN_CRATERS]
            n_below = sum(agreement < MIN_AGREEMENT for agreement in agreements)
            text = f"{min(agreements):.2f} to {max(agreements):.2f}" if agreements else "none"
            answer(
                f"{name}, {label}: {len(half)} pictures, {len(agreements)} tested, agreement {text}, {n_below} too low"
            )


if __name__ == "__main__":
    run_command_line(one_command(main))
