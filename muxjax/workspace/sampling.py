"""Which configurations a sweep looks at: sample n of a sweep is a function of (seed, n) alone.

Samples come in blocks of BLOCK; block k needs nothing but its number, so any process can compute
it, in any order, and a sweep can be resumed anywhere. Two samplers:

- ``"random"``: uniform Monte Carlo, Threefry-2x32 with the seed as key and (block, lane) as
  counter. There are 2^32 blocks, that is 5.6e14 samples, before a counter repeats.
- ``"lattice"``: the low-discrepancy additive recurrence frac(shift + n a), with a_d = g^-d and g
  the positive root of g^(D+1) = g + 1 (Roberts' R-sequence), in 64-bit integers, so that it is
  exact at any n. The seed gives the shift.

Uniform means uniform in the paper's coordinates: theta_i in [0, theta_max_i] and phi_i in
[0, 2 pi), all independent. (M VI-C says "Monte Carlo sampling" and no more.)
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt32

from muxjax.batched import Chain, Vector, series

Array = jax.Array | np.ndarray
Sampler = Literal["random", "lattice"]
SAMPLERS: tuple[Sampler, ...] = ("random", "lattice")

BLOCK = 1 << 17
COLUMNS = 1 << 10  # a lattice block is the outer sum of ROWS and COLUMNS numbers
ROWS = BLOCK // COLUMNS
_FRACTION_BITS = 24  # a float32 in [0, 1) holds these exactly
MAX_SAMPLES = BLOCK << 32

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))


def threefry(
    key: tuple[jax.Array, jax.Array], counter: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Threefry-2x32 with 20 rounds (Salmon et al., 2011): two random words a counter.

    ``jax.random`` has the same function, but on a CPU it runs as a loop over rounds that cannot
    be fused into the kernel that uses its words.
    """
    k0, k1 = (jnp.asarray(k, jnp.uint32) for k in key)
    keys = (k0, k1, k0 ^ k1 ^ np.uint32(0x1BD11BDA))
    x0, x1 = counter[0] + keys[0], counter[1] + keys[1]
    for group in range(5):
        for turn in _ROTATIONS[group % 2]:
            x0 = x0 + x1
            x1 = ((x1 << np.uint32(turn)) | (x1 >> np.uint32(32 - turn))) ^ x0
        x0 = x0 + keys[(group + 1) % 3]
        x1 = x1 + keys[(group + 2) % 3] + np.uint32(group + 1)
    return x0, x1


