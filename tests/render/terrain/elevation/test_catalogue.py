import dataclasses
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import rasterio
from tests.helpers.elevation_models import POLAR, write
from tests.helpers.scenes import config_with

from perilune_render.flight.view import view_envelope
from perilune_render.terrain.craters.population import ORIGINS
from perilune_render.terrain.elevation.catalogue import read_catalogue
from perilune_render.terrain.elevation.model import raster_places, read_elevation
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import grow_scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import selenographic_from_site

PIXEL_M = 5.0
CRATERS = [(120.0, -80.0, 160.0), (-200.0, 150.0, 90.0)]
GRID = Grid.even(900, 90)
TERRAIN = config_with().terrain


@pytest.fixture
def model(tmp_path):
    """An elevation model near the south pole with two bowls at known places of its site's frame."""
    flat = read_elevation(write(tmp_path / "flat.tif", np.zeros((400, 400)), POLAR, placed()))
    column, row = np.meshgrid(np.arange(400) + 0.5, np.arange(400) + 0.5)
    east, north = placed() @ (column, row)
    lon, lat = rasterio.warp.transform(POLAR, "+proj=longlat +R=1737400", east.ravel(), north.ravel())
    from perilune_shared.geometry.frames import site_from_selenographic

    x, y = site_from_selenographic(lat, lon, flat.latitude_deg, flat.longitude_deg)
    height = np.zeros(400 * 400)
    for cx, cy, d in CRATERS:
        r = np.hypot(x - cx, y - cy) / (d / 2)
        height += d * np.where(r < 1, -0.12 * (1 - r**2), 0) + d * 0.03 * np.exp(-(((r - 1) / 0.2) ** 2))
    return read_elevation(write(tmp_path / "a.tif", height.reshape(400, 400), POLAR, placed()))


def placed():
    return rasterio.Affine(PIXEL_M, 0, 30_000, 0, -PIXEL_M, 12_000)


def written(path, model, rows, header="longitude_deg,latitude_deg,diameter_m,name"):
    lines = [header]
    for x, y, diameter in rows:
        latitude, longitude = selenographic_from_site(x, y, model.latitude_deg, model.longitude_deg)
        lines.append(f"{longitude:.8f}, {latitude:.8f}, {diameter}, crater")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_places_and_sizes_come_back_largest_first(tmp_path, model):
    rows = [*CRATERS[::-1], (5000.0, 0.0, 300.0)]
    craters = read_catalogue(written(tmp_path / "c.csv", model, rows), model, GRID, TERRAIN).craters
    assert np.allclose(np.stack([craters.x_m, craters.y_m, craters.diameter_m], axis=1), CRATERS, atol=0.05)
    assert [ORIGINS[k] for k in craters.origin] == ["elevation model"] * 2 and np.isnan(craters.age_myr).all()


def test_only_what_the_model_itself_shows_is_taken(tmp_path, model):
    # Below what it resolves; on a hole; beyond the raster, where the ground is invented; with a rim off the grid.
    unfit = [(50.0, 60.0, 15.0), (300.0, 300.0, 80.0), (-1100.0, 0.0, 150.0), (0.0, 870.0, 100.0)]
    holed = dataclasses.replace(model, known=model.known.copy())
    column, row = raster_places(model, np.array([300.0]), np.array([300.0]))
    holed.known[int(row[0]), int(column[0])] = False
    path = written(tmp_path / "c.csv", model, [*CRATERS, *unfit])
    wide = read_catalogue(path, holed, Grid.even(1500, 90), TERRAIN)
    assert len(wide.craters) == 3
    assert str(wide.counts) == "3 used, 2 outside the model or in its holes, 1 too small for the model"
    assert str(read_catalogue(path, holed, GRID, TERRAIN).counts).startswith("2 used, 2 outside the ground")


