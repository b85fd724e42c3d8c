"""Draw docs/pictures/small_preview.jpg, the picture of the README: the preview of `small`, 1280 pixels wide."""

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

PICTURE = Path(__file__).parent.parent / "docs/pictures/small_preview.jpg"
WIDTH_PX = 1280


def main() -> None:
    """Render the preview and write the picture."""
    program = Path(sys.executable).with_name("perilune-render")
    with tempfile.TemporaryDirectory() as folder:
        sheet = Path(folder) / "preview.png"
        subprocess.run([program, "preview", "--preset", "small", "--out", sheet], check=True)
        image = cv2.imread(str(sheet))
    height_px = round(image.shape[0] * WIDTH_PX / image.shape[1])
    small = cv2.resize(image, (WIDTH_PX, height_px), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(PICTURE), small, [cv2.IMWRITE_JPEG_QUALITY, 84])


if __name__ == "__main__":
    main()
