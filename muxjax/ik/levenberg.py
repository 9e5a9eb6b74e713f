"""Levenberg-Marquardt in Cartesian bending, started from a table of poses.

For arms of any number of segments and for partial goals (``goals``). A table of configurations
within the limits is kept for each robot with its poses; those whose poses are nearest to the goal
are the starts. A step is

    db = mu + J' (J J' + damping |r|^2)^-1 (r - J mu)

with mu the pull towards the reference, which only what the goal leaves free can follow.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.stats import qmc

from muxjax.batched import WIDE_VECTORS, poses
from muxjax.ik.arcs import Array, Numbers, dot, solve_symmetric, tip_and_twists
from muxjax.ik.frames import inverse, quaternion
from muxjax.ik.goals import Frames, frames_of, goal_errors, is_pointing, sizes
from muxjax.ik.newton import FLOOR, clipped, in_pieces, padded
from muxjax.robot import Robot

MOST_SEGMENTS = 8  # the written-out code grows with the square of the segments
ENTRIES = 1 << 16  # of the table
STEPS = 40
DAMPING = 0.1
PULL = 0.5  # of the reference, times the error (at most 1)


class Reached(NamedTuple):
    """Where the steps ended; each row is one start."""

    b: Float[np.ndarray, "dof rows"]  # [rad]
    position: Float[np.ndarray, " rows"]  # error [m] over the axes that count
    angle: Float[np.ndarray, " rows"]  # error [rad] over the axes that count
    merit: Float[np.ndarray, " rows"]  # in the goal's metric


class Table(NamedTuple):
    """Configurations and their tool poses from the root."""

    b: Float[np.ndarray, "dof entries"]
    position: Float[np.ndarray, "entries 3"]
    quaternion: Float[np.ndarray, "4 entries"]


def table(robot: Robot) -> Table:
    """The robot's table; made once for each set of lengths, limits and tool."""
    key = (robot.length, robot.theta_max, robot.base, robot.tool)
    return _table(robot.config, *(np.asarray(x, np.float64).tobytes() for x in key))(robot)


@lru_cache(maxsize=8)
def _table(*_: object):  # type: ignore[no-untyped-def]
    made: list[Table] = []

    def get(robot: Robot) -> Table:
        if not made:
            made.append(_make(robot))
        return made[0]

    return get


def _make(robot: Robot) -> Table:
    s = robot.n_segments
    unit = qmc.Sobol(2 * s, scramble=False).random(ENTRIES)
    theta, phi = robot.theta_max * unit[:, :s], 2 * np.pi * unit[:, s:]
    b = np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1)
    frames = poses(robot, b.astype(np.float32), "matrix").astype(np.float64)
    inner = inverse(np.asarray(robot.base)) @ frames
    return Table(b.reshape(ENTRIES, -1).T, inner[:, :3, 3], quaternion(inner[:, :3, :3]))


_trees: dict[tuple[int, bytes], tuple[Table, cKDTree]] = {}


def nearest_entries(
    robot: Robot,
    goal: Float[np.ndarray, "7 rows"],
    weights: Float[np.ndarray, " 6"],
    count: int,
) -> Float[np.ndarray, "dof rows count"]:
    """Bending of the entries whose poses are nearest to each goal."""
    entries = table(robot)
    key = (id(entries), weights.tobytes())
    if key not in _trees:
        if len(_trees) >= 8:
            _trees.pop(next(iter(_trees)))
        features = _features(robot, entries.position, entries.quaternion, weights)
        _trees[key] = entries, cKDTree(features, balanced_tree=False)
    wanted = _features(robot, goal[:3].T, goal[3:], weights)
    _, index = _trees[key][1].query(wanted, k=np.arange(1, count + 1))
    return entries.b[:, index]


def _features(
    robot: Robot,
    position: Float[np.ndarray, "rows 3"],
    turn: Float[np.ndarray, "4 rows"],
    weights: Float[np.ndarray, " 6"],
) -> Float[np.ndarray, "rows features"]:
    """Numbers whose distance is about the goal's metric."""
    w, x, y, z = turn
    scaled = position * weights[:3] / np.sum(robot.length)
    if not weights[3:].any():
        return scaled
    if is_pointing(weights):
        axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        return np.concatenate([scaled, weights[3] * axis.T], axis=1)
    sign = np.where(w < 0, -1.0, 1.0)
    return np.concatenate([scaled, 2 * weights[3:].max() * (sign * turn).T], axis=1)


