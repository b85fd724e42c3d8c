"""Rolling shutter and motion blur by several poses in one exposure."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import yaml
from tests.helpers import in_process
from tests.helpers.scenes import config_with, flat_scene

from perilune_render.cli.main import main
from perilune_render.config.dataset import LightConfig, RenderConfig, SensorConfig
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.open_engine import open_engine
from perilune_render.flight.sub_poses import RowPoses, moved, row_times_s, sensor_rows
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.outputs.of_scene import SceneOutputs
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.frames import sun_direction
from perilune_shared.labels.masks import frame_masks
from perilune_shared.validation.validate import validate

CAMERA = Camera.from_field_of_view(96, 64, 50.0)
SUN = sun_direction(70, 40)
POSITION = np.array([3.0, -5.0, 400.0])
CIRCLES = RimCircles(
    np.arange(3), np.array([[0.0, 100, 0], [30, -110, 0], [-40, 10, 0]]), np.tile([0.0, 0, 1], (3, 1)), np.full(3, 20.0)
)


@pytest.fixture(scope="module")
def scene():
    """Flat ground with patches of other albedo, 10 m between vertices."""
    rng = np.random.default_rng(2)
    albedo = 1 + 0.5 * np.kron(rng.uniform(-1, 1, (51, 51)), np.ones((4, 4)))[:201, :201]
    return replace(flat_scene(2000.0, 201), albedo=albedo.ravel().astype(np.float32))


def config_of(engine="heightfield", **sensor):
    light = LightConfig(photometry="lommel_seeliger", sun_angular_diameter_deg=0)
    options = {"exposure": "fixed", "exposure_time_s": 0.02, "psf_sigma_px": 0.0} | sensor
    render = RenderConfig(engine=engine, samples=1, threads=1, exr=True)
    return config_with(light=light, render=render, sensor=SensorConfig(**options))


def shot(velocity=(0, 0, 0), turn=(0, 0, 0)):
    return Shot(POSITION, ROTATION_CAMERA_FROM_BODY, np.array(velocity, float), 5, 0, 0, np.array(turn, float))


def taken(scene, config, one, camera=CAMERA):
    """Frame, labels and crater index."""
    with open_engine(scene, config, camera.covering_pinhole(), SUN) as engine:
        source = FrameSource.of(engine, config, camera, CIRCLES)
        frame = source.take(one)
        return frame, source.labels(frame), source.crater_index(frame)


def test_a_turning_camera_sees_the_world_turn_the_other_way():
    turn = np.array([0.0, 0.0, 0.3])
    position, rotation = moved((POSITION, ROTATION_CAMERA_FROM_BODY), np.array([1.0, 2, 3]), turn, 2.0)
    assert np.allclose(position - POSITION, [2, 4, 6])
    # A point to the right of the axis moves up if the camera turns clockwise, from x to y (down).
    x, y, _ = rotation @ ROTATION_CAMERA_FROM_BODY.T @ [1.0, 0, 1]
    assert np.allclose([x, y], [np.cos(0.6), -np.sin(0.6)])


@pytest.mark.parametrize("camera", [CAMERA, replace(CAMERA, distortion=(-0.1, 0.01, 0.0, 0.0, 0.0))])
def test_rows_are_exposed_one_after_another(camera):
    times, rows = row_times_s(64, 1e-4), sensor_rows(camera, camera.covering_pinhole())
    assert np.allclose(np.diff(times), 1e-4) and abs(times.mean()) < 1e-12
    assert rows.min() == 0 and rows.max() == 63
    assert (np.diff(rows, axis=0) >= 0).all()
    assert (np.diff(rows, axis=1) == 0).all() == (not any(camera.distortion))


def test_each_row_is_that_of_a_frame_at_its_own_pose(scene):
    one, config = shot((60, -40, 20), (0.5, 1.0, -2.0)), config_of(row_time_s=2e-3)
    frame, _, _ = taken(scene, config, one)
    times = row_times_s(64, 2e-3)
    with open_engine(scene, config, CAMERA, SUN) as engine:
        still = engine.render(*one.pose, one.render_seed, 0)
        for row in (0, 20, 63):
            own = engine.render(*one.pose_at(times[row]), one.render_seed, 0)
            assert np.array_equal(frame.radiance.depth_m[row], own.depth_m[row])
            assert np.array_equal(frame.radiance.radiance_factor[row], own.radiance_factor[row])
        assert not np.allclose(frame.radiance.depth_m[0], still.depth_m[0], rtol=1e-3)


def test_cycles_renders_the_same_rows_in_bands(scene):
    pytest.importorskip("bpy")
    one = shot((60, -40, 20), (0.2, 0.5, -1.0))
    found = [taken(scene, config_of(name, row_time_s=1e-3), one)[0].radiance for name in ("cycles", "heightfield")]
    still = taken(scene, config_of("cycles"), one)[0].radiance
    a, b = (radiance.depth_m for radiance in found)
    # A fifth of a pixel between bands is at most a tenth of one from the row's own pose.
    slope = np.abs(np.gradient(b)[0]).max() + np.abs(np.gradient(b)[1]).max()
    assert np.abs(a - b).max() < 0.2 * slope + 1e-4 * POSITION[2] + 20 * 64e-3 / 30
    assert np.abs(still.depth_m - b).max() > 4 * np.abs(a - b).max()
    factor, true = (radiance.radiance_factor for radiance in found)
    assert np.abs(factor - true).mean() < 0.3 * np.abs(still.radiance_factor - true).mean()


def test_labels_are_where_the_row_of_their_centre_sees_them(scene):
    one, config = shot((100, 150, 10), (0.3, -0.2, 1.0)), config_of(row_time_s=1e-3)
    _, labels, index = taken(scene, config, one)
    _, still, _ = taken(scene, config_of(), one)
    assert labels.crater_id.tolist() == [0, 1, 2]
    times = row_times_s(64, 1e-3)
    centre = np.column_stack([labels.ellipses.cx_px, labels.ellipses.cy_px])
    for k in range(3):
        time = np.interp(centre[k, 1] - 0.5, np.arange(64), times)
        seen = CAMERA.project(camera_from_site(CIRCLES.centre_m[k], *one.pose_at(time)))
        assert np.abs(seen - centre[k]).max() < 0.05
        assert index[int(seen[1]), int(seen[0])] == k
    moved_px = np.hypot(labels.ellipses.cx_px - still.ellipses.cx_px, labels.ellipses.cy_px - still.ellipses.cy_px)
    assert moved_px.max() > 1


def test_without_motion_or_by_default_nothing_changes(scene):
    default = taken(scene, config_of(), shot())[0]
    for sensor in ({"row_time_s": 1e-3}, {"blur_poses": 5}):
        frame, _, _ = taken(scene, config_of(**sensor), shot())
        assert np.array_equal(frame.image, default.image)
        assert np.array_equal(frame.radiance.depth_m, default.radiance.depth_m)


def difference(first, second):
    """Root mean square of the difference of two frames' light away from the border."""
    return float(np.sqrt(np.square(first.exposure.light - second.exposure.light)[8:-8, 8:-8].mean()))


