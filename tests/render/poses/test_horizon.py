"""Views up to the horizon: curved ground, black sky, exposure and labels, and poses that are refused."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from tests.helpers import in_process
from tests.helpers.scenes import config_with

from perilune_render.cli.main import main
from perilune_render.config.dataset import RenderConfig, SensorConfig
from perilune_render.config.scene import SceneConfig, ViewConfig
from perilune_render.config.terrain import BouldersConfig, CratersConfig, ReliefConfig, TerrainConfig
from perilune_render.config.values import Span
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.open_engine import open_engine
from perilune_render.flight.pose_checks import Poses, check_poses
from perilune_render.flight.view import scene_view
from perilune_render.imaging.exr import read_radiance
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.sensor import expose
from perilune_render.labels.frame_labels import RimCircles, crater_index, label_frame
from perilune_render.terrain.scene import grow_scene
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.curvature import drop_m, hits_sphere, horizon_m
from perilune_shared.geometry.frames import MOON_RADIUS_M, quaternion_from_matrix, sun_direction
from perilune_shared.labels.masks import crater_masks
from perilune_shared.validation.validate import validate

HEIGHT_M = 1500.0
CAMERA = Camera.from_field_of_view(96, 72, 50.0)
SUN = sun_direction(70, 15)
SMOOTH = TerrainConfig(
    spacing_px=2.0,
    relief=ReliefConfig(rms_slope_deg=Span(low=0, high=0)),
    craters=CratersConfig(max_diameter_m=1.0),
    boulders=BouldersConfig(density=0),
)
ROUGH = TerrainConfig(spacing_px=1.0)
FILES = {"poses": "poses.csv", "scene": "scene.yaml", "camera": "camera.yaml"}


def level_view(below_deg):
    """rotation_camera_from_site of a camera that looks north, this far below the horizontal plane."""
    level = np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
    return Rotation.from_euler("x", below_deg, degrees=True).as_matrix() @ level


def config_of(terrain=SMOOTH, **render):
    views = (ViewConfig(height_m=1400, reach_m=300), ViewConfig(height_m=HEIGHT_M, reach_m=300))
    options = {"engine": "heightfield", "samples": 1, "threads": 1, "exr": True} | render
    return config_with(terrain=terrain, scene=SceneConfig(horizon=True, views=views), render=RenderConfig(**options))


@pytest.fixture(scope="module")
def smooth():
    config = config_of()
    return grow_scene(config, scene_view(config.scene, CAMERA), 3)


@pytest.fixture(scope="module")
def rough():
    config = config_of(ROUGH)
    return grow_scene(config, scene_view(config.scene, CAMERA), 3)


def taken(scene, config, below_deg=6.0):
    with open_engine(scene, config, CAMERA, SUN) as engine:
        source = FrameSource.of(engine, config, CAMERA, RimCircles.of_scene(scene))
        frame = source.take(Shot(np.array([0, 0, HEIGHT_M]), level_view(below_deg), np.zeros(3), 1))
        return frame, source.labels(frame), source.crater_index(frame)


def test_the_sphere_touches_the_plane_at_the_site():
    assert drop_m(0, 0) == 0
    assert np.isclose(drop_m(30_000, 40_000), MOON_RADIUS_M - np.sqrt(MOON_RADIUS_M**2 - 50_000**2), rtol=1e-9)
    assert np.isclose(horizon_m(1500), 72_210, rtol=1e-3)
    dip = np.arccos(MOON_RADIUS_M / (MOON_RADIUS_M + HEIGHT_M))
    rays = np.array([[[np.cos(a), 0, -np.sin(a)] for a in (dip + 1e-6, dip - 1e-6, np.pi / 2, -0.1)]])
    assert hits_sphere(np.array([[0, 0, HEIGHT_M]]), rays).tolist() == [[True, False, True, False]]


def test_the_horizon_of_smooth_ground_lies_at_the_dip_of_the_sphere(smooth):
    frame, _, _ = taken(smooth, config_of(), 6.0)
    radiance = frame.radiance
    sky = np.isinf(radiance.depth_m)
    row = sky[:, 48].sum()
    below_deg = 6.0 + np.degrees(np.arctan((row - CAMERA.cy_px) / CAMERA.fy_px))
    dip_deg = np.degrees(np.arccos(MOON_RADIUS_M / (MOON_RADIUS_M + HEIGHT_M)))
    assert abs(below_deg - dip_deg) < np.degrees(1 / CAMERA.fy_px)
    assert abs(radiance.depth_m[~sky].max() / horizon_m(HEIGHT_M) - 1) < 0.1
    assert (radiance.radiance_factor[sky] == 0).all() and not radiance.sunlit[sky].any()
    assert (radiance.normal[sky] == 0).all()
    assert radiance.sunlit[~sky].mean() > 0.99


def test_heights_follow_the_sphere_and_the_site_is_at_zero(smooth):
    x, y = smooth.grid.vertices_xy()
    assert np.allclose(smooth.height_m, -drop_m(x, y), rtol=1e-6, atol=1e-3)
    assert smooth.grid.extent_m / 2 > horizon_m(HEIGHT_M) + 300


def test_both_engines_agree_up_to_the_horizon(rough):
    pytest.importorskip("bpy")
    found = [taken(rough, config_of(ROUGH, engine=name)) for name in ("cycles", "heightfield")]
    (one, labels, index), (two, others, _) = found
    a, b = one.radiance, two.radiance
    assert (np.isinf(a.depth_m) == np.isinf(b.depth_m)).mean() > 0.999
    both = np.isfinite(a.depth_m) & np.isfinite(b.depth_m)
    assert 0.2 < both.mean() < 0.8
    assert (np.abs(a.depth_m[both] / b.depth_m[both] - 1) < 1e-4).mean() > 0.998
    assert labels.crater_id.tolist() == others.crater_id.tolist() and len(labels.crater_id) >= 5
    sky = np.isinf(a.depth_m)
    assert (a.radiance_factor[sky & np.isinf(b.depth_m)] == 0).mean() > 0.99
    assert (a.normal[sky] == 0).all() and (index[sky] == -1).all()


def test_exposure_counts_only_ground():
    """The upper half is sky: 1.5 % of the ground's pixels are bright, 0.75 % of the image."""
    shape = CAMERA.height_px, CAMERA.width_px
    factor, depth = np.full(shape, 0.05, np.float32), np.full(shape, 1000, np.float32)
    factor[:36], depth[:36] = 0, np.inf
    factor[36, :52] = 0.1
    normal, sunlit, sensor = np.zeros((*shape, 3)), factor > 0, SensorConfig(psf_sigma_px=0)

    def time_s(radiance_factor, depth_m):
        return expose(Radiance(radiance_factor, depth_m, normal, sunlit), sensor, CAMERA, CAMERA, np.zeros(3)).time_s

    bright = time_s(np.full(shape, 0.1, np.float32), depth)
    assert time_s(factor, depth) == bright
    assert time_s(factor, np.full(shape, 1000, np.float32)) > 1.5 * bright
    assert time_s(np.zeros(shape, np.float32), np.full(shape, np.inf)) == sensor.longest_exposure_s


