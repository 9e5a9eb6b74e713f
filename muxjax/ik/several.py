"""Many solutions of any goal: Levenberg-Marquardt from many entries of the table.

Each start is followed with itself as the reference, so that what the goal leaves free stays where
it was and the ends are spread as the starts are. Where solutions are isolated, equal ones are
merged. Where they form a continuum, representatives are kept that differ by ``APART`` in the
bending of at least one segment, those of least bending first.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.batched import WIDE_VECTORS
from muxjax.ik.all_solutions import AT_LIMIT, Found, repeated
from muxjax.ik.arcs import Array
from muxjax.ik.checks import distance_from_root, reach
from muxjax.ik.goals import Frames, Kind, frames_of, goal_rows, kind_of, tool_goals
from muxjax.ik.levenberg import ROWS, ROWS_ELSEWHERE, levenberg, reached, scales
from muxjax.ik.newton import padded
from muxjax.ik.stacked import stacked_tip
from muxjax.ik.table import nearest_entries, table
from muxjax.precision import by_device
from muxjax.robot import Robot

NEAREST = 32  # starts, of the table's entries nearest to a pose
SPREAD = 32  # and of entries all over the limits
PHASES = (12, 12, 24)  # steps, after each of which the starts that arrived are left
APART = 0.5  # [rad] between two representatives of a continuum


def solutions_from_table(
    robot: Robot,
    poses: Float[np.ndarray, "rows 4 4"],
    weights: Float[np.ndarray, " 6"],
    tolerance: tuple[float, float],
) -> tuple[Found, Bool[np.ndarray, " rows"]]:
    """Distinct solutions found, and for which poses it is certain that there are no others.

    That is only known of positions farther away than the arm is long. Call inside an x64 context.

    Args:
        robot: The arm, NumPy float64 leaves.
        poses: Of the tool [m].
        weights: Of the goal.
        tolerance: Of a solution's position [m] and angle [rad].
    """
    far = distance_from_root(robot, poses) > reach(robot) + tolerance[0]
    far &= bool(weights[:3].all())
    goal = tool_goals(robot, poses)
    row, b, position, angle = _arrived(robot, np.flatnonzero(~far), goal, weights, tolerance)
    if np.count_nonzero(weights) < len(b):
        order = np.lexsort((np.sum(b * b, axis=0), row))
        kept = order[_apart(row[order], b[:, order])]
    else:

        def is_solution(row: np.ndarray, b: np.ndarray) -> np.ndarray:
            return reached(levenberg(robot, b, b, goal[:, row], weights, 0), tolerance)

        kept = np.flatnonzero(~repeated(row, b, is_solution))
    singular = _smallest_singular(robot, b[:, kept], weights)
    return Found(row[kept], b[:, kept].T, singular, position[kept], angle[kept]), far


def _arrived(
    robot: Robot,
    rows: Int[np.ndarray, " n"],
    goal: Float[np.ndarray, "7 rows"],
    weights: Float[np.ndarray, " 6"],
    tolerance: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Row, bending and errors of every start that came to a solution, ordered by row."""
    near = nearest_entries(robot, goal[:, rows], weights, NEAREST)
    wide = np.repeat(table(robot).b[:, None, 1 : 1 + SPREAD], len(rows), axis=1)
    start = np.concatenate([near, wide], axis=2)
    row = np.repeat(rows, start.shape[2])
    b = start.reshape(len(start), len(row))
    own = b
    found = []
    for steps in PHASES:
        at = levenberg(robot, b, own, goal[:, row], weights, steps)
        theta = np.hypot(at.b[0::2], at.b[1::2])
        inside = (theta <= robot.theta_max[:, None] + AT_LIMIT).all(axis=0)
        good = reached(at, tolerance) & inside
        found.append((row[good], at.b[:, good], at.position[good], at.angle[good]))
        row, b, own = row[~good], at.b[:, ~good], own[:, ~good]
    all_rows, ends, position, angle = (
        np.concatenate(parts, axis=-1) for parts in zip(*found, strict=True)
    )
    order = np.argsort(all_rows, kind="stable")
    return all_rows[order], ends[:, order], position[order], angle[order]


def _apart(row: Int[np.ndarray, " n"], b: Float[np.ndarray, "dof n"]) -> Int[np.ndarray, " kept"]:
    """Entries that differ from all kept before them of their row; the rows are sorted."""
    change = b.reshape(len(b) // 2, 2, b.shape[1])
    kept: list[int] = []
    first = 0  # of this row among the kept
    for k in range(len(row)):
        if k and row[k] != row[k - 1]:
            first = len(kept)
        away = np.hypot(*np.moveaxis(change[:, :, kept[first:]] - change[:, :, [k]], 1, 0))
        if (away.max(axis=0) > APART).all():
            kept.append(k)
    return np.array(kept, int)


def _smallest_singular(
    robot: Robot, b: Float[np.ndarray, "dof n"], weights: Float[np.ndarray, " 6"]
) -> Float[np.ndarray, " n"]:
    """Smallest singular value of the Jacobian's rows that count, arm length 1 and rad."""
    ones = np.where(weights > 0, 1.0, 0.0)
    counted = np.flatnonzero(weights)  # the rows of free axes are zero, or left out
    values = np.empty(b.shape[1])
    size = by_device(ROWS, ROWS_ELSEWHERE)
    for first in range(0, b.shape[1], size):
        piece = slice(first, first + size)
        part = padded(b[:, piece], size).reshape(-1, 2, size)
        found = _jacobian(robot.length, frames_of(robot), part, ones, kind=kind_of(weights))
        rows = np.moveaxis(np.asarray(found), -1, 0)[: len(values[piece]), counted]
        values[piece] = np.linalg.svd(rows, compute_uv=False)[:, -1]
    return values


@partial(jax.jit, static_argnames="kind", compiler_options=WIDE_VECTORS)
def _jacobian(
    length: Float[Array, " S"],
    frames: Frames,
    b: Float[Array, "S 2 rows"],
    weights: Float[Array, " 6"],
    kind: Kind,
) -> Array:
    rows = goal_rows(frames, stacked_tip(length, b, tuple(frames.point)), kind)
    weighted = [w * x for w, x in zip(scales(weights, length, len(rows)), rows, strict=True)]
    return jnp.stack(weighted).reshape(len(rows), -1, b.shape[-1])
