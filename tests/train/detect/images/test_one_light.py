"""Pictures of the Moon are told from others by the light on their craters."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.helpers import in_process

from perilune_train.cli.main import main
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.images.one_light import agreement_of_light, doubt_of

LUNAR = Path(__file__).parents[4] / "docs/pictures/lunar_frame.png"


def bowls(towards_rad, side=20):
    """Discs of grey levels that fall towards given directions, in a row, and their boxes."""
    image, boxes = np.full((side, side * len(towards_rad)), 100, np.uint8), []
    y, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    for place, angle in enumerate(towards_rad):
        image[:, place * side : (place + 1) * side] = 100 + 60 * (x * np.cos(angle) + y * np.sin(angle))
        boxes.append((place * side, 0, (place + 1) * side, side))
    return image, Detections(np.array(boxes, float), np.linspace(0.9, 0.6, len(boxes)))


@pytest.mark.parametrize("towards", [0.0, 1.0, np.pi / 2, -2.0])
def test_one_sun_from_any_side_agrees(towards):
    image, found = bowls([towards] * 12)
    agreement, count = agreement_of_light(image, found)
    assert count == 12 and agreement == pytest.approx(1, abs=1e-3) and doubt_of(image, found) is None


def test_light_from_all_sides_does_not_agree():
    image, found = bowls(np.arange(12) * 2 * np.pi / 12)
    agreement, count = agreement_of_light(image, found)
    assert count == 12 and agreement < 0.01
    assert doubt_of(image, found) == (
        f"agreement (0 to 1) of the light directions of 12 craters: got {agreement:.2f}, expected at least 0.8 under "
        "one Sun; is it a picture of the Moon?"
    )


@pytest.mark.parametrize(
    "boxes",
    [
        np.zeros((0, 4)),
        np.array([[0.0, 0, 20, 20]] * 9),  # too few
        np.array([[1.0, 1, 3, 3]] * 50),  # too small
        np.array([[-500.0, -500, -400, -400]] * 50),  # off the image
    ],
)
def test_too_few_craters_say_nothing(boxes):
    image = np.random.default_rng(0).integers(0, 256, (1000, 1000), np.uint8)
    assert doubt_of(image, Detections(boxes, np.ones(len(boxes)))) is None


def test_a_flat_image_says_nothing():
    found = Detections(np.array([[0.0, 0, 20, 20]] * 20), np.ones(20))
    assert doubt_of(np.full((50, 50), 7, np.uint8), found) is None


def test_predict_warns_of_a_collage_and_not_of_the_moon(tmp_path):
    moon = cv2.imread(str(LUNAR), cv2.IMREAD_GRAYSCALE)
    # Four pieces of the Moon, each turned by another quarter: no Sun lights the Moon so.
    collage = np.vstack([np.hstack([moon, np.rot90(moon)]), np.hstack([np.rot90(moon, 3), np.rot90(moon, 2)])])
    cv2.imwrite(str(tmp_path / "collage.png"), collage)
    done = in_process.call(main, "detect", "predict", LUNAR, tmp_path / "collage.png", "--out", tmp_path / "out")
    warnings = [line for line in done.stderr.splitlines() if line.startswith("warning")]
    assert done.returncode == 0 and len(warnings) == 1
    assert warnings[0].startswith("warning: collage.png: agreement (0 to 1) of the light directions of ")


def test_many_doubts_are_counted(tmp_path):
    noise = np.random.default_rng(0)
    for number in range(7):
        picture = cv2.GaussianBlur(noise.integers(0, 256, (300, 300), np.uint8), (0, 0), 3)
        cv2.imwrite(str(tmp_path / f"{number}.png"), cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX))
    done = in_process.call(main, "detect", "predict", tmp_path, "--out", tmp_path / "out")
    warnings = [line for line in done.stderr.splitlines() if line.startswith("warning")]
    assert done.returncode == 0 and len(warnings) == 6
    assert warnings[-1] == "warning: 2 more images that may not show the Moon"