def test_real_craters_are_measured_on_the_model_and_kept_beside_ours(tmp_path, model, camera):
    path = written(tmp_path / "c.csv", model, CRATERS)
    config = config_with(
        terrain={
            "dem": str(tmp_path / "a.tif"),
            "catalogue": str(path),
            "spacing_px": 1.0,
            "boulders": {"density": 0.0},
        }
    )
    scene = grow_scene(config, view_envelope(camera, config.detect.flight), 1)
    real = scene.craters.origin == ORIGINS.index("elevation model")
    assert real.sum() == 2 and len(scene.craters) > 100
    assert np.allclose(scene.rims.depth_m[real] / scene.craters.diameter_m[real], 0.14, atol=0.03)
    inside = ~real & (np.hypot(scene.craters.x_m, scene.craters.y_m) < 1000)
    assert (scene.craters.diameter_m[inside] <= 4 * PIXEL_M * 1.01).all()
    without = grow_scene(
        config.model_copy(update={"terrain": config.terrain.model_copy(update={"catalogue": None})}),
        view_envelope(camera, config.detect.flight),
        1,
    )
    # A catalogue names what is there: it changes no height.
    assert np.array_equal(scene.height_m, without.height_m)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (None, "no such file"),
        ("", "columns: got columns none, expected longitude_deg, latitude_deg and diameter_m"),
        ("lon,lat,d\n1,2,3\n", "columns: got columns lon, lat, d, expected a diameter or radius with its unit"),
        ("longitude_deg,latitude_deg,diameter_m\n1,2,3\n1,95,3\n", "c.csv:3: latitude_deg: got 95"),
        ("longitude_deg,latitude_deg,diameter_m\n1,2,nan\n", "c.csv:2: diameter_m: got nothing"),
        ("longitude_deg,latitude_deg,diameter_m\n1,2,\n", "c.csv:2: diameter_m: got nothing"),
        ("longitude_deg,latitude_deg,diameter_m\n1,2,-5\n", "c.csv:2: diameter_m: got -5.0"),
    ],
)
def test_faults_are_reported_with_their_line(tmp_path, model, text, part):
    path = tmp_path / "c.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=re.escape(part)):
        read_catalogue(path, model, GRID, TERRAIN)


FORMS = {
    "perilune": ("longitude_deg,latitude_deg,diameter_m", "{lon},{lat},{m}"),
    "kilometres": ("longitude_deg,latitude_deg,diameter_km", "{lon},{lat},{km}"),
    "spaces in the header": ("longitude_deg , latitude_deg , diameter_m", "{lon} , {lat} , {m}"),
    "Robbins 2018": (
        "CRATER_ID,LAT_CIRC_IMG,LON_CIRC_IMG,LAT_ELLI_IMG,LON_ELLI_IMG,DIAM_CIRC_IMG,DIAM_CIRC_SD_IMG",
        "00-1-000001,{lat},{lon360},,,{km},0.002",
    ),
    "Head et al. 2010": ("Lon,Lat,Diam_km", "{lon},{lat},{km}"),
    "Povilaitis et al. 2018": ("x_coord,y_coord,Diam_km,tag", "{lon},{lat},{km},standard"),
    "LROCCraters.csv of DeepMoon": (",Unnamed: 0,Diameter (km),Long,Lat,tag", "0,0,{km},{lon},{lat},?"),
    "craterpy": ("Diameter (km),Latitude,Longitude", "{km},{lat},{lon}"),
    "craterpy, radius": ("lat,lon,rad_m", "{lat},{lon360},{radius}"),
    "gazetteer of the IAU": (
        "Feature_Name\tDiameter\tCenter_Latitude\tCenter_Longitude",
        "B\udcfcrg\t{km}\t{lat}\t{lon360}",
    ),
}


