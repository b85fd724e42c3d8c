"""Suns from SPICE kernels against NASA's table for the Apollo sites, and the highest Sun against an ephemeris.

The kernels are written here: the ephemeris is ERFA's (Earth: Simon and Bretagnon, Moon: Meeus), the orientation of the
Moon is the rotation of the IAU's report (Archinal et al. 2011, doi 10.1007/s10569-010-9320-4).
"""

import numpy as np
import pytest

from perilune_render.cli.sun import highest_sun_deg
from perilune_render.poses.spice import SpiceSource, read_spice

erfa = pytest.importorskip("erfa")
spiceypy = pytest.importorskip("spiceypy")

AU_KM, DAY_S, J2000 = 149_597_870.7, 86_400.0, 2_451_545.0
PCK = r"""KPL/PCK
\begindata
BODY301_POLE_RA = ( 269.9949 0.0031 0 )
BODY301_POLE_DEC = ( 66.5392 0.0130 0 )
BODY301_PM = ( 38.3213 13.17635815 -1.4D-12 )
BODY301_LONG_AXIS = ( 0 )
BODY3_NUT_PREC_ANGLES = (
  125.045 -1935.5364525    250.089 -3871.072905    260.008 475263.3328725  176.625 487269.629985
  357.529 35999.0509575    311.589 964468.49931    134.963 477198.869325   276.617 12006.300765
  34.226 63863.5132425     15.134 -5806.6093575    119.743 131.84064       239.961 6003.1503825
  25.053 473327.79642 )
BODY301_NUT_PREC_RA = ( -3.8787 -0.1204 0.07 -0.0172 0 0.0072 0 0 0 -0.0052 0 0 0.0043 )
BODY301_NUT_PREC_DEC = ( 1.5419 0.0239 -0.0278 0.0068 0 -0.0029 0.0009 0 0 0.0008 0 0 -0.0009 )
BODY301_NUT_PREC_PM = (
  3.5610 0.1208 -0.0642 0.0158 0.0252 -0.0066 -0.0047 -0.0046 0.0028 0.0052 0.0040 0.0019 -0.0044 )
BODY301_RADII = ( 1737.4 1737.4 1737.4 )
"""
LSK = r"""KPL/LSK
\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996 1.99096871D-7 )
DELTET/DELTA_AT = ( 8, @1969-JAN-1 )
"""
PUBLISHED = {
    (0.6875, 23.4333): (
        ("1969-07-20T20:17:39", 10.65, 88.81),
        ("1969-07-21T02:39:33", 13.84, 88.84),
        ("1969-07-21T05:11:13", 15.17, 88.85),
        ("1969-07-21T17:54:00", 21.65, 88.91),
    ),
    (-3.1975, -23.3856): (
        ("1969-11-19T06:54:36", 5.19, 91.16),
        ("1969-11-19T11:32:35", 7.52, 91.03),
        ("1969-11-20T03:54:45", 15.79, 90.60),
        ("1969-11-20T07:44:00", 17.72, 90.51),
        ("1969-11-20T14:25:47", 21.11, 90.33),
    ),
}
"""UTC, elevation and azimuth of the Sun at Apollo 11 and 12 (latitude, longitude), degrees: Apollo Lunar Surface
Journal, "Sun and Earth: Altitudes and Azimuths at the Apollo Landing Sites", by Fjeld and Scotti. A sixth instant of
Apollo 12 is left out: its azimuth does not lie between its neighbours."""


def places(et):
    """Position and velocity (6,) of the Sun and of the Moon relative to the solar system's barycentre, km, km/s."""
    from_sun, from_centre = erfa.epv00(J2000, et / DAY_S)
    moon = erfa.moon98(J2000, et / DAY_S)
    earth, sun = as_km(from_centre), as_km(from_centre) - as_km(from_sun)
    return sun, earth + as_km(moon)


def as_km(state):
    return np.concatenate([state["p"] * AU_KM, state["v"] * AU_KM / DAY_S])


@pytest.fixture(scope="module")
def kernels(tmp_path_factory):
    folder = tmp_path_factory.mktemp("suns")
    (folder / "a.tls").write_text(LSK)
    (folder / "a.tpc").write_text(PCK)
    handle = spiceypy.spkopn(str(folder / "a.bsp"), "test", 0)
    for first in (-961_300_000.0, -950_800_000.0):  # 1969-07-16 and 1969-11-15, for eight days each
        times = first + np.arange(0.0, 8 * DAY_S, 0.125 * DAY_S)
        for body, states in zip(
            (10, 301), np.ascontiguousarray(np.swapaxes([places(et) for et in times], 0, 1)), strict=True
        ):
            spiceypy.spkw13(handle, body, 0, "J2000", times[0], times[-1], "test", 7, len(times), states, times)
    spiceypy.spkcls(handle)
    return tuple(folder / name for name in ("a.tls", "a.tpc", "a.bsp"))


@pytest.mark.parametrize("site", PUBLISHED, ids=("apollo-11", "apollo-12"))
def test_suns_of_the_apollo_sites_are_the_published_ones(kernels, site):
    for utc, elevation_deg, azimuth_deg in PUBLISHED[site]:
        source = SpiceSource(kernels, "MOON", "IAU_MOON", "x,y,z", "IAU_MOON", utc, utc, 1, None)
        ((found_azimuth_deg, found_elevation_deg),) = read_spice(source, *site, 0.0).sun_deg
        assert found_elevation_deg == pytest.approx(elevation_deg, abs=0.07), utc
        assert found_azimuth_deg == pytest.approx(azimuth_deg, abs=0.03), utc


def test_the_sun_stays_within_the_stated_latitude(kernels):
    """Fifty years, which have more than two periods of the Moon's node."""
    spiceypy.furnsh(str(kernels[1]))
    try:
        latitudes_deg = []
        for day in range(0, 50 * 365):
            sun, moon = places(day * DAY_S)
            towards = spiceypy.pxform("J2000", "IAU_MOON", day * DAY_S)[2] @ (sun - moon)[:3]
            latitudes_deg.append(np.degrees(np.arcsin(towards / np.linalg.norm((sun - moon)[:3]))))
    finally:
        spiceypy.unload(str(kernels[1]))
    stated_deg = highest_sun_deg(-90.0)
    assert stated_deg - 0.01 < np.max(latitudes_deg) < stated_deg
    assert stated_deg - 0.01 < -np.min(latitudes_deg) < stated_deg
