"""Pictures of the Moon are told from others by their grey levels and by the light on their craters."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process

from perilune_train.cli.main import main
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.images.find import load_detector
from perilune_train.detect.images.one_light import agreement_of_light
from perilune_train.detect.images.suspect import suspicion_of, tiles_of

LUNAR = Path(__file__).parents[4] / "docs/pictures/lunar_frame.png"
NOTHING = Detections(np.zeros((0, 4)), np.zeros(0))


def bowls(towards_rad, side=20, steepness=None):
    """Discs of grey levels that fall towards given directions, in a row, and their boxes."""
    image, boxes = np.full((side, side * len(towards_rad)), 100, np.uint8), []
    steepness = np.full(len(towards_rad), 60) if steepness is None else steepness
    y, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    for place, angle in enumerate(towards_rad):
        slope = steepness[place] * (x * np.cos(angle) + y * np.sin(angle))
        image[:, place * side : (place + 1) * side] = 100 + slope
        boxes.append((place * side, 0, (place + 1) * side, side))
    return image, Detections(np.array(boxes, float), np.linspace(0.9, 0.6, len(boxes)))


@pytest.mark.parametrize("towards", [0.0, 1.0, np.pi / 2, -2.0])
def test_one_sun_from_any_side_agrees(towards):
    agreement, median, count = agreement_of_light(*bowls([towards] * 12))
    assert count == 12 and agreement == pytest.approx(1, abs=1e-3) and median == pytest.approx(0.75)


def test_light_from_all_sides_does_not_agree():
    agreement, _, count = agreement_of_light(*bowls(np.arange(12) * 2 * np.pi / 12))
    assert count == 12 and agreement < 0.02


def test_steep_slopes_count_more():
    """Ten steep bowls face one way, ten faint ones the other way: 100 - 20 over 100 + 20."""
    towards, steepness = np.repeat([0, np.pi], 10), np.repeat([100, 20], 10)
    assert agreement_of_light(*bowls(towards, steepness=steepness))[0] == pytest.approx(80 / 120, abs=0.02)


@pytest.mark.parametrize(
    "boxes",
    [
        np.zeros((0, 4)),
        np.array([[1.0, 1, 3, 3]] * 50),  # too small
        np.array([[-500.0, -500, -400, -400]] * 50),  # off the image
    ],
)
def test_without_craters_there_is_no_light(boxes):
    image = np.random.default_rng(0).integers(0, 256, (1000, 1000), np.uint8)
    assert agreement_of_light(image, Detections(boxes, np.ones(len(boxes)))) == (0, 0, 0)


def rendered_moon():
    return cv2.imread(str(LUNAR), cv2.IMREAD_GRAYSCALE)


def detections(count, towards, score):
    """A lunar picture with bowls painted over it, and their detections."""
    image = rendered_moon()
    bowl, found = bowls([towards[k % len(towards)] for k in range(count)])
    image[:20, : bowl.shape[1]] = bowl
    return image, Detections(found.boxes, np.full(count, score))


@pytest.mark.parametrize(
    ("count", "towards", "score", "calibrated", "suspected"),
    [
        (12, [0.0], 0.8, True, False),
        (12, [0.0, np.pi], 0.8, True, True),  # two lights
        (9, [0.0, np.pi], 0.8, True, False),  # too few craters to tell
        (12, [0.0, 1.2], 0.97, True, False),  # disturbed light, certain craters
        (12, [0.0, 1.2], 0.6, True, True),  # disturbed light, doubtful craters
        (12, [0.0, 1.2], 0.6, False, False),  # the scores of the network are lower than probabilities
        (12, [0.0, np.pi], 0.6, False, True),
    ],
)
def test_light_and_scores_are_weighed_together(count, towards, score, calibrated, suspected):
    suspicion = suspicion_of(*detections(count, towards, score), calibrated)
    assert (suspicion is not None) == suspected
    if suspicion is not None:
        assert suspicion.reason == "light" and suspicion.text.startswith(f"agreement of the light on {count} craters (")


def noise(seed, *, side=300, mean=128.0, deviation=40.0):
    return np.clip(np.random.default_rng(seed).normal(mean, deviation, (side, side)), 0, 255).astype(np.uint8)


def page():
    """A page of words in a typeface."""
    image = np.full((400, 300), 250, np.uint8)
    for row in range(12):
        place = (8, 30 * row + 30)
        cv2.putText(image, "crater and rim of the Moon", place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 10, 1, cv2.LINE_AA)
    return image


def tilted_board():
    """A chequered board that is turned by 20 degrees, with a camera's noise."""
    y, x = np.mgrid[:300, :300]
    board = (np.floor((0.94 * x + 0.34 * y) / 20) + np.floor((0.94 * y - 0.34 * x) / 20)) % 2
    return np.clip(60 + 120 * board + noise(1, mean=0, deviation=1) * 4.0, 0, 255).astype(np.uint8)


