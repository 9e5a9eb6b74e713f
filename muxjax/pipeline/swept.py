"""How near an arm comes to obstacles on its way: tendons that move, or a base that moves.

A motion is asked for its clearance at points so close together that no point of the arm moves by
more than RESOLUTION from one to the next. A clearance changes by no more than the arm moves, so
between two of them it is at least the mean of both less half of that way: the figures here are
such lower bounds, never a sample that happens to be free.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Float

from muxjax.collision import World, clearance
from muxjax.kinematics import configuration_from_bending
from muxjax.precision import pad_rows
from muxjax.robot import Robot
from muxjax.tendons import bending_from_displacements

Array = jax.Array | np.ndarray

RESOLUTION = 1e-3  # [m]
_BATCH = 512  # clearances in one call
_COARSE = 8  # parts of a leg by which its points are spread


class Swept(NamedTuple):
    """The tightest moment of a motion."""

    clearance: float  # no clearance on the way is less [m]
    share: float  # where, from 0 at the beginning to 1 at the end, by the way of the arm's points
    displacements: Float[np.ndarray, " SJ"]  # there [m]
    base: Float[np.ndarray, "4 4"]  # there


def clearances(
    robot: Robot,
    world: World,
    displacements: Float[np.ndarray, "n SJ"],
    bases: Float[np.ndarray, "n 4 4"] | None = None,
) -> Float[np.ndarray, " n"]:
    """Clearance [m] on the host in float64; -inf where displacements are undefined.

    Args:
        robot: The arm.
        world: Obstacles, and what the tool carries.
        displacements: Of the tendons [m].
        bases: Pose of the root for each of them; that of the robot by default.
    """
    count = len(displacements)
    if bases is None:
        bases = np.broadcast_to(np.asarray(robot.base), (count, 4, 4))
    found = []
    for begin in range(0, count, _BATCH):  # one size, one compilation
        rows = np.minimum(np.arange(begin, begin + _BATCH), count - 1)
        with jax.enable_x64(True):
            found.append(np.asarray(_clearances(robot, world, displacements[rows], bases[rows])))
    clear = np.concatenate([np.zeros(0), *found])[:count]
    return np.where(np.isfinite(clear), clear, -np.inf)


@jax.jit
def _clearances(
    robot: Robot,
    world: World,
    displacements: Float[Array, "n SJ"],
    bases: Float[Array, "n 4 4"],
) -> Float[Array, " n"]:
    q = configuration_from_bending(bending_from_displacements(robot, displacements))

    def one(q: Array, base: Array) -> Array:
        return clearance(eqx.tree_at(lambda r: r.base, robot, base), q, world)

    return jax.vmap(one)(q, bases)


def at_base(robot: Robot, pose: Float[np.ndarray, "4 4"]) -> Robot:
    """The same arm with its root elsewhere [m]."""
    return eqx.tree_at(lambda r: r.base, robot, np.asarray(pose, dtype=np.float64))


def grown(robot: Robot, world: World, margin: float) -> tuple[Robot, World]:
    """An arm, and what it carries, that is thicker by a margin [m] all round.

    What is clear for it keeps that distance with the arm as it is.
    """
    thick = eqx.tree_at(lambda r: r.body_radius, robot, np.asarray(robot.body_radius) + margin)
    carried = np.asarray(world.carried_radius) + margin
    return thick, eqx.tree_at(lambda w: w.carried_radius, world, carried)


def _beyond(robot: Robot, world: World) -> float:
    """Distance [m] from the last disc to the farthest point that is held there."""
    tool = np.asarray(robot.tool)
    held = np.asarray(world.carried) @ tool[:3, :3].T + tool[:3, 3]
    return float(np.max(np.linalg.norm(np.vstack([tool[None, :3, 3], held]), axis=1)))


def swept_tendons(
    robot: Robot, world: World, points: Float[np.ndarray, "P SJ"], resolution: float = RESOLUTION
) -> Swept:
    """Least clearance while the tendons go through points [m] in straight lines.

    While a segment's bending vector changes by db, its directions turn by at most |db| s / L at
    arc s: no point moves by more than |db| (L / 2 + what is beyond the segment).
    """
    bent = _host_bending(robot, _refined(points, np.full(len(points) - 1, _COARSE)))
    length = np.asarray(robot.length)
    lever = length / 2 + length.sum() - np.cumsum(length) + _beyond(robot, world)
    way = np.linalg.norm(np.diff(bent, axis=0), axis=-1) @ lever
    parts = np.ceil(way.reshape(-1, _COARSE).max(axis=1) * _COARSE / resolution)
    fine = _refined(points, np.maximum(parts, 1).astype(int))
    gaps = np.linalg.norm(np.diff(_host_bending(robot, fine), axis=0), axis=-1) @ lever
    least, where, share = _tightest(clearances(robot, world, fine), gaps)
    return Swept(least, share, fine[where], np.array(robot.base))


def _host_bending(
    robot: Robot, displacements: Float[np.ndarray, "n SJ"]
) -> Float[np.ndarray, "n S 2"]:
    with jax.enable_x64(True):
        return np.asarray(_bending(robot, pad_rows(displacements)))[: len(displacements)]


_bending = jax.jit(bending_from_displacements)


def _refined(points: Float[np.ndarray, "P n"], parts: np.ndarray) -> Float[np.ndarray, "Q n"]:
    """Every stretch of a polyline cut into a number of equal parts."""
    pieces = [
        begin + np.arange(count)[:, None] / count * (end - begin)
        for begin, end, count in zip(points[:-1], points[1:], parts, strict=True)
    ]
    return np.concatenate([*pieces, points[-1:]])


def _tightest(
    clear: Float[np.ndarray, " n"], gaps: Float[np.ndarray, " m"]
) -> tuple[float, int, float]:
    """Least clearance of a motion sampled with gaps, the sample it is nearest to, and its place."""
    along = np.concatenate([[0.0], np.cumsum(gaps)])
    where = int(np.argmin(clear))
    between = np.minimum(0.5 * (clear[:-1] + clear[1:] - gaps), np.minimum(clear[:-1], clear[1:]))
    least = float(np.min(between, initial=clear[where]))
    return least, where, float(along[where] / along[-1]) if along[-1] > 0 else 0.0


def base_path(
    poses: Float[np.ndarray, "P 4 4"], reach: float, resolution: float = RESOLUTION
) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " m"]]:
    """A base's way through poses, in straight lines and steady turns, in short steps.

    Args:
        poses: Of the arm's root [m].
        reach: Greatest distance of any point of the arm from its root [m].
        resolution: No point moves further in a step [m].

    Returns:
        Poses, and how far any point may move from each to the next [m].
    """
    places, gaps = [poses[:1]], [np.zeros(0)]
    for begin, end in pairwise(poses):
        turns = scipy.spatial.transform.Rotation.from_matrix(np.stack([begin[:3, :3], end[:3, :3]]))
        angle = float((turns[1] * turns[0].inv()).magnitude())
        way = float(np.linalg.norm(end[:3, 3] - begin[:3, 3])) + angle * reach
        count = max(1, int(np.ceil(way / resolution)))
        share = np.arange(1, count + 1) / count
        at = begin[:3, 3] + share[:, None] * (end - begin)[:3, 3]
        turned = scipy.spatial.transform.Slerp([0.0, 1.0], turns)(share)
        places.append(
            scipy.spatial.transform.RigidTransform.from_components(at, turned).as_matrix()
        )
        gaps.append(np.full(count, way / count))
    return np.concatenate(places), np.concatenate(gaps)


def swept_base(
    robot: Robot,
    world: World,
    displacements: Float[np.ndarray, " SJ"],
    poses: Float[np.ndarray, "P 4 4"],
    resolution: float = RESOLUTION,
) -> Swept:
    """Least clearance while the base goes through poses and the tendons stand still [m]."""
    reach = float(np.sum(robot.length)) + _beyond(robot, world)
    places, gaps = base_path(poses, reach, resolution)
    still = np.broadcast_to(displacements, (len(places), len(displacements)))
    clear = clearances(robot, world, still, places)
    least, where, share = _tightest(clear, gaps)
    return Swept(least, share, np.array(displacements), places[where])
