"""The heights of a raster file: their band, their unit, and the values that mark missing heights."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perilune_render.config.terrain import METRES_PER_UNIT, ElevationConfig
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M, Array
from perilune_shared.storage.rasters import RasterFiles, label_text

_FIELD = "dataset.terrain.elevation"
_HEIGHT = re.compile(r"height|elevation|altitude|topograph|radius|\bd[et]m\b|\bz\b", re.I)
_OTHER = re.compile(r"err|uncert|sigma|std|count|number|quality|mask|shade|slope|source", re.I)
_UNITS = {
    "m": r"m|met(?:er|re)s?|m\.",
    "km": r"km|kilomet(?:er|re)s?",
    "ft": r"ft|feet|foot|international foot",
    "us-ft": r"us[- _]?(?:survey[- _]?)?(?:ft|feet|foot)|ftus|u\.s\. survey f(?:oo|ee)t|foot_us",
    "cm": r"cm|centimet(?:er|re)s?",
    "mm": r"mm|millimet(?:er|re)s?",
}
_LOWEST_M, _HIGHEST_M = -9_900.0, 11_500.0
"""Lowest and highest accepted height relative to the mean radius. The Moon has heights of -9.1 to 10.8 km."""
_MIN_RELIEF = 7e-4
"""Range of heights, as a share of the ground's width, below which heights without a unit may be kilometres."""
_WIDEST_RELIEF = 25.0
"""Range of heights of the whole Moon, kilometres, with a margin. Values with a larger range are not in kilometres."""
_MIN_EXTENT_M = 1000.0
"""Smallest width of the ground, metres, at which heights are tested for kilometres."""
_MIN_PLATEAU = 4
"""Smallest number of equal values that are tested for fill."""
_ISIS_SPECIAL = 3.4e38
"""Smallest absolute value of pixels without data in an ISIS cube (Null, and saturated or out of range)."""


@dataclass(frozen=True, slots=True)
class HeightBand:
    """The band of an open raster that has the heights."""

    path: Path
    """The raster, named in error messages."""
    raster: Any
    """The open `rasterio.DatasetReader`."""
    index: int
    """Number of the band, from 1."""
    metres: float | None
    """Metres per unit of the heights, after scale and offset; None if neither file nor configuration states it."""
    nodata: float | None
    """Value, before scale and offset, that the configuration gives to pixels without a height."""
    special: bool
    """Whether values of the largest magnitudes mark pixels without a height, as in ISIS cubes."""

    @property
    def exact(self) -> bool:
        """Whether values must not be averaged, since some of them mark pixels without a height."""
        return self.nodata is not None or self.special

    def read(self, window: Any, shape: tuple[int, int]) -> Array:
        """Heights (rows, columns) of a window in the file's unit, NaN without a height; see `in_metres`."""
        from rasterio.enums import Resampling

        method = Resampling.nearest if self.exact else Resampling.average
        raw = self.raster.read(self.index, window=window, out_shape=shape, resampling=method, masked=True)
        values = raw.data
        height = raw.astype(np.float64).filled(np.nan)
        if self.nodata is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                height[values == np.array(self.nodata).astype(values.dtype)] = np.nan
        if self.special:
            height[np.abs(height) >= _ISIS_SPECIAL] = np.nan
        del raw, values
        # Some products store integers with a scale and an offset.
        height *= self.raster.scales[self.index - 1]
        height += self.raster.offsets[self.index - 1]
        return height

    def in_metres(self, height: Array, width_m: float) -> Array:
        """Convert heights or radii (rows, columns) to metres of height, in place.

        The ground is `width_m` wide. Raises UserError if the values cannot be heights on the Moon: if some are beyond
        the Moon's highest and lowest points, if many are equal and far from the rest (undeclared fill), or if the
        ground is too flat for metres and no unit is stated.
        """
        height[np.isinf(height)] = np.nan
        known = height[np.isfinite(height)]
        if not len(known):
            return height
        metres, middle = self.metres, float(np.median(known))
        if metres is None:
            in_km = _is_radius(middle * METRES_PER_UNIT["km"])
            metres = METRES_PER_UNIT["km"] if in_km else 1.0
        zero = MOON_RADIUS_M if _is_radius(middle * metres) else 0.0
        low, high = (zero + _LOWEST_M) / metres, (zero + _HIGHEST_M) / metres
        self._refuse_beyond(known, low, high, metres)
        self._refuse_plateau(known)
        relief = float(known.max() - known.min()) * metres
        flat = width_m >= _MIN_EXTENT_M and 0 < relief < min(_MIN_RELIEF * width_m, _WIDEST_RELIEF)
        if self.metres is None and zero == 0 and flat:
            raise UserError(
                self.path,
                f"{_FIELD}.height_unit",
                f"no unit, and heights that differ by {relief:.3g} over {width_m / 1000:.3g} km",
                "--height-unit km, or m if the heights are metres",
            )
        if metres != 1:
            height *= metres
            height -= zero
        return height

    def _refuse_beyond(self, known: Array, low: float, high: float, metres: float) -> None:
        beyond = known[(known < low) | (known > high)]
        if len(beyond):
            worst = float(beyond[np.argmax(np.abs(beyond))])
            raise UserError(
                self.path,
                "heights",
                f"{len(beyond)} of {len(known)} outside the Moon's heights, such as {worst:.9g}",
                f"{low:.6g} to {high:.6g}{self._hint(worst, metres)}",
            )

    def _refuse_plateau(self, known: Array) -> None:
        for value, apart in ((float(known.min()), 1), (float(known.max()), -1)):
            count = int((known == value).sum())
            if count < _MIN_PLATEAU or count == len(known):
                continue
            rest = known[known != value]
            gap = float((rest * apart).min() - value * apart)
            if gap <= 0.2 * float(np.ptp(rest)):
                continue
            steps = np.diff(np.unique(rest))
            if len(steps) > 1 and gap > 4 * float(steps.max()):
                raise UserError(
                    self.path,
                    "heights",
                    f"{count} of {len(known)} equal to {value:.9g}, {gap:.4g} apart from the rest",
                    f"heights without undeclared fill{self._hint(value, 1.0)}",
                )

    def _hint(self, value: float, metres: float) -> str:
        """Hint in an error message: how to declare a value as fill."""
        raw = (value - self.raster.offsets[self.index - 1]) / (self.raster.scales[self.index - 1] or 1.0)
        unit = "" if metres == 1 or self.metres is not None else ", or the unit with --height-unit"
        return f"; if it is fill, --set {_FIELD}.nodata={raw:.9g}{unit}"


