"""Predictions: what is written, in which coordinates, and that a fault leaves nothing."""

import json

import cv2
import numpy as np
import pandas as pd
import pytest
import rasterio
from pyproj import Transformer
from rasterio.crs import CRS
from rasterio.transform import from_origin
from tests.helpers.stored_run import THRESHOLD, settings_of, store_run
from typer.testing import CliRunner

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M
from perilune_train.cli.main import app
from perilune_train.detect.ellipses import correlations_of
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.evaluate.split_evaluation import ELLIPSE_COLUMNS
from perilune_train.detect.images.georeference import MOON_CRS, features, read_georeference
from perilune_train.detect.images.predict import PredictSettings, predict_images
from perilune_train.detect.inference.tiling import Tiling

EARTH = CRS.from_epsg(4326)
POLAR = CRS.from_proj4(f"+proj=stere +lat_0=-90 +R={MOON_RADIUS_M:.0f} +units=m +no_defs")
LONGITUDES = CRS.from_proj4(f"+proj=longlat +R={MOON_RADIUS_M:.0f} +no_defs")
COLUMNS = ["image", "x0_px", "y0_px", "x1_px", "y1_px", "centre_x_px", "centre_y_px", "radius_px", "score"]
COLUMNS += [*ELLIPSE_COLUMNS, "suspect", "novelty"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return store_run(tmp_path_factory.mktemp("runs"))


def noise(height, width):
    return np.random.default_rng(5).integers(0, 256, (height, width), np.uint8)


def geotiff(path, crs, transform, height=90, width=130):
    with rasterio.open(
        path, "w", driver="GTiff", height=height, width=width, count=1, dtype="uint8", crs=crs, transform=transform
    ) as image:
        image.write(noise(height, width), 1)
    return path


def test_everything_is_written(run, tmp_path):
    paths = [geotiff(tmp_path / "g.tif", POLAR, from_origin(1000, 3000, 2, 2)), tmp_path / "a.png", tmp_path / "b.jpg"]
    for path in paths[1:]:
        assert cv2.imwrite(str(path), noise(70, 300))
    count = predict_images(
        paths, run, settings_of(run), tmp_path / "out", PredictSettings(Tiling(tile_px=96, overlap_px=32))
    )
    names = ["a.png.overlay.png", "b.jpg.overlay.png", "detections.csv", "detections.geojson", "detections.parquet"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [*names, "g.tif.overlay.png"]
    table = pd.read_parquet(tmp_path / "out" / "detections.parquet")
    assert list(table.columns) == COLUMNS
    assert len(table) == count and set(table["image"]) == {"g.tif", "a.png", "b.jpg"}
    assert (table["score"] >= THRESHOLD).all()
    values = {name: table[name].to_numpy() for name in COLUMNS[1:]}
    assert values["centre_x_px"] == pytest.approx((values["x0_px"] + values["x1_px"]) / 2)
    area = (values["x1_px"] - values["x0_px"]) * (values["y1_px"] - values["y0_px"])
    assert (2 * values["radius_px"]) ** 2 == pytest.approx(area)
    written = pd.read_csv(tmp_path / "out" / "detections.csv")
    assert list(written.columns) == COLUMNS
    assert written["x0_px"].to_numpy() == pytest.approx(values["x0_px"], abs=1e-4)
    overlay = cv2.imread(str(tmp_path / "out" / "a.png.overlay.png"))
    assert overlay.shape == (280 + 24, 1200, 3)
    assert np.ptp(overlay[:280], axis=-1).max() > 60, "lines have a colour, the image has none"
    shapes = json.loads((tmp_path / "out" / "detections.geojson").read_text())
    assert len(shapes["features"]) == (table["image"] == "g.tif").sum()
    assert shapes["crs"]["properties"]["name"] == MOON_CRS


def test_the_named_system_is_the_moons():
    assert CRS.from_user_input(MOON_CRS).to_dict()["R"] == MOON_RADIUS_M


@pytest.mark.parametrize(
    ("crs", "transform", "place", "diameter_m"),
    [
        # A polar map is true to scale at the pole: 20 px of 2 m; the middle lies 600 m from it, towards 90 E.
        (POLAR, from_origin(560, 40, 2, 2), (90.0, -90 + np.degrees(600 / MOON_RADIUS_M)), 40.0),
        # 0.001 degree a pixel at latitude 60: half as long from west to east as from south to north.
        (LONGITUDES, from_origin(179.98, 60.02, 0.001, 0.001), (180.0, 60.0), 20e-3 * 30323.35 * np.sqrt(0.5)),
    ],
)
def test_places_and_diameters_on_the_moon(tmp_path, crs, transform, place, diameter_m):
    reference = read_georeference(geotiff(tmp_path / "g.tif", crs, transform))
    (feature,) = features("g.tif", Detections(np.array([[10.0, 10, 30, 30]]), np.array([0.5])), reference)
    reported = feature["properties"]
    assert (reported["longitude_deg"] % 360, reported["latitude_deg"]) == pytest.approx(place, abs=1e-6)
    assert reported["diameter_m"] == pytest.approx(diameter_m, rel=1e-4)
    ring = np.array(feature["geometry"]["coordinates"][0])
    assert np.ptp(ring[:, 0]) < 5.0, "torn at 180 degrees"
    x, y = ring.T - ring[0][:, None]
    assert (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0, "clockwise"


def test_an_ellipse_is_turned_on_the_map(tmp_path):
    """A polar map is true to scale at the pole; rows run south along 90 E to the pole, columns towards 0 E."""
    reference = read_georeference(geotiff(tmp_path / "g.tif", POLAR, from_origin(560, 40, 2, 2)))
    ellipse = np.array([[20.0, 20.0, 12.0, 6.0, np.radians(30)]])
    half = np.sqrt([[144 * 0.75 + 36 * 0.25, 144 * 0.25 + 36 * 0.75]])
    boxes = np.hstack([20 - half, 20 + half])
    shapes = np.column_stack([correlations_of(ellipse), [[0.5, 0.6, 0.7, 0.8]]])
    ((with_ellipse,), (plain,)) = (
        features("g.tif", Detections(boxes, np.array([0.5]), given), reference) for given in (shapes, None)
    )
    reported = with_ellipse["properties"]
    assert [reported[name] for name in ELLIPSE_COLUMNS] == pytest.approx([12, 6, 30, 0.5, 0.6, 0.7, 0.8])
    assert [reported[name] for name in ("semi_major_m", "semi_minor_m", "diameter_m", "diameter_px")] == pytest.approx(
        [24, 12, 2 * np.sqrt(24 * 12), 2 * np.sqrt(72)], rel=1e-4
    )
    # The polygon in pixels: map x = 560 + 2 column, map y = 40 - 2 row.
    to_map = Transformer.from_crs(f"+proj=longlat +R={MOON_RADIUS_M:.0f} +no_defs", POLAR.to_wkt(), always_xy=True)
    x, y = to_map.transform(*np.array(with_ellipse["geometry"]["coordinates"][0][:-1]).T)
    points = np.column_stack([(np.array(x) - 560) / 2, (40 - np.array(y)) / 2]) - 20
    along = points @ [np.cos(np.radians(30)), np.sin(np.radians(30))]
    across = points @ [-np.sin(np.radians(30)), np.cos(np.radians(30))]
    np.testing.assert_allclose((along / 12) ** 2 + (across / 6) ** 2, 1, atol=1e-3)
    assert plain["properties"]["sigma_x_px"] is None and plain["properties"]["angle_deg"] == 0


def test_a_world_file_needs_its_projection(tmp_path):
    path = tmp_path / "w.png"
    assert cv2.imwrite(str(path), noise(60, 60))
    assert read_georeference(path) is None
    (tmp_path / "w.pgw").write_text("2\n0\n0\n-2\n561\n39\n")
    assert read_georeference(path) is None
    (tmp_path / "w.prj").write_text(POLAR.to_wkt(version="WKT1_ESRI"))
    # A world file names the middle of the first pixel.
    assert read_georeference(path).transform == pytest.approx((2, 0, 560, 0, -2, 40))
    (tmp_path / "w.prj").write_text("nonsense")
    with pytest.raises(UserError, match=r"w\.prj: georeference"):
        read_georeference(path)


def test_an_image_of_the_earth_is_refused(tmp_path):
    with pytest.raises(UserError, match="a coordinate reference system of the Moon"):
        read_georeference(geotiff(tmp_path / "g.tif", EARTH, from_origin(10, 50, 0.1, 0.1)))


ORTHOGRAPHIC = CRS.from_proj4(f"+proj=ortho +lat_0=0 +lon_0=0 +R={MOON_RADIUS_M:.0f} +units=m +no_defs")
WHOLE_DISC = from_origin(-2e6, 2e6, 4e6 / 128, 4e6 / 128)


def test_what_lies_off_the_map_is_left_out_and_told(run, tmp_path, capsys):
    path = geotiff(tmp_path / "disc[b].tif", ORTHOGRAPHIC, WHOLE_DISC, 128, 128)
    middles = np.array([[2.0, 2], [64, 64], [64, 126], [119, 64], [100, 64]])
    boxes = np.concatenate([middles - 2, middles + 2], axis=1)
    kept = features("disc[b].tif", Detections(boxes, np.linspace(0.9, 0.5, 5)), read_georeference(path))
    # The middle of the image and one well inside the disc; at 119 the ellipse reaches over the limb.
    assert [feature["properties"]["score"] for feature in kept] == [0.8, 0.5]
    assert kept[0]["properties"]["longitude_deg"] == pytest.approx(0, abs=1e-6)
    count = predict_images([path], run, settings_of(run), tmp_path / "out", PredictSettings(Tiling(tile_px=128)))
    shapes = json.loads((tmp_path / "out" / "detections.geojson").read_text())["features"]
    assert 0 < len(shapes) < count == len(pd.read_parquet(tmp_path / "out" / "detections.parquet"))
    assert f"disc[b].tif: {count - len(shapes)} craters have no map coordinates" in " ".join(
        capsys.readouterr().err.split()
    )


def test_an_image_wholly_off_its_map_is_refused(tmp_path):
    path = geotiff(tmp_path / "sky.tif", ORTHOGRAPHIC, from_origin(5e6, 5e6, 1000, 1000))
    with pytest.raises(UserError, match=r"sky\.tif: projection: got none of its pixels on the map"):
        read_georeference(path)


def test_one_faulty_image_among_several_leaves_nothing(run, tmp_path):
    good, bad = tmp_path / "good.png", tmp_path / "bad.png"
    assert cv2.imwrite(str(good), noise(64, 64))
    bad.write_bytes(good.read_bytes()[:2000])
    with pytest.raises(UserError, match=r"bad\.png: image"):
        predict_images([good, bad], run, settings_of(run), tmp_path / "out", PredictSettings(Tiling()))
    (tmp_path / "more").mkdir()
    twin = tmp_path / "more" / "good.png"
    twin.write_bytes(good.read_bytes())
    with pytest.raises(UserError, match=r"more/good\.png: name: got a second image"):
        predict_images([good, twin], run, settings_of(run), tmp_path / "out", PredictSettings(Tiling()))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.png", "good.png", "more"]


def test_a_run_that_is_not_finished(run, tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), noise(64, 64))
    with pytest.raises(UserError, match=r"metrics\.json: metrics: got no such file"):
        predict_images(
            [tmp_path / "a.png"], tmp_path / "absent", settings_of(run), tmp_path / "out", PredictSettings(Tiling())
        )
    with pytest.raises(UserError, match=r"best\.ckpt: checkpoint: got no such file"):
        predict_images(
            [tmp_path / "a.png"],
            tmp_path / "absent",
            settings_of(run),
            tmp_path / "out",
            PredictSettings(Tiling(), 0.5),
        )
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_the_command(run, tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), noise(64, 64))
    arguments = ["detect", "predict", str(tmp_path / "a.png"), "--run", str(run), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*arguments, "--scale", "1", "--scale", "2", "--threshold", "0.9"])
    assert result.exit_code == 0, result.output
    assert "geojson" not in result.output
    placed = geotiff(tmp_path / "g.tif", POLAR, from_origin(1000, 3000, 2, 2))
    result = CliRunner().invoke(
        app, ["detect", "predict", str(placed), "--run", str(run), "--out", str(tmp_path / "placed")]
    )
    assert "detections.csv, detections.geojson, *.overlay.png" in " ".join(result.output.split())
    table = pd.read_parquet(tmp_path / "out" / "detections.parquet")
    assert len(table) == 0 and list(table.columns) == COLUMNS
    for options in (["--min-score", "2"], ["--scale", "0"], ["--tile", "100"], ["--overlap", "-1"], []):
        refused = CliRunner().invoke(app, [*arguments, *options])
        assert isinstance(refused.exception, UserError), options


