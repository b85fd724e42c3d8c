"""Draw docs/pictures/report_answers.jpg: the report after a click on a detection.

python scripts/draw_report.py runs/draw-report

Renders a descent over one scene in the given folder, three changed versions of its frames, evaluates the installed
detector, writes the report, and photographs it in Chromium. Run the same command again to resume.
"""

import shutil
import sys
from pathlib import Path

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import subprocess

from playwright.sync_api import sync_playwright

from perilune_shared.console.command_line import one_command, run_command_line

PICTURE = Path(__file__).parent.parent / "docs/pictures/report_answers.jpg"
_SETTINGS = (
    "render.engine=heightfield", "seed=48", "detect.n_scenes=1", "detect.trajectories_per_scene=1",
    "detect.n_frames=8", "detect.val_share=0", "detect.test_share=1", "terrain.spacing_px=1",
    "detect.sun.elevation_deg={low: 20, high: 20}", "detect.flight.start_altitude_m=900",
)  # fmt: skip
_CHANGES = {
    "counterfactual": ("--craters-per-scene", "12"),
    "shallower": ("--craters-per-scene", "12", "--depth-share", "0.5"),
    "turned": ("--craters-per-scene", "0", "--sun-azimuth-offset-deg", "40"),
}
_MOST_ANSWERS = 12


def main(folder: Path) -> None:
    """Write the report of one descent into `folder`, and docs/pictures/report_answers.jpg."""
    frames = folder / "data/detect"
    settings = [part for setting in _SETTINGS for part in ("--set", f"dataset.{setting}")]
    _run("perilune-render", "dataset", "--preset", "small", "--kind", "detect", "--out", frames.parent, *settings)
    for name, options in _CHANGES.items():
        given = ("--manifest", frames, "--frames-per-trajectory", "8", *options)
        _run("perilune-render", "counterfactual", "--out", folder / name, *given)
    evaluated = folder / "runs/detect/answers-installed"
    if not (evaluated / "metrics.json").is_file():
        _run("perilune-train", "detect", "evaluate", "--dataset", frames, "--out", evaluated)
    given = [part for name in _CHANGES for part in (f"--{name}", folder / name)]
    _run(
        "perilune-train", "report", "--name", "answers", "--dataset", folder / "data", "--runs", folder / "runs",
        "--out", folder / "report", *given,
    )  # fmt: skip
    photograph(folder / "report/report.html", PICTURE)


def photograph(page: Path, picture: Path) -> None:
    """Write a JPEG of the viewer with the answers on the first detection that all changed frames show."""
    program = next(found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name)))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        opened = browser.new_page(viewport={"width": 1200, "height": 1000}, color_scheme="light")
        opened.goto(page.resolve().as_uri())
        for _ in range(_MOST_ANSWERS):
            opened.click("#next-answer")
            if opened.locator("#answer-pictures figure").count() == 1 + len(_CHANGES):
                break
        opened.locator("#viewer").screenshot(path=picture, type="jpeg", quality=80)
        browser.close()


def _run(program: str, *arguments: object) -> None:
    # In a process group of its own, so that at Ctrl-C only this program prints a line.
    command = [str(Path(sys.executable).parent / program), *map(str, arguments)]
    subprocess.run(command, check=True, process_group=0)


if __name__ == "__main__":
    run_command_line(one_command(main))
