import numpy as np
import pytest
from tests.helpers.elevation_models import PLACED, POLAR, rough, write

from perilune_render.terrain.elevation.model import read_elevation
from perilune_render.terrain.elevation.quantisation import smoothed, step_of

SLOPE = np.add.outer(0.07 * np.arange(150), 0.03 * np.arange(150))


def in_8_bits(height):
    step = np.ptp(height) / 255
    return height.min() + np.rint((height - height.min()) / step) * step, step


@pytest.mark.parametrize("offset", [0.0, -3000.0])
def test_the_step_of_8_bit_heights_is_found(offset):
    held, step = in_8_bits(rough() + offset)
    assert step_of(held.astype(np.float32).astype(float).ravel(), 1.0) == pytest.approx(step, rel=1e-3)


def test_float_and_level_heights_have_no_step():
    assert step_of(rough().ravel(), 5.0) == 0
    # Single precision alone rounds to a quarter of a millimetre here.
    assert step_of((rough() - 3000).astype(np.float32).astype(float).ravel(), 5.0) == 0
    assert step_of(np.full(1000, 7.0), 5.0) == 0
    bowl = np.where(np.hypot(*np.mgrid[-50:50, -50:50]) < 20, -np.sqrt(np.abs(rough(2, 100))), 0)
    assert step_of(bowl.ravel(), 5.0) == 0


def test_terraces_of_a_ramp_are_gone_within_half_a_step():
    held = np.rint(SLOPE)
    ours = smoothed(held, 1.0)
    assert np.abs(ours - held).max() <= 0.5 + 1e-9
    assert np.std(np.diff(held, axis=0)) > 0.2 and np.std(np.diff(ours, axis=0)) < 0.03
    assert np.std(ours - SLOPE) < 0.15 * np.std(held - SLOPE)


def test_smoothed_ground_is_nearer_to_the_truth_than_what_was_stored():
    truth = rough()
    step = np.ptp(truth) / 40
    held = np.rint(truth / step) * step
    ours = smoothed(held, step)
    assert np.abs(ours - held).max() <= step / 2 * (1 + 1e-9)
    assert np.std(ours - truth) < 0.8 * np.std(held - truth)


def test_a_model_in_steps_is_read_smoothed_and_a_float_model_as_it_is(tmp_path):
    model = read_elevation(write(tmp_path / "a.tif", np.rint(SLOPE), POLAR, PLACED))
    assert model.step_m == pytest.approx(1) and np.abs(model.height_m - np.rint(SLOPE)).max() <= 0.5 + 1e-6
    height = rough().astype(np.float32)
    model = read_elevation(write(tmp_path / "b.tif", height, POLAR, PLACED))
    assert model.step_m == 0 and np.array_equal(model.height_m, height)
