"""A table of configurations and their poses, where Levenberg-Marquardt finds its starts."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np
import scipy
from jaxtyping import Float

from muxjax.batched import poses
from muxjax.ik.frames import inverse, quaternion
from muxjax.ik.goals import is_pointing
from muxjax.robot import Robot

Array = jax.Array | np.ndarray

ENTRIES = 1 << 15
# Places count this much more than the metric says: measured on MuxArm, a near place is the better
# start (95 % of random goals solved from one start, 92 % without).
PLACES_FIRST = 4.0
# An entry that is not quite the nearest is as good a start, and found in half the time.
LOOSELY = 1.0
KEPT = 8  # tables and trees


class Table(NamedTuple):
    """Configurations and their tool poses from the root."""

    b: Float[np.ndarray, "dof entries"]  # Cartesian bending [rad]
    position: Float[np.ndarray, "entries 3"]  # [m]
    quaternion: Float[np.ndarray, "4 entries"]


def table(robot: Robot) -> Table:
    """The robot's table; made once for each set of lengths, limits and tool."""
    key = (robot.length, robot.theta_max, robot.base, robot.tool)
    return _table(robot.config, *(np.asarray(x, np.float64).tobytes() for x in key))(robot)


@lru_cache(maxsize=KEPT)
def _table(*_: object):  # type: ignore[no-untyped-def]
    made: list[Table] = []

    def get(robot: Robot) -> Table:
        if not made:
            made.append(_make(robot))
        return made[0]

    return get


def _make(robot: Robot) -> Table:
    from scipy.stats import qmc  # here and not above: it takes a third of a second to import

    b = bendings(robot, qmc.Sobol(2 * robot.n_segments, scramble=False).random(ENTRIES))
    frames = poses(robot, b.reshape(ENTRIES, -1, 2).astype(np.float32), "matrix")
    inner = inverse(np.asarray(robot.base)) @ frames.astype(np.float64)
    return Table(b.T, inner[:, :3, 3], quaternion(inner[:, :3, :3]))


def bendings(robot: Robot, unit: Float[np.ndarray, "n dof"]) -> Float[np.ndarray, "n dof"]:
    """Cartesian bending [rad] within the limits, of points of the unit cube."""
    bend, turn = np.split(unit, 2, axis=1)
    theta, phi = np.asarray(robot.theta_max) * bend, 2 * np.pi * turn
    return np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1).reshape(unit.shape)


_trees: dict[tuple[int, bytes], tuple[Table, scipy.spatial.cKDTree]] = {}


def nearest_entries(
    robot: Robot,
    goal: Float[np.ndarray, "7 rows"],
    weights: Float[np.ndarray, " 6"],
    count: int,
    first: int = 0,
) -> Float[np.ndarray, "dof rows count"]:
    """Bending of the entries whose poses are about the nearest to each goal.

    Args:
        robot: The arm.
        goal: Position [m] and quaternion of the tool, from the root.
        weights: Of the goal.
        count: Entries wanted.
        first: Nearer ones to leave out.
    """
    entries = table(robot)
    key = (id(entries), weights.tobytes())
    if key not in _trees:
        if len(_trees) >= KEPT:
            _trees.pop(next(iter(_trees)))
        features = _features(robot, entries.position, entries.quaternion, weights)
        _trees[key] = entries, scipy.spatial.cKDTree(features, balanced_tree=False)
    wanted = _features(robot, goal[:3].T, goal[3:], weights)
    ranks = np.arange(1 + first, 1 + first + count)
    _, index = _trees[key][1].query(wanted, k=ranks, eps=LOOSELY)
    return entries.b[:, index]


def _features(
    robot: Robot,
    position: Float[np.ndarray, "rows 3"],
    turn: Float[np.ndarray, "4 rows"],
    weights: Float[np.ndarray, " 6"],
) -> Float[np.ndarray, "rows features"]:
    """Numbers whose distance is about the goal's metric, with places first."""
    w, x, y, z = turn
    scaled = position * (PLACES_FIRST * weights[:3] / np.sum(robot.length))
    if not weights[3:].any():
        return scaled
    if is_pointing(weights):
        axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        return np.concatenate([scaled, weights[3] * axis.T], axis=1)
    sign = np.where(w < 0, -1.0, 1.0)
    return np.concatenate([scaled, 2 * weights[3:].max() * (sign * turn).T], axis=1)
