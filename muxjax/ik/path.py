"""A path of poses, followed from one solution to the next."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from muxjax.ik.checks import check_pose, check_reference
from muxjax.ik.descent import STARTS, solve_by_descent
from muxjax.ik.every import all_ik, is_exhaustive
from muxjax.ik.result import IkResult
from muxjax.robot import Robot

Array = jax.Array | np.ndarray

SWITCH = 0.5  # [rad]; a larger step of a segment's bending than this is a jump to another branch


class PathResult(eqx.Module):
    """Configurations along a path."""

    q: Float[Array, "N dof"]  # [rad]
    converged: Bool[Array, " N"]
    switched: Bool[Array, " N"]  # the step to this pose jumps to another branch of solutions
    step: Float[Array, " N"]  # largest change of a segment's bending since the pose before [rad]


def solve_path(
    robot: Robot,
    poses: Float[Array, "N 4 4"],
    *,
    q0: Float[Array, " dof"] | None = None,
    largest_step: float = SWITCH,
    project_rotations: bool = False,
) -> PathResult:
    """Configurations for poses in order, each near the one before.

    With three segments all solutions of every pose are known, and the sequence of least total
    change is taken (a shortest path): a branch that ends later is left at the cheapest place.
    Other arms go on from each solution to the next. A pose without a solution is passed over
    (``converged`` false, q repeated), and the path goes on behind it.

    Args:
        robot: The arm.
        poses: In order; checked as by ``solve_ik``.
        q0: Configuration before the first pose [rad]; the straight arm by default.
        largest_step: Change of a segment's bending [rad] above which a step is a switch.
        project_rotations: As for ``all_ik``.

    Raises:
        ValueError: Poses that cannot be meant, not a sequence of them, or q0 beyond the limits.
    """
    checked = check_pose(robot, poses, project_rotations)
    if checked.ndim != 3:
        raise ValueError(f"poses: must have shape (N, 4, 4), found {checked.shape}")
    if largest_step <= 0:
        raise ValueError(f"largest_step: must be above 0, found {largest_step}")
    begin = check_reference(robot, q0, ())
    if is_exhaustive(robot):
        every = jax.tree.map(np.asarray, all_ik(robot, checked))
        q, converged = _shortest(every.q, every.mask, begin)
    else:
        q, converged = _followed(robot, checked, begin)
    step = np.abs(np.diff(_bending(np.concatenate([begin[None], q])), axis=0))
    change = np.hypot(step[:, 0::2], step[:, 1::2]).max(axis=-1, initial=0.0)
    switched = change > largest_step
    switched[:1] = False
    return PathResult(q, converged, switched, change)


def _bending(q: Float[np.ndarray, "*n dof"]) -> Float[np.ndarray, "*n dof"]:
    theta, phi = q[..., 0::2], q[..., 1::2]
    return np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1).reshape(q.shape)


def _shortest(
    q: Float[np.ndarray, "N K dof"], mask: Bool[np.ndarray, "N K"], begin: Float[np.ndarray, " dof"]
) -> tuple[Float[np.ndarray, "N dof"], Bool[np.ndarray, " N"]]:
    """One solution of each pose, the sum of the squared steps in bending least."""
    solved = np.flatnonzero(mask.any(axis=1)) if q.shape[1] else np.zeros(0, int)
    before, cost = _bending(begin)[None], np.zeros(1)
    origin: list[np.ndarray] = []
    for row in solved:
        here = _bending(q[row, mask[row]])
        total = cost[:, None] + np.sum((here - before[:, None]) ** 2, axis=-1)
        origin.append(np.argmin(total, axis=0))
        before, cost = here, np.min(total, axis=0)
    chosen = np.empty((len(q), q.shape[-1]))
    k = int(np.argmin(cost))
    for row, back in zip(solved[::-1], origin[::-1], strict=True):
        chosen[row] = q[row, mask[row]][k]
        k = int(back[k])
    converged = np.zeros(len(q), bool)
    converged[solved] = True
    last = begin
    for row in range(len(q)):
        if not converged[row]:
            chosen[row] = last
        last = chosen[row]
    return chosen, converged


def _followed(
    robot: Robot, poses: Float[np.ndarray, "N 4 4"], begin: Float[np.ndarray, " dof"]
) -> tuple[Float[np.ndarray, "N dof"], Bool[np.ndarray, " N"]]:
    q, converged = np.empty((len(poses), len(begin))), np.zeros(len(poses), bool)
    for row, pose in enumerate(poses):
        found: IkResult = solve_by_descent(robot, pose[None], begin[None], None, STARTS)
        converged[row] = bool(found.converged[0])
        if converged[row]:
            begin = np.asarray(found.q[0])
        q[row] = begin
    return q, converged
