"""What the file of an elevation model says, or leaves open, of its heights: unit, radius, band, fill, projection."""

import hashlib

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy
from tests.helpers.elevation_models import HILLY, MOON, POLAR, hilly, hilly_raster, rough, write
from tests.shared.storage.raster_files import isis_cube, pds3

from perilune_render.config.terrain import ElevationConfig
from perilune_render.terrain.elevation.model import base_heights, height_of_site_m, read_elevation
from perilune_render.terrain.grid import Grid
from perilune_shared.errors import UserError

GRID = Grid.even(500, 50)
SITE = {"site_latitude_deg": -20.0, "site_longitude_deg": 340.0}
PLACED = rasterio.Affine(5, 0, 1e5, 0, -5, 0)
NULL = float(np.float32(-3.4028226550889045e38))
AT = rasterio.Affine(5, 0, -1000, 0, -5, 1000)


def error_m(path, **settings):
    """Largest error of the ground of `hilly` as read from a file, metres, on known ground."""
    model = read_elevation(path, ElevationConfig(**SITE, **settings))
    assert height_of_site_m(model) == pytest.approx(hilly(0, 0), abs=0.3)
    height, beyond = base_heights(model, GRID)
    x, y = GRID.vertices_xy()
    assert np.isfinite(height).all()
    return np.abs(height - hilly(-x, -y) + hilly(0, 0))[beyond == 0].max()


@pytest.mark.parametrize(
    ("metres", "units"),
    [
        (1, "m"),
        (1, "Meters"),
        (1000, "km"),
        (1000, "Kilometre"),
        (0.3048, "ft"),
        (0.3048, "feet"),
        (1200 / 3937, "US survey foot"),
        (0.01, "cm"),
    ],
)
def test_the_unit_of_the_file_is_converted(tmp_path, metres, units):
    assert error_m(hilly_raster(tmp_path / "a.tif", 1 / metres, units=units)) < 0.1


def test_a_unit_of_the_configuration_comes_first(tmp_path):
    assert error_m(hilly_raster(tmp_path / "a.tif", 1e-3, units="m"), height_unit="km") < 0.1
    assert error_m(hilly_raster(tmp_path / "b.tif", 1 / 0.3048), height_unit="ft") < 0.1


def test_a_vertical_unit_of_the_projection_is_converted(tmp_path):
    local = (
        'COMPD_CS["a",{},VERT_CS["h",VERT_DATUM["d",2005],UNIT["foot",0.3048,AUTHORITY["EPSG","9002"]],AXIS["Up",UP]]]'
    )
    wkt = local.format(rasterio.crs.CRS.from_string(HILLY).to_wkt())
    path = hilly_raster(tmp_path / "a.tif", 1 / 0.3048)
    with rasterio.open(path, "r+") as file:
        file.crs = wkt
    assert error_m(path) < 0.1


def test_kilometres_without_a_unit_are_not_taken_for_metres(tmp_path):
    with pytest.raises(UserError, match=r"height_unit: got no unit, and heights that differ by 0\.\d+ over 2 km"):
        read_elevation(hilly_raster(tmp_path / "a.tif", 1e-3))
    assert error_m(tmp_path / "a.tif", height_unit="km") < 0.1
    flat = write(tmp_path / "b.tif", 1e-3 * rough(n=400), POLAR, PLACED)
    assert np.ptp(read_elevation(flat, ElevationConfig(height_unit="m")).height_m) < 1


@pytest.mark.parametrize(("metres", "units"), [(1000, None), (1000, "km"), (1, "m"), (1, None)])
def test_radii_are_heights(tmp_path, metres, units):
    path = hilly_raster(tmp_path / "a.tif", 1 / metres, 1737400 / metres, units=units, dtype="float64", nodata=None)
    assert error_m(path) < 0.1


@pytest.mark.parametrize("units", ["degree", "DN", "seconds of arc", "m/s"])
def test_what_is_no_length_is_refused(tmp_path, units):
    with pytest.raises(UserError, match=r"unit of heights: got .* expected a unit of length"):
        read_elevation(hilly_raster(tmp_path / "a.tif", units=units))


def on_the_map(resolution=6064.0):
    """Heights of `hilly` in a simple cylindrical map about the site, with its corner."""
    longitude = (np.arange(400) + 0.5 - 200) / resolution
    latitude = -20 - (np.arange(400) + 0.5 - 200) / resolution
    east, north = np.meshgrid(longitude, latitude)
    scale = np.radians(1) * 1737400
    # Near the site the sphere is flat to a decimetre of height here.
    return hilly(east * scale * np.cos(np.radians(north)), (north + 20) * scale), (
        -20 + 200 / resolution,
        340 - 200 / resolution,
    )


