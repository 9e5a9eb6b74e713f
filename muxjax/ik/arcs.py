"""Constant-curvature segments for batches: one array a number, no transcendental function.

``kinematics`` is the readable form. A solver that visits many configurations at once wants the
same formulas on structures of arrays, which XLA turns into straight vector code. A segment bent
by b turns by the half-angle quaternion (C, -e_y, e_x, 0) and ends at L S (e_x, e_y, C), where
e = S b / 2, S = sinc(theta / 2) and C = cos(theta / 2) are series in x = theta^2 / 4
(MODEL.md section 8). Everything is float64 if its input is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array | np.ndarray
Numbers = tuple[Array, ...]  # arrays of one shape, each one component of a vector or quaternion

# For theta up to 2 pi, x is below pi^2 and the first term left out below 1e-18.
_TERMS = 16
_SINC = [(-1) ** k / math.factorial(2 * k + 1) for k in range(_TERMS)]
_COSINE = [(-1) ** k / math.factorial(2 * k) for k in range(_TERMS)]
_SINC_SLOPE = [k * _SINC[k] for k in range(1, _TERMS)]


def series(coefficients: list[float], x: Array) -> Array:
    """Polynomial by Horner's rule, lowest power first."""
    value = jnp.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + c
    return value


class Bend(NamedTuple):
    """Half-angle form of one segment's bending."""

    c: Array  # cos(theta / 2)
    ex: Array  # sin(theta / 2) (cos phi, sin phi)
    ey: Array
    s: Array  # sinc(theta / 2): the chord over the arc


def bend(bx: Array, by: Array) -> Bend:
    """Half-angle form of the Cartesian bending [rad]."""
    x = 0.25 * (bx * bx + by * by)
    s = series(_SINC, x)
    return Bend(series(_COSINE, x), 0.5 * s * bx, 0.5 * s * by, s)


def sinc_slope(bx: Array, by: Array) -> Array:
    """D sinc(sqrt x) / dx at x = theta^2 / 4."""
    return series(_SINC_SLOPE, 0.25 * (bx * bx + by * by))


def turn(e: Bend, v: Numbers) -> Numbers:
    """R v for the segment's rotation."""
    x, y, z = v
    along = e.ex * x + e.ey * y
    sideways = 2 * (e.c * z - along)
    return x + sideways * e.ex, y + sideways * e.ey, z * (2 * e.c * e.c - 1) - 2 * e.c * along


def cross(a: Numbers, b: Numbers) -> Numbers:
    """Vector product."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def dot(a: Numbers, b: Numbers) -> Array:
    """Scalar product of vectors of any length."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def conjugate(q: Numbers) -> Numbers:
    """Inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


def turn_by(q: Numbers, v: Numbers) -> Numbers:
    """Vector v turned by the unit quaternion q."""
    u = q[1:]
    t = cross(u, v)
    t = (2 * t[0], 2 * t[1], 2 * t[2])
    more = cross(u, t)
    return tuple(x + q[0] * a + b for x, a, b in zip(v, t, more, strict=True))


def segment_twist(
    length: Array, bx: Array, by: Array, e: Bend, slope: Array
) -> tuple[list[Numbers], list[Numbers]]:
    """Velocities and angular velocities of a segment's end by b_x and b_y, proximal frame.

    From p = L (S^2 b / 2, S C) and omega = 2 dq q*, with dx = b . db / 2, dS = S' dx and
    dC = -S dx / 2, where S' = dS / dx is ``slope``.
    """
    s, c = e.s, e.c
    speeds: list[Numbers] = []
    turns: list[Numbers] = []
    for k, along in enumerate((bx, by)):
        dx = 0.5 * along
        ds, dc = slope * dx, -0.5 * s * dx
        dex = 0.5 * (ds * bx + (s if k == 0 else 0.0))
        dey = 0.5 * (ds * by + (s if k == 1 else 0.0))
        speeds.append(
            (
                length * (ds * e.ex + s * dex),
                length * (ds * e.ey + s * dey),
                length * (ds * c + s * dc),
            )
        )
        turns.append(
            (2 * (dc * e.ey - c * dey), 2 * (c * dex - dc * e.ex), 2 * (e.ex * dey - e.ey * dex))
        )
    return speeds, turns
