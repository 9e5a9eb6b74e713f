"""Levenberg-Marquardt in Cartesian bending, for any number of segments and any goal.

A step is

    db = mu + J' (J J' + damping |r|^2)^-1 (r - J mu)

with r the goal's weighted errors and mu a pull towards a reference, which only what the goal
leaves free can follow. Steps are taken boldly, uphill too, where a solution is looked for. The
closest configuration to a goal out of reach is looked for downhill: a step that does not descend
is drawn back. A segment at its limit that is pulled outwards only turns about its base: without
this the steps would rely on a bending that the limits then take away.
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
from muxjax.ik.arcs import Array, dot
from muxjax.ik.goals import Frames, Kind, frames_of, goal_errors, goal_rows, kind_of, sizes
from muxjax.ik.newton import FLOOR, padded, within
from muxjax.ik.stacked import eliminated, stacked_pose, stacked_tip
from muxjax.precision import by_device
from muxjax.robot import Robot

MOST_SEGMENTS = 8  # the written-out code grows with the square of the segments
DAMPING = 0.1
PULL = 0.5  # of the reference, times the error (at most 1)
DRAWN_BACK = 0.25  # what is left of a step that did not descend
AT_LIMIT = 1 - 1e-12  # of its limit, from which a segment lies on it
ROWS = 128  # configurations a call: one size is ever compiled
ROWS_ELSEWHERE = 1 << 13  # on a GPU


class Reached(NamedTuple):
    """Where the steps ended; each row is one start."""

    b: Float[np.ndarray, "dof rows"]  # [rad]
    position: Float[np.ndarray, " rows"]  # error [m] over the axes that count
    angle: Float[np.ndarray, " rows"]  # error [rad] over the axes that count
    merit: Float[np.ndarray, " rows"]  # in the goal's metric


def scales(weights: Array, length: Array, rows: int) -> list[Array]:
    """What an error is multiplied by in the goal's metric."""
    scale = 1 / jnp.sum(length)
    return [weights[k] * (scale if k < 3 else 1.0) for k in range(rows)]


