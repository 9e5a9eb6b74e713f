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
from muxjax.ik.arcs import (
    Array,
    Numbers,
    Tip,
    conjugate,
    dot,
    product,
    solve_symmetric,
    tip_and_twists,
)

FLOOR = 1e-20  # added to J'J, whose entries are about 1
INVERSE_ITERATIONS = 24  # for the smallest singular value
ROWS = (16, 512)  # configurations a call: two sizes are ever compiled


class Goal(NamedTuple):
    """Poses of the last disc in the root's frame, each entry an array of one shape."""

    position: Numbers  # [m]
    quaternion: Numbers  # (w, x, y, z)


class Solved(NamedTuple):
    """Where the steps ended."""

    b: Float[np.ndarray, "dof rows"]  # Cartesian bending [rad]
    position: Float[np.ndarray, " rows"]  # error [m]
    angle: Float[np.ndarray, " rows"]  # error [rad]
    singular: Float[np.ndarray, " rows"]  # smallest singular value of J, unit total length


def _errors(scale: Array, tip: Tip, goal: Goal) -> list[Array]:
    turn = product(goal.quaternion, conjugate(tip.quaternion))
    double = jnp.where(turn[0] < 0, -2.0, 2.0)
    offset = [scale * (a - b) for a, b in zip(goal.position, tip.position, strict=True)]
    return offset + [double * x for x in turn[1:]]


def _columns(scale: Array, tip: Tip) -> list[Numbers]:
    return [
        tuple(scale * x for x in linear) + angular
        for linear, angular in zip(tip.linear, tip.angular, strict=True)
    ]


def _gram(columns: list[Numbers], floor: Array | float) -> list[list[Array]]:
    """Lower half of J'J + floor."""
    rows = [[dot(a, b) for b in columns[: i + 1]] for i, a in enumerate(columns)]
    for i, row in enumerate(rows):
        row[i] = row[i] + floor
    return rows


@partial(jax.jit, compiler_options=WIDE_VECTORS)
def _iterate(
    length: Float[Array, " S"],
    b: Numbers,
    goal: Goal,
    damping: Array,
    theta_max: Float[Array, " S"],
    steps: Array | int,
) -> Numbers:
    """``steps`` damped steps, each kept within the limits (infinite ones leave them out)."""
    scale = 1 / jnp.sum(length)

    def body(_: Array | int, b: Numbers) -> Numbers:
        tip = tip_and_twists(length, b)
        r, columns = _errors(scale, tip, goal), _columns(scale, tip)
        merit = dot(tuple(r), tuple(r))
        slope = [dot(column, tuple(r)) for column in columns]
        step = solve_symmetric(_gram(columns, damping * merit + FLOOR), slope)
        return clipped(tuple(x + dx for x, dx in zip(b, step, strict=True)), theta_max)

    return lax.fori_loop(0, steps, body, b)


def clipped(b: Numbers, theta_max: Float[Array, " S"]) -> Numbers:
    """Each bending shortened to its limit."""
    kept: list[Array] = []
    for i in range(len(b) // 2):
        x, y = b[2 * i : 2 * i + 2]
        theta = jnp.sqrt(x * x + y * y)
        shorter = jnp.where(theta > theta_max[i], theta_max[i] / theta, 1.0)
        kept += [shorter * x, shorter * y]
    return tuple(kept)


@partial(jax.jit, compiler_options=WIDE_VECTORS)
def _judge(length: Float[Array, " S"], b: Numbers, goal: Goal) -> tuple[Array, Array, Array]:
    """Position error [m], angle [rad] and smallest singular value."""
    scale = 1 / jnp.sum(length)
    tip = tip_and_twists(length, b)
    r = _errors(scale, tip, goal)
    gram = _gram(_columns(scale, tip), FLOOR)

    def body(_: Array | int, carried: tuple[Numbers, Array]) -> tuple[Numbers, Array]:
        x = carried[0]
        y = solve_symmetric(gram, list(x))
        growth = jnp.sqrt(dot(tuple(y), tuple(y)))
        return tuple(value / growth for value in y), growth

    start = tuple(jnp.full_like(b[0], (-0.7) ** k) for k in range(len(b)))
    norm = jnp.sqrt(dot(start, start))
    start = tuple(x / norm for x in start)
    _, growth = lax.fori_loop(0, INVERSE_ITERATIONS, body, (start, norm))
    position = jnp.sqrt(dot(tuple(r[:3]), tuple(r[:3]))) / scale
    half = 0.5 * jnp.sqrt(dot(tuple(r[3:]), tuple(r[3:])))
    angle = 2 * jnp.arcsin(jnp.minimum(half, 1.0))
    return position, angle, jnp.sqrt(1 / growth)


def in_pieces(rows: int) -> list[tuple[slice, int]]:
    """Slices of up to ROWS[-1] rows and the compiled size that each is padded to."""
    pieces = []
    start = 0
    while start < rows:
        left = rows - start
        size = next((s for s in ROWS if s >= left), ROWS[-1])
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
    damping: float,
    theta_max: Float[np.ndarray, " S"] | None = None,
) -> Float[np.ndarray, "dof rows"]:
    """Bending after a number of steps; call inside an x64 context.

    Args:
        length: L_i [m].
        b: Start.
        goal: Position [m] and quaternion (w, x, y, z) of the last disc, in the root's frame.
        steps: Of them.
        damping: Times |r|^2.
        theta_max: Limits to stay within [rad]; none by default.
    """
    ends = np.empty_like(b)
    limits = np.full(len(length), np.inf) if theta_max is None else theta_max
    for piece, size in in_pieces(b.shape[1]):
        part, target = padded(b[:, piece], size), padded(goal[:, piece], size)
        found = _iterate(
            length, tuple(part), Goal(tuple(target[:3]), tuple(target[3:])), damping, limits, steps
        )
        for row, values in enumerate(found):
            ends[row, piece] = np.asarray(values)[: piece.stop - piece.start]
    return ends


def judge(
    length: Float[np.ndarray, " S"],
    b: Float[np.ndarray, "dof rows"],
    goal: Float[np.ndarray, "7 rows"],
) -> Solved:
    """Errors and smallest singular value of configurations; arguments as for ``newton``."""
    known = np.empty((3, b.shape[1]))
    for piece, size in in_pieces(b.shape[1]):
        part, target = padded(b[:, piece], size), padded(goal[:, piece], size)
        found = _judge(length, tuple(part), Goal(tuple(target[:3]), tuple(target[3:])))
        for row, values in enumerate(found):
            known[row, piece] = np.asarray(values)[: piece.stop - piece.start]
    return Solved(b, *known)


def solved(at: Solved, position: float, angle: float) -> Bool[np.ndarray, " rows"]:
    """Both errors below their tolerances."""
    return (at.position < position) & (at.angle < angle)
