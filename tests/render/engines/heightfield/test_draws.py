"""Random numbers at any position of NumPy's stream."""

import numpy as np
import pytest
import scipy.stats

from perilune_render.engines.heightfield.draws import normal_and_uniform, philox, poisson, state_of, uniform_pair
from perilune_render.streams import stream


@pytest.mark.parametrize("seed", [0, 7, 2**62])
def test_any_position_gives_the_numbers_of_numpy(seed):
    expected = stream(seed, "rays").random(200_002, np.float32)
    state = state_of(stream(seed, "rays"))
    for n in (0, 1, 2, 3, 17, 1000, 65_535, 100_000):
        first, second = uniform_pair(state, np.uint64(n))
        assert (first, second) == (expected[2 * n], expected[2 * n + 1])


def test_far_positions():
    """NumPy's own jump: 2^33 steps ahead."""
    rng = np.random.default_rng(3)
    state = state_of(rng)
    rng.bit_generator.advance(2**33)
    assert uniform_pair(state, np.uint64(2**33)) == tuple(rng.random(2, np.float32))


def test_a_used_half_or_another_generator_is_refused():
    rng = np.random.default_rng(1)
    rng.random(1, np.float32)
    with pytest.raises(ValueError, match="new PCG64"):
        state_of(rng)
    with pytest.raises(ValueError, match="got Philox"):
        state_of(np.random.Generator(np.random.Philox(1)))


@pytest.mark.parametrize("n", [1, 2, 77, 2**40])
def test_a_counter_gives_the_numbers_of_numpy(n):
    key = np.array([123_456_789_123_456_789, 2**63 + 5], np.uint64)
    # NumPy counts up before it computes an output.
    expected = np.random.Philox(key=key, counter=[n - 1, 0, 0, 0]).random_raw(4)
    np.testing.assert_array_equal(np.array(philox(key[0], key[1], np.uint64(n))), expected)


def test_noise_of_a_counter_has_its_distribution():
    drawn = np.array([normal_and_uniform(np.uint64(5), np.uint64(6), np.uint64(n)) for n in range(20_000)])
    assert scipy.stats.kstest(drawn[:, 0], "norm").pvalue > 1e-3
    assert scipy.stats.kstest(drawn[:, 1], "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.03


@pytest.mark.parametrize("mean", [0.0, 0.3, 5.0, 99.0])
def test_poisson_numbers_are_quantiles(mean):
    quantiles = [1e-6, 0.1, 0.5, 0.9, 1 - 1e-9]
    expected = scipy.stats.poisson.ppf(quantiles, mean) if mean else np.zeros(5)
    np.testing.assert_array_equal([poisson(mean, each) for each in quantiles], expected)
