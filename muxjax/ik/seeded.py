"""Levenberg-Marquardt from a table of poses, in rounds of restarts: one configuration a pose."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from muxjax.ik.all_solutions import AT_LIMIT
from muxjax.ik.checks import distance_from_root, reach
from muxjax.ik.descent import ORIENTATION_TOLERANCE, POSITION_TOLERANCE
from muxjax.ik.every import polar
from muxjax.ik.goals import tool_goals
from muxjax.ik.levenberg import Reached, levenberg, nearest_entries
from muxjax.ik.result import IkResult, IkStatus
from muxjax.robot import Robot

FIRST_STARTS = 8  # of Levenberg-Marquardt: the reference and the nearest entries of the table
MORE_STARTS = 64  # where these failed
FEW_STEPS, MORE_STEPS = 24, 60


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
    """Levenberg-Marquardt from the reference and from the table's nearest entries."""
    rows, dof = reference.shape
    wanted = bending_of(reference)
    best = Reached(np.zeros((dof, rows)), *(np.full(rows, np.inf) for _ in range(3)))
    with jax.enable_x64(True):
        goal = tool_goals(robot, poses)
        for count, steps in ((FIRST_STARTS, FEW_STEPS), (MORE_STARTS, MORE_STEPS)):
            open_rows = np.flatnonzero(~_reached(best))
            if not len(open_rows):
                break
            start = nearest_entries(robot, goal[:, open_rows], weights, count)
            start[:, :, 0] = wanted[open_rows].T
            many = np.repeat(open_rows, count)
            found = levenberg(
                robot, start.reshape(dof, -1), wanted[many].T, goal[:, many], weights, steps
            )
            away = np.sum((found.b - wanted[many].T) ** 2, axis=0)
            rank = np.where(_reached(found), away / (1 + away), 1 + found.merit / (1 + found.merit))
            pick = np.argmin(rank.reshape(-1, count), axis=1) + count * np.arange(len(open_rows))
            for kept, new in zip(best, found, strict=True):
                kept[..., open_rows] = new[..., pick]
    return closest(robot, poses, polar(robot, best.b.T), best.position, best.angle, _reached(best))


def _reached(found: Reached) -> np.ndarray:
    return (found.position < POSITION_TOLERANCE) & (found.angle < ORIENTATION_TOLERANCE)


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
