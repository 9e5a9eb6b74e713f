"""Damped Newton steps in Cartesian bending for many configurations at once.

A step solves (J'J + damping |r|^2) db = J'r with r the position error over the arm's length and
the axis times twice the sine of half the error angle, both in the root's frame. It is Levenberg
and Marquardt's far from a solution and Newton's near one; where J loses rank (straight arms,
coinciding solutions) it still converges, only linearly.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from muxjax.batched import WIDE_VECTORS
from muxjax.batched.formulas import product
from muxjax.ik.arcs import Array, conjugate
from muxjax.ik.stacked import Placed, Stacked, eliminated, stacked_pose, stacked_tip
from muxjax.precision import padded_size

FLOOR = 1e-20  # added to J'J, whose entries are about 1
INVERSE_ITERATIONS = 24  # for the smallest singular value
ROWS = (16, 128)  # configurations a call: two sizes are ever compiled
ROWS_ELSEWHERE = (128, 1 << 15)  # on a GPU
NO_TOOL = (np.zeros(()),) * 3


class Solved(NamedTuple):
    """Where the steps ended."""

    b: Float[np.ndarray, "dof rows"]  # Cartesian bending [rad]
    position: Float[np.ndarray, " rows"]  # error [m]
    angle: Float[np.ndarray, " rows"]  # error [rad]


def _errors(scale: Array, tip: Placed | Stacked, goal: Float[Array, "7 rows"]) -> Array:
    turn = product(tuple(goal[3:]), conjugate(tip.quaternion))
    double = jnp.where(turn[0] < 0, -2.0, 2.0)
    offset = [scale * (goal[k] - tip.position[k]) for k in range(3)]
    return lax.optimization_barrier(jnp.stack(offset + [double * x for x in turn[1:]]))


def _jacobian(scale: Array, tip: Stacked) -> Array:
    """Columns by rows, (6, 2S, configurations)."""
    jac = jnp.stack([scale * x for x in tip.linear] + list(tip.angular))
    return lax.optimization_barrier(jac.reshape(6, -1, jac.shape[-1]))


def _gram(jac: Float[Array, "m n rows"], floor: Array | float) -> Array:
    """J'J + floor."""
    gram = jnp.sum(jac[:, :, None] * jac[:, None], axis=0)
    return lax.optimization_barrier(gram + floor * jnp.eye(jac.shape[1])[..., None])


@partial(jax.jit, compiler_options=WIDE_VECTORS)
def _iterate(
    length: Float[Array, " S"],
    b: Float[Array, "dof rows"],
    goal: Float[Array, "7 rows"],
    damping: Array,
    theta_max: Float[Array, " S"],
    steps: Array | int,
) -> tuple[Array, Array]:
    """``steps`` damped steps, each kept within the limits; and the errors where they end."""
    scale, shape = 1 / jnp.sum(length), (len(length), 2, b.shape[-1])

    def body(_: Array | int, b: Array) -> Array:
        tip = stacked_tip(length, b, NO_TOOL)
        r, jac = _errors(scale, tip, goal), _jacobian(scale, tip)
        merit = jnp.sum(r * r, axis=0)
        slope = jnp.sum(jac * r[:, None], axis=0)
        step = eliminated(_gram(jac, damping * merit + FLOOR), lax.optimization_barrier(slope))
        return within(b + step.reshape(shape), theta_max)

    last = lax.optimization_barrier(lax.fori_loop(0, steps, body, b.reshape(shape)))
    r = _errors(scale, stacked_pose(length, last, NO_TOOL), goal)
    position = jnp.sqrt(jnp.sum(r[:3] ** 2, axis=0)) / scale
    half = 0.5 * jnp.sqrt(jnp.sum(r[3:] ** 2, axis=0))
    angle = 2 * jnp.arcsin(jnp.minimum(half, 1.0))
    return last.reshape(b.shape), jnp.stack([position, angle])


def within(b: Float[Array, "S 2 rows"], theta_max: Float[Array, " S"]) -> Array:
    """Each bending shortened to its limit (infinite ones leave it as it is)."""
    theta = jnp.sqrt(jnp.sum(b * b, axis=1, keepdims=True))
    limit = jnp.asarray(theta_max)[:, None, None]
    beyond = theta > limit
    return b * jnp.where(beyond, limit / jnp.where(beyond, theta, 1.0), 1.0)