@pytest.mark.parametrize(
    ("factor", "offset", "unit"),
    [(1.0, 1737.4, "KILOMETER"), (0.5, 1737400.0, "METER"), (1.0, 0.0, '"KM"'), (1, 0, "N/A")],
)
def test_pds3_labels_state_unit_factor_and_offset(tmp_path, factor, offset, unit):
    height, corner = on_the_map()
    radius = 1737400 if offset else 0
    stored = ((height + radius) / (1000 if "K" in unit else 1) - offset) / factor
    more = (f"SCALING_FACTOR = {factor}", f"OFFSET = {offset}", f"UNIT = {unit}", "MISSING_CONSTANT = -1.0e9")
    path = pds3(tmp_path, stored, image=more, corner_deg=corner)
    assert error_m(path) < 0.5
    stored[10:20, 10:20] = -1e9
    assert not read_elevation(pds3(tmp_path, stored, image=more, corner_deg=corner)).known[15, 15]


def test_pds4_labels_state_the_unit(tmp_path):
    height, (north, west) = on_the_map()
    transform = rasterio.Affine(1 / 6064, 0, west, 0, -1 / 6064, north)
    names = ("TITLE", "INVESTIGATION_AREA_NAME", "OBSERVING_SYSTEM_NAME", "TARGET_TYPE", "LOGICAL_IDENTIFIER")
    options = {f"VAR_{name}": "urn:a" for name in names} | {"VAR_TARGET": "Moon"}
    copy(
        write(tmp_path / "a.tif", height / 2000, MOON, transform), label := tmp_path / "a.xml", driver="PDS4", **options
    )
    stated = "<unit>km</unit><scaling_factor>2.0</scaling_factor><value_offset>1737.4</value_offset>"
    label.write_text(label.read_text().replace("</data_type>", f"</data_type>{stated}"))
    assert error_m(label) < 0.5
    before = read_elevation(label).source
    np.fromfile(tmp_path / "a.img", "<f4")[::-1].tofile(tmp_path / "a.img")
    assert read_elevation(label).source != before


MAPPING = """  Group = Mapping
    ProjectionName = Equirectangular
    CenterLongitude = 0.0
    CenterLatitude = 0.0
    TargetName = Moon
    EquatorialRadius = 1737400.0 <meters>
    PolarRadius = 1737400.0 <meters>
    LatitudeType = Planetocentric
    LongitudeDirection = PositiveEast
    LongitudeDomain = 360
    UpperLeftCornerX = {x!r} <meters>
    UpperLeftCornerY = {y!r} <meters>
    PixelResolution = {pixel!r} <meters/pixel>
    Scale = 6064.0 <pixels/degree>
  End_Group
"""


def test_isis_cubes_count_eastwards_and_mark_missing_values(tmp_path):
    height, (north, west) = on_the_map()
    scale = np.radians(1) * 1737400
    stored = height + 1737400.0 - 1737400.0
    stored[10:20, 10:20], stored[30:40, 10:20] = NULL, np.finfo(np.float32).max
    mapping = MAPPING.format(x=west * scale, y=north * scale, pixel=scale / 6064)
    path = isis_cube(tmp_path, stored.astype("f4"), mapping)
    assert error_m(path) < 0.5
    model = read_elevation(path)
    assert (~model.known).sum() == 200 and not model.known[15, 15] and not model.known[35, 15]


@pytest.mark.parametrize("fill", [-9999.0, -32768.0, NULL, 1e20, 65535.0, -np.inf, np.nan])
def test_undeclared_fill_never_becomes_ground(tmp_path, fill):
    height = np.tile(rough(n=200), (2, 2)) - 1500
    height[150:170, 60:90] = fill
    path = write(tmp_path / "a.tif", height, POLAR, PLACED, nodata=None)
    if not np.isfinite(fill):
        model = read_elevation(path)
        assert (~model.known).sum() == 600 and np.isfinite(model.height_m).all()
        return
    with pytest.raises(UserError, match=r"heights: got 600 of 160000 outside .*nodata=") as caught:
        read_elevation(path)
    stated = float(str(caught.value).split("nodata=")[1].split(",")[0])
    model = read_elevation(path, ElevationConfig(nodata=stated))
    assert (~model.known).sum() == 600 and np.abs(model.height_m + 1500).max() < 100


@pytest.mark.parametrize(("fill", "count"), [(0.0, 600), (-9000.0, 8), (0.0, 4)])
def test_isolated_plateaus_are_counted_and_refused(tmp_path, fill, count):
    height = rough(n=300) - 1500
    height[100:200, 100:200].flat[:count] = fill
    path = write(tmp_path / "a.tif", height, POLAR, PLACED, nodata=None)
    with pytest.raises(UserError, match=rf"heights: got {count} of 90000 equal to {fill:g}.*nodata={fill:g}"):
        read_elevation(path)
    assert (~read_elevation(path, ElevationConfig(nodata=fill)).known).sum() == count


def test_stored_integers_name_the_stored_fill(tmp_path):
    stored = np.round((rough(n=300) + 100) * 10)
    stored[100:120, 100:120] = -32768
    path = write(tmp_path / "a.tif", stored, POLAR, PLACED, nodata=None, dtype="int16")
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.1,), (50.0,)
    with pytest.raises(UserError, match=r"got 400 of 90000 .*nodata=-32768$"):
        read_elevation(path)
    assert (~read_elevation(path, ElevationConfig(nodata=-32768)).known).sum() == 400


