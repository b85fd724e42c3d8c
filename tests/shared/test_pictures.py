"""Pictures with ellipses: where the lines are, the size, and how a picture is displayed."""

import sys
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from perilune_shared.pictures import CYAN, GREEN, display, with_ellipses


def drawn_at(picture, colour=CYAN):
    """Rows and columns of the pixels of a colour."""
    return np.argwhere((np.asarray(picture) == colour).all(axis=2))


def test_the_line_is_where_the_ellipse_is():
    """In pixels from the outer corner of the first one; the picture is enlarged by 4."""
    picture = with_ellipses(np.zeros((256, 256), np.uint8), [[100.0, 50.0, 40.0, 20.0, np.pi / 2]])
    assert picture.size == (1024, 1024)
    place = (drawn_at(picture) + 0.5) / 4
    np.testing.assert_allclose([place[:, 1].min(), place[:, 1].max()], [80, 120], atol=0.3)
    np.testing.assert_allclose([place[:, 0].min(), place[:, 0].max()], [10, 90], atol=0.3)
    away = ((place[:, 1] - 100) / 20) ** 2 + ((place[:, 0] - 50) / 40) ** 2
    np.testing.assert_allclose(away, 1, atol=0.06)


def test_each_ellipse_has_its_colour_and_none_may_be_given():
    ellipses = [[20, 20, 5, 5, 0], [60, 60, 5, 5, 0]]
    picture = with_ellipses(np.zeros((80, 80), np.uint8), ellipses, [GREEN, CYAN])
    assert len(drawn_at(picture, GREEN)) and len(drawn_at(picture, CYAN))
    plain = np.asarray(with_ellipses(np.full((80, 80), 7, np.uint8), []))
    assert (plain == 7).all()


@pytest.mark.parametrize(("shape", "size"), [((300, 200), (600, 900)), ((1, 1), (1024, 1024)), ((10, 8192), (4096, 5))])
def test_small_images_are_enlarged_and_large_ones_reduced(shape, size):
    assert with_ellipses(np.zeros(shape, np.uint8), []).size == size


def test_deep_images_are_scaled_to_their_largest_value():
    deep = np.array([[0, 1000], [2000, 4000]], np.uint16)
    shown = np.asarray(with_ellipses(deep, []))[256::512, 256::512, 0]
    np.testing.assert_array_equal(shown, [[0, 64], [128, 255]])
    assert np.asarray(with_ellipses(np.zeros((4, 4), np.uint16), [])).max() == 0


def test_a_notebook_displays_a_picture_itself(monkeypatch):
    shown, opened, picture = [], [], Image.new("L", (2, 2))
    module = ModuleType("IPython.display")
    module.display = shown.append
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    monkeypatch.setattr(Image.Image, "show", lambda own: opened.append(own))
    monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
    display(picture)
    assert (shown, opened) == ([], [picture])
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    display(picture)
    assert (shown, opened) == ([picture], [picture])