@pytest.mark.parametrize(("velocity", "turn"), [((700, 0, 0), (0, 0, 0)), ((0, 0, 0), (0, 0, 4.0))])
def test_poses_in_the_exposure_agree_with_the_blur_of_the_image_on_level_ground(scene, velocity, turn):
    one = shot(velocity, turn)
    sharp, _, _ = taken(scene, config_of(motion_blur=False), one)
    image, _, _ = taken(scene, config_of(), one)
    poses, _, _ = taken(scene, config_of(blur_poses=16), one)
    assert difference(poses, image) < 0.25 * difference(sharp, image)


def test_the_blur_of_a_roll_grows_with_the_distance_from_the_centre(scene):
    one = shot(turn=(0, 0, 6.0))
    sharp, _, _ = taken(scene, config_of(motion_blur=False), one)
    poses, _, _ = taken(scene, config_of(blur_poses=16), one)
    change = np.abs(poses.exposure.light - sharp.exposure.light)
    radius = np.hypot(*np.meshgrid(np.arange(96) - 47.5, np.arange(64) - 31.5))
    rings = [change[(radius >= low) & (radius < low + 10)].mean() for low in (0, 10, 20, 40)]
    assert rings == sorted(rings) and rings[-1] > 3 * rings[0]


def test_automatic_exposure_sets_the_time_between_the_first_and_the_last_pose(scene):
    sensor = {"exposure": "automatic", "longest_exposure_s": 0.01, "responsivity_e_per_s": 1e7, "full_well_e": 3000}
    one = shot(velocity=(2000, 0, 0))
    frame, _, _ = taken(scene, config_of(blur_poses=2, **sensor), one)
    time_s = frame.exposure.time_s
    assert 0.001 < time_s <= 0.01
    with open_engine(scene, config_of(), CAMERA, SUN) as engine:
        ends = [engine.render(*one.pose_at(sign * time_s / 4), 1, 0).radiance_factor for sign in (-1, 1)]
    assert np.allclose(frame.exposure.light, np.mean(ends, axis=0), atol=1e-6)


