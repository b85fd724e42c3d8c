"""Contrast, lit share and instance image of labels against scenes that are known by formula."""

from dataclasses import replace

import numpy as np
import pytest

from perilune_render.config.dataset import LabelsConfig, SensorConfig
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.sensor import expected, expose
from perilune_render.labels.frame_labels import GreyAndSun, RimCircles, crater_index, label_frame, with_contrast
from perilune_render.labels.pixels import REACH, Circles, Rims, centred_in, contrasts, rim_shares, sunlit_fractions
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.ellipse import Ellipses, plane_basis, project_circles, rim_points
from perilune_shared.geometry.frames import matrix_from_rotation_vector, sun_direction
from perilune_shared.labels.masks import SLACK_PX, SLACK_RADII, crater_masks
from perilune_shared.labels.thresholds import REACH_RADII

CAMERA = Camera.from_field_of_view(128, 128, 50.0)
ABOVE = np.array([0.0, 0.0, 500.0])
RADIUS_M = 40.0
PLACE_M = np.array([20.0, -35.0])
CRATER = RimCircles(np.array([5]), np.array([[*PLACE_M, 0.0]]), np.array([[0, 0, 1.0]]), np.array([RADIUS_M]))


def turned(*degrees):
    return ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector(np.radians(degrees))


