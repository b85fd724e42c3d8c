"""What Blender renders against what the formulas say: photometry, depth, pixels of rims, shadows."""

import dataclasses
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from tests.helpers.scenes import config_with, flat_scene, round_craters
from tests.sampling import every

from perilune_render.config.dataset import LightConfig, RenderConfig
from perilune_render.engines.blender.renderer import Renderer
from perilune_render.labels.frame_labels import RimCircles, crater_index, label_frame
from perilune_render.terrain.craters.stamp import stamp_craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.frames import matrix_from_rotation_vector, sun_direction
from perilune_shared.photometry import LAWS, radiance_factor

CAMERA = Camera(96, 64, 110.0, 110.0, 50.0, 30.0)
TILTED = ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector(np.radians([12, -20, 30]))
POSITION = np.array([3.0, -5.0, 60.0])


def ground_points(camera, position, rotation):
    """Where each pixel's centre meets the plane z = 0, and the view direction there (from the ground to the camera)."""
    rays = camera.rays(camera.pixel_centres()) @ rotation
    depth = -position[2] / rays[..., 2]
    return position + rays * depth[..., None], depth, -rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("azimuth", "elevation"), every(3, [(70, 25), (200, 80), (310, 6)]))
def test_radiance_is_the_formulas(law, azimuth, elevation):
    sun = sun_direction(azimuth, elevation)
    config = config_with(
        light=LightConfig(photometry=law, sun_angular_diameter_deg=0.0), render=RenderConfig(samples=64)
    )
    with Renderer(flat_scene(400, 41), config, CAMERA, sun) as renderer:
        radiance = renderer.render(POSITION, TILTED)
    # The mean over each pixel, since the opposition surge has a cusp.
    fine = Camera(96 * 8, 64 * 8, 110.0 * 8, 110.0 * 8, 50.0 * 8, 30.0 * 8)
    _, _, view = ground_points(fine, POSITION, TILTED)
    expected = radiance_factor(law, sun[2], view[..., 2], view @ sun).reshape(64, 8, 96, 8).mean(axis=(1, 3))
    relative = np.abs(radiance.radiance_factor / expected - 1)
    assert relative.max() < 0.005 and np.median(relative) < 0.0005


def test_depth_is_along_the_axis_and_normals_are_in_the_sites_frame():
    slope = np.tile(0.2 * np.linspace(-200, 200, 41), (41, 1))
    with Renderer(flat_scene(400, 41, height_m=slope), config_with(), CAMERA, sun_direction(0, 60)) as renderer:
        radiance = renderer.render(POSITION, TILTED)
    rays = CAMERA.rays(CAMERA.pixel_centres()) @ TILTED
    normal = np.array([-0.2, 0, 1]) / np.hypot(0.2, 1)
    depth = -(POSITION @ normal) / (rays @ normal)
    assert np.allclose(radiance.depth_m, depth, rtol=1e-5)
    assert np.allclose(radiance.normal, normal, atol=1e-3)


def test_rendered_pixels_lie_on_the_height_field(scene, small_config, camera):
    position, rotation = np.array([40.0, -25.0, 500.0]), TILTED
    with Renderer(scene, small_config, camera, sun_direction(90, 40)) as renderer:
        radiance = renderer.render(position, rotation)
    points = position + (camera.rays(camera.pixel_centres()) * radiance.depth_m[..., None]) @ rotation
    error = points[..., 2] - value_at(scene.height_m, scene.grid, points[..., 0], points[..., 1])
    assert np.isfinite(radiance.depth_m).all()
    assert np.median(np.abs(error)) < 0.5 and np.quantile(np.abs(error), 0.99) < 2.5


def test_the_sun_casts_shadows_away_from_itself():
    height = np.zeros((201, 201))
    height[95:106, 95:106] = 10.0
    camera = Camera(200, 200, 200.0, 200.0, 100.0, 100.0)
    east = sun_direction(90, 45)
    with Renderer(flat_scene(100, 201, height_m=height), config_with(), camera, east) as renderer:
        image = renderer.render(np.array([0, 0, 100.0]), ROTATION_CAMERA_FROM_BODY).radiance_factor
    dark = np.argwhere(image < 1e-6)
    # East is -X, left in the image: the shadow falls to the right, about as long as the block is high.
    assert 120 < len(dark) < 400 and dark[:, 1].min() > 100 and dark[:, 1].max() < 140


