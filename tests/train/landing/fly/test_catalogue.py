"""Catalogues of a descent by latitude and longitude, against the site's frame."""

import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.train.landing.fly.descent_files import write_descent, write_yaml

from perilune_shared.errors import UserError
from perilune_shared.geometry.curvature import drop_m
from perilune_shared.geometry.frames import selenographic_from_site
from perilune_train.landing.fly.catalogue import CatalogueUse, read_catalogue
from perilune_train.landing.fly.settings import read_prior

SITE = -20.0, 340.0
PLACES = np.array([[0.0, 0.0], [1500.0, -900.0], [-400.0, 20_000.0]])
DIAMETERS_M = np.array([90.0, 140.0, 2000.0])
FORMS = {
    "robbins": "LON_CIRC_IMG LAT_CIRC_IMG DIAM_CIRC_IMG",
    "head": "Lon Lat Diam_km",
    "lroc": "Long Lat Diameter (km)",
}


def _table(form, places=PLACES, diameters_m=DIAMETERS_M, **others):
    lat, lon = selenographic_from_site(*places.T, *SITE)
    names = FORMS[form].split(" ", 2)
    return pa.table(
        {"": range(len(lat)), **dict(zip(names, (lon % 360, lat, diameters_m / 1000), strict=True)), **others}
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_known_catalogues_against_the_frame_of_the_site(tmp_path, form, suffix):
    path = tmp_path / f"craters.{suffix}"
    table = _table(form, height_m=[0.0, 12.5, -30.0])
    table.to_pandas().to_csv(path, index=False) if suffix == "csv" else pq.write_table(table, path)
    found = read_catalogue(path, CatalogueUse(1.0, 0.03, SITE))
    assert found.radius_m.tolist() == [1000, 70, 45]
    assert np.allclose(found.centre_m[:, :2], PLACES[[2, 1, 0]], atol=1e-3)
    expected = np.array([-30, 12.5, 0]) - drop_m(*PLACES[[2, 1, 0]].T)
    assert np.allclose(found.centre_m[:, 2], expected, atol=1e-6)
    assert drop_m(*PLACES[2]) > 100
    assert np.allclose(np.linalg.norm(found.normal, axis=1), 1)
    assert found.normal[2].tolist() == [0, 0, 1]
    assert found.normal[0, 1] == pytest.approx(20_000 / 1_737_400, rel=1e-3)


def test_far_and_repeated_craters_are_left_out_and_counted(tmp_path, capsys):
    path = tmp_path / "craters.parquet"
    places = np.concatenate([PLACES, PLACES[:2], [[900_000.0, 0.0]]])
    pq.write_table(_table("head", places, np.concatenate([DIAMETERS_M, DIAMETERS_M[:2], [5000.0]])), path)
    assert len(read_catalogue(path, CatalogueUse(1.0, 0.03, SITE))) == 3
    assert "craters.parquet: 3 used, 1 farther than 200 km from the site, 2 listed twice" in capsys.readouterr().err
    pq.write_table(_table("head", places[5:], DIAMETERS_M[:1]), path)
    with pytest.raises(UserError, match="craters: got 0 used, 1 farther than 200 km from the site, 0 listed twice"):
        read_catalogue(path, CatalogueUse(1.0, 0.03, SITE))


def test_without_a_site_such_a_catalogue_is_refused(tmp_path):
    pq.write_table(_table("head"), tmp_path / "craters.parquet")
    message = "site: got none, expected site_latitude_deg and site_longitude_deg in prior.yaml"
    with pytest.raises(UserError, match=message):
        read_catalogue(tmp_path / "craters.parquet", CatalogueUse(1.0, 0.03))


def test_the_prior_states_site_and_columns(tmp_path):
    import json

    folder = write_descent(tmp_path / "descent")
    content = json.loads((folder / "prior.yaml").read_text())
    columns = {"longitude_deg": "l", "latitude_deg": "b", "radius_km": "r"}
    content |= {"site_latitude_deg": SITE[0], "site_longitude_deg": SITE[1], "catalogue_columns": columns}
    write_yaml(folder / "prior.yaml", content)
    (folder / "own.csv").write_text("b;l;r\n-20;-20;0.07\n")
    found = read_catalogue(folder / "own.csv", read_prior(folder / "prior.yaml").catalogue_use)
    assert found.radius_m.tolist() == [70]
    assert np.allclose(found.centre_m, 0, atol=1e-6)
    for change, part in (
        ({"site_latitude_deg": None}, "site_latitude_deg and site_longitude_deg, or neither"),
        ({"catalogue_columns": {"longitude_deg": "l"}}, "longitude_deg, latitude_deg and one size"),
    ):
        write_yaml(folder / "prior.yaml", content | change)
        with pytest.raises(UserError, match=re.escape(part)):
            read_prior(folder / "prior.yaml")