def test_craters_beyond_the_horizon_and_before_the_sky_are_not_visible(smooth):
    y = -np.array([3000.0, 78_000.0, 76_000.0])
    z = -drop_m(0 * y, y) + [0, 0, 3000.0]  # on the ground, behind the limb, and floating before the sky
    normal = np.tile([0, 0, 1.0], (3, 1))
    circles = RimCircles(np.arange(3), np.stack([0 * y, y, z], axis=1), normal, np.array([500.0, 6000.0, 6000.0]))
    pose = np.array([0, 0, HEIGHT_M]), level_view(12.0)
    with open_engine(smooth, config_of(), CAMERA, SUN) as engine:
        radiance = engine.render(*pose, 0, 0)
    labels = label_frame(circles, CAMERA, *pose, radiance, (0.1, 1e6))
    assert labels.crater_id.tolist() == [0, 1, 2]
    assert labels.visible_fraction[0] > 0.9
    assert labels.visible_fraction[1:].tolist() == [0, 0]
    index = crater_index(circles, CAMERA, *pose, radiance.depth_m)
    assert set(np.unique(index)) == {-1, 0}
    rotation = pose[1]
    centres = (circles.centre_m - pose[0]) @ rotation.T
    masks = crater_masks(CAMERA, [0, 1, 2], centres, normal @ rotation.T, circles.radius_m, radiance.depth_m)
    assert [bool(mask.visible.any()) for mask in masks] == [True, False, False]


@pytest.mark.parametrize(
    ("place", "below_deg", "message"),
    [
        ((0, 0, HEIGHT_M), -30, "a view of the sky alone"),
        ((0, 0, -5.0), 6, "a camera -5.0 m above the ground"),
        ((0, 0, 9000.0), 6, "a horizon 177"),
        ((200_000, 0, HEIGHT_M), 6, "a camera at x 200000 m"),
    ],
)
def test_poses_without_ground_are_refused(smooth, place, below_deg, message):
    poses = Poses(["s/t/000000"], np.array([place], float), quaternion_from_matrix(level_view(below_deg))[None])
    with pytest.raises(UserError, match=f"frame s/t/000000: got {message}"):
        check_poses(poses, CAMERA, smooth, "plan")


@pytest.mark.parametrize("below_deg", [90.0, 6.0, -15.0])
def test_poses_with_ground_and_sky_pass(smooth, below_deg):
    poses = Poses(["s/t/000000"], np.array([[0, 0, 1400.0]]), quaternion_from_matrix(level_view(below_deg))[None])
    check_poses(poses, CAMERA, smooth, "plan")


def test_the_command_makes_a_valid_dataset_with_sky_that_regenerates(tmp_path):
    level, down = quaternion_from_matrix(level_view(5.0)), quaternion_from_matrix(level_view(80.0))
    lines = [f"{t},{40 * t},0,{z},{','.join(map(str, q))}" for t, (z, q) in enumerate([(50, level), (80, down)])]
    (tmp_path / "poses.csv").write_text("\n".join(["# frame: O_L", "time_s,x_m,y_m,z_m,qw,qx,qy,qz", *lines, ""]))
    scene = {
        "name": "horizon",
        "terrain": {"spacing_px": 2.0},
        "render": {"samples": 1, "engine": "heightfield", "exr": True},
        "scene": {"sun_elevation_deg": 20, "horizon": True},
    }
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"dataset": scene}))
    (tmp_path / "camera.yaml").write_text("width_px: 64\nheight_px: 48\n")
    files = [f"--{name}={tmp_path / file}" for name, file in FILES.items()]
    done = in_process.call(main, "frames", *files, "--out", tmp_path / "out", "--preset", "tiny", "--workers", 0)
    assert done.returncode == 0, done.stderr
    made = open_dataset(tmp_path / "out")
    assert validate(made) == []
    assert made.info.recipe().config["scene"]["horizon"] is True
    rows = made.table("frames").sort_by("frame_id").to_pylist()
    depths = [read_radiance(tmp_path / "out" / row["exr_path"]).depth_m for row in rows]
    assert 0.2 < np.isinf(depths[0]).mean() < 0.6 and np.isfinite(depths[1]).all()
    done = in_process.call(main, "regenerate", "--manifest", tmp_path / "out", "--verify", "--all")
    assert done.returncode == 0 and "2 frames: 2 identical" in done.stdout
