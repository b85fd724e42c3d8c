"""Errors of recorded detections: match them to the true craters, measure their errors, and draw new errors.

A detected centre has three errors: an image error that all detections share (`common_pattern`), an error that repeats
in every frame of a crater, and an error that differs from frame to frame. The filter uses the same parts.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.matching import Circles, matched
from perilune_train.landing.craters.projection import projected
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.filter.state import common_pattern
from perilune_train.landing.methods.seen import SeenDescent

N_CLASSES = 8
"""Number of classes of equal size, by stated standard deviation."""
_GATE, _MARGIN_PX = 3.0, 6.0
_MIN_MATCHES, _MIN_PAIRS = 20, 30
"""Smallest number of matches of a frame, and of craters matched in consecutive frames, to measure errors."""


@dataclass(frozen=True, slots=True)
class FrameMatches:
    """The K detections of a frame that match a true crater."""

    sighting: NDArray[np.integer]
    """Rows of the sightings (K,)."""
    crater: NDArray[np.integer]
    """Rows of the catalogue (K,)."""
    centre_px: Array
    """True centres (K, 2), pixels."""
    radius_px: Array
    """True radii (K,), pixels."""


def matches_of(descent: SeenDescent, exact: Catalogue) -> list[FrameMatches]:
    """Match the detections of each frame to the craters at the true pose of the frame."""
    found = []
    for true, sightings in zip(descent.true, descent.sightings, strict=True):
        seen = projected(exact, descent.camera, true, _MARGIN_PX, 1.0)
        sigma_px = np.hypot(sightings.noise_px, sightings.static_px)
        sighting, crater, _ = matched(
            Circles(sightings.centre_px, np.log(sightings.radius_px), sigma_px),
            Circles(seen.centre_px, np.log(seen.radius_px), np.zeros(len(seen.index))),
            sightings.size_sigma**2,
            _GATE,
        )
        found.append(FrameMatches(sighting, seen.index[crater], seen.centre_px[crater], seen.radius_px[crater]))
    return found


@dataclass(frozen=True, slots=True)
class DetectorErrors:
    """Standard deviations of the errors of matched detections."""

    common_px: tuple[float, ...]
    """Five coefficients of the shared image error, constant over a descent, pixels: root mean square over descents."""
    static_share: float
    """Error of a centre that repeats in every frame, on each axis, divided by the radius."""
    noise_factor: float
    """Error of a centre that differs from frame to frame, on each axis, divided by `Sightings.noise_px`."""
    size_bias: float
    """Mean error of the logarithm of a radius."""
    size_static: float
    """Error of the logarithm of a radius that repeats in every frame."""
    size_noise: float
    """Error of the logarithm of a radius that differs from frame to frame."""

    def table(self) -> dict[str, object]:
        """The errors as a JSON object."""
        return asdict(self)


def measured_errors(descents: Sequence[tuple[SeenDescent, list[FrameMatches]]], source: str) -> DetectorErrors:
    """Measure the errors of recorded detections, from descents and their matches.

    Errors that repeat are measured by the products of the errors of a crater in consecutive frames, and the other
    errors by their differences. `source` names the dataset. Raises UserError if too few detections match.
    """
    means, pairs = [], []
    for descent, matches in descents:
        common, before = [], None
        for sightings, match in zip(descent.sightings, matches, strict=True):
            if len(match.crater) < _MIN_MATCHES:
                before = None
                continue
            now = _Residuals.of(descent, sightings, match)
            common.append(now.common_px)
            if before is not None:
                pairs.append(now.paired(before))
            before = now
        if common:
            means.append(np.mean(common, axis=0))
    joined = np.concatenate([np.zeros((0, 8)), *pairs])
    if len(joined) < _MIN_PAIRS:
        raise UserError(
            source, "detections", f"{len(joined)} that match in consecutive frames", f"{_MIN_PAIRS} or more"
        )
    first, second, sigma = joined[:, [0, 1, 2]], joined[:, [3, 4, 5]], joined[:, [6, 7]]
    size_bias = float(np.mean(joined[:, [2, 5]]))
    repeated = np.mean(first[:, :2] * second[:, :2])
    noise = np.mean((first[:, :2] - second[:, :2]) ** 2 / (sigma**2).sum(axis=1, keepdims=True))
    return DetectorErrors(
        tuple(np.sqrt(np.mean(np.square(means), axis=0)).tolist()),
        float(np.sqrt(max(repeated, 0.0))),
        float(np.sqrt(noise)),
        size_bias,
        float(np.sqrt(max(np.mean((first[:, 2] - size_bias) * (second[:, 2] - size_bias)), 0.0))),
        float(np.sqrt(np.mean((first[:, 2] - second[:, 2]) ** 2) / 2)),
    )


def paired_errors(descent: SeenDescent, matches: list[FrameMatches]) -> pd.DataFrame:
    """Errors of the centres of craters that are matched in consecutive frames of a descent, one row per pair.

    Columns, pixels: error in the later frame (`x_px`, `y_px`) and in the earlier one (`before_x_px`, `before_y_px`),
    true radius, and stated deviations in the later frame (`noise_px`, `static_px`). The shared error is removed.
    """
    parts, before = [np.zeros((0, 7))], None
    for sightings, match in zip(descent.sightings, matches, strict=True):
        if len(match.crater) < _MIN_MATCHES:
            before = None
            continue
        error = _Residuals.of(descent, sightings, match).error[:, :2] * match.radius_px[:, None]
        if before is not None:
            _, now, then = np.intersect1d(match.crater, before[0], return_indices=True)
            own = match.sighting[now]
            stated = [match.radius_px[now], sightings.noise_px[own], sightings.static_px[own]]
            parts.append(np.column_stack([error[now], before[1][then], *stated]))
        before = match.crater, error
    names = ["x_px", "y_px", "before_x_px", "before_y_px", "radius_px", "noise_px", "static_px"]
    return pd.DataFrame(np.concatenate(parts), columns=names)


@dataclass(frozen=True, slots=True)
class _Residuals:
    """Errors of the matched detections of one frame, without the shared image error."""

    crater: NDArray[np.integer]
    """Rows of the catalogue (K,)."""
    error: Array
    """Errors of the centre divided by the true radius, and of the logarithm of the radius (K, 3)."""
    sigma: Array
    """`Sightings.noise_px` divided by the true radius (K,)."""
    common_px: Array
    """Coefficients of the shared image error (5,)."""

    @classmethod
    def of(cls, descent: SeenDescent, sightings: Sightings, match: FrameMatches) -> "_Residuals":
        pattern = common_pattern(descent.camera.rays(match.centre_px)[:, :2])
        offset = sightings.centre_px[match.sighting] - match.centre_px
        weight = 1 / np.hypot(sightings.noise_px, sightings.static_px)[match.sighting]
        common, *_ = np.linalg.lstsq(
            (pattern * weight[:, None, None]).reshape(-1, 5), (offset * weight[:, None]).ravel(), rcond=None
        )
        centre = (offset - pattern @ common) / match.radius_px[:, None]
        size = np.log(sightings.radius_px[match.sighting] / match.radius_px)
        sigma = sightings.noise_px[match.sighting] / match.radius_px
        return cls(match.crater, np.column_stack([centre, size]), sigma, common)

    def paired(self, before: "_Residuals") -> Array:
        """Errors (P, 8) of the craters that both frames have: three of this frame, three before, and both sigmas."""
        _, now, then = np.intersect1d(self.crater, before.crater, return_indices=True)
        return np.column_stack([self.error[now], before.error[then], self.sigma[now], before.sigma[then]])


def drawn_sightings(
    descent: SeenDescent, matches: Sequence[FrameMatches], errors: DetectorErrors, rng: np.random.Generator
) -> list[Sightings]:
    """Draw new errors of the matched detections of each frame.

    Scores, unmatched detections, and which craters are detected stay as recorded.
    """
    n_craters = 1 + max((int(match.crater.max(initial=-1)) for match in matches), default=-1)
    common = np.array(errors.common_px) * rng.normal(size=5)
    static = errors.static_share * rng.normal(size=(n_craters, 2))
    size = errors.size_bias + errors.size_static * rng.normal(size=n_craters)
    found = []
    for sightings, match in zip(descent.sightings, matches, strict=True):
        pattern = common_pattern(descent.camera.rays(match.centre_px)[:, :2])
        noise_px = (
            errors.noise_factor * sightings.noise_px[match.sighting, None] * rng.normal(size=(len(match.crater), 2))
        )
        centre, radius = sightings.centre_px.copy(), sightings.radius_px.copy()
        centre[match.sighting] = (
            match.centre_px + pattern @ common + match.radius_px[:, None] * static[match.crater] + noise_px
        )
        noise = errors.size_noise * rng.normal(size=len(match.crater))
        radius[match.sighting] = match.radius_px * np.exp(size[match.crater] + noise)
        order = np.argsort(-radius, kind="stable")
        found.append(replace(sightings, centre_px=centre, radius_px=radius).part(order))
    return found


def deviation_table(descents: Sequence[tuple[SeenDescent, list[FrameMatches]]]) -> pd.DataFrame:
    """Stated and measured standard deviations of centres per axis, pixels, by stated standard deviation.

    Takes descents with their matches (`matches_of`). One row per class, and a last row for all. Only craters that are
    matched in two consecutive frames count: products of their two errors give the part that persists, differences give
    the part that differs from frame to frame. The error that all sightings of a frame share is removed. The table is
    empty if there are no such craters.
    """
    pairs = pd.concat([paired_errors(descent, matches) for descent, matches in descents], ignore_index=True)
    if not len(pairs):
        return pd.DataFrame()
    stated = np.hypot(pairs["noise_px"], pairs["static_px"])
    edges = np.unique(np.quantile(stated, np.linspace(0, 1, N_CLASSES + 1)))
    number = np.searchsorted(edges[1:-1], stated, side="left")
    rows = [_deviation_row(pairs[number == k]) for k in range(len(edges) - 1)]
    return pd.DataFrame([*rows, _deviation_row(pairs)])


def _deviation_row(pairs: pd.DataFrame) -> dict[str, float]:
    now, before = pairs[["x_px", "y_px"]].to_numpy(), pairs[["before_x_px", "before_y_px"]].to_numpy()
    stated = {name: float(np.sqrt(np.mean(np.square(pairs[f"{name}_px"])))) for name in ("static", "noise")}
    persistent, independent = np.mean(now * before), np.mean((now - before) ** 2) / 2
    variance = (pairs["noise_px"] ** 2 + pairs["static_px"] ** 2).to_numpy()[:, None]
    return {
        "n_pairs": float(len(pairs)),
        "radius_px": float(pairs["radius_px"].median()),
        "stated_px": float(np.hypot(stated["static"], stated["noise"])),
        "error_px": float(np.sqrt(np.mean(now**2))),
        "normalised_error_squared": float(np.mean(now**2 / variance)),
        "stated_static_px": stated["static"],
        "static_px": float(np.sqrt(max(persistent, 0.0))),
        "stated_noise_px": stated["noise"],
        "noise_px": float(np.sqrt(independent)),
    }