def test_one_bounce_lights_shadows_that_still_count_as_shadows():
    x = np.linspace(-50, 50, 201)
    # A hollow of a sphere of radius 50 m, 40 m in radius at its rim.
    bowl = 30 - np.sqrt(2500 - np.minimum(np.hypot(x[None, :], x[:, None]), 40) ** 2)
    above, camera = np.array([0, 0, 100.0]), Camera(100, 100, 100.0, 100.0, 50.0, 50.0)
    frames = {}
    for bounce in (False, True):
        light = LightConfig(photometry="lambert", bounce=bounce, sun_angular_diameter_deg=0.0)
        config = config_with(light=light, render=RenderConfig(samples=64))
        with Renderer(flat_scene(100, 201, height_m=bowl), config, camera, sun_direction(90, 15)) as renderer:
            frames[bounce] = renderer.render(above, ROTATION_CAMERA_FROM_BODY)
    dark = frames[False].radiance_factor == 0
    # In a sphere every place sees every other alike: albedo^2 times the light through the rim over the sphere's area.
    expected = 0.12**2 * np.sin(np.radians(15)) * np.pi * 40**2 / (4 * np.pi * 50**2)
    assert dark.sum() > 500 and frames[True].radiance_factor[dark].mean() == pytest.approx(expected, rel=0.05)
    assert not frames[True].sunlit[dark].any()
    assert (frames[True].sunlit == frames[False].sunlit).mean() > 0.995


@pytest.mark.parametrize(("longitude_deg", "earth_sine"), [(60.0, 0.5), (-120.0, 0.0)])
@pytest.mark.parametrize("bounce", [False, True])
def test_earthshine_lights_the_near_side_only(longitude_deg, earth_sine, bounce):
    height = np.zeros((201, 201))
    height[95:106, 95:106] = 10.0
    scene = dataclasses.replace(flat_scene(100, 201, height_m=height), longitude_deg=longitude_deg)
    light = LightConfig(photometry="lambert", earthshine=True, bounce=bounce)
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)
    with Renderer(scene, config_with(light=light), camera, sun_direction(90, 45)) as renderer:
        frame = renderer.render(np.array([0, 0, 100.0]), ROTATION_CAMERA_FROM_BODY)
    # The block's shadow, on flat ground west of it; the Earth stands in the west.
    shadow = np.s_[49:52, 56:60]
    assert not frame.sunlit[shadow].any() and frame.sunlit.mean() > 0.9
    expected = 0.12 * 0.1 / 1361 * earth_sine
    assert np.median(frame.radiance_factor[shadow]) == pytest.approx(expected, rel=0.02, abs=1e-12)