def _in_form(path, model, rows, form, end="\n"):
    header, row = FORMS[form]
    lines = [header]
    for x, y, d in rows:
        lat, lon = selenographic_from_site(x, y, model.latitude_deg, model.longitude_deg)
        values = {"lat": f"{lat:.8f}", "lon": f"{lon:.8f}", "lon360": f"{lon % 360:.8f}"}
        lines.append(row.format(**values, m=d, km=d / 1000, radius=d / 2))
    path.write_bytes((end.join(lines) + end).encode("utf-8", "surrogateescape"))
    return path


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_known_catalogues_are_read_as_they_come(tmp_path, model, form, end):
    found = read_catalogue(_in_form(tmp_path / "c.csv", model, CRATERS, form, end), model, GRID, TERRAIN)
    craters = found.craters
    assert np.allclose(np.stack([craters.x_m, craters.y_m, craters.diameter_m], axis=1), CRATERS, atol=0.05)


def test_a_catalogue_in_parquet(tmp_path, model):
    lat, lon = selenographic_from_site(*np.array(CRATERS).T[:2], model.latitude_deg, model.longitude_deg)
    sizes = [d / 1000 for _, _, d in CRATERS]
    pq.write_table(pa.table({"Lat": lat, "Lon": lon, "Diam_km": sizes, "name": ["a", "b"]}), tmp_path / "c.parquet")
    found = read_catalogue(tmp_path / "c.parquet", model, GRID, TERRAIN).craters
    assert np.allclose(np.stack([found.x_m, found.y_m, found.diameter_m], axis=1), CRATERS, atol=0.05)


def test_columns_of_another_catalogue_are_stated(tmp_path, model):
    FORMS["other"] = ("breadth,length,size", "{lat},{lon},{km}")
    path = _in_form(tmp_path / "c.csv", model, CRATERS, "other")
    del FORMS["other"]
    columns = {"longitude_deg": "length", "latitude_deg": "breadth", "diameter_km": "size"}
    stated = config_with(terrain={"elevation": {"catalogue_columns": columns}}).terrain
    assert read_catalogue(path, model, GRID, stated).craters.diameter_m.tolist() == [160, 90]
    columns["diameter_km"] = "wide"
    stated = config_with(terrain={"elevation": {"catalogue_columns": columns}}).terrain
    with pytest.raises(UserError, match="catalogue_columns: got no column wide, expected columns of breadth, len"):
        read_catalogue(path, model, GRID, stated)
    del columns["diameter_km"]
    with pytest.raises(ValueError, match="longitude_deg, latitude_deg and one of diameter_m"):
        config_with(terrain={"elevation": {"catalogue_columns": columns}})


def test_repeated_craters_are_used_once(tmp_path, model):
    slightly = [(x + 1, y - 1, d * 1.02) for x, y, d in CRATERS]
    concentric = [(*CRATERS[0][:2], 70.0)]
    path = written(tmp_path / "c.csv", model, [*CRATERS, *CRATERS, *slightly, *concentric])
    found = read_catalogue(path, model, GRID, TERRAIN)
    assert np.allclose(found.craters.diameter_m, [160, 90, 70])
    assert str(found.counts) == "3 used, 4 listed twice"


@pytest.mark.parametrize(
    ("rows", "part"),
    [
        ([], "craters: got no row, expected at least one crater of more than 20 m"),
        ([(5000.0, 0.0, 90.0)], "craters: got 0 used, 1 outside the ground, expected at least one crater"),
        (
            [(x, y, d / 1000) for x, y, d in CRATERS],
            "got 0 used, 2 too small for the model, expected at least one crater of more than 20 m with its rim on the "
            "ground; the largest of diameter_m is 0.16 m: state kilometres with "
            "dataset.terrain.elevation.catalogue_columns",
        ),
    ],
)
def test_a_catalogue_without_a_usable_crater_is_refused(tmp_path, model, rows, part):
    with pytest.raises(UserError, match=re.escape(part)):
        read_catalogue(written(tmp_path / "c.csv", model, rows), model, GRID, TERRAIN)
