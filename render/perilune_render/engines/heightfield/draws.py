"""NumPy's random numbers at any position of a stream, so that each pixel can draw its own in any order.

`np.random.default_rng` is PCG64: a linear congruential generator of 128 bits, of which each step gives 64 bits
(O'Neill, 2014, "PCG: A Family of Simple Fast Space-Efficient Statistically Good Algorithms", XSL-RR). Step n is reached
from the start in log2(n) multiplications. `Generator.random` makes two float32 of each output: first of the lower half,
then of the upper half.

    state = state_of(np.random.default_rng(7))
    uniform_pair(state, np.uint64(3))         # equals default_rng(7).random(8, np.float32)[6:8]
"""

import numpy as np

from perilune_render.engines.heightfield.surface import INLINED
from perilune_render.provenance.kernels import njit

_HALF, _LOW = np.uint64(32), np.uint64(2**32 - 1)
_ZERO, _ONE = np.uint64(0), np.uint64(1)
_MULTIPLIER = np.uint64(2549297995355413924), np.uint64(4865540595714422341)
"""The generator's multiplier, upper and lower 64 bits."""
_ROTATION, _WORD, _SIX_BITS = np.uint64(58), np.uint64(64), np.uint64(63)
_DROPPED, _UNIT = np.uint64(8), np.float32(2.0**-24)
"""A float32 uses the upper 24 of 32 bits."""


def state_of(rng: np.random.Generator) -> np.ndarray:
    """State and increment of a new PCG64 generator as (4,) uint64: state high, state low, increment high and low.

    Raises ValueError for another generator, or if half of an output is already used.
    """
    state = rng.bit_generator.state
    if state["bit_generator"] != "PCG64" or state["has_uint32"]:
        raise ValueError(f"generator: got {state['bit_generator']}, expected a new PCG64 generator")
    numbers = state["state"]["state"], state["state"]["inc"]
    return np.array([part for number in numbers for part in (number >> 64, number & (2**64 - 1))], np.uint64)


@njit(**INLINED)
def _product(ah, al, bh, bl):
    """Product of two numbers of 128 bits, modulo 2^128."""
    a0, a1, b0, b1 = al & _LOW, al >> _HALF, bl & _LOW, bl >> _HALF
    middle = a1 * b0 + ((a0 * b0) >> _HALF)
    upper = a0 * b1 + (middle & _LOW)
    return a1 * b1 + (middle >> _HALF) + (upper >> _HALF) + ah * bl + al * bh, al * bl


@njit(**INLINED)
def _total(ah, al, bh, bl):
    """Sum of two numbers of 128 bits, modulo 2^128."""
    low = al + bl
    return ah + bh + (_ONE if low < al else _ZERO), low


@njit(**INLINED)
def uniform_pair(state, n):
    """The two float32 in [0, 1) of output n (uint64) of a generator with `state` (4,) uint64."""
    left = n + _ONE
    # Factor and summand that make left steps at once, by repeated squaring.
    factor_h, factor_l, sum_h, sum_l = _ZERO, _ONE, _ZERO, _ZERO
    (step_h, step_l), plus_h, plus_l = _MULTIPLIER, state[2], state[3]
    while left > _ZERO:
        if left & _ONE:
            factor_h, factor_l = _product(factor_h, factor_l, step_h, step_l)
            sum_h, sum_l = _product(sum_h, sum_l, step_h, step_l)
            sum_h, sum_l = _total(sum_h, sum_l, plus_h, plus_l)
        more_h, more_l = _total(step_h, step_l, _ZERO, _ONE)
        plus_h, plus_l = _product(more_h, more_l, plus_h, plus_l)
        step_h, step_l = _product(step_h, step_l, step_h, step_l)
        left = left >> _ONE
    high, low = _product(factor_h, factor_l, state[0], state[1])
    high, low = _total(high, low, sum_h, sum_l)
    mixed, turn = high ^ low, high >> _ROTATION
    output = (mixed >> turn) | (mixed << ((_WORD - turn) & _SIX_BITS))
    first, second = (output & _LOW) >> _DROPPED, (output >> _HALF) >> _DROPPED
    return np.float32(first) * _UNIT, np.float32(second) * _UNIT
