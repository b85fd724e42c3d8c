"""Datasets with hazard maps, their channels in the EXRs, flash lidar and altimeter: whole, resumed, made again."""

import hashlib
import shutil

import numpy as np
import pytest
import rasterio
import yaml
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_render.config.outputs import FlashLidarConfig
from perilune_render.imaging.exr import CHANNELS, read_exr
from perilune_render.outputs.flash_lidar import lidar_camera
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.attach import attach
from perilune_shared.editing.merge import merge
from perilune_shared.editing.pack import pack
from perilune_shared.editing.subset import Limit, subset
from perilune_shared.validation.validate import validate

CAMERA = {"width_px": 48, "height_px": 48, "horizontal_fov_deg": 40}
NAMES = "time_s,x_m,y_m,z_m,qw,qx,qy,qz,trajectory"
OUTPUTS = {
    "camera": CAMERA,
    "terrain": {"spacing_px": 1.5},
    "render": {"engine": "heightfield", "samples": 1, "exr": True},
    "hazard": {"footprint_m": 8, "pixel_m": 2, "extent_m": 120, "frame_channels": True},
    "flash_lidar": {"width_px": 48, "height_px": 48, "horizontal_fov_deg": 40, "false_return_share": 0.01},
    "nav": {"instruments": {"range_rate_hz": 10}},
}


def rendered(folder, out, settings, *more):
    (folder / f"{out}.yaml").write_text(yaml.safe_dump({"dataset": settings}))
    files = ["--poses", folder / "poses.csv", "--scene", folder / f"{out}.yaml", "--out", folder / out]
    return in_process.call(main, "frames", *files, "--preset", "tiny", "--workers", 0, *more)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("outputs")
    lines = [f"{t},{10 * t},-40,{300 - 30 * t},0,1,0,0,{'ab'[t]}" for t in range(2)]
    (folder / "poses.csv").write_text("\n".join(["# frame: O_L", NAMES, *lines, ""]))
    done = rendered(folder, "made", OUTPUTS)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def made(folder):
    return open_dataset(folder / "made")


def files_of(dataset):
    """SHA-256 of all files but those that depend on edits."""
    root = dataset.store.folder
    kept = [path for path in root.rglob("*") if path.suffix in (".png", ".exr", ".tif")]
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(kept)}


def test_it_is_valid_and_its_files_are_listed(made):
    assert validate(made) == []
    (scene,), frames = made.table("scenes").to_pylist(), made.table("frames").to_pylist()
    assert scene["hazard_path"] == "hazard/scene-0000.tif"
    assert [row["lidar_path"] for row in frames] == [f"frames/{row['frame_id']}.lidar.exr" for row in frames]
    with rasterio.open(made.file(scene["hazard_path"])) as raster:
        assert raster.shape == (60, 60) and raster.count == 6
        assert 0 < raster.read(6).mean() < 1


def test_true_ranges_agree_with_the_depth_of_the_frame(made):
    camera = lidar_camera(FlashLidarConfig(**OUTPUTS["flash_lidar"]))
    assert camera == made.exr_camera
    along = np.linalg.norm(camera.rays(camera.pixel_centres()), axis=-1)
    for row in made.table("frames").to_pylist():
        depth = read_exr(made.file(row["exr_path"]))["Z"]
        true = read_exr(made.file(row["lidar_path"]))["range_true"]
        assert np.abs(true / (depth * along) - 1).max() < 1e-4


def test_the_exr_has_the_map_under_each_pixel(made):
    row = made.table("frames").sort_by("frame_id").to_pylist()[0]
    channels = read_exr(made.file(row["exr_path"]))
    assert set(channels) == {*CHANNELS, "slope", "roughness", "boulder", "safe"}
    with rasterio.open(made.file("hazard/scene-0000.tif")) as raster:
        layers = dict(zip(raster.descriptions, raster.read(), strict=True))
    # The camera looks straight down, its x axis along O_L's x and its y axis along -y.
    camera = made.exr_camera
    rays = camera.rays(camera.pixel_centres())
    depth = channels["Z"].astype(float)
    x, y = row["position_m"][0] + depth * rays[..., 0], row["position_m"][1] - depth * rays[..., 1]
    column, row_of = np.floor(-x / 2 + 30).astype(int), np.floor(y / 2 + 30).astype(int)
    inside = (column >= 0) & (column < 60) & (row_of >= 0) & (row_of < 60)
    assert inside.any() and not inside.all()
    for name in ("slope", "roughness", "boulder", "safe"):
        assert np.array_equal(channels[name][inside], layers[name][row_of[inside], column[inside]])
        assert np.isnan(channels[name][~inside]).all()


