"""Random numbers at any position of NumPy's stream."""

import numpy as np
import pytest

from perilune_render.engines.heightfield.draws import state_of, uniform_pair
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
