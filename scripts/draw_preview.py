"""Draw docs/pictures/small_preview.jpg, a picture of the home page: the preview of `small`, 1280 pixels wide."""

import tempfile
from pathlib import Path

from perilune_shared.console.interrupts import end_at_interrupt

if __name__ == "__main__":
    # An import by another module must not change how Ctrl-C works.
    end_at_interrupt()

import perilune_render.provenance.processor  # noqa: F401, I001 - must be imported before NumPy
import cv2

from perilune_render.cli.main import app
from perilune_shared.console.command_line import one_command, run_command_line

PICTURE = Path(__file__).parent.parent / "docs/pictures/small_preview.jpg"
WIDTH_PX = 1280


def main() -> None:
    """Render the preview and write the picture."""
    with tempfile.TemporaryDirectory() as folder:
        sheet = Path(folder) / "preview.png"
        app(["preview", "--preset", "small", "--out", str(sheet)], standalone_mode=False)
        image = cv2.imread(str(sheet))
    height_px = round(image.shape[0] * WIDTH_PX / image.shape[1])
    small = cv2.resize(image, (WIDTH_PX, height_px), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(PICTURE), small, [cv2.IMWRITE_JPEG_QUALITY, 70, cv2.IMWRITE_JPEG_PROGRESSIVE, 1])


if __name__ == "__main__":
    run_command_line(one_command(main))
