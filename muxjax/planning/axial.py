"""Axial positions for a sequence of steps (M Eq. 10)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from muxjax.robot import Robot


def fewest_repositionings(
    robot: Robot,
    moving: Bool[np.ndarray, "K SJ"],
    servos: tuple[int, ...],
    start: int | None,
    preferred: Int[np.ndarray, " K"],
) -> Int[np.ndarray, " K"]:
    """Axial position of each step such that the axial motor moves least often over all of them.

    A shortest path over axial positions rather than a greedy choice; among equals, the one that
    departs least from ``preferred``. Positions count from 1.

    Args:
        robot: The arm.
        moving: Tendons that move in each step.
        servos: Available servos.
        start: Position before the first step, if known.
        preferred: A choice that is feasible, such as the planner's own.
    """
    missed = np.any(moving[:, None, :] & ~robot.reach(servos)[None], axis=-1)
    n_steps, n_axial = missed.shape
    reposition = n_steps + 1.0  # outweighs every departure from the preferred ones together
    departs = np.arange(1, n_axial + 1) != preferred[:, None]
    own = np.where(missed, np.inf, departs)
    best = np.full(n_axial, reposition)
    if start is not None:
        best[start - 1] = 0.0
    came_from = np.zeros((n_steps, n_axial), dtype=np.int64)
    for k in range(n_steps):
        cheapest = int(np.argmin(best))
        if k:
            stays = best <= best[cheapest] + reposition
            came_from[k] = np.where(stays, np.arange(n_axial), cheapest)
        best = np.minimum(best, best[cheapest] + reposition) + own[k]
    path = np.zeros(n_steps, dtype=np.int64)
    for k in reversed(range(n_steps)):
        path[k] = np.argmin(best) if k == n_steps - 1 else came_from[k + 1, path[k + 1]]
    return path + 1