def height_band(path: Path, files: RasterFiles, raster: Any, config: ElevationConfig) -> HeightBand:
    """The band that a configuration chooses for heights, or the only band that can have heights.

    Raises UserError if several bands can have heights, if the raster is a picture or has complex numbers, or if the
    unit of the band is not a length.
    """
    index = _index_of(path, raster, config)
    unit = config.height_unit or _unit_of(path, files, raster, index)
    if str(raster.dtypes[index - 1]).startswith("complex"):
        raise UserError(path, "heights", "complex numbers", "real numbers")
    eight_bits = raster.dtypes[index - 1] in ("uint8", "int8")
    if eight_bits and unit is None and config.band is None and raster.scales[index - 1] == 1:
        expected = f"a band of heights; if these are heights, --set {_FIELD}.band={index}"
        raise UserError(path, "heights", "an 8-bit picture, such as a hillshade", expected)
    metres = None if unit is None else METRES_PER_UNIT[unit]
    return HeightBand(path, raster, index, metres, config.nodata, files.driver == "ISIS3")


def _is_radius(value_m: float) -> bool:
    return _LOWEST_M <= value_m - MOON_RADIUS_M <= _HIGHEST_M


def _index_of(path: Path, raster: Any, config: ElevationConfig) -> int:
    """Number of the band of heights, from 1."""
    from rasterio.enums import ColorInterp

    if config.band is not None:
        if config.band > raster.count:
            raise UserError(path, f"{_FIELD}.band", config.band, f"1 to {raster.count}")
        return config.band
    plain = (ColorInterp.gray, ColorInterp.undefined, ColorInterp.alpha)
    colours = sorted({kind.name for kind in raster.colorinterp if kind not in plain})
    if colours:
        expected = f"an elevation model; if a band has heights, --set {_FIELD}.band=1"
        raise UserError(path, "heights", f"a picture in colours ({', '.join(colours)})", expected)
    bands = [k for k, kind in enumerate(raster.colorinterp, 1) if kind is not ColorInterp.alpha]
    if len(bands) == 1:
        return bands[0]
    names = [raster.descriptions[k - 1] or "" for k in bands]
    named = [k for k, name in zip(bands, names, strict=True) if _HEIGHT.search(name) and not _OTHER.search(name)]
    if len(named) == 1:
        return named[0]
    listed = ", ".join(f"{k} {name}".rstrip() for k, name in list(zip(bands, names, strict=True))[:8])
    raise UserError(path, f"{_FIELD}.band", f"{len(bands)} bands ({listed})", "the number of the band of heights")


def _unit_of(path: Path, files: RasterFiles, raster: Any, index: int) -> str | None:
    """The unit of heights that a file states in the band, in a label, or as vertical unit.

    Returns None if the file states no unit.
    """
    stated = [raster.units[index - 1] or ""]
    if files.driver == "PDS":
        label = label_text(files)
        image = re.search(r"^\s*OBJECT\s*=\s*IMAGE\s*$(.*?)^\s*END_OBJECT\s*=\s*IMAGE\s*$", label, re.S | re.M)
        stated += re.findall(r"^\s*UNIT\s*=\s*[\"'<]?([^\"'>\r\n]+)", image[1] if image else "", re.M)
    elif files.driver == "PDS4":
        stated += re.findall(r"<(?:\w+:)?unit>(.*?)</", label_text(files))
    if raster.crs is not None:
        vertical = re.search(r'VERT(?:_CS|CRS|ICALCRS)\[.*?(?:LENGTH)?UNIT\["([^"]+)"', raster.crs.to_wkt(), re.S)
        stated += [vertical[1]] if vertical else []
    for text in stated:
        name = text.strip().lower()
        if name in ("", "n/a", "none", "unknown", "null"):
            continue
        for unit, pattern in _UNITS.items():
            if re.fullmatch(pattern, name):
                return unit
        expected = f"a unit of length, or the right one: --height-unit {' | '.join(METRES_PER_UNIT)}"
        raise UserError(path, "unit of heights", text.strip(), expected)
    return None
