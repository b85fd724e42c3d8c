"""Pictures of the Moon and of other things that `predict` suspects, by folder and reason.

    python -m benchmarks.train.suspect LUNAR_FOLDER... --others FOLDER

A subfolder of OTHERS is one kind of picture. Pictures are cut to their middle (--side).
"""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from perilune_shared.console.command_line import one_command, run_command_line
from perilune_shared.console.terminal import answer
from perilune_train.detect.images.find import load_detector
from perilune_train.detect.images.pictures import pictures_of
from perilune_train.detect.images.read import read_grey


def main(
    lunar: Annotated[list[Path], typer.Argument(help="Folders of pictures of the Moon.")],
    others: Annotated[list[Path] | None, typer.Option(help="Folder of pictures of other things. Repeatable.")] = None,
    run: Annotated[Path | None, typer.Option(help="Detect run. [default: the installed detector]")] = None,
    most: Annotated[int, typer.Option(help="Maximum number of pictures of a folder, evenly spread.")] = 100,
    side: Annotated[int, typer.Option(help="Largest side of the middle that is kept, pixels.")] = 448,
) -> None:
    """Print the suspected pictures, craters per picture, and craters per picture outside suspected pictures."""
    detector = load_detector(run)
    for folder in [*lunar, *(part for root in others or [] for part in sorted(root.iterdir()) if part.is_dir())]:
        paths = pictures_of(folder, recursive=True)
        reasons: Counter[str] = Counter()
        found, left = 0, 0
        chosen = paths[:: max(len(paths) // most, 1)][:most]
        for path in chosen:
            grey = read_grey(path, quiet=True)
            top, start = (max(0, (length - side) // 2) for length in grey.shape)
            craters = detector(grey[top : top + side, start : start + side])
            found += len(craters)
            if craters.suspicion is None:
                left += len(craters)
            else:
                reasons[craters.suspicion.reason] += 1
        text = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common()) or "none"
        answer(
            f"{folder.name}: {reasons.total()} of {len(chosen)} suspected ({text}); "
            f"craters per picture {found / len(chosen):.2f}, unsuspected {left / len(chosen):.2f}"
        )


if __name__ == "__main__":
    run_command_line(one_command(main))
