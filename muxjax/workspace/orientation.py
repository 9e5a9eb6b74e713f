"""Grids on the rotation group: the test orientations, and the finer bins that samples fill.

Dexterity asks of each test orientation whether some sample came within 10 degrees of it. Asking
every sample would cost thousands of distances each; instead a sample marks the bin that it falls
into, and at the end a test orientation counts as met if a marked bin's centre is within the
tolerance. A sample is judged by its bin's centre, so the tolerance of this estimator is off by at
most ``bin_error().largest``; coverage for the tolerance less and plus the typical error shows by
how much that matters.

Quaternions are (w, x, y, z). A rotation and its negative quaternion are one; bins fold them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

Array = Any  # NumPy on the host, JAX in the kernel

TEST_ORIENTATIONS = 4608

# The bins cut the four facets |component| = largest of the quaternion cube. Equal steps of
# g + c_3 (g^3 - g) + c_5 (g^5 - g) make nearly equal angles: it is close to (4 / pi) atan(g).
_WARP_3, _WARP_5 = -0.3614, 0.0966


def _warp(g: Array) -> Array:
    square = g * g
    return g * ((1 - _WARP_3 - _WARP_5) + square * (_WARP_3 + square * _WARP_5))


def _facet(q: list[Array], mirrored: bool) -> tuple[Array, list[Array]]:
    """Facet number 0-3 and the three other components over the largest, in [-1, 1].

    With ``mirrored``, a rotation and its mirror image in the xz plane, (w, -x, y, -z), are one
    too: then (w, y) and (x, z) may each change sign, and the first number lies in [0, 1].
    """
    xp = np if isinstance(q[0], np.ndarray) else jnp
    w, x, y, z = q
    if mirrored:
        y = xp.where(w < 0, -y, y)
        z = xp.where(x < 0, -z, z)
        w, x = xp.abs(w), xp.abs(x)
    aw, ax, ay, az = (xp.abs(c) for c in (w, x, y, z))
    of_wx, of_yz = xp.maximum(aw, ax), xp.maximum(ay, az)
    first, wide = aw >= ax, of_wx >= of_yz
    third = ay >= az
    facet = xp.where(wide, xp.where(first, 0, 1), xp.where(third, 2, 3))
    largest = xp.where(wide, xp.where(first, w, x), xp.where(third, y, z))
    if mirrored:
        # w and x are not negative; the sign of a large y or z goes to the second number.
        sign = xp.where(largest < 0, np.float32(-1), np.float32(1))
        scale = 1 / xp.abs(largest)
        others = [
            xp.where(wide & first, x, w),
            xp.where(wide, y, x * sign),
            xp.where(wide | third, z, y),
        ]
        return facet, [c * scale for c in others]
    scale = 1 / largest
    others = [
        xp.where(wide & first, x, w),
        xp.where(wide, y, x),
        xp.where(wide | third, z, y),
    ]
    return facet, [c * scale for c in others]


def bin_index(q: list[Array], per_axis: int, mirrored: bool) -> Array:
    """Bin of each unit quaternion, int32 below ``n_bins(per_axis, mirrored)``; NumPy or JAX."""
    xp = np if isinstance(q[0], np.ndarray) else jnp
    facet, numbers = _facet(q, mirrored)
    index = facet
    for axis, g in enumerate(numbers):
        half = mirrored and axis == 0
        count = per_axis // 2 if half else per_axis
        t = _warp(g) if half else 0.5 + 0.5 * _warp(g)
        place = xp.clip((t * np.float32(count)).astype(np.int32), 0, count - 1)
        index = index * count + place
    return index


def n_bins(per_axis: int, mirrored: bool) -> int:
    """Bins in all: four facets of per_axis^3, half as many if mirror images are folded."""
    return 4 * per_axis**3 // (2 if mirrored else 1)


@lru_cache(maxsize=4)
def bin_centres(per_axis: int, mirrored: bool) -> Float[np.ndarray, "B 4"]:
    """Unit quaternion at the centre of each bin, in the order of ``bin_index``, float64."""
    grid = np.linspace(-1.0, 1.0, 20001)
    edges = (np.arange(per_axis) + 0.5) / per_axis
    full = np.interp(2 * edges - 1, _warp(grid), grid)
    half = np.interp((np.arange(per_axis // 2) + 0.5) / (per_axis // 2), _warp(grid), grid)
    a, b, c = np.meshgrid(half if mirrored else full, full, full, indexing="ij")
    one = np.ones_like(a)
    if mirrored:
        # Undo _facet: a large y (or z) is +-1, its sign that of the second number.
        sign = np.where(b < 0, -1.0, 1.0)
        facets = [(one, a, b, c), (a, one, b, c), (a, np.abs(b), sign, c), (a, np.abs(b), c, sign)]
    else:
        facets = [(one, a, b, c), (a, one, b, c), (a, b, one, c), (a, b, c, one)]
    q = np.concatenate([np.stack(f, axis=-1).reshape(-1, 4) for f in facets])
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


class BinError(NamedTuple):
    """Angle between a rotation and the centre of its bin [rad], over 2^18 random rotations."""

    typical: float  # root mean square
    largest: float


@lru_cache(maxsize=4)
def bin_error(per_axis: int, mirrored: bool) -> BinError:
    """Angular error of judging a sample by its bin, measured."""
    q = np.random.default_rng(0).normal(size=(1 << 18, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    index = np.asarray(bin_index(list(q.T.astype(np.float32)), per_axis, mirrored))
    centre = bin_centres(per_axis, mirrored)[index]
    cosine = np.abs(np.sum(q * centre, axis=-1))
    if mirrored:
        cosine = np.maximum(cosine, np.abs(np.sum(mirror(q) * centre, axis=-1)))
    angle = 2 * np.arccos(np.minimum(cosine, 1.0))
    return BinError(float(np.sqrt(np.mean(angle**2))), float(np.max(angle)))


def mirror(q: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
    """Mirror image of a rotation in the xz plane."""
    return q * np.array([1.0, -1.0, 1.0, -1.0])


@lru_cache(maxsize=1)
def test_orientations() -> Float[np.ndarray, "T 4"]:
    """4608 evenly spread rotations: HEALPix directions (N_side 4) times 24 spins.

    This is level two of the successive orthogonal grid of Yershova, Jain, LaValle and Mitchell
    (2010): Hopf coordinates, in which the Haar measure is direction times spin.
    """
    side, spins = 4, 24
    z, azimuth = healpix_directions(side)
    half_tilt = 0.5 * np.arccos(z)[:, None]
    half_spin = np.pi * (np.arange(spins) + 0.5)[None, :] / spins
    turned = azimuth[:, None] + half_spin
    parts = [
        np.cos(half_tilt) * np.cos(half_spin),
        np.sin(half_tilt) * np.cos(turned),
        np.sin(half_tilt) * np.sin(turned),
        np.cos(half_tilt) * np.sin(half_spin),
    ]
    return np.stack(np.broadcast_arrays(*parts), axis=-1).reshape(-1, 4)


def healpix_directions(side: int) -> tuple[np.ndarray, np.ndarray]:
    """(z, azimuth) of the 12 side^2 pixel centres, ring by ring (Gorski et al. 2005, Eq. 4-9)."""
    z: list[float] = []
    azimuth: list[float] = []
    for ring in range(1, 4 * side):
        polar = min(ring, 4 * side - ring)
        if polar < side:
            height = 1 - polar**2 / (3 * side**2)
            count, shift = 4 * polar, 0.5
        else:
            height = 4 / 3 - 2 * min(ring, 4 * side - ring) / (3 * side)
            count, shift = 4 * side, 0.5 * ((ring - side + 1) % 2)
        z += [height if ring <= 2 * side else -height] * count
        azimuth += [2 * np.pi * (k + shift) / count for k in range(count)]
    return np.array(z), np.array(azimuth)


@lru_cache(maxsize=4)
def bins_near_tests(
    per_axis: int, mirrored: bool, widest: float
) -> tuple[list[Int[np.ndarray, " K"]], list[Float[np.ndarray, " K"]]]:
    """Bins whose centre is within ``widest`` [rad] of each test orientation.

    Returns:
        For each test orientation the bins and their angular distances [rad].
    """
    tests, centres = test_orientations(), bin_centres(per_axis, mirrored)
    order, starts, group_centres, radius = _groups(per_axis, mirrored)
    images = [tests, mirror(tests)] if mirrored else [tests]

    def cosines(q: np.ndarray, chosen: np.ndarray | slice) -> np.ndarray:
        """Of half the angle to each chosen test orientation."""
        products = [np.abs(q @ image[chosen].T) for image in images]
        return products[0] if len(products) == 1 else np.maximum(*products)

    close = cosines(group_centres, slice(None)) >= np.cos(0.5 * min(widest + radius, np.pi))
    parts = []
    for group, neighbours in enumerate(close):
        bins, chosen = order[starts[group] : starts[group + 1]], np.flatnonzero(neighbours)
        cosine = cosines(centres[bins], chosen)
        row, column = np.nonzero(cosine >= np.cos(0.5 * widest))
        parts.append((chosen[column], bins[row], cosine[row, column]))
    test, near, cosine = (np.concatenate(part) for part in zip(*parts, strict=True))
    by_test = np.argsort(test, kind="stable")
    ends = np.cumsum(np.bincount(test, minlength=len(tests)))[:-1]
    angle = 2 * np.arccos(np.minimum(cosine[by_test], 1.0))
    return np.split(near[by_test], ends), np.split(angle, ends)


def _groups(
    per_axis: int, mirrored: bool
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, "G 4"], float]:
    """Bins by the coarse bin that holds them: order, starts, coarse centres, their radius [rad]."""
    coarse = min(8, per_axis)
    centres = bin_centres(per_axis, mirrored)
    group = np.asarray(bin_index(list(centres.T.astype(np.float32)), coarse, mirrored))
    group_centres = bin_centres(coarse, mirrored)
    inside = np.abs(np.sum(centres * group_centres[group], axis=-1))
    radius = 2 * float(np.arccos(min(1.0, inside.min())))
    order = np.argsort(group, kind="stable").astype(np.int32)
    starts = np.searchsorted(group[order], np.arange(len(group_centres) + 1))
    return order, starts, group_centres, radius


def tests_met(
    packed: Int[np.ndarray, "B C8"], per_axis: int, mirrored: bool, tolerance: float, widest: float
) -> Int[np.ndarray, "T C8"]:
    """Test orientations met in each cell, from the marked bins; cells are bits, eight a byte.

    Args:
        packed: Marked bins.
        per_axis: As in ``bin_index``.
        mirrored: As in ``bin_index``.
        tolerance: Largest angle between a test orientation and a marked bin's centre [rad].
        widest: Largest tolerance that will be asked for [rad]; its neighbourhoods are kept.
    """
    near, angles = bins_near_tests(per_axis, mirrored, widest)
    met = np.zeros((len(near), packed.shape[1]), np.uint8)
    for t, (bins, angle) in enumerate(zip(near, angles, strict=True)):
        chosen = bins[angle <= tolerance]
        if len(chosen):
            np.bitwise_or.reduce(packed[chosen], axis=0, out=met[t])
    return met


def count_met(met: Int[np.ndarray, "T C8"], n_cells: int) -> Int[np.ndarray, " C"]:
    """How many test orientations are met in each cell."""
    bits: Bool[np.ndarray, "T C"] = np.unpackbits(met, axis=1, count=n_cells)
    return bits.sum(axis=0, dtype=np.int32)
