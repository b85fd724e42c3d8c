"""The sensor's statistics on flat fields, as EMVA 1288 measures a camera, and where its light goes."""

import cv2
import numpy as np
import pytest

from perilune_render.config.dataset import SensorConfig
from perilune_render.imaging.radiance import Radiance
from perilune_render.imaging.sensor import FixedPattern, expected, expose, motion_px, psf_kernel, read_out
from perilune_shared.geometry.camera import Camera

CAMERA = Camera(200, 160, 220.0, 220.0, 100.0, 80.0)
BARREL = Camera(200, 160, 220.0, 220.0, 104.0, 77.0, (-0.15, 0.03, 0.002, -0.001, 0.0))
IDEAL = SensorConfig(
    exposure="fixed",
    exposure_time_s=0.001,
    responsivity_e_per_s=1e8,
    full_well_e=30_000,
    bits=16,
    read_noise_e=0,
    dark_current_e_per_s=0,
    dark_nonuniformity_e=0,
    gain_nonuniformity=0,
    hot_pixel_share=0,
    psf_sigma_px=0,
)
"""A fixed exposure that turns I/F into 100,000 electrons each, with shot noise alone."""
PER_E = 65535 / 30_000
"""Its grey values per electron."""


def sensor(**changes) -> SensorConfig:
    return SensorConfig.model_validate({**IDEAL.model_dump(), **changes})


def scene(light, camera=CAMERA, depth_m=500.0) -> Radiance:
    shape = camera.height_px, camera.width_px
    factor = np.broadcast_to(np.float32(light), shape)
    return Radiance(factor, np.full(shape, depth_m, np.float32), np.zeros((*shape, 3)), factor > 0)


def photograph(light, config, frame=0, camera=CAMERA, exr_camera=None, velocity=(0, 0, 0), seed=1):
    """A frame in floating grey values; the fixed pattern follows from `seed`, the noise from `frame`."""
    pattern = FixedPattern.draw(config, camera, seed)
    rng = np.random.default_rng(frame)
    exr_camera = exr_camera or camera
    exposure = expose(scene(light, exr_camera), config, camera, exr_camera, np.array(velocity))
    image = read_out(exposure, config, pattern, rng)
    assert image.shape == (camera.height_px, camera.width_px)
    return image.astype(float)


@pytest.mark.parametrize("gain", [0.5, 1.0, 2.0])
def test_photon_transfer_gives_the_gain(gain):
    """Half the variance of the difference of two frames, against the mean, has the slope K (EMVA 1288, 6.6)."""
    config = sensor(gain=gain, read_noise_e=12, dark_current_e_per_s=20_000, black_level_share=0.05)
    means, variances = [], []
    for light in (0.0, 0.0005, 0.01, 0.03, 0.06, 0.12):
        one, two = (photograph(light, config, frame) for frame in (1, 2))
        means.append((one + two).mean() / 2)
        variances.append((one - two).var() / 2)
    k = gain * PER_E
    assert means == pytest.approx(
        k * (1e5 * np.array([0, 0.0005, 0.01, 0.03, 0.06, 0.12]) + 20) + 0.05 * 65535, rel=2e-3
    )
    slope = np.polyfit(np.array(means) - means[0], variances, 1)[0]
    assert slope == pytest.approx(k, rel=0.03)
    # In the dark: read noise and shot noise of the dark current, and rounding.
    assert variances[0] == pytest.approx(k**2 * (12**2 + 20) + 1 / 12, rel=0.03)
    # On either side of where a Gaussian replaces the Poisson law.
    expected = k**2 * (12**2 + 20) + 1 / 12 + k * (np.array(means) - means[0])
    assert variances == pytest.approx(expected, rel=0.04)


def test_fixed_pattern_has_its_sizes_and_stays():
    """The mean of many frames keeps PRNU, DSNU and hot pixels and loses the noise."""
    config = sensor(gain_nonuniformity=0.02, dark_nonuniformity_e=40, black_level_share=0.1, exposure_time_s=0.0005)
    dark = np.mean([photograph(0.0, config, frame) for frame in range(4)], axis=0) / PER_E
    bright = np.mean([photograph(0.3, config, frame) for frame in range(64)], axis=0) / PER_E
    assert dark.std() == pytest.approx(40, rel=0.03)
    # PRNU: of the bright mean less the dark one; shot noise of 64 frames is left.
    assert np.sqrt((bright - dark).var() - 15_000 / 64) / 15_000 == pytest.approx(0.02, rel=0.03)
    other = np.mean([photograph(0.3, config, frame, seed=2) for frame in range(64)], axis=0) / PER_E
    assert abs(np.corrcoef(bright.ravel(), other.ravel())[0, 1]) < 0.05