def test_row_poses_count_the_motion_of_the_whole_image():
    rows = RowPoses(sensor_rows(CAMERA, CAMERA), row_times_s(64, 0.01), shot((100, 0, 0)).pose_at)
    motion = rows.motion_px(np.full((64, 96), 400.0), CAMERA)
    assert motion == pytest.approx(CAMERA.fx_px * 100 * 0.63 / 400, rel=1e-6)
    assert [int(pixels.sum()) for pixels, _ in rows.bands(4)] == [16 * 96] * 4


@dataclass(frozen=True)
class PlaceMap:
    """Stands for a hazard map whose values are the places themselves."""

    def at(self, x_m, y_m):
        return {"x": x_m, "y": y_m}


@pytest.mark.parametrize("camera", [CAMERA, replace(CAMERA, distortion=(-0.05, 0.0, 0.0, 0.0, 0.0))])
@pytest.mark.parametrize("turn", [(0, 0, 0), (0.2, -0.3, 1.0)])
def test_channels_of_the_hazard_map_are_those_of_the_place_that_each_row_shows(scene, turn, camera):
    one, config = shot((300, -200, -400), turn), config_of(row_time_s=1e-3)
    with open_engine(scene, config, camera.covering_pinhole(), SUN) as engine:
        source, exr_camera = FrameSource.of(engine, config, camera, CIRCLES), engine.camera
        channels = (
            SceneOutputs(hazard=PlaceMap(), has_channels=True).of_frame(source.take(one), source.places_m).channels
        )
    times_s, rows = row_times_s(64, 1e-3), sensor_rows(camera, exr_camera)
    height, width = rows.shape
    for row, column in ((1, 2), (height // 2, 5), (height - 2, width - 1)):
        position, rotation = one.pose_at(times_s[rows[row, column]])
        ray = exr_camera.rays(np.array([column + 0.5, row + 0.5])) @ rotation
        x, y, _ = position - position[2] / ray[2] * ray
        assert channels["x"][row, column] == pytest.approx(x, abs=2e-3)
        assert channels["y"][row, column] == pytest.approx(y, abs=2e-3)


def test_the_command_records_the_turn_and_the_manifest_gives_the_same_bytes(tmp_path):
    names = "time_s,x_m,y_m,z_m,qw,qx,qy,qz,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps"
    lines = [f"{t},0,-40,{300 - t},0,1,0,0,20,0,-30,0,0.1,{t}" for t in range(2)]
    (tmp_path / "poses.csv").write_text("\n".join(["# frame: O_L", names, *lines, ""]))
    scene = {
        "name": "rolling",
        "terrain": {"spacing_px": 2.0},
        "render": {"samples": 1, "engine": "heightfield"},
        "sensor": {"row_time_s": 1e-4, "blur_poses": 3},
    }
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"dataset": scene}))
    (tmp_path / "camera.yaml").write_text("width_px: 64\nheight_px: 48\n")
    files = [f"--{name}={tmp_path / name}.{end}" for name, end in FILES.items()]
    done = in_process.call(main, "frames", *files, "--out", tmp_path / "out", "--preset", "tiny", "--workers", 0)
    assert done.returncode == 0, done.stderr
    made = open_dataset(tmp_path / "out")
    assert validate(made) == []
    rows = made.table("frames").sort_by("frame_id")
    assert [rows[f"w{axis}_radps"].to_pylist() for axis in "xyz"] == [[0, 0], [0.1, 0.1], [0, 1]]
    assert made.info.recipe().config["sensor"]["blur_poses"] == 3
    labels = made.table("labels").to_pandas()
    frame_id = labels["frame_id"].iloc[-1]
    labels = labels[labels["frame_id"] == frame_id]
    for mask, label in zip(frame_masks(made, frame_id, labels["crater_id"].tolist()), labels.itertuples(), strict=True):
        inside, _ = np.nonzero(mask.amodal)
        if mask.row > 0 and mask.row + len(mask.amodal) < 48:
            assert abs(mask.row + inside.mean() + 0.5 - label.ellipse_cy_px) < 0.5
    done = in_process.call(main, "regenerate", "--manifest", tmp_path / "out", "--verify", "--all")
    assert done.returncode == 0 and "2 frames: 2 identical" in done.stdout
    done = in_process.call(main, "dataset", "--manifest", tmp_path / "out", "--out", tmp_path / "again", "--workers", 0)
    assert done.returncode == 0, done.stderr
    again = open_dataset(tmp_path / "again").table("frames").sort_by("frame_id")
    assert again["png_sha256"].to_pylist() == rows["png_sha256"].to_pylist()


FILES = {"poses": "csv", "scene": "yaml", "camera": "yaml"}