@partial(jax.jit, compiler_options=WIDE_VECTORS)
def _smallest(length: Float[Array, " S"], b: Float[Array, "dof rows"]) -> Array:
    """Smallest singular value of J, by iteration with the inverse of J'J."""
    n, rows = b.shape
    tip = stacked_tip(length, b.reshape(-1, 2, rows), NO_TOOL)
    gram = _gram(_jacobian(1 / jnp.sum(length), tip), FLOOR)
    unit = jnp.broadcast_to(jnp.eye(n)[..., None], gram.shape)
    inverse = eliminated(gram, unit)

    def body(_: Array | int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        x = jnp.sum(inverse * state[0], axis=1)
        growth = jnp.sqrt(jnp.sum(x * x, axis=0))
        return lax.optimization_barrier((x / growth, growth))

    start = jnp.broadcast_to(((-0.7) ** jnp.arange(n))[:, None], b.shape)
    first = start / jnp.sqrt(jnp.sum(start * start, axis=0))
    _, growth = lax.fori_loop(0, INVERSE_ITERATIONS, body, (first, jnp.ones(rows)))
    return jnp.sqrt(1 / growth)


def in_pieces(rows: int) -> list[tuple[slice, int]]:
    """Slices of the rows and the compiled size that each is padded to."""
    pieces = []
    start = 0
    while start < rows:
        left = rows - start
        size = padded_size(left, ROWS, ROWS_ELSEWHERE)
        pieces.append((slice(start, start + min(left, size)), size))
        start += size
    return pieces


def padded(array: np.ndarray, size: int) -> np.ndarray:
    """The last axis filled up to ``size`` with its last entry."""
    missing = size - array.shape[-1]
    return np.concatenate([array, np.repeat(array[..., -1:], missing, axis=-1)], axis=-1)


def newton(
    length: Float[np.ndarray, " S"],
    b: Float[np.ndarray, "dof rows"],
    goal: Float[np.ndarray, "7 rows"],
    *,
    steps: int,
    damping: float = 0.0,
    theta_max: Float[np.ndarray, " S"] | None = None,
) -> Solved:
    """Bending after a number of steps, and its errors; call inside an x64 context.

    Args:
        length: L_i [m].
        b: Start.
        goal: Position [m] and quaternion (w, x, y, z) of the last disc, in the root's frame.
        steps: Of them; 0 only judges.
        damping: Times |r|^2.
        theta_max: Limits to stay within [rad]; none by default.
    """
    ends, known = np.empty_like(b), np.empty((2, b.shape[1]))
    limits = np.full(len(length), np.inf) if theta_max is None else theta_max
    pieces = in_pieces(b.shape[1])
    given = (length, np.float64(damping), limits, np.int64(steps))
    if len(pieces) > 1:
        # Every array from the host costs a call ten microseconds; this costs a hundred, once.
        given = jax.device_put(given)
    arm, factor, bound, count = given
    for piece, size in pieces:
        start, target = padded(b[:, piece], size), padded(goal[:, piece], size)
        last, errors = _iterate(arm, start, target, factor, bound, count)
        here = piece.stop - piece.start
        ends[:, piece] = np.asarray(last)[:, :here]
        known[:, piece] = np.asarray(errors)[:, :here]
    return Solved(ends, *known)


def smallest_singular(
    length: Float[np.ndarray, " S"], b: Float[np.ndarray, "dof rows"]
) -> Float[np.ndarray, " rows"]:
    """Smallest singular value of the Jacobian, arm length 1 and rad; call inside x64."""
    found = np.empty(b.shape[1])
    for piece, size in in_pieces(b.shape[1]):
        values = np.asarray(_smallest(length, padded(b[:, piece], size)))
        found[piece] = values[: piece.stop - piece.start]
    return found


def solved(at: Solved, position: float, angle: float) -> Bool[np.ndarray, " rows"]:
    """Both errors below their tolerances."""
    return (at.position < position) & (at.angle < angle)