def test_hot_pixels_are_at_the_same_places_in_all_frames():
    config = sensor(hot_pixel_share=0.01, hot_pixel_e=5_000, read_noise_e=5, exposure_time_s=0.002)
    hot = [photograph(0.0, config, frame) / PER_E > 100 for frame in range(3)]
    assert 0.008 < hot[0].mean() < 0.012
    assert (hot[0] != hot[1]).sum() <= 3 and (hot[0] != hot[2]).sum() <= 3
    extra = photograph(0.0, config)[hot[0]] / PER_E
    assert extra.mean() == pytest.approx(5_000, rel=0.25)


def test_the_signal_of_hot_pixels_grows_with_the_exposure_time():
    def brightest_e(time_s):
        config = sensor(hot_pixel_share=0.01, hot_pixel_e=1_000, exposure_time_s=time_s, dark_current_e_per_s=0)
        return np.sort(photograph(0.0, config) / PER_E, axis=None)[-400:].mean()

    assert brightest_e(0.004) / brightest_e(0.002) == pytest.approx(2, rel=0.02)
    assert brightest_e(0.0005) / brightest_e(0.002) == pytest.approx(0.25, rel=0.05)


def test_read_noise_shows_in_the_dark():
    image = photograph(0.0, sensor(read_noise_e=30, black_level_share=0.1)) / PER_E
    assert image.std() == pytest.approx(30, rel=0.03) and image.mean() == pytest.approx(3_000, abs=1)


@pytest.mark.parametrize(("bits", "kind"), [(8, np.uint8), (10, np.uint16), (12, np.uint16), (16, np.uint16)])
def test_grey_values_fill_the_bits(bits, kind):
    config = sensor(bits=bits)
    pattern = FixedPattern.draw(config, CAMERA, 1)
    light = np.linspace(0, 0.6, 200)
    rng = np.random.default_rng(1)
    image = read_out(expose(scene(light), config, CAMERA, CAMERA, np.zeros(3)), config, pattern, rng)
    assert image.dtype == kind and image.min() == 0 and image.max() == 2**bits - 1
    assert len(np.unique(image)) > 0.6 * min(2**bits, 5_000)
    assert image[:, 100].mean() == pytest.approx(light[100] * 1e5 / 30_000 * (2**bits - 1), rel=0.01, abs=0.5)


def test_a_fixed_exposure_is_linear_in_the_radiance_factor():
    grey = [photograph(light, sensor()).mean() for light in (0.02, 0.05, 0.1, 0.2)]
    assert grey == pytest.approx([PER_E * 1e5 * light for light in (0.02, 0.05, 0.1, 0.2)], rel=2e-3)
    assert photograph(0.1, sensor(exposure_time_s=0.002)).mean() == pytest.approx(2 * grey[2], rel=2e-3)
    assert photograph(0.9, sensor()).min() == 65535


def test_automatic_exposure_hits_its_level_within_its_bound():
    ramp = np.linspace(0.01, 0.05, 200)
    auto = {"exposure": "automatic", "exposure_percentile": 90.0, "exposure_level": 0.6}
    for changes in ({}, {"gain": 3.0}, {"black_level_share": 0.1}, {"dark_current_e_per_s": 1e6}):
        image = photograph(ramp, sensor(**auto, **changes))
        assert np.percentile(image, 90) / 65535 == pytest.approx(0.6, rel=0.01)
    short = photograph(ramp, sensor(**auto, longest_exposure_s=0.001))
    assert np.percentile(short, 90) == pytest.approx(np.percentile(ramp, 90) * 1e5 * PER_E, rel=0.01)


def test_shadow_stays_black():
    assert photograph(0.0, sensor(exposure="automatic")).max() == 0