def test_label_ellipses_lie_on_rendered_rims():
    """A fresh crater's crest is where the normal turns: fit its pixels and compare with the label."""
    x, y, d = np.array([-25.0, 75.0, 20.0]), np.array([20.0, -50.0, 70.0]), np.array([80.0, 60.0, 45.0])
    craters = round_craters(np.stack([x, y, d, np.full(3, 0.15)], axis=1))
    height, grid = np.zeros(1001 * 1001), Grid.even(200, 500)
    stamp_craters(height, np.ones_like(height), grid, craters, np.zeros(3))
    scene = flat_scene(400, 1001, craters, height)
    camera = Camera.from_field_of_view(512, 512, 50.0)
    position, rotation = (
        np.array([10.0, 15.0, 330.0]),
        ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector([0.2, 0.15, 0.4]),
    )
    with Renderer(scene, config_with(), camera, sun_direction(90, 60)) as renderer:
        radiance = renderer.render(position, rotation)
    labels = label_frame(RimCircles.of_scene(scene), camera, position, rotation, radiance, (2, 150))
    assert labels.crater_id.tolist() == [0, 1, 2]
    assert (labels.visible_fraction > 0.95).all() and (labels.sunlit_fraction > 0.95).all()
    # The tilted view passes the small ground's edge: there is no depth.
    depth = np.where(np.isfinite(radiance.depth_m), radiance.depth_m, 1e6)
    points = position + (camera.rays(camera.pixel_centres()) * depth[..., None]) @ rotation
    for k in range(3):
        # Pixels whose ground lies on the rim circle must lie on the ellipse.
        on_rim = np.abs(np.hypot(points[..., 0] - x[k], points[..., 1] - y[k]) - d[k] / 2) < 0.15
        e = labels.ellipses
        dv, du = np.argwhere(on_rim).T + 0.5
        du, dv = du - e.cx_px[k], dv - e.cy_px[k]
        cos, sin = np.cos(e.theta_rad[k]), np.sin(e.theta_rad[k])
        radial = np.sqrt(((du * cos + dv * sin) / e.a_px[k]) ** 2 + ((dv * cos - du * sin) / e.b_px[k]) ** 2)
        assert len(radial) > 50 and abs(radial.mean() - 1) * e.a_px[k] < 0.3
    index = crater_index(RimCircles.of_scene(scene), camera, position, rotation)
    # Each crater's floor carries its own index, the ground between none.
    floor = np.hypot(points[..., 0] - x[1], points[..., 1] - y[1]) < 20
    between = np.min([np.hypot(points[..., 0] - x[k], points[..., 1] - y[k]) / d[k] for k in range(3)], axis=0) > 0.55
    assert (index[floor] == 1).all() and (index[between] == -1).all()


def test_a_hidden_rim_and_a_dark_crater_are_reported():
    """A low Sun leaves the crater behind a wall dark; a wall between hides its rim from a slanted view."""
    n = 401
    height = np.zeros((n, n))
    height[:, 150:160] = 60.0
    craters = round_craters([(-5, 0, 30, 0.1)])
    scene = flat_scene(200, n, craters, height)
    camera = Camera.from_field_of_view(256, 256, 50.0)
    sun = sun_direction(90, 20)
    slanted = ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector([0, np.radians(50), 0])
    with Renderer(scene, config_with(), camera, sun) as renderer:
        above = np.array([0, 0, 180.0])
        lit = label_frame(
            RimCircles.of_scene(scene),
            camera,
            above,
            ROTATION_CAMERA_FROM_BODY,
            renderer.render(above, ROTATION_CAMERA_FROM_BODY),
            (2, 90),
        )
        assert lit.visible_fraction[0] > 0.9 and lit.sunlit_fraction[0] < 0.1
        aside = np.array([-150.0, 0, 100.0])
        circles = RimCircles.of_scene(scene)
        hidden = label_frame(circles, camera, aside, slanted, renderer.render(aside, slanted), (2, 90))
        if len(hidden.crater_id) == 0:
            slanted = ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector([0, np.radians(-50), 0])
            hidden = label_frame(circles, camera, aside, slanted, renderer.render(aside, slanted), (2, 90))
    assert hidden.visible_fraction[0] < 0.6