@pytest.mark.parametrize(
    ("crs", "said"),
    [
        (EARTH, "a coordinate reference system of the Moon"),
        (CRS.from_proj4("+proj=longlat +R=3396190 +no_defs"), "a coordinate reference system of the Moon"),
        (CRS.from_wkt(EARTH.to_wkt().replace("4326", "1")), "a coordinate reference system of the Moon"),
    ],
)
def test_an_image_of_another_body_is_detected_in_pixels(run, tmp_path, capsys, crs, said):
    paths = [geotiff(tmp_path / "e.tif", crs, from_origin(10, 50, 0.1, 0.1))]
    paths.append(geotiff(tmp_path / "m.tif", POLAR, from_origin(1000, 3000, 2, 2)))
    out = tmp_path / "out"
    count = predict_images(paths, run, settings_of(run), out, PredictSettings(Tiling(tile_px=96, overlap_px=32)))
    table = pd.read_parquet(out / "detections.parquet")
    of_earth = int((table["image"] == "e.tif").sum())
    assert len(table) == count > of_earth > 0
    shapes = json.loads((out / "detections.geojson").read_text())["features"]
    assert len(shapes) == count - of_earth
    text = " ".join(capsys.readouterr().err.split())
    assert "e.tif: not in detections.geojson, since its georeference cannot be used" in text and said in text