def random_fractions(
    key: UInt32[Array, " 2"], block: jax.Array, lane: jax.Array, n: int
) -> list[jax.Array]:
    """As many independent uniform numbers in [0, 1) for each lane, multiples of 2^-24.

    Args:
        key: The seed's low and high word.
        block: Block number, uint32, of each lane.
        lane: Index inside the block, any shape.
        n: Numbers a lane, at most 2^15.
    """
    words: list[jax.Array] = []
    for pair in range(-(-n * _FRACTION_BITS // 64)):
        place = lane.astype(jnp.uint32) | np.uint32(pair * BLOCK)
        words += threefry((key[0], key[1]), (jnp.broadcast_to(block, lane.shape), place))
    fractions = []
    for d in range(n):
        # 24 of 32 bits would waste a quarter of the words: number d is bits 24 d ... 24 d + 23.
        word, offset = divmod(d * _FRACTION_BITS, 32)
        bits = words[word] >> np.uint32(offset)
        if offset > 32 - _FRACTION_BITS:
            bits = bits | (words[word + 1] << np.uint32(32 - offset))
        fractions.append(_fraction(bits & np.uint32((1 << _FRACTION_BITS) - 1)))
    return fractions


def _fraction(bits: jax.Array) -> jax.Array:
    return bits.astype(jnp.int32).astype(jnp.float32) * np.float32(2.0**-_FRACTION_BITS)


@lru_cache(maxsize=8)
def lattice_steps(n: int) -> np.ndarray:
    """The recurrence's steps a_1 ... a_n as fractions of 2^64, shape (n,), uint64."""
    root = 2.0
    for _ in range(64):
        root = (1.0 + root) ** (1.0 / (n + 1))
    # Newton in integers of 256 bits: float64 would leave the low bits of a step meaningless.
    one = 1 << 256
    g = int(root * (1 << 60)) << 196
    for _ in range(6):
        power = one
        for _ in range(n):
            power = power * g >> 256
        value, slope = (power * g >> 256) - g - one, (n + 1) * power - one
        g -= value * one // slope
    steps, power = [], one
    for _ in range(n):
        power = power * one // g
        steps.append(power >> 192)
    return np.array(steps, np.uint64)


def lattice_parts(
    n: int, seed: int, block: int
) -> tuple[UInt32[np.ndarray, "n R"], UInt32[np.ndarray, "n C"]]:
    """Row and column of a lattice block, as 32-bit fractions; a sample is the sum of two.

    Truncating both to 32 bits moves a sample by less than 2^-31 of the range.
    """
    step, shift, column = _lattice_constants(n, seed)
    first = np.uint64(block * BLOCK)
    row = first + np.arange(ROWS, dtype=np.uint64) * np.uint64(COLUMNS)
    return _upper_word(shift[:, None] + step[:, None] * row), column


@lru_cache(maxsize=8)
def _lattice_constants(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steps, the seed's shift (both fractions of 2^64), and the column that all blocks share."""
    step = lattice_steps(n)
    shift = np.random.default_rng([seed, 0x6C61]).integers(0, 1 << 64, n, dtype=np.uint64)
    column = _upper_word(step[:, None] * np.arange(COLUMNS, dtype=np.uint64))
    return step, shift, column


def _upper_word(numbers: np.ndarray) -> np.ndarray:
    return (numbers >> np.uint64(32)).astype(np.uint32)


def lattice_fractions(rows: UInt32[Array, "n R"], columns: UInt32[Array, "n C"]) -> list[jax.Array]:
    """The n low-discrepancy numbers of a block, each of shape (R, C)."""
    drop = np.uint32(32 - _FRACTION_BITS)
    return [
        _fraction((r[:, None] + c[None, :]) >> drop) for r, c in zip(rows, columns, strict=True)
    ]


def bending_of(
    arm: Chain, theta_max: Float[jax.Array, " S"], fractions: list[jax.Array], in_plane: bool
) -> Vector:
    """Cartesian bending of uniform fractions, an array for each number.

    Args:
        arm: The robot.
        theta_max: Largest bending angles [rad].
        fractions: (theta_1, phi_1, theta_2, ...) as fractions of their ranges; without phi_1 if
            ``in_plane``.
        in_plane: phi_1 = 0, for arms whose rotation about the base axis gives nothing new.
    """
    polar = list(fractions)
    if in_plane:
        polar.insert(1, jnp.zeros_like(polar[0]))
    rows: list[jax.Array] = []
    for i in range(arm.n_segments):
        theta = polar[2 * i] * theta_max[i]
        if in_plane and i == 0:
            rows += [theta, jnp.zeros_like(theta)]
            continue
        cosine, sine = turn(polar[2 * i + 1])
        rows += [theta * cosine, theta * sine]
    return tuple(rows)


def turn(fraction: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(cos, sin) of an azimuth given as a fraction of a turn, by polynomials.

    The half angle h lies in [-pi/2, pi/2]; then cos = 1 - 2 sin^2 h and sin = 2 sin h cos h. The
    result is half a turn away from the fraction's own azimuth, which a uniform one does not mind.
    """
    half = (fraction - np.float32(0.5)) * np.float32(np.pi)
    sinc, cosine = series(0.25 * np.pi**2).evaluate(half * half)
    sine = half * sinc
    return 1 - 2 * sine * sine, 2 * sine * cosine