def shaded(ratio, sun, camera=CAMERA, position=ABOVE, rotation=ROTATION_CAMERA_FROM_BODY, rough=0.0, radius=RADIUS_M):
    """A bowl of depth ratio x diameter in a plane, painted onto it by Lambert's law, with rough slopes about it."""
    rays = camera.rays(camera.pixel_centres()) @ rotation
    depth = -position[2] / rays[..., 2]
    x, y = np.moveaxis((position + rays * depth[..., None])[..., :2] - PLACE_M, -1, 0)
    r = np.hypot(x, y) / radius
    # z = -depth (1 - r^2)^2 within the rim: no edge at all.
    steep = np.where(r < 1, 2 * ratio * radius * 4 * (1 - r**2) / radius**2, 0.0)
    slope_x = steep * x + rough * (np.sin(x / 7) + np.sin((x - 2 * y) / 11))
    slope_y = steep * y + rough * np.sin((y + x) / 5)
    light = (sun[2] - slope_x * sun[0] - slope_y * sun[1]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    factor = np.maximum(0.1 * light, 0).astype(np.float32)
    return Radiance(factor, depth.astype(np.float32), np.zeros((*depth.shape, 3)), factor > 0)


def contrast(ratio, sun, sensor=None, **scene):
    """The bowl's contrast through the whole sensor."""
    sensor = sensor or SensorConfig()
    radiance = shaded(ratio, sun, **scene)
    camera = scene.get("camera", CAMERA)
    pose = scene.get("position", ABOVE), scene.get("rotation", ROTATION_CAMERA_FROM_BODY)
    circles = replace(CRATER, radius_m=np.array([scene.get("radius", RADIUS_M)]))
    labels = label_frame(circles, camera, *pose, radiance, (2, 50))
    assert labels.crater_id.tolist() == [5] and np.isnan(labels.contrast).all()
    shown = GreyAndSun(*expected(expose(radiance, sensor, camera, camera, np.zeros(3)), sensor), sun)
    return float(with_contrast(labels, circles, camera, *pose, shown).contrast[0])


def test_contrast_is_nothing_without_depth_and_rises_with_it():
    sun = sun_direction(70, 30)
    assert abs(contrast(0.0, sun)) < 0.01
    values = [contrast(ratio, sun, rough=0.03) for ratio in (0.0, 0.005, 0.01, 0.02, 0.05)]
    assert abs(values[0]) < 3 and np.all(np.diff(values) > 1)
    assert contrast(0.1, sun) > 30 and contrast(-0.1, sun) < -30


def test_the_bound_grows_with_the_image_and_what_it_leaves_out_is_counted():
    assert LabelsConfig().bounds_px(128) == LabelsConfig().bounds_px(256) == (2.0, 50.0)
    assert LabelsConfig().bounds_px(1024) == (2.0, 200.0)
    assert LabelsConfig(max_radius_px=50.0).bounds_px(1024) == (2.0, 50.0)
    radiance = shaded(0.1, sun_direction(70, 30))
    for largest_px, count in ((50, 0), (5, 1)):
        found = label_frame(CRATER, CAMERA, ABOVE, ROTATION_CAMERA_FROM_BODY, radiance, (2, largest_px))
        assert (len(found.crater_id), found.n_above) == (1 - count, count)


def test_a_dark_frame_gives_no_contrast():
    assert contrast(0.1, sun_direction(70, -20)) == 0


def test_contrast_rises_with_a_low_sun():
    values = [contrast(0.01, sun_direction(200, elevation), rough=0.01) for elevation in (85, 70, 50, 30)]
    assert np.all(np.diff(values) > 0)
    # With the Sun overhead no wall faces it more than another.
    assert abs(contrast(0.01, np.array([0, 0, 1.0]))) < 0.1


def test_contrast_falls_with_noise_clutter_and_blur():
    sun = sun_direction(70, 30)
    for worse in (
        {"read_noise_e": 200.0},
        {"full_well_e": 1000.0, "responsivity_e_per_s": 5e6},
        {"bits": 8, "gain": 0.1},
    ):
        sensor = SensorConfig(exposure="fixed", exposure_time_s=0.001, **{"read_noise_e": 15.0, **worse})
        good = SensorConfig(exposure="fixed", exposure_time_s=0.001)
        assert contrast(0.005, sun, sensor, radius=8.0) < 0.9 * contrast(0.005, sun, good, radius=8.0), worse
    plain = contrast(0.005, sun, radius=20.0)
    assert contrast(0.005, sun, rough=0.05, radius=20.0) < 0.8 * plain
    assert contrast(0.005, sun, SensorConfig(psf_sigma_px=3.0), radius=20.0) < 0.5 * plain


@pytest.mark.parametrize("angle", [90, 180, 270])
def test_a_quarter_turn_of_the_camera_changes_nothing(angle):
    sun = sun_direction(70, 30)
    expected_value = contrast(0.02, sun, rough=0.02)
    assert contrast(0.02, sun, rough=0.02, rotation=turned(0, 0, angle)) == pytest.approx(expected_value, rel=1e-4)


def test_contrast_hardly_depends_on_turn_tilt_and_lens():
    sun = sun_direction(70, 30)
    straight = contrast(0.02, sun, rough=0.02)
    barrel = replace(CAMERA, distortion=(-0.15, 0.0, 0.002, 0.0, 0.0))
    for scene in ({"rotation": turned(0, 0, 37)}, {"rotation": turned(9, -7, 20)}, {"camera": barrel}):
        assert contrast(0.02, sun, rough=0.02, **scene) == pytest.approx(straight, rel=0.15), scene


def test_contrast_is_a_number_of_standard_errors():
    """Least squares by other means on many noisy frames: the strength of the shading scatters by what is said."""
    rng = np.random.default_rng(4)
    matrix = np.array([[6.0, 2.0], [-1.5, 5.0]])
    centre = np.array([20.3, 17.8])
    offset = CAMERA.pixel_centres()[:40, :40] - centre
    s, t = np.moveaxis(offset @ np.linalg.inv(matrix).T, -1, 0)
    r = np.hypot(s, t)
    bowl = -s * np.exp(-((r / 0.8) ** 4))
    near = r <= 1.5
    design = np.stack([np.ones_like(s), s, t, bowl], axis=-1)[near]
    clean, noise = 90 + 3 * s - 2 * t + 4 * bowl, 2.5
    found = [
        np.linalg.lstsq(design, (clean + noise * rng.standard_normal(clean.shape))[near], rcond=None)[0][3]
        for _ in range(2000)
    ]
    value = contrasts(centre[None], matrix[None], clean, np.full(clean.shape, noise))[0]
    assert np.mean(found) == pytest.approx(4, rel=0.02) and value == pytest.approx(4 / np.std(found), rel=0.05)
    # Clutter that was drawn once counts as much as noise of its size.
    still = np.zeros(clean.shape)
    cluttered = [clean + noise * rng.standard_normal(clean.shape) for _ in range(300)]
    values = [contrasts(centre[None], matrix[None], grey, still)[0] for grey in cluttered]
    assert np.mean(values) == pytest.approx(value, rel=0.05)
    # Out of the image, or with no matrix, nothing shows.
    nothing = contrasts(np.array([[-50.0, 5], [20, 20]]), np.stack([matrix, np.full((2, 2), np.nan)]), clean, clean)
    assert nothing.tolist() == [0, 0]


def test_the_lit_share_is_that_of_the_ellipses_pixels():
    rng = np.random.default_rng(1)
    n = 60
    a = rng.uniform(1, 30, n)
    theta = rng.uniform(0, np.pi, n)
    ellipses = Ellipses(rng.uniform(-5, 105, n), rng.uniform(-5, 85, n), a, a * rng.uniform(0.3, 1, n), theta)
    sunlit = rng.random((80, 100)) < 0.4
    found = sunlit_fractions(ellipses, sunlit)
    row, column = np.mgrid[:80, :100] + 0.5
    for k in range(n):
        dx, dy = column - ellipses.cx_px[k], row - ellipses.cy_px[k]
        along, across = dx * np.cos(theta[k]) + dy * np.sin(theta[k]), dy * np.cos(theta[k]) - dx * np.sin(theta[k])
        inside = (along / ellipses.a_px[k]) ** 2 + (across / ellipses.b_px[k]) ** 2 <= 1
        assert found[k] == pytest.approx(sunlit[inside].mean() if inside.any() else 0)


def scattered(n=300):
    """Craters about the origin, tilted a little."""
    rng = np.random.default_rng(8)
    centre = np.column_stack([rng.uniform(-400, 400, (n, 2)), rng.uniform(-5, 5, n)])
    normal = np.column_stack([0.2 * rng.standard_normal((n, 2)), np.ones(n)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return RimCircles(3 * np.arange(n), centre, normal, 5 * (1 - rng.random(n)) ** -0.7)


@pytest.mark.parametrize("hidden", [False, True])
def test_the_instance_image_is_the_smallest_of_the_masks(hidden):
    """Against masks made by other code, with half the image behind something near."""
    circles, rotation = scattered(), turned(12, -8, 30)
    depth = None
    if hidden:
        depth = np.full((128, 128), 1000.0)
        depth[:, 40:90] = 300.0
    index = crater_index(circles, CAMERA, ABOVE, rotation, depth)
    in_camera = camera_from_site(circles.centre_m, ABOVE, rotation)
    large = (2 * CAMERA.fx_px * circles.radius_m > in_camera[:, 2]) & (in_camera[:, 2] > 0)
    expected_index = np.full((128, 128), -1.0)
    normals = circles.normal @ rotation.T
    masks = crater_masks(CAMERA, circles.crater_id, in_camera, normals, circles.radius_m, depth)
    for k in np.argsort(-circles.radius_m):
        if large[k]:
            seen = masks[k].visible if hidden else masks[k].amodal
            expected_index[masks[k].window][seen] = circles.crater_id[k]
    np.testing.assert_array_equal(index, expected_index)
    assert len(np.unique(index)) > 50 and (not hidden or (index[:, 40:90] == -1).all())


def test_the_rule_of_visible_counts_the_pixels_in_which_contrast_is_measured():
    assert REACH == REACH_RADII


def test_craters_that_may_have_a_label_are_selected():
    rng = np.random.default_rng(3)
    centre, normal = rng.normal(0, 100, (20000, 3)), rng.normal(size=(20000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius = rng.uniform(0, 20, 20000)
    position, rotation = np.array([3.0, -2.0, 1.0]), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    found, places = centred_in(CAMERA, position, rotation, Circles(centre, normal, radius), 4.0)
    exact = camera_from_site(centre, position, rotation)
    np.testing.assert_array_equal(places, exact[found])
    inside = CAMERA.inside(CAMERA.project(exact))
    assert inside[found].all()
    with np.errstate(all="ignore"):
        radius_px = project_circles(CAMERA, exact, normal @ rotation.T, radius).radius_px()
    labelled = np.flatnonzero(inside & (radius_px >= 4.0) & (CAMERA.fx_px * radius > 2.0 * exact[:, 2]))
    assert len(labelled) > 500 and np.isin(labelled, found).all()
    closed = np.isfinite(radius_px[found])
    assert closed.sum() > 500 and (radius_px[found[closed]] > 0.985 * 4.0).all()


def test_visible_shares_of_rims_are_those_of_the_projected_points():
    rng = np.random.default_rng(5)
    normal = rng.normal(size=(300, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    centre, radius = rng.uniform(-60, 60, (300, 3)), rng.uniform(0.5, 15, 300)
    position = np.array([2.0, 1.0, 80.0])
    rotation = np.diag([1.0, -1.0, -1.0]) @ matrix_from_rotation_vector([0.1, 0.2, 0.3])
    depth = rng.uniform(40, 140, (CAMERA.height_px, CAMERA.width_px)).astype(np.float32)
    depth[:20] = np.inf
    angle = 2 * np.pi * np.arange(48) / 48
    rims = Rims(centre, *plane_basis(normal), radius, np.cos(angle), np.sin(angle))
    points = camera_from_site(rim_points(centre, normal, radius, 48), position, rotation)
    pixels = CAMERA.project(points)
    inside = CAMERA.inside(pixels)
    column, row = (np.where(inside, pixels[..., k], 0).astype(int) for k in range(2))
    slack = np.maximum(SLACK_RADII * radius, SLACK_PX * points[:, 0, 2] / CAMERA.fx_px)
    there = depth[row, column]
    expected_shares = (inside & np.isfinite(there) & (points[..., 2] <= there + slack[:, None])).mean(axis=1)
    assert ((expected_shares > 0) & (expected_shares < 1)).sum() > 50
    np.testing.assert_array_equal(rim_shares(rims, CAMERA, position, rotation, depth), expected_shares)