def test_a_broken_projection_or_a_place_off_the_map_leaves_pixels(run, tmp_path, capsys):
    sky = geotiff(tmp_path / "sky.tif", ORTHOGRAPHIC, from_origin(5e6, 5e6, 1000, 1000))
    odd = tmp_path / "w.png"
    assert cv2.imwrite(str(odd), noise(90, 130))
    (tmp_path / "w.pgw").write_text("2\n0\n0\n-2\n561\n39\n")
    (tmp_path / "w.prj").write_bytes(b"\xff nonsense")
    assert predict_images([sky, odd], run, settings_of(run), tmp_path / "out", PredictSettings(Tiling(tile_px=96))) > 0
    text = " ".join(capsys.readouterr().err.split())
    assert "sky.tif: not in detections.geojson" in text and "w.png: not in detections.geojson" in text
    assert not (tmp_path / "out" / "detections.geojson").exists()


def test_an_old_detector_says_what_it_lacks(tmp_path, capsys):
    """Its ellipses lie in the boxes and are axis-aligned; it knows no standard deviations."""
    old = store_run(tmp_path / "runs", "ellipses=false")
    assert cv2.imwrite(str(tmp_path / "a.png"), noise(64, 96))
    assert predict_images([tmp_path / "a.png"], old, settings_of(old), tmp_path / "out", PredictSettings(Tiling())) > 0
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("stored: this detector predicts only boxes") == 1
    table = pd.read_parquet(tmp_path / "out" / "detections.parquet")
    assert list(table.columns) == COLUMNS and set(table["angle_deg"]) <= {0, 90}
    width, height = table["x1_px"] - table["x0_px"], table["y1_px"] - table["y0_px"]
    np.testing.assert_allclose(2 * table["semi_major_px"], np.maximum(width, height))
    assert table[list(ELLIPSE_COLUMNS[3:])].isna().all(axis=None)


