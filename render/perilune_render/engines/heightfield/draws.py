"""NumPy's random numbers at any position of a stream, so that each pixel can draw its own in any order.

`np.random.default_rng` is PCG64: a linear congruential generator of 128 bits, of which each step gives 64 bits
(O'Neill, 2014, "PCG: A Family of Simple Fast Space-Efficient Statistically Good Algorithms", XSL-RR). Step n is reached
from the start in log2(n) multiplications. `Generator.random` makes two float32 of each output: first of the lower half,
then of the upper half.

    state = state_of(np.random.default_rng(7))
    uniform_pair(state, np.uint64(3))         # equals default_rng(7).random(8, np.float32)[6:8]

Philox4x64-10 (Salmon et al., 2011, doi 10.1145/2063384.2063405) needs no steps: it computes the output of any counter.
"""

import math

import numpy as np

from perilune_render.engines.heightfield.surface import INLINED
from perilune_render.provenance.kernels import njit

_HALF, _LOW = np.uint64(32), np.uint64(2**32 - 1)
_ZERO, _ONE = np.uint64(0), np.uint64(1)
_MULTIPLIER = np.uint64(2549297995355413924), np.uint64(4865540595714422341)
"""The generator's multiplier, upper and lower 64 bits."""
_ROTATION, _WORD, _SIX_BITS = np.uint64(58), np.uint64(64), np.uint64(63)
_PHILOX = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
"""Philox's multipliers."""
_WEYL = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
"""Philox's increments of the key."""
_PHILOX_ROUNDS = 10
_DROPPED_64, _UNIT_64 = np.uint64(11), 2.0**-53
"""A float64 uses the upper 53 of 64 bits."""
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


@njit(**INLINED)
def _wide_product(a, b):
    """Upper and lower 64 bits of the product of two uint64."""
    a0, a1, b0, b1 = a & _LOW, a >> _HALF, b & _LOW, b >> _HALF
    middle = a1 * b0 + ((a0 * b0) >> _HALF)
    upper = a0 * b1 + (middle & _LOW)
    return a1 * b1 + (middle >> _HALF) + (upper >> _HALF), a * b


@njit(**INLINED)
def philox(k0, k1, n):
    """The four uint64 of counter (n, 0, 0, 0) with the key (k0, k1); all are uint64."""
    first, second, third, fourth = n, _ZERO, _ZERO, _ZERO
    for _ in range(_PHILOX_ROUNDS):
        high0, low0 = _wide_product(_PHILOX[0], first)
        high1, low1 = _wide_product(_PHILOX[1], third)
        first, second, third, fourth = high1 ^ second ^ k0, low1, high0 ^ fourth ^ k1, low0
        k0, k1 = k0 + _WEYL[0], k1 + _WEYL[1]
    return first, second, third, fourth


@njit(**INLINED)
def normal_and_uniform(k0, k1, n):
    """A standard normal and a uniform number in [0, 1) of counter n, with the key (k0, k1); all uint64.

    The normal number is by Box and Muller, 1958, doi 10.1214/aoms/1177706645.
    """
    first, second, third, _ = philox(k0, k1, n)
    # Above 0, so that the logarithm is finite.
    radius = math.sqrt(-2.0 * math.log((np.float64(first >> _DROPPED_64) + 1.0) * _UNIT_64))
    angle = 2.0 * math.pi * np.float64(second >> _DROPPED_64) * _UNIT_64
    return radius * math.cos(angle), np.float64(third >> _DROPPED_64) * _UNIT_64


@njit(**INLINED)
def poisson(mean, uniform):
    """The Poisson number at the quantile `uniform`; `mean` is at most 700, where exp(-mean) is still above 0."""
    share = math.exp(-mean)
    total, count = share, 0
    # The sum of the shares can stay below the largest uniform numbers by rounding.
    while uniform > total and count < 10 * mean + 100:
        count += 1
        share *= mean / count
        total += share
    return count
