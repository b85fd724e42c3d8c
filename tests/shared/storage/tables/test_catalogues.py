"""Columns of crater catalogues, and craters that are listed twice."""

from pathlib import Path

import numpy as np
import pytest

from perilune_shared.errors import UserError
from perilune_shared.storage.tables.catalogues import duplicates, read_craters, recognised

HEADERS = {
    "longitude_deg,latitude_deg,diameter_m,diameter_km": ("longitude_deg", "latitude_deg", "diameter_m", "diameter_m"),
    "LAT,LON,D [km]": ("LON", "LAT", "diameter_km", "D [km]"),
    "Latitude (deg N),Longitude (deg E),Diameter km": (
        "Longitude (deg E)",
        "Latitude (deg N)",
        "diameter_km",
        "Diameter km",
    ),
    "lat,lon,rad_km,diam_m": ("lon", "lat", "diameter_m", "diam_m"),
    "lat,long,Radius(m)": ("long", "lat", "radius_m", "Radius(m)"),
}


@pytest.mark.parametrize("header", HEADERS)
def test_columns_are_recognised_by_name_and_unit(header):
    longitude, latitude, size, column = HEADERS[header]
    found = recognised(Path("c.csv"), "columns", header.split(","))
    assert found == {"longitude_deg": longitude, "latitude_deg": latitude, size: column}


@pytest.mark.parametrize(
    "header",
    ["lat,lon,diam", "Lat,Latitude,lon,diam_km", "lat,lon,diam_km,d_m", "lat,diam_km", "x,y,z", "Lon W,lat,d_m"],
)
def test_columns_that_may_mean_something_else_are_refused(header):
    with pytest.raises(UserError, match=r"c.csv: columns: got columns .*; setting can state which columns these are"):
        recognised(Path("c.csv"), "setting", header.split(","))


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ("400,0,1", "c.csv:3: lon: got 400.0, expected a number from -180 to 360"),
        ("0,91,1", "c.csv:3: lat: got 91.0, expected a number from -90 to 90"),
        ("0,0,0", "c.csv:3: d_km: got 0.0, expected a number above 0, at most 10000"),
        ("0,0,10001", "c.csv:3: d_km: got 10001.0, expected a number from 0 to 10000"),
        ("0,0,inf", "c.csv:3: d_km: got inf, expected a number from 0 to 10000"),
        ("0,,1", "c.csv:3: lat: got nothing, expected a number from -90 to 90"),
        ("0,x,1", "c.csv:3: lat: got x, expected a number"),
    ],
)
def test_a_value_out_of_range_is_refused(tmp_path, row, fault):
    path = tmp_path / "c.csv"
    path.write_text(f"lon,lat,d_km\n1,2,3\n{row}\n")
    with pytest.raises(UserError) as caught:
        read_craters(path, "columns")
    assert str(caught.value).endswith(fault)


def test_duplicates_by_brute_force():
    rng = np.random.default_rng(5)
    x, y = rng.uniform(0, 1000, (2, 400))
    diameter = 10 ** rng.uniform(0, 2.5, 400)
    x, y, diameter = (np.concatenate([values, values[:80]]) for values in (x, y, diameter))
    x[400:] += rng.uniform(-0.08, 0.08, 80) * diameter[400:]
    diameter[400:] *= rng.uniform(0.88, 1.12, 80)
    expected = np.zeros(480, bool)
    for second in range(480):
        larger = np.maximum(diameter[:second], diameter[second])
        near = np.hypot(x[:second] - x[second], y[:second] - y[second]) <= 0.05 * larger
        expected[second] = (near & (np.abs(diameter[:second] - diameter[second]) <= 0.1 * larger)).any()
    assert 20 < expected.sum() < 80
    assert np.array_equal(duplicates(x, y, diameter), expected)
    assert duplicates(x[:0], y[:0], diameter[:0]).shape == (0,)