def test_predict_says_which_scales_it_used(run, tmp_path, capsys):
    for name, side in (("a.png", 100), ("b.png", 300)):
        assert cv2.imwrite(str(tmp_path / name), noise(side, side))
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for number, (scales, said) in enumerate(((None, "1 (1 image); 1, 1/2, 1/4 (1 image)"), ((1.0, 2.0), "1, 2"))):
        settings = PredictSettings(Tiling(scales=scales), 0.9)
        predict_images(paths, run, settings_of(run), tmp_path / f"out{number}", settings)
        assert f"scales: {said}" in " ".join(capsys.readouterr().err.split())


def test_a_folder_and_a_least_size(run, tmp_path):
    root = tmp_path / "pictures"
    root.mkdir()
    for name in ("a.png", "b.jpg", "a_mask.png"):
        assert cv2.imwrite(str(root / name), noise(70, 96))
    (root / "._a.png").write_bytes(b"\0")
    (root / "notes.txt").write_text("x")
    command = ["detect", "predict", str(root), "--run", str(run), "--tile", "96", "--out"]
    result = CliRunner().invoke(app, [*command, str(tmp_path / "all")])
    assert result.exit_code == 0, result.output
    assert "craters in 2 images" in " ".join(result.output.split())
    every = pd.read_parquet(tmp_path / "all" / "detections.parquet")
    assert set(every["image"]) == {"a.png", "b.jpg"}
    least = float(every["radius_px"].median() * 2)
    result = CliRunner().invoke(app, [*command, str(tmp_path / "large"), "--min-size", str(least)])
    large = pd.read_parquet(tmp_path / "large" / "detections.parquet")
    assert len(large) == (2 * every["radius_px"] >= least).sum() < len(every)
    (tmp_path / "none").mkdir()
    for arguments, message in (
        ([str(tmp_path / "none"), "--out", str(tmp_path / "x")], "none: images: got a folder without images"),
        ([str(root), str(root / "a.png"), "--out", str(tmp_path / "x")], "a.png: name: got a second image"),
        ([str(root), "--min-size", "-1"], "--min-size: got -1.0"),
        ([str(root), "--nodata", "inf"], "--nodata: got inf"),
    ):
        refused = CliRunner().invoke(app, ["detect", "predict", *arguments])
        assert isinstance(refused.exception, UserError) and message in str(refused.exception)


