"""Frames of lens models: bright rings painted on flat ground appear where the camera projects their circles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from tests.helpers.scenes import config_with, flat_scene
from tests.sampling import every
from tests.shared.geometry.test_lens_models import BENT, CAHVOR, CAHVORES, FISHEYE, KANNALA_BRANDT, UNIFIED

from perilune_render.config.dataset import LightConfig, RenderConfig, SensorConfig
from perilune_render.engines.frame_source import FrameSource, Shot
from perilune_render.engines.heightfield.engine import HeightfieldEngine
from perilune_render.engines.heightfield.surface import surface_of
from perilune_render.engines.open_engine import open_engine
from perilune_render.flight.sub_poses import row_times_s
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.resampling import refined
from perilune_render.imaging.sensor import motion_px
from perilune_render.labels.frame_labels import RimCircles, crater_index, label_frame
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.ellipse import rim_points
from perilune_shared.geometry.frames import matrix_from_rotation_vector, sun_direction

ALTITUDE_M, EXTENT_M, N_VERTICES = 25.0, 160.0, 1601
RING_M = 0.2
"""Width of a ring (sigma of its brightness), metres; two vertices of the ground."""
FINE = 8
"""Pixels of the picture for one pixel of the frame, along each axis."""
REACH_PX, STEP_PX = 9.0, 0.125
"""Search distance from a circle's image, and distance between the samples, pixels of the picture."""
LENSES = {
    "equidistant": FISHEYE,
    "kannala_brandt": KANNALA_BRANDT,
    "unified": UNIFIED,
    "unified with distortion": BENT,
    "cahvor": CAHVOR,
    "cahvore": CAHVORES[2],
}
CONFIG = config_with(light=LightConfig(photometry="lommel_seeliger"), render=RenderConfig(samples=2))
SUN = sun_direction(60, 50)
ROTATION = matrix_from_rotation_vector([0.1, -0.05, 0.4]) @ ROTATION_CAMERA_FROM_BODY
POSITION = np.array([1.0, -2.0, ALTITUDE_M])
CIRCLES = RimCircles(
    np.arange(7),
    np.array([[2.0, -1, 0], [12, 6, 0], [-14, 3, 0], [3, 19, 0], [-6, -22, 0], [34, -20, 0], [-30, 38, 0]]),
    np.tile([0.0, 0, 1], (7, 1)),
    np.array([5.0, 3.0, 4.0, 4.0, 3.5, 6.0, 7.0]),
)


def small(camera: Camera) -> Camera:
    """The camera with half as many pixels along each axis."""
    values = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    parameters = camera.parameters
    if camera.model.startswith("cahvor"):
        parameters = (parameters[0] / 2, *parameters[1:])
    return Camera(128, 100, *(each / 2 for each in values), camera.distortion, camera.model, parameters)


def finer(camera: Camera) -> Camera:
    """The camera with FINE times as many pixels along each axis."""
    fine = refined(camera, FINE)
    if camera.model.startswith("cahvor"):
        fine = replace(fine, parameters=(FINE * camera.parameters[0], *camera.parameters[1:]))
    return fine


@pytest.fixture(scope="module")
def scene():
    return flat_scene(EXTENT_M, N_VERTICES)


@pytest.fixture(scope="module")
def painted(scene):
    """The flat ground with bright rings on the circles."""
    surface = surface_of(scene)
    along = np.linspace(-EXTENT_M / 2, EXTENT_M / 2, N_VERTICES)
    x, y = np.meshgrid(along, along)
    albedo = np.full(x.shape, 0.02)
    for centre, radius in zip(CIRCLES.centre_m, CIRCLES.radius_m, strict=True):
        off = np.hypot(x - centre[0], y - centre[1]) - radius
        albedo += np.exp(-((off / RING_M) ** 2) / 2)
    surface.ground.vertex[:, 3] = albedo.ravel()
    return surface