def test_given_poses_have_a_range_at_each_frame(made):
    ranges, frames = (made.table(name).sort_by("trajectory_id") for name in ("ranges", "frames"))
    assert ranges["time_s"].equals(frames["time_s"]) and len(ranges) == 2
    for range_m, row in zip(ranges["range_m"].to_pylist(), frames.to_pylist(), strict=True):
        middle = read_exr(made.file(row["exr_path"]))["Z"][23:25, 23:25]
        assert abs(range_m - middle.mean()) < 3


def test_resumed_and_from_its_manifest_it_has_the_same_bytes(made, tmp_path):
    subset(made, tmp_path / "plan", images="plan")
    arguments = ["--manifest", tmp_path / "plan", "--out", tmp_path / "new", "--workers", 0]
    for more in (["--shard", "1/2"], []):
        assert not (tmp_path / "new/overview.png").exists()
        done = in_process.call(main, "dataset", *arguments, *more)
        assert done.returncode == 0, done.stderr
    new = open_dataset(tmp_path / "new")
    assert validate(new) == []
    assert files_of(new) == files_of(made)
    assert new.table("ranges").equals(made.table("ranges"))
    assert new.table("scenes").equals(made.table("scenes"))


def test_frames_are_regenerated_with_all_their_files(folder):
    done = in_process.call(main, "regenerate", "--manifest", folder / "made", "--all", "--out", folder / "frames-only")
    assert done.returncode == 0 and "2 frames: 2 identical" in done.stdout
    assert len(list((folder / "frames-only").rglob("*.lidar.exr"))) == 2


def test_tools_copy_the_files_or_leave_them_out(made, tmp_path):
    subset(made, tmp_path / "one", limit=Limit(n_frames=1))
    one = open_dataset(tmp_path / "one")
    assert validate(one) == [] and len(files_of(one)) == 4
    merge([made, one], tmp_path / "merged")
    merged = open_dataset(tmp_path / "merged")
    assert validate(merged) == [] and merged.info.counts.scenes == 1
    pack(made, tmp_path / "packed")
    packed = open_dataset(tmp_path / "packed")
    assert validate(packed) == [] and files_of(packed) == {}
    assert packed.table("scenes")["hazard_path"].to_pylist() == [None]
    subset(made, tmp_path / "absent", images="none")
    attach(open_dataset(tmp_path / "absent"), made.store, tmp_path / "attached")
    attached = open_dataset(tmp_path / "attached")
    assert validate(attached) == [] and attached.table("frames").equals(made.table("frames"))
    assert attached.table("scenes").equals(made.table("scenes"))


@pytest.mark.parametrize("path", ["hazard/scene-0000.tif", "frames/scene-0000/trajectory-0000/000000.lidar.exr"])
def test_a_changed_file_is_a_fault(folder, tmp_path, path):
    copy = shutil.copytree(folder / "made", tmp_path / "copy")
    (copy / path).write_bytes((copy / path).read_bytes()[:-1] + b"?")
    assert [fault.file for fault in validate(open_dataset(copy))] == [path]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hazard": {"footprint_m": 1, "pixel_m": 2}}, "footprint_m of 3 to 100 pixel_m"),
        ({"hazard": {"extent_m": 900}}, "dataset.hazard.extent_m: got 900"),
        ({"render": {"exr": False, "engine": "heightfield"}}, "render.exr true, since hazard.frame_channels is true"),
        ({"flash_lidar": {"width_px": 0}}, "dataset.flash_lidar.width_px"),
    ],
)
def test_bad_settings_are_one_line_and_leave_no_folder(folder, changes, message):
    done = rendered(folder, "bad", OUTPUTS | changes)
    assert done.returncode == 2
    assert message in " ".join(done.stderr.split())
    assert not (folder / "bad").exists()


def test_cycles_has_the_same_map_and_ranges_and_depths_that_agree(folder, made):
    pytest.importorskip("bpy")
    settings = OUTPUTS | {"render": OUTPUTS["render"] | {"engine": "cycles"}}
    done = rendered(folder, "cycles", settings)
    assert done.returncode == 0, done.stderr
    cycles = open_dataset(folder / "cycles")
    assert validate(cycles) == []
    first, second = files_of(made), files_of(cycles)
    same = [path for path in first if path.endswith((".lidar.exr", ".tif"))]
    assert len(same) == 3 and all(first[path] == second[path] for path in same)
    camera = made.exr_camera
    along = np.linalg.norm(camera.rays(camera.pixel_centres()), axis=-1)
    for row in cycles.table("frames").to_pylist():
        depth = read_exr(cycles.file(row["exr_path"]))["Z"]
        true = read_exr(cycles.file(row["lidar_path"]))["range_true"]
        # A few rays pass an edge of a boulder on the other side.
        assert (np.abs(true / (depth * along) - 1) < 1e-4).mean() > 0.998
