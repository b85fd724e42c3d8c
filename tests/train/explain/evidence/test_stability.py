"""Stability of masks whose reaction to noise, shifts and lenses is known."""

import cv2
import numpy as np
import pytest

from perilune_train.explain.evidence.stability import Changes, between, lens_map, noisy, shifted, stability


@pytest.fixture
def images():
    rng = np.random.default_rng(0)
    fields = [cv2.GaussianBlur(rng.normal(size=(64, 64)), (0, 0), 2) for _ in range(3)]
    return np.stack([np.clip(128 + 30 * one / one.std(), 0, 255).astype(np.uint8) for one in fields])


def test_noise_has_its_standard_deviation_and_stays_within_eight_bits():
    rng = np.random.default_rng(1)
    grey = np.full((4, 64, 64), 128, np.uint8)
    noise = noisy(grey, 5.0, rng).astype(float) - 128
    # Rounding adds a variance of 1 / 12; the standard error of 16384 values is 0.03.
    assert noise.std() == pytest.approx(np.sqrt(25 + 1 / 12), abs=0.12) and abs(noise.mean()) < 0.15
    white = noisy(np.full((1, 64, 64), 254, np.uint8), 5.0, rng)
    assert white.max() == 255 and white.min() > 225


def test_a_shift_by_hand():
    image = np.arange(6).reshape(2, 3)
    np.testing.assert_array_equal(shifted(image, 1, 0), [[0, 0, 1], [3, 3, 4]])
    np.testing.assert_array_equal(shifted(image, -1, 1), [[1, 2, 2], [1, 2, 2]])


def test_a_mask_that_follows_the_image_is_stable_under_shifts_and_one_fixed_to_the_frame_is_not(images):
    rng = np.random.default_rng(2)
    fixed = cv2.GaussianBlur(rng.normal(size=(64, 64)), (0, 0), 1)

    def masks_of(given):
        brightness = given.astype(np.float32) / 255
        return {"brightness": brightness, "fixed": np.stack([fixed] * len(given)), "flat": np.ones_like(brightness)}

    table = stability(masks_of, images, rng, Changes((10.0,), ((3, -2),)))
    assert list(table.columns) == ["map", "change", "frame_index", "pearson"]
    values = table.set_index(["map", "change"])["pearson"].sort_index()
    np.testing.assert_allclose(values["brightness", "shift 3 -2 px"], 1)
    assert (values["fixed", "shift 3 -2 px"] < 0.5).all()
    np.testing.assert_allclose(values["fixed", "noise 10 DN"], 1)
    # Signal of 30 DN and noise of 10 DN: 1 / sqrt(1 + 1 / 9).
    np.testing.assert_allclose(values["brightness", "noise 10 DN"], 0.949, atol=0.01)
    assert values["flat"].isna().all()


def test_both_frames_of_a_stacked_pair_are_shifted(images):
    pairs = np.concatenate([images, images[::-1]], axis=1)
    table = stability(
        lambda given: {"half": given.astype(np.float32)}, pairs, np.random.default_rng(0), Changes((), ((0, 5),), ()), 2
    )
    np.testing.assert_allclose(table["pearson"], 1)
    seen = []
    stability(
        lambda given: {"half": seen.append(given) or given},
        pairs,
        np.random.default_rng(0),
        Changes((), ((0, 5),), ()),
        2,
    )
    np.testing.assert_array_equal(seen[1][:, 69:], pairs[:, 64:-5])
    np.testing.assert_array_equal(seen[1][:, 64:69], np.repeat(pairs[:, 64:65], 5, axis=1))


def test_a_lens_by_hand():
    column, row = lens_map(65, 65, -0.1)
    assert (column[32, 32], row[32, 32]) == (32, 32)
    # At the edge of the new image, r' = 32 / 32.5 half widths.
    assert column[32, 64] == pytest.approx(32 + 32 * (1 + 0.1 * (32 / 32.5) ** 2))
    assert row[32, 64] == 32


def test_a_mask_that_follows_the_image_is_stable_under_another_lens_and_one_fixed_to_the_frame_is_not(images):
    fixed = cv2.GaussianBlur(np.random.default_rng(2).normal(size=(128, 128)), (0, 0), 1)
    large = np.stack([cv2.resize(one, (128, 128)) for one in images])
    pairs = np.concatenate([large, large[::-1]], axis=1)

    def masks_of(given):
        doubled = np.concatenate([fixed, fixed])
        return {"brightness": given.astype(np.float32), "fixed": np.stack([doubled] * len(given))}

    table = stability(masks_of, pairs, np.random.default_rng(0), Changes((), (), (-0.08, 0.08)), 2)
    assert set(table["change"]) == {"lens -8 %", "lens +8 %"}
    values = table.groupby("map")["pearson"]
    assert values.min()["brightness"] > 0.99
    assert values.max()["fixed"] < 0.8


def test_between_two_renderings(images):
    masks_a = {"B_11": images.astype(np.float32)}
    masks_b = {"B_11": np.roll(masks_a["B_11"][:, :, ::-1], 1, axis=2)}
    plain = between(masks_a, masks_b, "turned Sun")
    assert plain["frame_index"].tolist() == [0, 1, 2] and set(plain["change"]) == {"turned Sun"}
    expected = [np.corrcoef(masks_a["B_11"][i].ravel(), masks_b["B_11"][i].ravel())[0, 1] for i in range(3)]
    np.testing.assert_allclose(plain["pearson"], expected)
    assert (plain["pearson"].abs() < 0.5).all()
