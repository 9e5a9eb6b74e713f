"""Levenberg-Marquardt from a table of poses, in rounds of restarts: one configuration a pose.

Few steps are taken for all starts, then those that have not arrived go on, then the poses that
none of their starts solved get more of them; what no start solves is out of reach or nearly so,
and the closest configuration is looked for downhill.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.ik.all_solutions import AT_LIMIT
from muxjax.ik.checks import distance_from_root, reach
from muxjax.ik.descent import ORIENTATION_TOLERANCE, POSITION_TOLERANCE
from muxjax.ik.every import polar
from muxjax.ik.goals import tool_goals
from muxjax.ik.levenberg import Reached, levenberg, reached
from muxjax.ik.result import IkResult, IkStatus
from muxjax.ik.table import nearest_entries
from muxjax.robot import Robot

TOLERANCE = (POSITION_TOLERANCE, ORIENTATION_TOLERANCE)
NEAR_STARTS = 8  # the reference and the nearest entries, all followed to their end
MORE_STARTS = 8  # where these failed
MANY_STARTS = 64  # and where those did
FEW_STEPS = (8, 8)  # after each of them, what has arrived is left
MORE_STEPS = (8, 8, 8)
MANY_STEPS = (12, 12, 24)
SURVIVORS = 0.25  # of the many starts, after their first steps
CLOSEST_STARTS = 24  # downhill, where nothing arrives
CLOSEST_LEADERS = 4  # of them go on after the first round
CLOSEST_STEPS = 16
CLOSEST_ROUNDS = 20  # at most
SETTLED = 1e-10  # relative fall of the merit in a round below which a configuration is closest


def bending_of(q: Float[np.ndarray, "*n dof"]) -> Float[np.ndarray, "*n dof"]:
    """Cartesian bending [rad] of configurations, flattened."""
    theta, phi = q[..., 0::2], q[..., 1::2]
    return np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1).reshape(q.shape)


def from_table(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    reference: Float[np.ndarray, "rows dof"],
    weights: Float[np.ndarray, " 6"],
) -> IkResult:
    """Levenberg-Marquardt from the reference and from the table's nearest entries.

    A goal with isolated solutions and a straight reference, which is the default, takes the first
    solution that is found. Otherwise the reference and its seven rivals are all followed, and the
    nearest solution of theirs is taken.
    """
    wanted = bending_of(reference).T
    isolated = np.count_nonzero(weights) >= len(wanted)
    with jax.enable_x64(True):
        goal = tool_goals(robot, poses)
        best = _nothing(*wanted.shape)
        every = np.arange(len(poses))
        far = np.asarray(distance_from_root(robot, poses) > reach(robot))
        within = every[~far] if weights[:3].all() else every
        bent = np.any(wanted != 0, axis=0, keepdims=True)[0, within]
        for rows, near in ((within[~bent], not isolated), (within[bent], True)):
            if not len(rows):
                continue
            count = NEAR_STARTS if near else 1
            start = nearest_entries(robot, goal[:, rows], weights, count)
            if near:
                start[:, :, 0] = wanted[:, rows]
            steps = MORE_STEPS if near else FEW_STEPS
            _race(best, robot, rows, start, wanted, goal, weights, steps, all_of_them=near)
        for first, count, steps in (
            (1, MORE_STARTS, MORE_STEPS),
            (1 + MORE_STARTS, MANY_STARTS, MANY_STEPS),
        ):
            rows = np.setdiff1d(within, np.flatnonzero(reached(best, TOLERANCE)))
            if not len(rows):
                break
            start = nearest_entries(robot, goal[:, rows], weights, count, first)
            _race(best, robot, rows, start, wanted, goal, weights, steps)
        _go_down(best, robot, wanted, goal, weights)
    q = polar(robot, best.b.T)
    return closest(robot, poses, q, best.position, best.angle, reached(best, TOLERANCE))


def closest_configurations(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    weights: Float[np.ndarray, " 6"],
) -> IkResult:
    """For poses that are known to be out of reach: the closest configuration, downhill at once."""
    with jax.enable_x64(True):
        goal = tool_goals(robot, poses)
        best = _nothing(2 * robot.n_segments, len(poses))
        _go_down(best, robot, best.b, goal, weights)
    q = polar(robot, best.b.T)
    return closest(robot, poses, q, best.position, best.angle, reached(best, TOLERANCE))


def _nothing(dof: int, rows: int) -> Reached:
    return Reached(np.zeros((dof, rows)), *(np.full(rows, np.inf) for _ in range(3)))


def _race(
    best: Reached,
    robot: Robot,
    rows: Int[np.ndarray, " n"],
    start: Float[np.ndarray, "dof n starts"],
    reference: Float[np.ndarray, "dof rows"],
    goal: Float[np.ndarray, "7 rows"],
    weights: Float[np.ndarray, " 6"],
    phases: Sequence[int],
    all_of_them: bool = False,
) -> None:
    """Follow all starts of the poses ``rows`` and offer what they find to ``best``.

    Unless ``all_of_them`` are wanted, a pose's other starts are given up once one has arrived, and
    where there are many, those whose merit is worst after the first phase.
    """
    count = start.shape[2]
    row = np.repeat(rows, count)
    b = start.reshape(len(start), -1)
    for number, steps in enumerate(phases):
        found = levenberg(robot, b, reference[:, row], goal[:, row], weights, steps)
        arrived = reached(found, TOLERANCE)
        _offer(best, row, found, reference)
        going = ~arrived
        solved = reached(best, TOLERANCE)
        if not all_of_them:
            going &= ~solved[row]
        if number == 0 and count >= MANY_STARTS:
            going &= _leading(row, found.merit, int(SURVIVORS * count))
        if not going.any():
            break
        row, b = row[going], found.b[:, going]


def _leading(
    row: Int[np.ndarray, " n"], merit: Float[np.ndarray, " n"], count: int
) -> Bool[np.ndarray, " n"]:
    """The ``count`` entries of least merit of each row; the rows are sorted."""
    order = np.lexsort((merit, row))
    sizes = np.diff(np.flatnonzero(np.diff(row, prepend=-1, append=-1)))
    rank = np.empty(len(row), int)
    rank[order] = np.concatenate([np.arange(size) for size in sizes])
    return rank < count


def _offer(
    best: Reached,
    row: Int[np.ndarray, " n"],
    found: Reached,
    reference: Float[np.ndarray, "dof rows"],
) -> None:
    """Keep what is better: solutions by their distance to the reference, others by merit."""
    rank = _rank(found, reference[:, row])
    order = np.lexsort((rank, row))
    first = np.flatnonzero(np.diff(row[order], prepend=-1))
    pick = order[first]
    rows = row[pick]
    held = Reached(*(x[..., rows] for x in best))
    better = rank[pick] < _rank(held, reference[:, rows])
    for kept, new in zip(best, found, strict=True):
        kept[..., rows[better]] = new[..., pick[better]]


def _rank(found: Reached, reference: Float[np.ndarray, "dof n"]) -> Float[np.ndarray, " n"]:
    """Below 1 for solutions, from 1 on for others; NaN errors come last."""
    away = np.sum((found.b - reference) ** 2, axis=0)
    merit = np.nan_to_num(found.merit, nan=np.inf, posinf=np.inf)
    return np.where(reached(found, TOLERANCE), away / (1 + away), 2 - 1 / (1 + merit))


def _go_down(
    best: Reached,
    robot: Robot,
    reference: Float[np.ndarray, "dof rows"],
    goal: Float[np.ndarray, "7 rows"],
    weights: Float[np.ndarray, " 6"],
) -> None:
    """The closest configurations of the poses that are not solved."""
    rows = np.flatnonzero(~reached(best, TOLERANCE))
    if not len(rows):
        return
    start = nearest_entries(robot, goal[:, rows], weights, CLOSEST_STARTS)
    known = np.isfinite(best.merit[rows])
    start[:, known, -1] = best.b[:, rows[known]]
    row, b = np.repeat(rows, CLOSEST_STARTS), start.reshape(len(start), -1)
    before = np.full(len(row), np.inf)
    for number in range(CLOSEST_ROUNDS):
        found = levenberg(robot, b, b, goal[:, row], weights, CLOSEST_STEPS, downhill=True)
        _offer(best, row, found, reference)
        going = ~(found.merit >= (1 - SETTLED) * before)
        if number == 0:
            going &= _leading(row, found.merit, CLOSEST_LEADERS)
        if not going.any():
            break
        row, b, before = row[going], found.b[:, going], found.merit[going]


def closest(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    q: Float[np.ndarray, "rows dof"],
    position: Float[np.ndarray, " rows"],
    angle: Float[np.ndarray, " rows"],
    solved: np.ndarray,
) -> IkResult:
    """The result of a search, with what keeps the poses that it did not solve away."""
    binding = q[:, 0::2] >= robot.theta_max - AT_LIMIT
    failure = np.where(
        distance_from_root(robot, poses) > reach(robot),
        int(IkStatus.OUT_OF_REACH),
        np.where(binding.any(axis=-1), int(IkStatus.LIMITED), int(IkStatus.NOT_CONVERGED)),
    )
    status = np.where(solved, int(IkStatus.CONVERGED), failure)
    return IkResult(q, position, angle, solved, status, binding)