@partial(jax.jit, static_argnames=("kind", "pulled"), compiler_options=WIDE_VECTORS)
def _descend(
    length: Float[Array, " S"],
    theta_max: Float[Array, " S"],
    frames: Frames,
    b: Float[Array, "S 2 rows"],
    reference: Float[Array, "S 2 rows"],
    goal: Float[Array, "7 rows"],
    weights: Float[Array, " 6"],
    steps: Array | int,
    downhill: Array | bool,
    kind: Kind,
    pulled: bool,
) -> tuple[Array, Array]:
    """The configuration after so many steps (downhill, the best on the way), and its errors."""
    position, turn = tuple(goal[:3]), tuple(goal[3:])

    def body(_: Array | int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        b, best, least = state
        tip = stacked_tip(length, b, tuple(frames.point))
        errors = goal_errors(frames, tip, position, turn, kind)
        rows = goal_rows(frames, tip, kind)
        factors = scales(weights, length, len(errors))
        r = jnp.stack([w * e for w, e in zip(factors, errors, strict=True)])
        jac = jnp.stack([w * e for w, e in zip(factors, rows, strict=True)])
        r, jac = lax.optimization_barrier((r, jac))
        merit = lax.optimization_barrier(jnp.sum(r * r, axis=0))
        back = downhill & ~(merit < least)
        pull = jnp.where(downhill, 0.0, PULL * jnp.minimum(1.0, jnp.sqrt(merit)))
        mu = pull * (reference - b) if pulled else None
        step = _step(_free(b, theta_max, jac, r), r, DAMPING * merit + FLOOR, mu)
        best = jnp.where(back, best, b)
        ahead = within(b + lax.optimization_barrier(step), theta_max)
        ahead = jnp.where(back, best + DRAWN_BACK * (b - best), ahead)
        return lax.optimization_barrier((ahead, best, jnp.where(back, least, merit)))

    far = jnp.full_like(b[0, 0], jnp.inf)
    last, best, _ = lax.fori_loop(0, steps, body, (b, b, far))
    chosen = lax.optimization_barrier(jnp.where(downhill, best, last))
    return chosen, _judged(length, frames, chosen, goal, weights, kind)


def _judged(
    length: Float[Array, " S"],
    frames: Frames,
    b: Float[Array, "S 2 rows"],
    goal: Float[Array, "7 rows"],
    weights: Float[Array, " 6"],
    kind: Kind,
) -> Array:
    """Position error, angle and merit, stacked."""
    tip = stacked_pose(length, b, tuple(frames.point))
    errors = lax.optimization_barrier(
        goal_errors(frames, tip, tuple(goal[:3]), tuple(goal[3:]), kind)
    )
    factors = scales(weights, length, len(errors))
    r = tuple(w * e for w, e in zip(factors, errors, strict=True))
    return jnp.stack([*sizes(errors, jnp.where(weights > 0, 1.0, 0.0)), dot(r, r)])


def _free(
    b: Float[Array, "S 2 rows"],
    theta_max: Float[Array, " S"],
    jac: Float[Array, "m S 2 rows"],
    r: Float[Array, "m rows"],
) -> Array:
    """The Jacobian without the outward direction of segments that are held at their limit."""
    slope = jnp.sum(jac * r[:, None, None], axis=0)
    square = jnp.sum(b * b, axis=1)
    limit = (jnp.asarray(theta_max) * AT_LIMIT)[:, None]
    held = (square >= limit * limit) & (jnp.sum(b * slope, axis=1) > 0)
    inverse = jnp.where(held, 1 / jnp.where(held, square, 1.0), 0.0)
    inverse = lax.optimization_barrier(inverse)
    along = lax.optimization_barrier(inverse * jnp.sum(jac * b, axis=2))
    return lax.optimization_barrier(jac - along[:, :, None] * b)


def _step(
    jac: Float[Array, "m S 2 rows"],
    r: Float[Array, "m rows"],
    damping: Float[Array, " rows"],
    mu: Float[Array, "S 2 rows"] | None,
) -> Array:
    """The smaller of two equal systems is solved; without freedom there is no pull."""
    shape, m = jac.shape[1:], len(r)
    flat = jac.reshape(m, -1, shape[-1])
    n = flat.shape[1]
    if mu is None and n <= m:
        gram = jnp.sum(flat[:, :, None] * flat[:, None], axis=0)
        slope = jnp.sum(flat * r[:, None], axis=0)
        damped = lax.optimization_barrier((_damped(gram, damping), slope))
        return eliminated(*damped).reshape(shape)
    pull = jnp.zeros_like(flat[0]) if mu is None else mu.reshape(flat.shape[1:])
    rest = r - jnp.sum(flat * pull, axis=1)
    gram = jnp.sum(flat[:, None] * flat[None], axis=2)
    y = eliminated(*lax.optimization_barrier((_damped(gram, damping), rest)))
    return (pull + jnp.sum(flat * y[:, None], axis=0)).reshape(shape)


def _damped(gram: Float[Array, "n n rows"], damping: Float[Array, " rows"]) -> Array:
    return gram + jnp.eye(len(gram))[..., None] * damping


def levenberg(
    robot: Robot,
    start: Float[np.ndarray, "dof rows"],
    reference: Float[np.ndarray, "dof rows"],
    goal: Float[np.ndarray, "7 rows"],
    weights: Float[np.ndarray, " 6"],
    steps: int,
    downhill: bool = False,
) -> Reached:
    """Steps from every start; call inside an x64 context.

    Args:
        robot: The arm, NumPy float64 leaves.
        start: Cartesian bending [rad].
        reference: Bending to stay near.
        goal: Of the tool from the root, position [m] and quaternion.
        weights: Of the goal.
        steps: Of them.
        downhill: Never up, and without the pull of the reference: for goals out of reach.
    """
    ends, known = np.empty_like(start), np.empty((3, start.shape[1]))
    size = by_device(ROWS, ROWS_ELSEWHERE)
    shape = (robot.n_segments, 2, size)
    # Put on the device once: every array from the host costs a call ten microseconds.
    fixed = jax.device_put(
        (robot.length, robot.theta_max, frames_of(robot), weights, steps, downhill)
    )
    length, theta_max, frames, metric, count, down = fixed
    kind, pulled = kind_of(weights), bool(np.count_nonzero(weights) < len(start))
    for first in range(0, start.shape[1], size):
        piece = slice(first, first + size)
        b, near, to = (padded(x[:, piece], size) for x in (start, reference, goal))
        last, errors = _descend(
            length,
            theta_max,
            frames,
            b.reshape(shape),
            near.reshape(shape),
            to,
            metric,
            count,
            down,
            kind=kind,
            pulled=pulled,
        )
        here = min(size, start.shape[1] - first)
        ends[:, piece] = np.asarray(last).reshape(-1, size)[:, :here]
        known[:, piece] = np.asarray(errors)[:, :here]
    return Reached(ends, *known)


def reached(found: Reached, tolerance: tuple[float, float]) -> Bool[np.ndarray, " rows"]:
    """Both errors below their tolerances, [m] and [rad]."""
    return (found.position < tolerance[0]) & (found.angle < tolerance[1])
