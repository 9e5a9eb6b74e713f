"""The tangent's linear systems, at a cost linear in the number of joints.

The tangent couples elements e < f by A_e' X_f above and Y_f' a_e below the diagonal blocks D (see
``kernel``). Eliminating from the tip to the base, what joints beyond element e send back is
c_e = P_e s_(e+1) + r_e, with s_(e+1) = sum of a x up to e, and

    W = D + A' P a,   h = Y + P' A,   g = X + P a,   b^ = b - A' r,
    P <- P - g W^-1 h',   r <- r + g W^-1 b^;        forwards  x = W^-1 (b^ - h' s).

The W are the pivots of a block LU factorisation: their negative signs count the negative
eigenvalues of a symmetric tangent (Sylvester), and c' H^-1 b = sum of c^' W^-1 b^.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from muxjax.statics.kernel import Tangent

Array = Any


class Factors(NamedTuple):
    """Elimination of right-hand sides b (R of them) and left-hand sides c (C of them)."""

    solved: Float[Array, "E p R B"]  # W^-1 b^
    gain: Float[Array, "E p 3 B"]  # W^-1 h'
    axis: Float[Array, "E p 3 B"]
    product: Float[Array, "C R B"]  # c' H^-1 b
    negative: Int[Array, " B"]  # pivots below zero


def eliminate(
    tangent: Tangent, rhs: Float[Array, "E p R B"], lhs: Float[Array, "E p C B"] | None
) -> Factors:
    """One pass from the tip to the base.

    Args:
        tangent: The system.
        rhs: Right-hand sides.
        lhs: Left-hand sides of ``product``; None where the tangent is symmetric and they are rhs.
    """
    lanes, dtype = rhs.shape[-1], rhs.dtype
    n_left = tangent.left.shape[2]
    start = (
        jnp.zeros((n_left, 3, lanes), dtype),
        jnp.zeros((n_left, rhs.shape[2], lanes), dtype),
        None if lhs is None else jnp.zeros((3, lhs.shape[2], lanes), dtype),
    )

    def step(carry: Any, x: Any) -> Any:
        big, back, back_left = carry
        block, left, right, lower, axis, b, c = x
        pa = _sum(left[:, :, None] * big, 1)  # A' P, (p, 3, B)
        h = lower + pa
        g = right + _sum(big * axis[:, None], 2)  # (p, L, B)
        w = block + _sum(pa[:, None] * axis, 2)
        hat = b - _sum(left[:, :, None] * back, 1)
        both, pivots = solve_pivotless(w, jnp.concatenate([hat, h], axis=1))
        x_hat, gain = both[:, : b.shape[1]], both[:, b.shape[1] :]
        big = big - _sum(g[:, :, None] * gain[:, None], 0)
        back = back + _sum(g[:, :, None] * x_hat[:, None], 0)
        c_hat = None
        if c is not None:
            c_hat = c - _sum(axis[:, :, None] * back_left, 1)
            back_left = back_left + _sum(gain[:, :, None] * c_hat[:, None], 0)
        return (big, back, back_left), (hat, x_hat, gain, pivots, c_hat)

    xs = (tangent.block, tangent.left, tangent.right, tangent.lower, tangent.axis, rhs, lhs)
    _, (hat, solved, gain, pivots, c_hat) = jax.lax.scan(step, start, xs, reverse=True)
    other = hat if c_hat is None else c_hat
    product = (other[:, :, :, None] * solved[:, :, None]).sum((0, 1))
    return Factors(solved, gain, tangent.axis, product, (pivots < 0).sum((0, 1)))


def substitute(factors: Factors, solved: Float[Array, "E p B"]) -> Float[Array, "E p B"]:
    """One pass from the base to the tip, for a combination of the eliminated sides."""

    def step(s: Array, x: Any) -> Any:
        hat, gain, axis = x
        found = hat - _sum(gain * s, 1)
        return s + _sum(axis * found[:, None], 0), found

    start = jnp.zeros((3, solved.shape[-1]), solved.dtype)
    _, found = jax.lax.scan(step, start, (solved, factors.gain, factors.axis), unroll=1)
    return found


def solve_pivotless(
    matrix: Float[Array, "m m B"], rhs: Float[Array, "m R B"]
) -> tuple[Float[Array, "m R B"], Float[Array, "m B"]]:
    """Gauss-Jordan of a small system: solution and pivots, whose signs are the inertia.

    Without pivoting, since exchanging rows would lose the signs; a pivot of zero gives NaN.
    """
    m = matrix.shape[0]
    rows, pivots = jnp.concatenate([matrix, rhs], axis=1), []
    for i in range(m):
        pivots.append(rows[i, i])
        own = rows[i] / rows[i, i]
        if m == 1:
            return own[None, 1:], jnp.stack(pivots)
        rows = rows - rows[:, i, None] * own
        rows = jnp.concatenate([rows[:i], own[None], rows[i + 1 :]])
    return rows[:, m:], jnp.stack(pivots)


def _sum(values: Array, axis: int) -> Array:
    """Sum over a short axis, written out: XLA then fuses and vectorises it along the batch."""
    parts = [
        jax.lax.index_in_dim(values, i, axis, keepdims=False) for i in range(values.shape[axis])
    ]
    return sum(parts[1:], parts[0])
