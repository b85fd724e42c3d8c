"""Elevation models through the command line: units, seams, what is refused, and what is hashed."""

import contextlib
import re

import cv2
import numpy as np
import pytest
import rasterio
from tests.helpers import in_process
from tests.helpers.elevation_models import HILLY, POLAR, hilly, hilly_raster, moon_raster, rough, smooth_moon, write
from tests.helpers.scenes import config_with

from perilune_render.cli.main import main
from perilune_render.config.terrain import ElevationConfig
from perilune_render.flight.view import view_envelope
from perilune_render.provenance.recipe import recorded_settings
from perilune_render.terrain import cache
from perilune_render.terrain.elevation.model import read_elevation, remarks
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import grow_scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import selenographic_from_site

SMALL = ["--preset=tiny", "--kind=detect", "--set=dataset.camera.width_px=32", "--set=dataset.camera.height_px=32"]
SMALL += ["--set=dataset.terrain.spacing_px=4", "--set=dataset.render.engine=heightfield"]
BARE = ["--set=dataset.terrain.relief.rms_slope_deg.low=0", "--set=dataset.terrain.relief.rms_slope_deg.high=0"]
BARE += ["--set=dataset.terrain.craters.min_diameter_spacings=1000"]


def site(latitude, longitude):
    place = {"site_latitude_deg": latitude, "site_longitude_deg": longitude}
    return [f"--set=dataset.terrain.elevation.{name}={value}" for name, value in place.items()]


def exported(tmp_path, *arguments):
    """Heights of the exported ground, and its pixels' places east and north of the site, metres."""
    out = tmp_path / "ground.tif"
    done = in_process.call(main, "ground", *SMALL, *BARE, *arguments, "--pixel-m", "20", "--out", out)
    assert done.returncode == 0, done.stderr
    with rasterio.open(out) as file:
        height, n = file.read(1), file.width
    side = (np.arange(n) + 0.5 - n / 2) * 20
    return height, *np.meshgrid(side, -side)


def refused(tmp_path, *arguments):
    """The one line of error of an export."""
    done = in_process.call(main, "ground", *SMALL, *arguments, "--out", tmp_path / "ground.tif")
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error")]
    assert done.returncode == 2 and "Traceback" not in done.stderr and not (tmp_path / "ground.tif").exists()
    return line


def test_the_unit_is_an_option(tmp_path):
    dem = hilly_raster(tmp_path / "a.tif", 1e-3)
    line = refused(tmp_path, "--dem", dem)
    assert "got no unit" in line and "--height-unit km" in line
    height, east, north = exported(tmp_path, "--dem", dem, "--height-unit", "km")
    near = np.hypot(east, north) < 700
    assert np.abs(height - hilly(east, north) + hilly(0, 0))[near].max() < 12


@pytest.mark.parametrize("longitude", [180.0, -179.99, 179.9])
def test_ground_at_the_seam_of_a_map_of_the_moon(tmp_path, longitude):
    dem = moon_raster(
        tmp_path / "a.tif", "+proj=longlat +R=1737400", rasterio.Affine(0.5, 0, -180, 0, -0.5, 90), (360, 720)
    )
    height, east, north = exported(tmp_path, "--dem", dem, *site(-20.0, longitude))
    there = smooth_moon(*selenographic_from_site(-east, -north, -20.0, longitude))
    assert np.abs(height - there + smooth_moon(-20.0, longitude)).max() < 2


def test_a_model_without_heights_in_view_is_an_error_unless_asked_for(tmp_path):
    height = rough(n=200)
    height[20:180, 20:180] = -9999
    dem = write(tmp_path / "a.tif", height, POLAR, rasterio.Affine(40, 0, 1e5, 0, -40, 0))
    line = refused(tmp_path, "--dem", dem)
    assert "no height within" in line and "allow_unseen=true" in line
    done = in_process.call(
        main,
        "preview",
        *SMALL,
        "--dem",
        dem,
        "--set=dataset.terrain.elevation.allow_unseen=true",
        "--out",
        tmp_path / "p.png",
    )
    assert done.returncode == 0 and "0% of the ground" in " ".join(done.stderr.split())
    assert "Mean of empty" not in done.stderr
    assert cv2.imread(str(tmp_path / "p-map.png")).std() > 10


