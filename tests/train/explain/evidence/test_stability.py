"""Stability of masks whose reaction to noise, shifts and lenses is known."""

import cv2
import numpy as np
import pytest

from perilune_train.explain.evidence.stability import between, noisy, shifted, stability


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

    table = stability(masks_of, images, rng, sigmas_dn=(10.0,), shifts_px=((3, -2),))
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
        lambda given: {"half": given.astype(np.float32)}, pairs, np.random.default_rng(0), (), ((0, 5),), stacked=2
    )
    np.testing.assert_allclose(table["pearson"], 1)
    seen = []
    stability(lambda given: {"half": seen.append(given) or given}, pairs, np.random.default_rng(0), (), ((0, 5),), 2)
    np.testing.assert_array_equal(seen[1][:, 69:], pairs[:, 64:-5])
    np.testing.assert_array_equal(seen[1][:, 64:69], np.repeat(pairs[:, 64:65], 5, axis=1))


def test_between_renderings_of_another_lens(images):
    masks_a = {"B_11": images.astype(np.float32)}
    x, y = np.meshgrid(np.arange(64, dtype=np.float32), np.arange(64, dtype=np.float32))
    # Lens b shows the point of pixel x of a at 64 - x, so pixel 0 of a is outside b.
    masks_b = {"B_11": np.roll(masks_a["B_11"][:, :, ::-1], 1, axis=2)}
    mapped = between(masks_a, masks_b, "lens", 64 - x, y)
    np.testing.assert_allclose(mapped["pearson"], 1, atol=1e-6)
    assert mapped["frame_index"].tolist() == [0, 1, 2] and set(mapped["change"]) == {"lens"}
    plain = between(masks_a, masks_b, "lens")
    expected = [np.corrcoef(masks_a["B_11"][i].ravel(), masks_b["B_11"][i].ravel())[0, 1] for i in range(3)]
    np.testing.assert_allclose(plain["pearson"], expected)
    assert (plain["pearson"].abs() < 0.5).all()
