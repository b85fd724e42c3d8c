"""Recordings, read by rerun-sdk's own reader, give the images, poses and labels of the dataset.

rerun-sdk has another reader since NumPy 2 (`RrdReader` instead of `rr.dataframe`), so the tests know both.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
import tests.shared.export.test_estimates as estimates
from rich.progress import Progress
from tests.helpers import in_process
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.cli.main import main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.export.rerun_recording import _terrain, export_rerun
from perilune_shared.geometry.ellipse import plane_basis
from perilune_shared.geometry.frames import matrix_from_quaternion

rr = pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
CAMERA = "/site/lander/camera"


@pytest.fixture(scope="module")
def descents(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("descents") / "set"
    return build_dataset(root, "nav", splits={"train": 1, "test": 1}, n_frames=5, side_px=64, craters=400)


@pytest.fixture(scope="module")
def recordings(descents, tmp_path_factory) -> Path:
    return exported(open_dataset(descents), tmp_path_factory.mktemp("recordings") / "out")


def exported(dataset, out, **choice) -> Path:
    with Progress(disable=True) as progress:
        export_rerun(dataset, out, progress, **choice)
    return out


def rows_of(path: Path, entity: str, component: str) -> list[tuple[float | None, list]]:
    """Time in seconds (None for all times) and values of a component of an entity, in temporal order."""
    found = []
    for names, batch in _batches(path, entity):
        columns = [name for name in names if component in name.split(":")[-1].lower()]
        for column in columns:
            times = batch["time"].to_pylist() if "time" in names else [None] * len(batch)
            values = batch[column].to_pylist()
            found += [(_seconds(t), v) for t, v in zip(times, values, strict=True) if v is not None]
    return sorted(found, key=lambda row: -1.0 if row[0] is None else row[0])


def _batches(path: Path, entity: str):
    if hasattr(rr, "dataframe"):
        view = rr.dataframe.load_recording(path).view(index="time", contents=entity)
        for table in (view.select().read_all(), view.select_static().read_all()):
            own = [name for name in table.column_names if name == "time" or name.startswith(f"{entity}:")]
            yield own, table
        return
    from rerun.chunk import RrdReader

    for chunk in RrdReader(str(path)).stream().to_chunks():
        if chunk.entity_path == entity:
            batch = chunk.to_record_batch()
            yield batch.schema.names, batch


def _seconds(time) -> float | None:
    return None if time is None else time.value / 1e9  # pandas: since 0, or since 1970


@pytest.mark.parametrize("name", ["s000/t000", "s001/t001"])
def test_images_and_poses_equal_the_manifest(descents, recordings, name):
    path = recordings / f"{name}.rrd"
    frames = open_dataset(descents).table("frames", None, *name.split("/")).to_pandas().sort_values("time_s")
    images = rows_of(path, f"{CAMERA}/image", "blob")
    assert [time for time, _ in images] == pytest.approx(frames["time_s"].tolist(), abs=1e-6)
    for (_, (png,)), row in zip(images, frames.itertuples(), strict=True):
        assert bytes(png) == (descents / row.png_path).read_bytes()
    places = rows_of(path, "/site/lander", "translation")
    turns = rows_of(path, "/site/lander", "quat")
    mounting = np.diag([1.0, -1.0, -1.0])
    for (_, (place,)), (_, (turn,)), row in zip(places, turns, frames.itertuples(), strict=True):
        assert np.allclose(place, row.position_m, atol=1e-3)  # float32
        x, y, z, w = turn
        rotation = mounting @ matrix_from_quaternion([w, x, y, z]).T
        assert np.allclose(rotation, matrix_from_quaternion(row.rotation_wxyz), atol=1e-6)
    matrices = [values for _, values in rows_of(path, CAMERA, "image_from_camera") or rows_of(path, CAMERA, "pinhole")]
    assert np.allclose(np.reshape(matrices[0], (3, 3)).T, open_dataset(descents).camera.matrix, rtol=1e-6)


def test_labels_of_each_frame(descents, recordings):
    path = recordings / "s000/t000.rrd"
    labels = open_dataset(descents).table("labels", None, "s000", "t000").to_pandas()
    labels = labels.sort_values(["frame_id", "crater_id"])
    corners = [corner for _, row in rows_of(path, f"{CAMERA}/image/boxes", "half") for corner in row]
    size = labels[["bbox_x1_px", "bbox_y1_px"]].to_numpy() - labels[["bbox_x0_px", "bbox_y0_px"]].to_numpy()
    assert np.allclose(corners, size / 2, atol=1e-4)
    strips = [strip for _, row in rows_of(path, f"{CAMERA}/image/ellipses", "strip") for strip in row]
    assert len(strips) == len(labels) > 20
    centres = [np.mean(strip[:-1], axis=0) for strip in strips]
    assert np.allclose(centres, labels[["ellipse_cx_px", "ellipse_cy_px"]], atol=1e-3)
    none = exported(
        open_dataset(descents), path.parent.parent / "none", split="train",
        choose=lambda _dataset, _scene, rows: np.zeros(len(rows), bool),
    )  # fmt: skip
    assert not any(row for _, row in rows_of(none / "s000/t000.rrd", f"{CAMERA}/image/ellipses", "strip"))
    assert not (none / "s001").exists()


def test_rims_are_circles_on_the_ground(descents, recordings):
    dataset = open_dataset(descents)
    (_, strips), = rows_of(recordings / "s000/t000.rrd", "/site/craters", "strip")  # fmt: skip
    ids = dataset.table("labels", ["crater_id"], "s000", "t000").to_pandas()["crater_id"].unique()
    craters = dataset.table("craters", None, "s000").to_pandas().set_index("crater_id").loc[ids]
    craters = craters.nlargest(len(craters), "diameter_m")
    assert len(strips) == len(craters)
    for strip, crater in zip(strips, craters.itertuples(), strict=True):
        offset = np.array(strip) - [crater.x_m, crater.y_m, crater.z_m]
        assert np.allclose(np.linalg.norm(offset, axis=1), crater.diameter_m / 2, atol=1e-2)
        assert plane_basis([[crater.normal_x, crater.normal_y, crater.normal_z]])[0].shape == (1, 3)


@pytest.mark.filterwarnings("ignore:Setting the shape:DeprecationWarning")  # rasterio 1.4 with NumPy 2.5
def test_the_terrain_of_a_hazard_map(tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="hazard maps are GeoTIFFs")
    heights = np.random.default_rng(2).uniform(-20, 20, (2, 6, 6)).astype(np.float32)
    profile = {"driver": "GTiff", "width": 6, "height": 6, "count": 2, "dtype": "float32"}
    transform = rasterio.Affine(5.0, 0, -15.0, 0, -5.0, 15.0)  # north up, as hazard maps are
    with rasterio.open(tmp_path / "map.tif", "w", **profile, transform=transform) as raster:
        raster.write(heights)
    vertices, triangles, grey = _terrain(tmp_path / "map.tif", np.array([0.0, 0.0, 1.0]))
    assert vertices.shape == (36, 3) and triangles.shape == (50, 3) and grey.shape == (36,)
    with rasterio.open(tmp_path / "map.tif") as raster:
        for x, y, z in vertices:
            row, column = raster.index(-x, -y)  # O_L: x west, y south
            assert heights[0, row, column] == z
    a, b, c = vertices[triangles].swapaxes(0, 1)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    assert np.abs(np.cross(b - a, c - a)[:, 2] / 2).sum() == pytest.approx(25 * 25)
    (tmp_path / "map.tif").write_bytes(b"<html>")
    with pytest.raises(UserError, match="hazard map"):
        _terrain(tmp_path / "map.tif", np.array([0.0, 0.0, 1.0]))


def test_the_filter_with_its_covariance(descents, tmp_path):
    covariance = estimates.covariance_9()
    estimates.trace(covariance, (0.0, 10.0)).to_parquet(tmp_path / "frames.parquet")
    words = ["export", str(descents), "--format", "rerun", "--trajectory", "s000/t000", "--out", str(tmp_path / "out")]
    done = in_process.call(main, *words, "--estimates", str(tmp_path))
    assert done.returncode == 0, done.stderr
    path = tmp_path / "out/s000/t000.rrd"
    halves = rows_of(path, "/site/estimate/covariance", "half")
    assert [time for time, _ in halves] == [0, 10]
    expected = 3 * np.sqrt(np.linalg.eigvalsh(covariance[:3, :3]))
    assert np.allclose(sorted(halves[0][1][0]), expected, rtol=1e-5)
    (_, error), = [row for row in rows_of(path, "/filter/z/error", "scalar") if row[0] == 0]  # fmt: skip
    first = open_dataset(descents).table("frames", None, "s000", "t000").to_pandas().sort_values("time_s").iloc[0]
    assert error[0] == pytest.approx(300 - first["position_m"][2])
    above = rows_of(path, "/filter/x/above", "scalar")
    assert above[0][1][0] == pytest.approx(3 * np.sqrt(covariance[0, 0]))


def test_a_failed_export_leaves_no_files(descents, tmp_path):
    dataset = open_dataset(descents)
    read = dataset.pngs
    dataset.pngs = lambda rows, split=None: ((name, b"no image") for name, _ in read(rows, split))
    with pytest.raises(UserError, match="image: got not a PNG file"):
        exported(dataset, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_missing_extra_is_named(descents, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = in_process.call(main, "export", str(descents), "--format", "rerun", "--out", str(tmp_path / "out"))
    assert done.returncode == 2 and 'pip install "perilune-shared[rerun]"' in done.stderr
    assert done.stderr.strip().count("\n") == 0 and not list(tmp_path.iterdir())
