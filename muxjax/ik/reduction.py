"""Three inextensible segments reduced to one equation in one unknown (MODEL.md section 8).

Half-angle quaternions q_i = (w_i, x_i, y_i, 0) have no z part. A segment is the dual quaternion
q_i + eps rho_i k / 2 with the chord rho_i = L_i sinc(theta_i / 2), a function of w_i alone. For a
target (q, p) in the root's frame let s = (0, p) q and d = q_z. Then

    s . q3 = -rho_3 d                      q3 lies on a closed curve: the unknown t runs along it
    s . q1 = -rho_1 d, (q1* q q3*)_k = 0   two roots q1 for each q3
    E = (q1* s q3*)_k - rho_1 q . q3 - rho_3 q . q1 -+ rho_2 = 0,  -+ the sign of q2's w

and where E = 0 the whole pose holds, q2 = q1* q q3*. With rho affine in w the curve is a circle
and q1 is where a line meets the sphere; rho is affine up to 0.009 L, most of which a
fixed-point step removes. Here are the curve, both roots and E; ``all_solutions`` looks for the
zeros.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float
from numpy.polynomial import Chebyshev, Polynomial

from muxjax.batched import WIDE_VECTORS
from muxjax.batched.formulas import product
from muxjax.ik.arcs import Array, Numbers, bend, conjugate, cross, dot, series

INTERVALS = 64  # of the admissible arc of q3
# A bracket of a solution at a bending limit reaches over it: w may pass its limit by this much
# at either end of the arc, and at a sample on it.
SLACK_AT_END = 0.02
SLACK = 0.25
FIXED_POINT_STEPS = 1  # what is left, 1e-4, is for the polish in six variables

# sinc(acos w) on the range that bending to 180 degrees needs, with room for brackets that reach
# over its edge; within 1e-6.
_LOWEST_W = -0.25


def _sinc_acos(w: np.ndarray) -> np.ndarray:
    return np.sinc(np.arccos(np.minimum(w, 1.0)) / np.pi)


_fit = Chebyshev.interpolate(_sinc_acos, 8, domain=[_LOWEST_W, 1.0])
_CHORD = [float(c) for c in _fit.convert(kind=Polynomial).coef]
# The affine part, through the values at 0 and 180 degrees less half the largest deviation.
_SLOPE = 1.0 - 2.0 / np.pi
_w = np.linspace(0.0, 1.0, 1001)
_OFFSET = float(np.mean([f(_sinc_acos(_w) - _SLOPE * _w) for f in (np.min, np.max)]))


class Target(NamedTuple):
    """What of a target the reduction needs, each entry an array of one shape."""

    s: Numbers  # (0, p) q [m]
    q: Numbers  # (w, x, y, z)


class Point(NamedTuple):
    """A point of the curve with one root for q1."""

    q1: Numbers  # (w, x, y); NaN where q3 leaves q1 no root
    q3: Numbers  # (w, x, y)
    w2: Array  # w of q2 = q1* q q3*, of either sign
    value: Array  # E without its last term [m]


def chord(w: Array) -> Array:
    """sinc(acos w): the chord of a segment of length 1 with cos(theta / 2) = w."""
    return series(_CHORD, jnp.clip(w, _LOWEST_W, 1.0))


class _Circle(NamedTuple):
    """Where q3 lives while its chord is taken as affine in w."""

    d: Array
    length: Array
    normal: Numbers
    first: Numbers  # unit, in the plane of the circle, towards greatest w
    second: Numbers
    square: Array  # of the normal


def _circle(target: Target, length: Array) -> _Circle:
    s, d = target.s, target.q[3]
    nw = s[0] + d * _SLOPE * length
    sideways = jnp.hypot(s[1], s[2])
    safe = jnp.where(sideways > 0, sideways, 1.0)
    ax, ay = jnp.where(sideways > 0, s[1] / safe, 1.0), s[2] / safe
    square = nw * nw + sideways * sideways
    norm = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    first = (sideways / norm, -nw / norm * ax, -nw / norm * ay)
    return _Circle(d, length, (nw, s[1], s[2]), first, (jnp.zeros_like(ax), -ay, ax), norm * norm)


def _around(circle: _Circle, offset: Array, cosine: Array, sine: Array) -> Numbers:
    """Point of the circle whose chord is L (offset + slope w)."""
    back = -circle.d * circle.length * offset / circle.square
    radius = jnp.sqrt(jnp.maximum(1 - back * back * circle.square, 0.0))
    return tuple(
        back * n + radius * (cosine * a + sine * b)
        for n, a, b in zip(circle.normal, circle.first, circle.second, strict=True)
    )


def arc_limit(target: Target, length: Array, w_min: Array) -> Array:
    """Largest |t| with w_3 above its limit [rad]; NaN if no chord of segment 3 fits the target."""
    circle = _circle(target, length)
    back = -circle.d * length * _OFFSET / circle.square
    inside = 1 - back * back * circle.square
    radius = jnp.sqrt(inside + SLACK_AT_END) * circle.first[0]
    bound = (w_min - SLACK_AT_END - back * circle.normal[0]) / jnp.where(radius > 0, radius, 1e-300)
    return jnp.where(bound > 1, jnp.nan, jnp.arccos(jnp.clip(bound, -1.0, 1.0)))


def point(
    lengths: Float[Array, " 3"],
    target: Target,
    t: Array,
    side: Array | float,
    clip: bool = False,
) -> Point:
    """The curve's point at t [rad] and the root q1 on the given side (+1 or -1).

    With m from (q1* q q3*)_k = m . q1, the two linear conditions on q1 leave a line along
    u = n x m whose point nearest to the origin is proportional to the affine chord. ``clip``
    takes that point where the line misses the sphere.
    """
    s, q = target
    d = q[3]
    circle = _circle(target, lengths[2])
    half = bend(t, jnp.zeros_like(t))  # cos and sin of t / 2 by series: XLA calls scalar ones
    cosine, sine = 2 * half.c * half.c - 1, 2 * half.c * half.ex
    offset: Array = jnp.full_like(cosine, _OFFSET)
    for _ in range(FIXED_POINT_STEPS):
        w = _around(circle, offset, cosine, sine)[0]
        offset = chord(w) - _SLOPE * w
    q3 = _around(circle, offset, cosine, sine)
    back = conjugate((*q3, jnp.zeros_like(cosine)))
    r, y = product(q, back), product(s, back)
    m = (r[3], -r[2], r[1])
    n = (s[0] + d * _SLOPE * lengths[0], s[1], s[2])
    u = cross(n, m)
    square = dot(u, u)
    inverse = 1 / jnp.where(square > 0, square, 1e-300)
    across = dot(n, m)
    scale = -d * lengths[0] * inverse
    nearest = tuple(scale * (dot(m, m) * a - across * b) for a, b in zip(n, m, strict=True))
    norm = dot(nearest, nearest)
    offset = jnp.full_like(cosine, _OFFSET)
    for _ in range(FIXED_POINT_STEPS):
        along = side * jnp.sqrt(jnp.maximum(1 - offset * offset * norm, 0.0) * inverse)
        w = offset * nearest[0] + along * u[0]
        offset = chord(w) - _SLOPE * w
    inside = 1 - offset * offset * norm
    if clip:
        inside = jnp.maximum(inside, 0.0)
    along = side * jnp.sqrt(inside * inverse)
    q1 = tuple(offset * a + along * b for a, b in zip(nearest, u, strict=True))
    value = (
        dot(q1, (y[3], -y[2], y[1]))
        - lengths[0] * chord(q1[0]) * dot(q3, q[:3])
        - lengths[2] * chord(q3[0]) * dot(q1, q[:3])
    )
    return Point(q1, q3, dot(q1, r[:3]), value)


def equation(lengths: Float[Array, " 3"], at: Point, sign: Array | float) -> Array:
    """E for q2 with w of the given sign, smooth across w = 0 [m]."""
    return at.value - sign * lengths[1] * chord(sign * at.w2)


@partial(jax.jit, static_argnames="intervals", compiler_options=WIDE_VECTORS)
def sweep(
    lengths: Float[Array, " 3"],
    w_min: Float[Array, " 3"],
    target: Target,
    intervals: int = INTERVALS,
) -> tuple[Array, list[jax.Array]]:
    """E along the whole curve.

    Args:
        lengths: L_i [m].
        w_min: Cosine of half each segment's bending limit.
        target: Entries of shape (rows,).
        intervals: Of the admissible arc.

    Returns:
        The arc's half length (rows,), and E of shape (rows, intervals + 1) for both sides of q1,
        + first; its real part is for w_2 > 0 and its imaginary part for w_2 < 0. NaN where there
        is no root, or where a segment is bent beyond its limit. (XLA on a CPU computes each
        result of a kernel anew: two complex results cost half of four real ones.)
    """
    limit = arc_limit(target, lengths[2], w_min[2])
    t = limit[:, None] * jnp.linspace(-1.0, 1.0, intervals + 1)
    wide = jax.tree.map(lambda x: x[:, None], target)
    values = []
    for side in (1.0, -1.0):
        at = point(lengths, wide, t, side)
        allowed = at.q1[0] > w_min[0] - SLACK
        plus, minus = (
            jnp.where(
                allowed & (sign * at.w2 > w_min[1] - SLACK), equation(lengths, at, sign), jnp.nan
            )
            for sign in (1.0, -1.0)
        )
        values.append(lax.complex(plus, minus))
    return limit, values
