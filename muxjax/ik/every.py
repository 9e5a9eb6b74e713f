"""The face for all solutions."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float, Int

from muxjax.ik.all_solutions import Found, solutions_of_three
from muxjax.ik.checks import check_pose
from muxjax.ik.descent import ORIENTATION_TOLERANCE, POSITION_TOLERANCE
from muxjax.ik.frames import disc_goals
from muxjax.ik.goals import check_weights
from muxjax.ik.levenberg import MOST_SEGMENTS
from muxjax.ik.result import AllIkResult
from muxjax.ik.several import solutions_from_table
from muxjax.precision import by_device
from muxjax.robot import Robot

Array = jax.Array | np.ndarray

CHUNK = 1024  # poses at a time
CHUNK_ELSEWHERE = 1 << 13  # on a GPU


def all_ik(
    robot: Robot,
    pose: Float[Array, "*batch 4 4"],
    *,
    weights: Float[Array, " 6"] | Sequence[float] | None = None,
    project_rotations: bool = False,
) -> AllIkResult:
    """Configurations within the bending limits that reach each tool pose, in float64.

    For whole poses of three segments that bend by no more than 180 degrees these are all there
    are: the search is exhaustive (MODEL.md section 8). Other arms and goals get the distinct
    solutions that a search from many starts finds (``several``): each once where they are
    isolated, representatives at least ``several.APART`` apart where the goal leaves freedom. One
    or two segments reach few whole poses: none found is then the usual answer.

    ``complete`` tells whether there can be others. It is false for searches from starts, unless
    the position is out of reach, and for three segments where infinitely many solutions exist,
    as for a point straight above the root.

    Args:
        robot: The arm; its base and tool frames are included.
        pose: Homogeneous transforms [m], any leading batch axes; checked as by ``solve_ik``.
        weights: What of the pose counts, as for ``solve_ik``; all of it by default.
        project_rotations: Take the nearest rotation in place of a 3 x 3 part that is none.

    Returns:
        NumPy float64 arrays. Each solution meets the goal within 1e-10 m and 1e-10 rad; they are
        ordered by bending, least first.

    Raises:
        ValueError: A pose that cannot be meant (the message names the row), bad weights, more
            than ``MOST_SEGMENTS`` segments, or a call inside a JAX trace: the number of solutions
            is known only on the host.
    """
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((robot, pose))):
        raise ValueError("all_ik: the number of solutions is data, so it cannot be traced")
    wanted = check_weights(weights)
    whole = bool((wanted > 0).all())
    if robot.n_segments > MOST_SEGMENTS:
        raise ValueError(
            f"all_ik: is for at most {MOST_SEGMENTS} segments, the robot has {robot.n_segments}"
        )
    poses = check_pose(robot, pose, project_rotations)
    batch, flat = poses.shape[:-2], poses.reshape(-1, 4, 4)
    host = jax.tree.map(lambda x: np.asarray(x, np.float64), robot)
    tolerance = (POSITION_TOLERANCE, ORIENTATION_TOLERANCE)
    parts, complete = [], np.ones(len(flat), bool)
    with jax.enable_x64(True):
        size = by_device(CHUNK, CHUNK_ELSEWHERE)
        for start in range(0, len(flat), size):
            chunk = flat[start : start + size]
            if whole and is_exhaustive(robot):
                goal = disc_goals(host, chunk)
                found, certain = solutions_of_three(host.length, host.theta_max, goal, tolerance)
            else:
                found, certain = solutions_from_table(host, chunk, wanted, tolerance)
            parts.append(found._replace(row=found.row + start))
            complete[start : start + size] = certain
    result = _packed(host, len(flat), parts, complete)
    return jax.tree.map(lambda x: x.reshape((*batch, *x.shape[1:])), result)


def is_exhaustive(robot: Robot) -> bool:
    """Three segments within 180 degrees, for which all solutions can be found."""
    return robot.n_segments == 3 and bool(np.all(robot.theta_max <= np.pi + 1e-12))


def polar(robot: Robot, b: Float[np.ndarray, "n dof"]) -> Float[np.ndarray, "n dof"]:
    """Configurations of Cartesian bending, theta within the limits and phi in [0, 2 pi)."""
    theta = np.hypot(b[:, 0::2], b[:, 1::2])
    phi = np.arctan2(b[:, 1::2], b[:, 0::2]) % (2 * np.pi)
    phi[(phi >= 2 * np.pi) | (theta == 0)] = 0.0  # -1e-17 % 2 pi rounds to 2 pi itself
    theta = np.minimum(theta, robot.theta_max)
    return np.stack([theta, phi], axis=-1).reshape(b.shape)


def _packed(robot: Robot, rows: int, parts: list[Found], complete: np.ndarray) -> AllIkResult:
    """The list of solutions as one padded array."""
    dof = 2 * robot.n_segments
    none = Found(np.zeros(0, int), np.zeros((0, dof)), *(np.zeros(0) for _ in range(3)))
    found = Found(*(np.concatenate(x) for x in zip(none, *parts, strict=True)))
    order = np.lexsort((np.sum(found.b**2, axis=1), found.row))
    row = found.row[order]
    slot = _rank_in_row(row)
    most = int(slot.max(initial=-1)) + 1

    def spread(values: np.ndarray) -> np.ndarray:
        wide = np.full((rows, most, *values.shape[1:]), np.nan)
        wide[row, slot] = values[order]
        return wide

    mask = np.zeros((rows, most), bool)
    mask[row, slot] = True
    return AllIkResult(
        q=spread(polar(robot, found.b)),
        mask=mask,
        singular_value=spread(found.singular),
        position_error=spread(found.position),
        orientation_error=spread(found.angle),
        complete=complete,
    )


def _rank_in_row(row: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Place of each entry among those of its row; the rows are sorted."""
    first = np.concatenate([[True], row[1:] != row[:-1]])[: len(row)]
    start = np.flatnonzero(first)
    return np.arange(len(row)) - np.repeat(start, np.diff([*start, len(row)]))
