import numpy as np

from perilune_render.config import SensorConfig
from perilune_render.sensor import develop

QUIET = SensorConfig(read_noise_e=0, psf_sigma_px=0, full_well_e=1e9, exposure_percentile=100)


def test_exposure_puts_the_bright_percentile_at_its_level():
    ramp = np.linspace(0, 0.2, 256 * 256).reshape(256, 256)
    image = develop(ramp, QUIET.model_copy(update={"exposure_level": 0.5}), np.random.default_rng(1))
    assert image.dtype == np.uint8 and image.max() == 128 and image.min() == 0
    assert abs(int(image[128, 128]) - 64) <= 1


def test_shadow_stays_black():
    assert develop(np.zeros((20, 20)), QUIET, np.random.default_rng(1)).max() == 0


def test_noise_variance_grows_with_the_signal():
    config = SensorConfig(read_noise_e=0, psf_sigma_px=0, full_well_e=2000, exposure_percentile=100, exposure_level=0.9)
    light = np.full((400, 400), 0.1)
    light[:200] = 0.02
    light[0, 0] = 0.1
    image = develop(light, config, np.random.default_rng(3)).astype(float) * 2000 / 255
    # Photon transfer: variance of a Poisson signal is its mean, plus that of quantisation (7.8^2 / 12 e^2).
    for part, mean in ((image[:200, 1:], 360), (image[200:], 1800)):
        assert abs(part.mean() / mean - 1) < 0.02
        assert abs((part.var() - 7.84**2 / 12) / mean - 1) < 0.06


def test_read_noise_shows_in_the_dark():
    config = SensorConfig(read_noise_e=300, psf_sigma_px=0, full_well_e=10_000, exposure_percentile=100)
    light = np.zeros((200, 200))
    light[0, 0] = 1
    image = develop(light, config, np.random.default_rng(3)).astype(float)[1:] * 10_000 / 255
    assert 0.4 < (image > 0).mean() < 0.55 and abs(np.sqrt((image**2).mean() * 2) / 300 - 1) < 0.1


def test_the_point_spread_keeps_the_light():
    light = np.full((64, 64), 0.001)
    light[32, 32] = 1.0
    sharp = develop(light, QUIET.model_copy(update={"exposure_level": 1.0}), np.random.default_rng(0))
    soft = develop(
        light, QUIET.model_copy(update={"exposure_level": 1.0, "psf_sigma_px": 1.0}), np.random.default_rng(0)
    )
    assert (sharp > 20).sum() == 1 and (soft > 20).sum() >= 9


def test_the_same_seed_gives_the_same_frame():
    light = np.random.default_rng(0).random((50, 50)) * 0.1
    frames = [develop(light, SensorConfig(), np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert np.array_equal(frames[0], frames[1]) and not np.array_equal(frames[0], frames[2])
