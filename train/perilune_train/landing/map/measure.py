"""Errors of a crater map relative to the craters of the terrain."""

import itertools

import numpy as np
import pandas as pd
from scipy.spatial import KDTree

from perilune_shared.geometry.frames import Array
from perilune_train.landing.craters.catalogue import Catalogue

DIAMETERS_M = (3.0, 5.0, 7.0, 10.0, 20.0, 40.0, 100.0, np.inf)
"""Limits of the diameter bins, metres."""
_CANDIDATES = 12
_MAX_APART = 0.8
"""Largest cost of a match between a mapped and a true crater. The cost is their distance in radii of the mapped crater
plus twice the absolute difference of the logarithms of the radii."""


def measured(mapped: Catalogue, exact: Catalogue, covered_m: Array) -> pd.DataFrame:
    """One row per diameter bin: number of mapped craters, precision, recall and errors.

    `covered_m` (2,) holds the largest |x| and |y| of the ground that both images show, metres. Craters outside do not
    count as missed.
    """
    truth = KDTree(exact.centre_m[:, :2])
    distance_m, index = truth.query(mapped.centre_m[:, :2], min(_CANDIDATES, len(exact)))
    distance_m, index = (values.reshape(len(mapped), -1) for values in (distance_m, index))
    by_size = np.log(mapped.radius_m[:, None] / exact.radius_m[index])
    cost = distance_m / mapped.radius_m[:, None] + 2 * np.abs(by_size)
    rows, best = np.arange(len(mapped)), cost.argmin(axis=1)
    nearest, by_size, true = index[rows, best], by_size[rows, best], cost[rows, best] < _MAX_APART
    error_m = mapped.centre_m - exact.centre_m[nearest]
    is_found = np.zeros(len(exact), bool)
    is_found[nearest[true]] = True
    covered = (np.abs(exact.centre_m[:, :2]) < covered_m).all(axis=1)
    table = []
    for low, high in itertools.pairwise(DIAMETERS_M):
        in_bin = (2 * mapped.radius_m >= low) & (2 * mapped.radius_m < high)
        mapped_true, true_in_bin = in_bin & true, covered & (2 * exact.radius_m >= low) & (2 * exact.radius_m < high)
        table.append(
            {
                "diameter_m": f"{low:g} to {high:g}" if np.isfinite(high) else f"{low:g} or more",
                "mapped": int(in_bin.sum()),
                "true_share": _mean(true[in_bin]),
                "found_share": _mean(is_found[true_in_bin]),
                "position_rmse_m": _rms(error_m[mapped_true][:, :2]),
                "height_rmse_m": _rms(error_m[mapped_true][:, 2]),
                "diameter_bias_share": _mean(by_size[mapped_true]),
                "diameter_sigma_share": float(by_size[mapped_true].std()) if mapped_true.any() else np.nan,
            }
        )
    return pd.DataFrame(table)


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else np.nan


def _rms(values: Array) -> float:
    """Root mean square of all values, which for vectors is the RMS per axis."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan
