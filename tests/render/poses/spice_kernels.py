"""Small SPICE kernels of a descent over a site, written with spiceypy, and the truth by hand.

The Moon turns about an axis fixed in J2000 at a constant rate. Moon and Sun move along straight lines. The lander moves
along a straight line in O_L. Times are seconds past J2000 TDB.
"""

from pathlib import Path

import numpy as np

from perilune_shared.geometry.frames import matrix_from_quaternion, matrix_from_rotation_vector

DAY_S = 86400.0
T0 = 5.366e8
"""Time of the first frame, 2017; later times have coarser steps, and the Moon turns by 0.5 micrometres in one."""
SPEED_OF_LIGHT_KMPS = 299792.458
LATITUDE, LONGITUDE, HEIGHT_M = -45.5, 177.6, 250.0
"""The site, and its height above the sphere of 1737.4 km."""
RADIUS_M = 1_737_400.0
POLE_RA, POLE_DEC, PM, RATE = 266.0, 65.0, 38.0, 13.17635815
"""Orientation of the Moon at J2000, degrees, and its rate, degrees a day."""
START_M, VELOCITY_MPS = np.array([40.0, -60.0, 400.0]), np.array([-2.0, 3.0, -20.0])
MOON_KM, MOON_KMPS = np.array([1.2e8, 0.8e8, 0.3e8]), np.array([-14.0, 24.0, 9.0])
"""Place and velocity of the Moon at T0, J2000, relative to the solar system's barycentre."""
SUN_KMPS = np.array([6.0, -8.0, 3.0])
CAMERA_FROM_FIXED_WXYZ = np.array([0.1, 0.7, -0.5, 0.3])
LSK = """KPL/LSK
\\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996 1.99096871D-7 )
DELTET/DELTA_AT = ( 37, @2017-JAN-1 )
"""
PCK = f"""KPL/PCK
\\begindata
BODY301_POLE_RA = ( {POLE_RA} 0 0 )
BODY301_POLE_DEC = ( {POLE_DEC} 0 0 )
BODY301_PM = ( {PM} {RATE} 0 )
BODY301_RADII = ( 1737.4 1737.4 1737.4 )
"""
FK = """KPL/FK
\\begindata
NAIF_BODY_NAME += ( 'TEST_LANDER' )
NAIF_BODY_CODE += ( -99 )
FRAME_TEST_CAM = -99001
FRAME_-99001_NAME = 'TEST_CAM'
FRAME_-99001_CLASS = 3
FRAME_-99001_CLASS_ID = -99001
FRAME_-99001_CENTER = -99
CK_-99001_SCLK = -99
CK_-99001_SPK = -99
FRAME_TEST_DOWN = -99002
FRAME_-99002_NAME = 'TEST_DOWN'
FRAME_-99002_CLASS = 4
FRAME_-99002_CLASS_ID = -99002
FRAME_-99002_CENTER = -99
TKFRAME_-99002_SPEC = 'MATRIX'
TKFRAME_-99002_RELATIVE = 'IAU_MOON'
TKFRAME_-99002_MATRIX = ( {matrix} )
"""
SCLK = """KPL/SCLK
\\begindata
SCLK_KERNEL_ID = ( @2026-01-01 )
SCLK_DATA_TYPE_99 = ( 1 )
SCLK01_TIME_SYSTEM_99 = ( 1 )
SCLK01_N_FIELDS_99 = ( 2 )
SCLK01_MODULI_99 = ( 4294967296 1000 )
SCLK01_OFFSETS_99 = ( 0 0 )
SCLK01_OUTPUT_DELIM_99 = ( 1 )
SCLK_PARTITION_START_99 = ( 0.0 )
SCLK_PARTITION_END_99 = ( 4.0E12 )
SCLK01_COEFFICIENTS_99 = ( 0.0 0.0 1.0 )
"""


def turn(axis: int, angle_deg: float) -> np.ndarray:
    """The rotation of a frame about one of its axes."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    rows = [[[1, 0, 0], [0, c, s], [0, -s, c]], [[c, 0, -s], [0, 1, 0], [s, 0, c]], [[c, s, 0], [-s, c, 0], [0, 0, 1]]]
    return np.array(rows[axis])


def fixed_from_j2000(t: float) -> np.ndarray:
    """The rotation from J2000 to the Moon's axes, by the angles of the PCK."""
    return turn(2, PM + RATE * t / DAY_S) @ turn(0, 90 - POLE_DEC) @ turn(2, 90 + POLE_RA)


def site_axes() -> np.ndarray:
    """Unit vectors west, south and up at the site in the Moon's axes, as rows."""
    lat, lon = np.radians([LATITUDE, LONGITUDE])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    return np.stack([-east, -np.cross(up, east), up])


def site_j2000_km(t: float) -> np.ndarray:
    """The site relative to the Moon's centre, J2000."""
    return fixed_from_j2000(t).T @ site_axes()[2] * (RADIUS_M + HEIGHT_M) / 1000