def test_results_keep_the_strongest_and_the_large_and_replace_older_ones(run, tmp_path):
    path, out = tmp_path / "a.png", tmp_path / "out"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (96, 96), dtype=np.uint8))
    command = [
        "detect",
        "predict",
        str(path),
        "--run",
        str(run),
        "--out",
        str(out),
        "--tile",
        "96",
        "--min-score",
        "1e-6",
    ]

    def table(*options: str) -> pd.DataFrame:
        result = CliRunner().invoke(app, [*command, *options])
        assert result.exit_code == 0, result.output
        return pd.read_parquet(out / "detections.parquet")

    full = table()
    assert len(full) > 5
    with pytest.raises(UserError, match="--overwrite replaces it"):
        table_again = CliRunner().invoke(app, command)
        raise table_again.exception
    strong = table("--top", "3", "--overwrite")
    assert sorted(strong["score"]) == sorted(full["score"])[-3:]
    radius = float(full["radius_px"].median())
    large = table("--min-radius-px", str(radius), "--overwrite")
    assert len(large) == (full["radius_px"] >= radius).sum() < len(full)
    both = CliRunner().invoke(app, [*command, "--overwrite", "--min-size", "1", "--min-radius-px", "1"])
    assert "--min-size: options: got together with --min-radius-px" in str(both.exception)