@partial(jax.jit, static_argnames="pointing", compiler_options=WIDE_VECTORS)
def _descend(
    length: Float[Array, " S"],
    theta_max: Float[Array, " S"],
    frames: Frames,
    b: Numbers,
    reference: Numbers,
    goal: Numbers,
    weights: Float[Array, " 6"],
    steps: Array | int,
    pointing: bool,
) -> tuple[Numbers, Array, Array, Array]:
    """The configuration of least merit on the way, its position error, angle and merit."""
    scale = 1 / jnp.sum(length)
    rows = [weights[k] * (scale if k < 3 else 1.0) for k in range(6)]
    wanted = jnp.where(weights > 0, 1.0, 0.0)

    def look(b: Numbers) -> tuple[list[Array], list[Array], Array, Array]:
        # The barriers keep XLA from computing these anew for each of their many uses, which would
        # take it a minute to compile for five segments.
        tip = lax.optimization_barrier(tip_and_twists(length, b, frames.point))
        offset, rotation, jacobian = goal_errors(frames, tip, goal[:3], goal[3:], pointing)
        r = [w * e for w, e in zip(rows, offset + rotation, strict=True)]
        weighted = [w * e for w, e in zip(rows, jacobian, strict=True)]
        r, weighted = lax.optimization_barrier((r, weighted))
        return r, weighted, *sizes(offset, rotation, wanted)

    def body(_: Array | int, state: tuple[Numbers, Numbers, Numbers]) -> tuple[Numbers, ...]:
        b, best, known = state
        r, jacobian, position, angle = look(b)
        merit = dot(tuple(r), tuple(r))
        better = merit < known[0]
        best = tuple(jnp.where(better, x, old) for x, old in zip(b, best, strict=True))
        known = tuple(
            jnp.where(better, x, old)
            for x, old in zip((merit, position, angle), known, strict=True)
        )
        pull = PULL * jnp.minimum(1.0, jnp.sqrt(merit))
        mu = pull * (jnp.stack(reference) - jnp.stack(b))
        step = _step(jacobian, r, DAMPING * merit + FLOOR, mu)
        return (
            clipped(tuple(x + dx for x, dx in zip(b, step, strict=True)), theta_max),
            best,
            known,
        )

    far = jnp.full_like(b[0], jnp.inf)
    _, best, known = lax.fori_loop(0, steps, body, (b, b, (far, far, far)))
    return best, known[1], known[2], known[0]


def _step(jacobian: list[Array], r: list[Array], damping: Array, mu: Array) -> list[Array]:
    """The smaller of the two equal systems is solved: 6 rows or 2S columns."""
    n = mu.shape[0]
    if n < 6:
        rows = [tuple(row[i] for row in jacobian) for i in range(n)]
        gram = [[dot(a, b) for b in rows[: i + 1]] for i, a in enumerate(rows)]
        for i in range(n):
            gram[i][i] = gram[i][i] + damping
        return solve_symmetric(gram, [dot(row, tuple(r)) for row in rows])
    rest = [e - jnp.sum(row * mu, axis=0) for e, row in zip(r, jacobian, strict=True)]
    gram = [[jnp.sum(jacobian[i] * jacobian[j], axis=0) for j in range(i + 1)] for i in range(6)]
    for i in range(6):
        gram[i][i] = gram[i][i] + damping
    y = lax.optimization_barrier(solve_symmetric(gram, rest))
    change = mu + sum((row * c for row, c in zip(jacobian, y, strict=True)), start=0.0)
    return [change[k] for k in range(n)]


def levenberg(
    robot: Robot,
    start: Float[np.ndarray, "dof rows"],
    reference: Float[np.ndarray, "dof rows"],
    goal: Float[np.ndarray, "7 rows"],
    weights: Float[np.ndarray, " 6"],
    steps: int = STEPS,
) -> Reached:
    """Steps from every start; call inside an x64 context.

    Args:
        robot: The arm, NumPy float64 leaves.
        start: Cartesian bending [rad].
        reference: Bending to stay near.
        goal: Of the tool from the root, position [m] and quaternion.
        weights: Of the goal.
        steps: Of them.
    """
    ends, known = np.empty_like(start), np.empty((3, start.shape[1]))
    frames, pointing = frames_of(robot), is_pointing(weights)
    for piece, size in in_pieces(start.shape[1]):
        parts = [tuple(padded(x[:, piece], size)) for x in (start, reference, goal)]
        best, *errors = _descend(
            robot.length, robot.theta_max, frames, *parts, weights, steps, pointing=pointing
        )
        count = piece.stop - piece.start
        for row, values in enumerate(best):
            ends[row, piece] = np.asarray(values)[:count]
        for row, values in enumerate(errors):
            known[row, piece] = np.asarray(values)[:count]
    return Reached(ends, *known)