def ground_without_fill():
    """Ground that looks like fill, but is none: terraces, a mesa, a flat floor, a single peak."""
    terraces = np.round(rough(n=300) / 3) * 3
    mesa = np.zeros((300, 300))
    mesa[100:200, 100:200] = 50
    floor = np.maximum(rough(n=300), -2.0)
    peak = rough(n=300)
    peak[150, 150] += 300
    return {"terraces": terraces, "mesa": mesa, "floor": floor, "peak": peak, "flat": np.zeros((300, 300))}


@pytest.mark.parametrize("name", ground_without_fill())
def test_flat_ground_is_not_taken_for_fill(tmp_path, name):
    path = write(tmp_path / "a.tif", ground_without_fill()[name], POLAR, PLACED, nodata=None)
    assert read_elevation(path).known.all()


def several(path, names, bands):
    path = write(path, np.stack(bands), HILLY, AT, photometric="minisblack")
    with rasterio.open(path, "r+") as file:
        file.descriptions = names
    return path


def test_one_band_of_several_is_chosen_by_name_or_number(tmp_path):
    height, other = (
        hilly(*np.meshgrid(np.arange(-997.5, 1000, 5), np.arange(997.5, -1000, -5))),
        np.full((400, 400), 0.3),
    )
    described = several(tmp_path / "a.tif", ("IntersectionErr", "Height"), [other, height])
    assert error_m(described) < 0.1
    plain = several(tmp_path / "b.tif", (None, None), [other, height])
    with pytest.raises(UserError, match=r"elevation\.band: got 2 bands \(1, 2\), expected the number"):
        read_elevation(plain)
    assert error_m(plain, band=2) < 0.1
    both = several(tmp_path / "c.tif", ("height", "height error"), [height, other])
    assert error_m(both) < 0.1
    with pytest.raises(UserError, match=r"elevation\.band: got 3, expected 1 to 2"):
        read_elevation(both, ElevationConfig(band=3))


def test_pictures_are_refused(tmp_path):
    grey = np.random.default_rng(1).integers(0, 255, (4, 100, 100)).astype("uint8")
    for name, bands, options, text in (
        ("rgba", grey, {"photometric": "rgb", "alpha": "yes"}, "a picture in colours"),
        ("shade", grey[0], {}, "an 8-bit picture"),
    ):
        path = write(tmp_path / f"{name}.tif", bands, POLAR, PLACED, nodata=None, dtype="uint8", **options)
        with pytest.raises(UserError, match=text):
            read_elevation(path)
    assert read_elevation(path, ElevationConfig(band=1)).known.all()
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {0: (1, 2, 3, 255)})
    with pytest.raises(UserError, match="a picture in colours"):
        read_elevation(path)
    path = write(tmp_path / "c.tif", grey[0] + 1j, POLAR, PLACED, nodata=None, dtype="complex64")
    with pytest.raises(UserError, match="complex numbers"):
        read_elevation(path)


def test_a_projection_of_the_configuration(tmp_path):
    height = rough(n=200)
    for crs in (None, "EPSG:3031"):
        path = write(tmp_path / "a.tif", height, crs, PLACED)
        with pytest.raises(UserError, match="projection"):
            read_elevation(path)
        assert read_elevation(path, ElevationConfig(crs=POLAR)).latitude_deg < -86
    for text in ("/etc/passwd", "http://127.0.0.1/a", "a.prj", "EPSG:4326; x"):
        with pytest.raises(ValueError, match="crs"):
            ElevationConfig(crs=text)
    with pytest.raises(UserError, match="nadgrids, which names a file"):
        read_elevation(path, ElevationConfig(crs="+proj=longlat +R=1737400 +nadgrids=/etc/passwd"))
    with pytest.raises(UserError, match=r"elevation\.crs: got"):
        read_elevation(path, ElevationConfig(crs="+proj=nothing +R=1737400"))


def test_a_projection_beside_the_file_is_named_and_not_read(tmp_path):
    path = write(tmp_path / "a.tif", rough(n=200), None, PLACED)
    (tmp_path / "a.tif.aux.xml").write_text("<PAMDataset><SRS>x</SRS></PAMDataset>")
    with pytest.raises(UserError, match=r"projection: got none, expected .*a\.tif\.aux\.xml is not read"):
        read_elevation(path)


def test_every_file_of_a_model_is_in_its_hash(tmp_path):
    height, corner = on_the_map()
    path = pds3(tmp_path, height, corner_deg=corner)
    before = read_elevation(path).source
    data = tmp_path / "ground.IMG"
    data.write_bytes(data.read_bytes()[:-4] + np.float32(-1490).tobytes())
    assert read_elevation(path).source != before
    tiff = write(tmp_path / "a.tif", rough(), POLAR, PLACED)
    own = f"a.tif sha256:{hashlib.sha256(tiff.read_bytes()).hexdigest()}"
    assert read_elevation(tiff).source == own
    # GDAL reads a world file only if the raster has no place of its own.
    (tmp_path / "a.tfw").write_text("5\n0\n0\n-5\n2.5\n2.5\n")
    assert read_elevation(tiff).source == own