def lander_j2000_km(t: float) -> np.ndarray:
    """The lander relative to the Moon's centre, J2000."""
    place = START_M + VELOCITY_MPS * (t - T0)
    return site_j2000_km(t) + fixed_from_j2000(t).T @ site_axes().T @ place / 1000


def rate_of(place, t: float, step_s: float = 1.0) -> np.ndarray:
    """Derivative of a function of time, by central differences of fourth order."""
    near, far = place(t + step_s) - place(t - step_s), place(t + 2 * step_s) - place(t - 2 * step_s)
    return (8 * near - far) / (12 * step_s)


def sun_truth_deg(t: float, sun_km: np.ndarray) -> tuple[float, float]:
    """Apparent azimuth and elevation of the Sun at the site: light time, then stellar aberration."""
    observer = MOON_KM + MOON_KMPS * (t - T0) + site_j2000_km(t)
    velocity = MOON_KMPS + rate_of(site_j2000_km, t, 100.0)
    delay = 0.0
    for _ in range(5):
        seen = sun_km + SUN_KMPS * (t - delay - T0) - observer
        delay = np.linalg.norm(seen) / SPEED_OF_LIGHT_KMPS
    towards = seen / np.linalg.norm(seen) + velocity / SPEED_OF_LIGHT_KMPS
    west, south, up = site_axes() @ fixed_from_j2000(t) @ (towards / np.linalg.norm(towards))
    return float(np.degrees(np.arctan2(-west, -south)) % 360), float(np.degrees(np.arcsin(up)))


def sun_at_km() -> np.ndarray:
    """A place of the Sun at T0 that is 20 degrees high in the south-east of the site, 1 au away."""
    azimuth, elevation = np.radians([130.0, 20.0])
    east, north = np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation)
    towards = fixed_from_j2000(T0).T @ site_axes().T @ np.array([-east, -north, np.sin(elevation)])
    return MOON_KM + 1.496e8 * towards


def write_kernels(
    folder: Path, duration_s: float = 20.0, sun_km: np.ndarray | None = None, turn_radps: np.ndarray | None = None
) -> Path:
    """Write all kernels into a folder; returns their meta-kernel.

    The camera is at rest in the Moon's axes, without angular velocities in the CK; with `turn_radps` (3,) it turns at
    this rate, in its own axes, and the CK has its angular velocities in J2000.
    """
    import spiceypy

    sun = sun_at_km() if sun_km is None else sun_km
    down = (np.diag([1.0, -1.0, -1.0]) @ site_axes()).T  # IAU_MOON from TEST_DOWN
    texts = {
        "a.tls": LSK,
        "a.tpc": PCK,
        "a.tsc": SCLK,
        "a.tf": FK.format(matrix="\n".join(map(repr, down.T.ravel().tolist()))),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    wide = T0 + np.linspace(-5000, 5000, 5)
    moon = np.array([[*(MOON_KM + MOON_KMPS * (t - T0)), *MOON_KMPS] for t in wide])
    suns = np.array([[*(sun + SUN_KMPS * (t - T0)), *SUN_KMPS] for t in wide])
    times = T0 + np.arange(0.0, duration_s + 0.5)
    lander = np.array([[*lander_j2000_km(t), *rate_of(lander_j2000_km, t)] for t in times])
    handle = spiceypy.spkopn(str(folder / "a.bsp"), "test", 0)
    for body, centre, states, at in ((301, 0, moon, wide), (10, 0, suns, wide), (-99, 301, lander, times)):
        spiceypy.spkw13(handle, body, centre, "J2000", at[0], at[-1], "test", 3, len(at), states, at)
    spiceypy.spkcls(handle)
    ticks = 1000 * times
    fixed = matrix_from_quaternion(CAMERA_FROM_FIXED_WXYZ)
    rate = np.zeros(3) if turn_radps is None else turn_radps
    attitudes = [matrix_from_rotation_vector(-(t - T0) * rate) @ fixed @ fixed_from_j2000(t) for t in times]
    turns = np.array([spiceypy.m2q(attitude) for attitude in attitudes])
    spin = fixed_from_j2000(T0).T @ [0, 0, np.radians(RATE) / DAY_S]
    rates = np.array([attitude.T @ rate + spin for attitude in attitudes])
    handle = spiceypy.ckopn(str(folder / "a.bc"), "test", 0)
    spiceypy.ckw03(
        handle,
        ticks[0],
        ticks[-1],
        -99001,
        "J2000",
        turn_radps is not None,
        "test",
        len(ticks),
        ticks,
        turns,
        rates,
        1,
        ticks[:1],
    )
    spiceypy.ckcls(handle)
    names = [*texts, "a.bsp", "a.bc"]
    listed = ", ".join(f"'$F/{name}'" for name in names)
    (folder / "all.tm").write_text(
        f"KPL/MK\n\\begindata\nPATH_VALUES = ( '{folder}' )\nPATH_SYMBOLS = ( 'F' )\nKERNELS_TO_LOAD = ( {listed} )\n"
    )
    return folder / "all.tm"