def test_almost_all_is_not_all(tmp_path):
    height = rough(n=800)
    height[5:9, 5:9] = -9999
    height[300:306, 300:306] = -9999
    dem = write(tmp_path / "a.tif", height, POLAR, rasterio.Affine(5, 0, 1e5, 0, -5, 0))
    (line,) = remarks(read_elevation(dem), Grid.even(1900, 10), "procedural")
    assert re.search(r": 99\.9\d% of the ground, 3800 m x 3800 m, is real, the rest procedural$", line)
    height[:] = -9999
    height[396:404, 396:404] = 5
    write(dem, height, POLAR, rasterio.Affine(5, 0, 1e5, 0, -5, 0))
    (line,) = remarks(read_elevation(dem), Grid.even(1900, 10), "procedural")
    assert re.search(r": 0\.0[1-9]% of the ground", line)


def test_the_settings_of_a_file_need_a_file(tmp_path):
    for setting in (
        "height_unit=km",
        "band=1",
        "nodata=0",
        "crs=EPSG:4326",
        "allow_unseen=true",
        "vrt_files=[a.tif]",
        "citation=x",
    ):
        line = refused(tmp_path, f"--set=dataset.terrain.elevation.{setting}")
        assert f"elevation.{setting.split('=')[0]}: got" in line and "--dem, an elevation model" in line
    assert "height_unit" in refused(tmp_path, "--set=dataset.terrain.elevation.height_unit=mile")


def test_a_recipe_records_only_settings_that_were_made():
    plain = recorded_settings(config_with(), "detect")["terrain"]["elevation"]
    assert set(plain) == {"outside"}
    made = config_with(terrain={"dem": "a.tif", "elevation": {"height_unit": "km", "nodata": 0.0, "citation": "PDS"}})
    recorded = recorded_settings(made, "detect")["terrain"]["elevation"]
    assert recorded == {"outside": "procedural", "height_unit": "km", "nodata": 0.0, "citation": "PDS"}


def vrt(folder):
    """Two tiles and the VRT that joins them."""
    height = rough(n=400) - 1000
    for k in (0, 1):
        half = height[:, 200 * k : 200 * k + 200]
        write(folder / f"{k}.tif", half, HILLY, rasterio.Affine(5, 0, -1000 + 1000 * k, 0, -5, 1000))
    sources = "".join(
        f'<ComplexSource><SourceFilename relativeToVRT="1">{k}.tif</SourceFilename><SourceBand>1</SourceBand>'
        f'<SrcRect xOff="0" yOff="0" xSize="200" ySize="400"/>'
        f'<DstRect xOff="{200 * k}" yOff="0" xSize="200" ySize="400"/>'
        "<NODATA>-9999</NODATA></ComplexSource>"
        for k in (0, 1)
    )
    crs = rasterio.crs.CRS.from_string(HILLY).to_wkt().replace('"', "&quot;")
    (folder / "all.vrt").write_text(
        f'<VRTDataset rasterXSize="400" rasterYSize="400"><SRS>{crs}</SRS>'
        "<GeoTransform>-1000, 5, 0, 1000, 0, -5</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><NoDataValue>-9999</NoDataValue>'
        f"{sources}</VRTRasterBand></VRTDataset>"
    )
    return folder / "all.vrt", height


def test_a_tile_that_changes_changes_source_and_cache(tmp_path, camera):
    path, height = vrt(tmp_path)
    with pytest.raises(UserError, match="XML text"):
        read_elevation(path)
    elevation = {"vrt_files": ["0.tif", "1.tif"]}
    config = config_with(terrain={"dem": str(path), "elevation": elevation})
    view = view_envelope(camera, config.detect.flight)
    before = read_elevation(path, ElevationConfig(**elevation))
    assert np.allclose(before.height_m, height, atol=1e-3)
    key = cache.scene_key(config, view, 1)
    with rasterio.open(tmp_path / "1.tif", "r+") as file:
        file.write(file.read() + np.float32(1))
    assert read_elevation(path, ElevationConfig(**elevation)).source != before.source
    assert cache.scene_key(config, view, 1) != key


def test_no_ground_of_a_bad_model_is_not_finite(camera, tmp_path):
    """Heights at the limits of what is accepted, with holes and infinities, give finite ground."""
    rng = np.random.default_rng(3)
    for k in range(6):
        height = rng.uniform(-9000, 10000, (60, 60))
        height[rng.random(height.shape) < 0.3] = rng.choice([np.nan, np.inf, -np.inf, -9999])
        path = write(tmp_path / f"{k}.tif", height, POLAR, rasterio.Affine(20, 0, 1e5, 0, -20, 0), dtype="float64")
        config = config_with(terrain={"dem": str(path), "spacing_px": 4.0})
        with contextlib.suppress(UserError):
            scene = grow_scene(config, view_envelope(camera, config.detect.flight), k)
            assert np.isfinite(scene.height_m).all() and np.isfinite(scene.boulder_z_m).all()
