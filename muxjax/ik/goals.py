"""What of a pose is wanted: all of it, or a part.

A goal's ``weights`` are six numbers >= 0: along the world's x, y, z and about the tool's own x, y,
z. (1, 1, 1, 0, 0, 0) is a position alone and (1, 1, 1, 1, 1, 0) a position and a pointing
direction, the tool's z axis: what turns about it does not count. The metric of an error is
sum (w e)^2, positions over the arm's length and rotations in radians.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.batched.formulas import product
from muxjax.ik.arcs import Array, Numbers, conjugate, dot, turn_by
from muxjax.ik.frames import inverse, quaternion, without_rounding
from muxjax.ik.stacked import Placed, Stacked
from muxjax.precision import host_array
from muxjax.robot import Robot

Kind = Literal["whole", "position", "pointing", "axes"]


class Frames(NamedTuple):
    """The robot's frames as the solver uses them."""

    base: Float[Array, " 4"]  # quaternion of the base frame
    tool: Float[Array, " 4"]  # of the tool in the last disc's frame
    point: Float[Array, " 3"]  # tool point in the last disc's frame [m]


def check_weights(weights: object) -> Float[np.ndarray, " 6"]:
    """Host check of a goal's weights; all ones if None.

    Raises:
        ValueError: Not six finite numbers >= 0 with one above 0.
    """
    checked = np.ones(6) if weights is None else host_array("weights", weights, last=6)
    if checked.ndim != 1:
        raise ValueError(f"weights: must be 6 numbers for all poses, found shape {checked.shape}")
    if (checked < 0).any() or not checked.any():
        raise ValueError(f"weights: must be >= 0 and not all 0, found {checked.tolist()}")
    return checked


def is_pointing(weights: Float[np.ndarray, " 6"]) -> bool:
    """Turning about the tool's z axis is free, about x and y it is not."""
    return bool(weights[5] == 0 and weights[3] > 0 and weights[4] > 0)


def kind_of(weights: Float[np.ndarray, " 6"]) -> Kind:
    """How the goal's errors are written down: the fewer rows and turns, the cheaper."""
    if is_pointing(weights):
        return "pointing"
    if (weights[:3] == weights[0]).all() and (weights[3:] == weights[3]).all() and weights[0] > 0:
        return "whole" if weights[3] > 0 else "position"
    return "axes"


def frames_of(robot: Robot) -> Frames:
    """Quaternions and tool point of a robot."""
    base, tool = np.asarray(robot.base, np.float64), np.asarray(robot.tool, np.float64)
    return Frames(
        quaternion(base[None, :3, :3])[:, 0],
        quaternion(tool[None, :3, :3])[:, 0],
        tool[:3, 3],
    )


def tool_goals(robot: Robot, pose: Float[np.ndarray, "rows 4 4"]) -> Float[np.ndarray, "7 rows"]:
    """Position [m] and quaternion of the tool from the root."""
    inner = inverse(np.asarray(robot.base)) @ without_rounding(pose)
    return np.concatenate([inner[:, :3, 3].T, quaternion(inner[:, :3, :3])])


def goal_errors(
    frames: Frames, tip: Placed | Stacked, position: Numbers, turn: Numbers, kind: Kind
) -> Numbers:
    """Offset [m] and turn that are left: 3 + 3 rows, 3 for ``position``, 3 + 2 for ``pointing``.

    The turn is its axis times twice the sine of half its angle. Axes that count alike need no
    frame of their own: ``whole`` and ``position`` are in the root's frame. Otherwise the offset is
    in the world and the turn in the tool's frame; for ``pointing`` it is the shortest turn that
    takes the tool's z axis to the wanted one.
    """
    offset = tuple(a - b for a, b in zip(position, tip.position, strict=True))
    if kind == "position":
        return offset
    facing = product(tip.quaternion, tuple(frames.tool))
    if kind == "whole":
        return offset + _doubled(product(turn, conjugate(facing)))
    offset, left = turn_by(tuple(frames.base), offset), product(conjugate(facing), turn)
    if kind == "axes":
        return offset + _doubled(left)
    zero = jnp.zeros_like(left[0])
    x, y, z = turn_by(left, (zero, zero, zero + 1))
    stretch = jnp.sqrt(2 / jnp.maximum(1 + z, 1e-12))
    return (*offset, -stretch * y, stretch * x)


def goal_rows(frames: Frames, tip: Stacked, kind: Kind) -> Numbers:
    """Rows of the tip's Jacobian that belong to ``goal_errors``, arrays (S, 2, rows)."""
    if kind == "position":
        return tip.linear
    if kind == "whole":
        return tip.linear + tip.angular
    own = conjugate(product(tip.quaternion, tuple(frames.tool)))
    count = 2 if kind == "pointing" else 3
    return turn_by(tuple(frames.base), tip.linear) + turn_by(own, tip.angular)[:count]


def _doubled(left: Numbers) -> Numbers:
    """Axis times twice the sine of half the angle, of the shorter of both turns."""
    double = jnp.where(left[0] < 0, -2.0, 2.0)
    return tuple(double * c for c in left[1:])


def sizes(errors: Numbers, wanted: Float[Array, " 6"]) -> tuple[Array, Array]:
    """Position error [m] and angle [rad] over the axes with ``wanted`` = 1 (others 0)."""
    counted = [wanted[k] * x for k, x in enumerate(errors)]
    half = jnp.zeros_like(errors[0])
    if len(counted) > 3:
        half = 0.5 * jnp.sqrt(dot(tuple(counted[3:]), tuple(counted[3:])))
    position = jnp.sqrt(dot(tuple(counted[:3]), tuple(counted[:3])))
    return position, 2 * jnp.arcsin(jnp.minimum(half, 1.0))