def test_ctrl_c_during_a_frame_is_not_swallowed():
    config = config_with(render=RenderConfig(samples=60))
    with Renderer(flat_scene(400, 41), config, CAMERA, sun_direction(0, 40)) as renderer:
        renderer.render(POSITION, TILTED)
        timer = threading.Timer(0.02, lambda: os.kill(os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            for _ in range(100):
                renderer.render(POSITION, TILTED)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert renderer.render(POSITION, TILTED).radiance_factor.mean() > 0.01


@pytest.mark.parametrize("camera", [Camera(90, 70, 100.0, 100.0, 12.0, 61.0), Camera(90, 70, 100.0, 120.0, 70.0, 10.0)])
def test_a_point_lands_where_the_camera_projects_it(camera):
    """Small blocks on flat ground, seen by a camera whose principal point is far off the middle."""
    position = np.array([5.0, -3.0, 60.0])
    ground, _, _ = ground_points(camera, position, TILTED)
    # On the grid of half a metre, near three places in the image.
    place = np.round(2 * ground[[12, 35, 58], [15, 80, 30], :2]) / 2
    height = np.zeros((601, 601))
    for x, y in place:
        row, column = round(2 * y) + 300, round(2 * x) + 300
        height[row - 2 : row + 3, column - 2 : column + 3] = 1.0
    with Renderer(flat_scene(300, 601, height_m=height), config_with(), camera, sun_direction(0, 60)) as renderer:
        radiance = renderer.render(position, TILTED)
    pixels = camera.project(camera_from_site(np.column_stack([place, np.full(3, 1.0)]), position, TILTED))
    rays = camera.rays(camera.pixel_centres()) @ TILTED
    high = position[2] + rays[..., 2] * radiance.depth_m > 0.4
    assert camera.inside(pixels).all()
    seen = np.argwhere(high)[:, ::-1] + 0.5
    own = np.argmin(np.linalg.norm(seen[:, None] - pixels, axis=2), axis=1)
    for k in range(3):
        assert (own == k).sum() >= 3
        assert np.allclose(seen[own == k].mean(axis=0), pixels[k], atol=0.7)


def test_exact_depth_and_normals_leave_the_radiance_as_it_is(scene, small_config, camera):
    frames = {}
    for exr in (False, True):
        config = config_with(terrain=small_config.terrain, render=RenderConfig(samples=3, exr=exr))
        with Renderer(scene, config, camera, sun_direction(90, 20)) as renderer:
            frames[exr] = [renderer.render(np.array([0, 0, z]), TILTED, seed=7) for z in (700.0, 300.0)]
    for plain, exact in zip(frames[False], frames[True], strict=True):
        assert np.array_equal(plain.radiance_factor, exact.radiance_factor)
        assert np.array_equal(plain.sunlit, exact.sunlit)
        # Both depths are of the pixel's centre; normals of several rays are means over ground that turns.
        assert np.allclose(plain.depth_m, exact.depth_m, rtol=1e-4)
        assert (np.abs(plain.normal - exact.normal).max(axis=-1) > 1e-3).mean() > 0.1


def test_one_renderer_at_a_time_in_a_process():
    """Blender holds one scene: a second Renderer would silently take the first one's place."""
    ground, sun = flat_scene(100, 11), sun_direction(0, 60)
    with Renderer(ground, config_with(), CAMERA, sun) as first:
        with pytest.raises(RuntimeError, match="another Renderer is open"):
            Renderer(ground, config_with(), CAMERA, sun)
        assert first.stage.camera is not None
    with pytest.raises(RuntimeError, match="closed"):
        first.render(np.array([0, 0, 100.0]), np.diag([1.0, -1.0, -1.0]))
    with pytest.raises(AttributeError):
        Renderer(None, config_with(), CAMERA, sun)
    with Renderer(ground, config_with(), CAMERA, sun) as second:
        assert (second.render(np.array([0, 0, 100.0]), np.diag([1.0, -1.0, -1.0])).radiance_factor > 0).all()


def test_one_thread_renders_on_one_core_and_lets_python_run():
    """Blender's pool of threads must not spin while one thread renders; Python's other threads must not wait for it."""
    config, gap_s = config_with(render=RenderConfig(samples=200, threads=1)), []

    def cpu_s(thread):
        fields = (thread / "stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def measure_gaps():
        last = time.monotonic()
        while not stopped.wait(0.01):
            gap_s.append(time.monotonic() - last)
            last += gap_s[-1]

    with Renderer(flat_scene(400, 41), config, CAMERA, sun_direction(0, 40)) as renderer:
        renderer.render(POSITION, TILTED)
        threads = list(Path("/proc/self/task").iterdir())
        before, stopped = [cpu_s(thread) for thread in threads], threading.Event()
        measuring = threading.Thread(target=measure_gaps)
        measuring.start()
        renderer.render(POSITION, TILTED)
        stopped.set()
        measuring.join()
    used_s = sorted(cpu_s(thread) - start for thread, start in zip(threads, before, strict=True))
    assert used_s[-1] > 0.5
    assert sum(used_s[:-1]) < 0.2 * used_s[-1]
    assert max(gap_s) < 0.5 * used_s[-1]


def test_all_cores_render_by_default():
    with Renderer(flat_scene(400, 41), config_with(), CAMERA, sun_direction(0, 40)) as renderer:
        assert renderer.stage.render.threads == len(os.sched_getaffinity(0))
