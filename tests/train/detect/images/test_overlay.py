import cv2
import numpy as np

from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.images.overlay import MAX_DRAWN, write_overlay


def drawn(tmp_path, scores):
    """The overlay, without its strip, of squares of 20 px in rows over a black image of 1600 x 1600 px."""
    k = np.arange(len(scores))
    corner = np.column_stack([k % 60, k // 60]) * 25.0
    found = Detections(np.hstack([corner, corner + 20]), np.asarray(scores))
    write_overlay(tmp_path / "a.png", np.zeros((1600, 1600), np.uint8), found, 0.5)
    picture = cv2.imread(str(tmp_path / "a.png")).astype(int)
    assert picture[1600:].any()
    return picture[:1600]


def test_higher_scores_are_yellower(tmp_path):
    weak, strong = (drawn(tmp_path, [score]).reshape(-1, 3).max(axis=0) for score in (0.5, 1.0))
    assert weak[0] > weak[1] + 80, "purple: more blue than green"
    assert strong[1] > strong[0] + 80, "yellow: more green than blue"


def test_only_the_strongest_are_drawn(tmp_path):
    scores = np.linspace(1.0, 0.6, MAX_DRAWN + 200)
    picture = drawn(tmp_path, scores)
    assert [picture[25 * (k // 60) :][:20, 25 * (k % 60) :][:, :20].any() for k in (0, 999, 1000, 1199)] == [
        True,
        True,
        False,
        False,
    ]


def test_an_image_without_craters_and_a_narrow_one(tmp_path):
    none = Detections(np.zeros((0, 4)), np.zeros(0))
    write_overlay(tmp_path / "a.png", np.zeros((900, 3), np.uint8), none, 1.0)
    assert cv2.imread(str(tmp_path / "a.png")).shape == (924, 3, 3)


def test_a_tilted_ellipse_is_drawn_tilted(tmp_path):
    """Semi-axes of 60 and 20 px at 30 degrees from x towards y, about (100, 100)."""
    theta = np.radians(30)
    half = np.hypot([60 * np.cos(theta), 60 * np.sin(theta)], [20 * np.sin(theta), 20 * np.cos(theta)])
    correlation = (60**2 - 20**2) * np.sin(theta) * np.cos(theta) / half.prod()
    found = Detections(np.array([[*(100 - half), *(100 + half)]]), np.ones(1), np.array([[correlation, 1, 1, 1, 1]]))
    write_overlay(tmp_path / "a.png", np.zeros((1600, 1600), np.uint8), found, 0.5)
    rows, columns = np.nonzero(cv2.imread(str(tmp_path / "a.png"))[:1600].max(axis=2) > 100)
    x, y = columns + 0.5 - 100, rows + 0.5 - 100
    along, across = x * np.cos(theta) + y * np.sin(theta), y * np.cos(theta) - x * np.sin(theta)
    assert len(x) > 200 and np.abs(np.hypot(along / 60, across / 20) - 1).max() < 0.08
