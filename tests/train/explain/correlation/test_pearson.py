import numpy as np
import pandas as pd
import pytest

from perilune_train.explain.correlation.pearson import (
    is_constant,
    partial_rows,
    pearson,
    pearson_rows,
    standardised_rows,
)


def test_pearson_by_hand():
    # Deviations (-1.5, -0.5, 0.5, 1.5) and (-1, 1, -1, 1): 2 / sqrt(5 * 4).
    assert pearson([1, 2, 3, 4], [0, 2, 0, 2]) == pytest.approx(2 / np.sqrt(20))


def test_pearson_ignores_gain_and_offset_and_keeps_the_sign():
    image = np.random.default_rng(0).random((5, 6))
    assert pearson(image, 3 * image + 7) == pytest.approx(1)
    assert pearson(image, -image) == pytest.approx(-1)


def test_pearson_over_seen_pixels_only():
    a, b = np.array([[1.0, 2, 3, 99]]), np.array([[1.0, 2, 3, -99]])
    assert pearson(a, b, np.array([[True, True, True, False]])) == pytest.approx(1)
    assert pearson(a, b) < -0.9
    assert np.isnan(pearson(a, b, np.zeros((1, 4), bool)))


@pytest.mark.parametrize("level", [0.0, 1.0, 0.1])
def test_a_constant_mask_has_no_correlation(level):
    flat = np.full((64, 64), level, np.float32)
    assert is_constant(flat)
    assert np.isnan(pearson(flat, np.random.default_rng(0).random((64, 64))))


def test_pearson_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"\(1, 2, 2\).*\(1, 3, 3\)"):
        pearson(np.eye(2), np.eye(3))


def test_rows_agree_with_numpy():
    rng = np.random.default_rng(1)
    maps = rng.random((4, 8, 9)).astype(np.float32)
    targets = maps + rng.random((4, 8, 9)).astype(np.float32)
    seen = rng.random((4, 8, 9)) < 0.7
    np.testing.assert_allclose(
        pearson_rows(maps, targets, seen),
        [np.corrcoef(a[s], b[s])[0, 1] for a, b, s in zip(maps, targets, seen, strict=True)],
        atol=1e-6,
    )
    rows, others = standardised_rows(maps), standardised_rows(targets)
    np.testing.assert_allclose(rows @ rows.T, np.corrcoef(maps.reshape(4, -1)), atol=1e-6)
    np.testing.assert_allclose(np.diagonal(rows @ others.T), pearson_rows(maps, targets), atol=1e-12)


def test_partial_correlation_agrees_with_the_inverse_of_the_correlation_matrix():
    rng = np.random.default_rng(2)
    one, two = rng.standard_normal((2, 3, 20, 20))
    maps = one + 0.5 * two + rng.standard_normal((3, 20, 20))
    targets = one - two + rng.standard_normal((3, 20, 20)) + 0.3 * maps
    for n, found in enumerate(partial_rows(maps, targets, [one, two])):
        columns = pd.DataFrame(
            {"m": maps[n].ravel(), "t": targets[n].ravel(), "a": one[n].ravel(), "b": two[n].ravel()}
        )
        inverse = np.linalg.inv(columns.corr().to_numpy())
        assert found == pytest.approx(-inverse[0, 1] / np.sqrt(inverse[0, 0] * inverse[1, 1]), abs=1e-9)
        assert found == pytest.approx(-np.linalg.inv(columns.cov().to_numpy())[0, 1] / _scale(columns), abs=1e-9)


def _scale(columns):
    precision = np.linalg.inv(columns.cov().to_numpy())
    return np.sqrt(precision[0, 0] * precision[1, 1])


def test_partial_correlation_removes_a_common_cause():
    rng = np.random.default_rng(3)
    cause = rng.standard_normal((2, 60, 60))
    maps, targets = (cause + 0.1 * rng.standard_normal(cause.shape) for _ in range(2))
    assert (pearson_rows(maps, targets) > 0.95).all()
    assert (np.abs(partial_rows(maps, targets, [cause])) < 0.06).all()


def test_partial_correlation_is_undefined_if_the_givens_determine_the_map():
    rng = np.random.default_rng(4)
    one, two, target = rng.standard_normal((3, 2, 12, 12)).astype(np.float32)
    assert np.isnan(partial_rows(2 * one - two + 1, target, [one, two])).all()
    assert np.isnan(partial_rows(np.ones_like(one), target, [one])).all()
    # A given that repeats another, or is constant, changes nothing.
    np.testing.assert_allclose(
        partial_rows(two, target, [one, 3 * one, np.ones_like(one)]), partial_rows(two, target, [one]), atol=1e-9
    )