def smooth_hills():
    return cv2.normalize(
        cv2.GaussianBlur(noise(2).astype(np.float32), (0, 0), 12), None, 0, 255, cv2.NORM_MINMAX
    ).astype(np.uint8)


def stars():
    rng, sky = np.random.default_rng(3), np.abs(noise(4, mean=3, deviation=2))
    for x, y in rng.integers(5, 290, (900, 2)):
        cv2.circle(sky, (int(x), int(y)), 1, int(rng.integers(100, 255)), -1)
    return sky


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.full((300, 300), 90, np.uint8), "blank"),
        (noise(0, deviation=2), "blank"),
        (np.zeros((40, 50), np.uint8), "blank"),
        (noise(0, mean=290), "overexposed"),
        (stars(), "dark"),
        (page(), "flat"),
        (noise(0), "noise"),
        (np.tile(np.linspace(0, 255, 300), (300, 1)).astype(np.uint8), "smooth"),
        (smooth_hills(), "smooth"),
        (tilted_board(), "straight"),
    ],
)
def test_pictures_without_regolith_have_a_reason(image, reason):
    assert suspicion_of(image, NOTHING, True).reason == reason


@pytest.mark.parametrize(
    "change", ["none", "darker", "lighter", "noisy", "blurred", "stretched", "half black", "strip"]
)
def test_the_moon_is_not_suspected(change):
    moon = rendered_moon().astype(float)
    image = {
        "none": moon,
        "darker": moon / 3,
        "lighter": 0.5 * moon + 120,
        "noisy": moon + np.random.default_rng(0).normal(0, 5, moon.shape),
        "blurred": cv2.GaussianBlur(moon, (0, 0), 0.6),
        "stretched": np.interp(moon, np.quantile(moon, [0.05, 0.95]), [0, 255]),
        "half black": np.hstack([moon, 0 * moon]),
        "strip": np.tile(moon, (6, 1)),
    }[change]
    craters = load_detector()(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert len(craters) > 20 and craters.suspicion is None


def test_tiles_cover_large_pictures_evenly():
    image = noise(0, side=2000)
    tiles = tiles_of(image)
    assert len(tiles) == 16 and all(tile.shape == (256, 256) for tile in tiles)
    assert np.array_equal(tiles[-1], image[-256:, -256:]) and tiles_of(image[:100]) == []
    image[:300] = 0
    assert len(tiles_of(image)) == 12


def test_predict_warns_of_a_collage_and_not_of_the_moon(tmp_path):
    moon = rendered_moon()
    # Four pieces of the Moon, each turned by another quarter: no Sun lights the Moon so.
    collage = np.vstack([np.hstack([moon, np.rot90(moon)]), np.hstack([np.rot90(moon, 3), np.rot90(moon, 2)])])
    cv2.imwrite(str(tmp_path / "collage.png"), collage)
    done = in_process.call(main, "detect", "predict", LUNAR, tmp_path / "collage.png", "--out", tmp_path / "out")
    warnings = [line for line in done.stderr.splitlines() if line.startswith("warning")]
    assert done.returncode == 0 and len(warnings) == 1
    assert warnings[0].startswith("warning: collage.png: agreement of the light on ")
    table = pd.read_parquet(tmp_path / "out/detections.parquet")
    assert set(zip(table["image"], table["suspect"], strict=True)) == {(LUNAR.name, ""), ("collage.png", "light")}


def test_many_suspicions_are_counted(tmp_path):
    for number in range(7):
        cv2.imwrite(str(tmp_path / f"{number}.png"), noise(number))
    done = in_process.call(main, "detect", "predict", tmp_path, "--out", tmp_path / "out")
    warnings = [line for line in done.stderr.splitlines() if line.startswith("warning")]
    assert done.returncode == 0 and len(warnings) == 6
    assert warnings[-1] == "warning: 2 more images that may not show the Moon"
    assert pd.read_parquet(tmp_path / "out/detections.parquet").dtypes["suspect"] == "str"
