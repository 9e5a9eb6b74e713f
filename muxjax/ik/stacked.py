"""Tip and Jacobian of an arm with all its segments in one array, for arms of any length.

``arcs`` writes every segment out, which is fastest to run for three and slow to compile for more.
Here each formula appears once, on arrays with an axis for the segments, and a scan puts the
segments together: the time to compile does not grow with the arm. The barriers keep XLA from
computing a result anew for each of its uses.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from muxjax.batched.formulas import product
from muxjax.ik.arcs import Array, Numbers, bend, cross, segment_twist, sinc_slope, turn_by

LEAST_PIVOT = 1e-24  # far below rounding; its powers stay finite


class Placed(NamedTuple):
    """Where the tip is, and the segments on the way to it."""

    position: Numbers  # of the tip [m], in the root frame, arrays (rows,)
    quaternion: Numbers  # of the last disc (w, x, y, z)
    ends: Array  # of the segments [m], (S, 3, rows)
    before: Array  # quaternions of the frames that the segments start in, (S, 4, rows)


class Stacked(NamedTuple):
    """Position and orientation of the tip, and the twist that each bending gives it."""

    position: Numbers  # [m], in the root frame, arrays (rows,)
    quaternion: Numbers  # of the last disc (w, x, y, z)
    linear: Numbers  # three components of d position / d b [m/rad], arrays (S, 2, rows)
    angular: Numbers  # and of the angular velocities


def stacked_pose(length: Float[Array, " S"], b: Float[Array, "S 2 rows"], tool: Numbers) -> Placed:
    """Tip of a chain of segments.

    Args:
        length: Segment lengths [m].
        b: Cartesian bending [rad].
        tool: Tool point in the last disc's frame [m].
    """
    e = lax.optimization_barrier(bend(b[:, 0], b[:, 1]))
    chord = jnp.asarray(length)[:, None] * e.s
    step = jnp.stack([chord * e.ex, chord * e.ey, chord * e.c], axis=1)
    own = jnp.stack([e.c, -e.ey, e.ex, jnp.zeros_like(e.c)], axis=1)
    step, own = lax.optimization_barrier((step, own))

    def add(
        at: tuple[jax.Array, jax.Array], segment: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        position, quaternion = at
        after = position + jnp.stack(turn_by(tuple(quaternion), tuple(segment[0])))
        turned = jnp.stack(product(tuple(quaternion), tuple(segment[1])))
        return (after, turned), (after, quaternion)

    rows = b.shape[-1]
    root = jnp.zeros((3, rows), b.dtype), jnp.zeros((4, rows), b.dtype).at[0].set(1.0)
    (end, last), (ends, before) = lax.scan(add, root, (step, own))
    tip = tuple(p + t for p, t in zip(end, turn_by(tuple(last), tool), strict=True))
    return lax.optimization_barrier(Placed(tip, tuple(last), ends, before))


def stacked_tip(length: Float[Array, " S"], b: Float[Array, "S 2 rows"], tool: Numbers) -> Stacked:
    """The same with its derivatives."""
    at = stacked_pose(length, b, tool)
    bx, by, along = b[:, 0], b[:, 1], jnp.asarray(length)[:, None]
    e, slope = lax.optimization_barrier((bend(bx, by), sinc_slope(bx, by)))
    speeds, turns = (
        tuple(jnp.stack(pair, axis=1) for pair in zip(*by_axis, strict=True))
        for by_axis in segment_twist(along, bx, by, e, slope)
    )
    speeds, turns = lax.optimization_barrier((speeds, turns))
    start = tuple(at.before[:, k, None] for k in range(4))
    angular = lax.optimization_barrier(turn_by(start, turns))
    beyond = tuple(x - at.ends[:, k, None] for k, x in enumerate(at.position))
    linear = tuple(
        v + w for v, w in zip(turn_by(start, speeds), cross(angular, beyond), strict=True)
    )
    linear, angular = lax.optimization_barrier((linear, angular))
    return Stacked(at.position, at.quaternion, linear, angular)


def eliminated(
    a: Float[Array, "n n rows"], y: Float[Array, "n ... rows"]
) -> Float[Array, "n ... rows"]:
    """X with A x = y for positive matrices, by Gauss and Jordan without a search for pivots."""
    n = len(a)
    both = jnp.concatenate([a, y.reshape(n, -1, y.shape[-1])], axis=1)
    places = jnp.arange(n)[:, None, None]
    for k in range(n):
        row = both[k] / jnp.maximum(both[k, k], LEAST_PIVOT)
        both = jnp.where(places == k, row, both - both[:, k, None] * row)
        both = lax.optimization_barrier(both)
    return both[:, n:].reshape(y.shape)