def ring_offsets_px(picture: np.ndarray, curve_px: np.ndarray) -> np.ndarray:
    """Distances (n,) of a bright ring from a closed curve (n, 2), along its normals, pixels of the picture."""
    tangent = np.roll(curve_px, -1, axis=0) - np.roll(curve_px, 1, axis=0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    away = np.arange(-REACH_PX, REACH_PX + STEP_PX / 2, STEP_PX)
    places = curve_px[:, None] + away[:, None] * normal[:, None] - 0.5
    bright = map_coordinates(picture, [places[..., 1], places[..., 0]], order=3, mode="nearest")
    bright -= bright.min(axis=1, keepdims=True)
    bright[bright < 0.2 * bright.max(axis=1, keepdims=True)] = 0
    return (bright * away).sum(axis=1) / bright.sum(axis=1)


@pytest.mark.parametrize("name", every(2, list(LENSES)))
def test_a_painted_ring_appears_on_its_circle_and_its_label(scene, painted, name):
    camera = small(LENSES[name])
    position = [1.0, -2.0, 60.0] if name == "cahvor" else POSITION
    with HeightfieldEngine(scene, CONFIG, finer(camera), SUN, 1, painted) as engine:
        picture = engine.render(position, ROTATION).radiance_factor
    labels = label_frame(CIRCLES, camera, position, ROTATION, nothing(camera), (2.0, 50.0))
    points = rim_points(CIRCLES.centre_m, CIRCLES.normal, CIRCLES.radius_m, 256)
    n_measured, e = 0, labels.ellipses
    for row, crater in enumerate(labels.crater_id):
        curve = camera.project(camera_from_site(points[crater], position, ROTATION))
        if not ((curve > 2) & (curve < np.array([camera.width_px, camera.height_px]) - 2)).all():
            continue
        n_measured += 1
        assert np.sqrt(np.mean((ring_offsets_px(picture, FINE * curve) / FINE) ** 2)) < 0.015
        # The label is the ellipse that fits the curve best.
        cos, sin = np.cos(e.theta_rad[row]), np.sin(e.theta_rad[row])
        x, y = curve[:, 0] - e.cx_px[row], curve[:, 1] - e.cy_px[row]
        u, v = (x * cos + y * sin) / e.a_px[row], (y * cos - x * sin) / e.b_px[row]
        apart = (np.hypot(u, v) - 1) / np.hypot(u / e.a_px[row], v / e.b_px[row])
        assert np.abs(apart).max() < 0.1
    assert n_measured >= 4


def nothing(camera: Camera) -> Radiance:
    """A rendering of the sky alone."""
    shape = camera.height_px, camera.width_px
    return Radiance(np.zeros(shape), np.full(shape, np.inf), np.zeros((*shape, 3)), np.zeros(shape, bool))


@pytest.mark.parametrize("name", LENSES)
def test_depth_is_the_distance_along_the_ray_and_dark_pixels_see_nothing(scene, name):
    camera = small(LENSES[name])
    with HeightfieldEngine(scene, CONFIG, camera, SUN, 1) as engine:
        source = FrameSource.of(engine, CONFIG, camera, CIRCLES)
        frame = source.take(Shot(POSITION, ROTATION, np.zeros(3), 3))
    radiance, pixels = frame.radiance, camera.pixel_centres()
    rays = camera.rays(pixels) @ ROTATION
    starts = POSITION + camera.ray_starts(pixels) @ ROTATION
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = np.where(rays[..., 2] < 0, starts[..., 2] / -rays[..., 2], np.inf)
    hit = np.isfinite(radiance.depth_m)
    place = starts + np.where(np.isfinite(expected), expected, 0)[..., None] * rays
    assert (hit == (np.isfinite(expected) & (np.abs(place[..., :2]) < EXTENT_M / 2).all(axis=-1))).mean() > 0.999
    assert np.abs(radiance.depth_m[hit] / expected[hit] - 1).max() < 1e-5
    places = source.places_m(frame)
    assert np.abs(places[hit][:, 2]).max() < 2e-3 and np.abs(places[hit] - place[hit]).max() < 2e-2
    assert np.allclose(camera.project(camera_from_site(places[hit], POSITION, ROTATION)), pixels[hit], atol=1e-3)
    dark = np.isnan(rays[..., 0])
    assert (radiance.radiance_factor[dark] == 0).all() and not radiance.sunlit[dark].any()
    assert not radiance.normal[dark].any() and (radiance.radiance_factor[hit] > 0).all()
    assert (dark.mean() > 0.02) == (name not in ("unified with distortion", "cahvor", "cahvore"))


def test_parts_and_rows_of_a_frame_equal_the_whole(scene):
    camera = small(KANNALA_BRANDT)
    with HeightfieldEngine(scene, CONFIG, camera, SUN, 1) as engine:
        whole = engine.render(POSITION, ROTATION, 5)
        wanted = np.zeros((camera.height_px, camera.width_px), bool)
        wanted[40:50, 60:90] = True
        again = engine.render_again(nothing(camera), wanted, POSITION, ROTATION, 5)
        assert np.array_equal(again.radiance_factor[wanted], whole.radiance_factor[wanted])
        config = CONFIG.model_copy(update={"sensor": SensorConfig(row_time_s=1e-3)})
        source = FrameSource.of(engine, config, camera, CIRCLES)
        rolled = source.render(Shot(POSITION, ROTATION, np.array([0.0, 0, -20.0]), 5))
    times = row_times_s(camera.height_px, 1e-3)
    for row in (10, 90):
        with HeightfieldEngine(scene, CONFIG, camera, SUN, 1) as engine:
            moved = POSITION + times[row] * np.array([0.0, 0, -20.0])
            assert np.array_equal(engine.render(moved, ROTATION, source_seed()).depth_m[row], rolled.depth_m[row])


def source_seed() -> int:
    """The random seed of the engine for the shot above."""
    return Shot(POSITION, ROTATION, np.zeros(3), 5).render_seed


@pytest.mark.parametrize("name", LENSES)
def test_motion_is_the_shift_of_projected_points(name):
    camera = small(LENSES[name])
    depth = np.full((camera.height_px, camera.width_px), 25.0)
    depth[:10] = np.inf
    step, turn = np.array([0.02, -0.03, 0.05]), np.array([1e-3, 2e-3, -1e-3])
    motion = motion_px(depth, camera, step, turn)
    pixels = camera.pixel_centres()[60, 20:100:20]
    points = camera.points(pixels, np.full(4, 25.0))
    # The camera turns by `turn` in its axes, then the scene turns back.
    expected = camera.project((points - step) @ matrix_from_rotation_vector(-turn).T) - pixels
    assert np.allclose(motion[60, 20:100:20], expected, atol=2e-3) and np.isfinite(motion).all()


def test_the_crater_index_shows_each_disc(scene):
    camera = small(UNIFIED)
    with HeightfieldEngine(scene, CONFIG, camera, SUN, 1) as engine:
        depth = engine.render(POSITION, ROTATION).depth_m
    index = crater_index(CIRCLES, camera, POSITION, ROTATION, depth)
    places = POSITION + (camera.points(camera.pixel_centres(), np.where(np.isfinite(depth), depth, np.nan)) @ ROTATION)
    for k, (centre, radius) in enumerate(zip(CIRCLES.centre_m, CIRCLES.radius_m, strict=True)):
        inside = np.hypot(*(places[..., :2] - centre[:2]).transpose(2, 0, 1)) < radius
        assert inside.any() and ((index == k) == inside).mean() > 0.9995


@pytest.mark.parametrize("changes", [{"engine": "cycles"}, {"engine": "heightfield", "device": "cuda"}])
def test_other_engines_refuse_lens_models(scene, changes, monkeypatch):
    monkeypatch.setattr("perilune_render.provenance.versions._cuda_found", lambda: True)
    config = CONFIG.model_copy(update={"render": RenderConfig(**changes)})
    with pytest.raises(UserError, match=r"dataset\.render\.(engine|device): got c.*expected"):
        open_engine(scene, config, small(FISHEYE), SUN)