@pytest.mark.parametrize("sigma", [0.2, 0.3, 0.45, 0.7, 1.0, 2.0])
def test_the_point_spread_has_its_variance_and_keeps_the_light(sigma):
    light = np.zeros((160, 200))
    light[80, 100] = 20.0
    spread = expose(scene(light), sensor(psf_sigma_px=sigma), CAMERA, CAMERA, np.zeros(3)).light.astype(float)
    assert spread.sum() == pytest.approx(20, rel=1e-5)
    v, u = np.mgrid[:160, :200]
    assert (spread * (u - 100) ** 2).sum() / spread.sum() == pytest.approx(sigma**2, rel=0.01)
    assert (spread * (v - 80) ** 2).sum() / spread.sum() == pytest.approx(sigma**2, rel=0.01)
    kernel = psf_kernel(sigma)
    assert kernel @ np.square(np.arange(len(kernel)) - len(kernel) // 2) == pytest.approx(sigma**2, rel=1e-6)


@pytest.mark.parametrize(("velocity", "blur_px"), [((100.0, 0, 0), 4.4), ((-20.0, 0, 0), 0.88)])
def test_motion_blurs_an_edge_by_its_way(velocity, blur_px):
    """100 m/s for 0.1 s at 500 m and 220 px is 4.4 px: the edge becomes a ramp of that length about its place."""
    edge = np.where(np.arange(200) < 100, 0.05, 0.15)
    changes = {"exposure_time_s": 0.1, "responsivity_e_per_s": 1e8, "full_well_e": 2e6}
    row = photograph(edge, sensor(**changes), velocity=velocity).mean(axis=0)
    slope, place = np.diff(row), np.arange(1, 200)
    slope = np.where(np.abs(place - 100) < 12, slope, 0) / slope.sum()
    centre = (slope * place).sum()
    # A box of the motion's length; its variance is a twelfth of the square.
    assert centre == pytest.approx(100, abs=0.02)
    assert (slope * (place - centre) ** 2).sum() == pytest.approx(blur_px**2 / 12, rel=0.1)
    still = photograph(edge, sensor(**changes, motion_blur=False), velocity=velocity).mean(axis=0)
    assert still[99] / still[50] == pytest.approx(1, rel=0.01) == still[100] / still[150]


@pytest.mark.parametrize("camera", [CAMERA, BARREL])
def test_motion_in_the_image_is_that_of_projected_points(camera):
    rng = np.random.default_rng(4)
    depth = rng.uniform(300, 400, (160, 200)).astype(np.float32)
    way = np.array([0.3, -0.2, 0.5])
    points = camera.rays(camera.pixel_centres()) * depth[..., None].astype(float)
    expected = camera.project(points - way / 2) - camera.project(points + way / 2)
    assert np.abs(motion_px(depth, camera, way) - expected).max() < 2e-3 * np.abs(expected).max()
    assert (motion_px(np.full((160, 200), np.inf, np.float32), camera, way) == 0).all()


def test_distortion_moves_a_dot_to_where_the_camera_projects_it():
    pinhole = BARREL.covering_pinhole()
    for u, v in ((12.3, 9.0), (190.0, 150.5), (104.0, 77.0), (15.0, 140.2)):
        ray = BARREL.rays([u, v])
        at = pinhole.project(ray) - 0.5
        y, x = np.mgrid[: pinhole.height_px, : pinhole.width_px]
        dot = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 2.0**2))
        image = photograph(0.25 * dot, sensor(motion_blur=False), camera=BARREL, exr_camera=pinhole)
        weight = np.where(image > 0.05 * image.max(), image, 0)
        y, x = np.mgrid[:160, :200] + 0.5
        centre = [(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()]
        assert np.allclose(centre, [u, v], atol=0.08)


def test_a_coarser_camera_averages_what_the_finer_one_saw():
    fine = np.random.default_rng(3).random((160, 200)).astype(np.float32) * 0.2
    half = Camera(100, 80, 110.0, 110.0, 50.0, 40.0)
    config = sensor(motion_blur=False, responsivity_e_per_s=1e10, full_well_e=3e6)
    image = photograph(fine, config, camera=half, exr_camera=CAMERA) / 65535 * 3e6 / 1e7
    expected = cv2.resize(fine, (100, 80), interpolation=cv2.INTER_AREA)
    assert np.abs(image - expected).max() < 0.005


def test_the_same_seed_gives_the_same_frame():
    light = np.random.default_rng(0).random((160, 200)) * 0.1
    frames = [photograph(light, SensorConfig(), frame) for frame in (1, 1, 2)]
    assert np.array_equal(frames[0], frames[1]) and not np.array_equal(frames[0], frames[2])


@pytest.mark.parametrize("light", [0.0, 0.003, 0.1, 0.25])
@pytest.mark.parametrize("bits", [8, 12])
def test_expected_mean_and_deviation_are_those_of_frames(light, bits):
    """Over many sensors and frames, with all noise but hot pixels."""
    config = sensor(
        bits=bits,
        read_noise_e=80,
        dark_current_e_per_s=20_000,
        dark_nonuniformity_e=40,
        gain_nonuniformity=0.02,
        black_level_share=0.05,
        psf_sigma_px=0.5,
    )
    images = np.array([photograph(light, config, frame, seed=frame) for frame in range(8)])
    mean, deviation = expected(expose(scene(light), config, CAMERA, CAMERA, np.zeros(3)), config)
    assert mean.dtype == deviation.dtype == np.float32 and mean.std() < 1e-4 * mean.mean()
    assert images.mean() == pytest.approx(mean.mean(), rel=1e-3)
    assert images.std() == pytest.approx(deviation.mean(), rel=0.01)


def test_what_is_expected_stops_at_the_full_well():
    config = sensor(bits=8, black_level_share=0.1)
    mean, _ = expected(expose(scene(5.0), config, CAMERA, CAMERA, np.zeros(3)), config)
    assert (mean == 255).all() and (photograph(5.0, config) == 255).all()
