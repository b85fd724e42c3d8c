"""Pearson correlations of maps, plain and partial."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perilune_shared.geometry.frames import Array

Maps = NDArray[np.floating]
"""Maps (N, height, width) of N images."""
_ROUNDING = 1e-6
"""Largest variation, relative to the values, that counts as a rounding error of float32."""


def pearson(a: ArrayLike, b: ArrayLike, seen: NDArray[np.bool_] | None = None) -> float:
    """Pearson correlation of two maps over the pixels `seen`; NaN if a map is constant or no pixel is `seen`."""
    x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return float(pearson_rows(x[None], y[None], None if seen is None else seen[None])[0])


def pearson_rows(maps: Maps, targets: Maps, seen: NDArray[np.bool_] | None = None) -> Array:
    """Correlation (N,) of each of N maps (N, ...) with its target (N, ...), over the pixels `seen` (N, ...).

    NaN where the map or the target is constant, or no pixel is `seen`. Raises ValueError if the shapes differ.
    """
    if maps.shape != targets.shape:
        raise ValueError(f"shapes {maps.shape} and {targets.shape} differ")
    return dot_rows(standardised_rows(maps, seen), standardised_rows(targets, seen))


def partial_rows(maps: Maps, targets: Maps, givens: Sequence[Maps]) -> Array:
    """Partial correlation (N,) of each map (N, ...) with its target (N, ...), given the other maps (N, ...).

    The map and the target are each regressed on the givens and a constant by least squares; the result is the Pearson
    correlation of the residuals. NaN where a residual is constant: there the givens determine the map or the target.
    """
    basis = given_basis(givens)
    return partial_of_rows(standardised_rows(maps), residual_rows(standardised_rows(targets), basis), basis)


def partial_of_rows(rows: Array, residuals: Array, basis: Sequence[Array]) -> Array:
    """Partial correlations (N,) from standardised maps (N, P) and the targets' `residual_rows` (N, P).

    `basis` is the `given_basis` of the other maps. The target's residual is orthogonal to the basis, so of the map's
    residual only the length is needed.
    """
    left = np.sqrt(
        np.maximum(1 - sum((dot_rows(rows, basis_rows) ** 2 for basis_rows in basis), np.zeros(len(rows))), 0)
    )
    return dot_rows(rows, residuals) / np.where(left > _ROUNDING, left, np.nan)


def dot_rows(a: Array, b: Array) -> Array:
    """Dot product (N,) of each pair of rows of two arrays (N, P)."""
    return np.einsum("np,np->n", a, b)


def standardised_rows(maps: Maps, seen: NDArray[np.bool_] | None = None) -> Array:
    """Maps (N, ...) as rows (N, P) of mean 0 and length 1; the dot product of two rows is their correlation.

    Pixels that are not `seen` are 0 and do not count. A row is NaN if the map is constant or no pixel is `seen`.
    """
    flat = maps.reshape(len(maps), -1)
    rows = np.zeros(flat.shape)
    for n, row in enumerate(rows):
        keep = slice(None) if seen is None else seen[n].ravel()
        values = flat[n, keep].astype(np.float64)
        largest = max(values.max(initial=0), -values.min(initial=0))
        values -= values.mean() if values.size else 0
        length = np.sqrt(values @ values)
        # The same limit as in `is_constant`, without its temporary arrays.
        if length <= _ROUNDING * np.sqrt(values.size) * max(largest, 1e-30):
            row[:] = np.nan
        else:
            row[keep] = values / length
    return rows


def given_basis(givens: Sequence[Maps]) -> list[Array]:
    """Orthonormal basis of the centred given maps (N, ...): rows (N, P) for each given map.

    A row is zero if the given map depends linearly on earlier given maps.
    """
    basis: list[Array] = []
    for given in givens:
        rows = _without(np.nan_to_num(standardised_rows(given)), basis)
        lengths = np.linalg.norm(rows, axis=1, keepdims=True)
        basis.append(np.where(lengths > _ROUNDING, rows / np.maximum(lengths, _ROUNDING), 0.0))
    return basis


def residual_rows(rows: Array, basis: Sequence[Array]) -> Array:
    """Residuals (N, P), scaled to length 1, of standardised maps (N, P) after regression on a basis.

    A row is NaN if the basis determines the map.
    """
    residuals = _without(rows, basis)
    lengths = np.linalg.norm(residuals, axis=1)
    return residuals / np.where(lengths > _ROUNDING, lengths, np.nan)[:, None]


def is_constant(values: ArrayLike) -> bool:
    """Whether values are constant except for rounding errors.

    The standard deviation of these values is at most 1e-6 of the largest absolute value.
    """
    array = np.asarray(values, np.float64)
    return bool(np.std(array) <= _ROUNDING * max(float(np.abs(array).max()), 1e-30))


def _without(rows: Array, basis: Sequence[Array]) -> Array:
    """Rows (N, P) without their components along the basis. Subtracting twice limits rounding errors."""
    for _ in range(2):
        for basis_rows in basis:
            rows = rows - dot_rows(rows, basis_rows)[:, None] * basis_rows
    return rows
