"""What of a pose is wanted: all of it, or a part.

A goal's ``weights`` are six numbers >= 0: along the world's x, y, z and about the tool's own x, y,
z. (1, 1, 1, 0, 0, 0) is a position alone and (1, 1, 1, 1, 1, 0) a position and a pointing
direction, the tool's z axis: what turns about it does not count. The metric of an error is
sum (w e)^2, positions over the arm's length and rotations in radians.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.batched.formulas import product
from muxjax.ik.arcs import Array, Numbers, Tip, conjugate, dot, turn_by
from muxjax.ik.frames import inverse, quaternion, without_rounding
from muxjax.precision import host_array
from muxjax.robot import Robot


class Frames(NamedTuple):
    """The robot's frames as the solver uses them."""

    base: Numbers  # quaternion of the base frame
    tool: Numbers  # quaternion of the tool in the last disc's frame
    point: Numbers  # tool point in the last disc's frame [m]


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


def frames_of(robot: Robot) -> Frames:
    """Quaternions and tool point of a robot."""
    base, tool = np.asarray(robot.base, np.float64), np.asarray(robot.tool, np.float64)
    return Frames(
        tuple(quaternion(base[None, :3, :3])[:, 0]),
        tuple(quaternion(tool[None, :3, :3])[:, 0]),
        tuple(tool[:3, 3]),
    )


def tool_goals(robot: Robot, pose: Float[np.ndarray, "rows 4 4"]) -> Float[np.ndarray, "7 rows"]:
    """Position [m] and quaternion of the tool from the root."""
    inner = inverse(np.asarray(robot.base)) @ without_rounding(pose)
    return np.concatenate([inner[:, :3, 3].T, quaternion(inner[:, :3, :3])])


def goal_errors(
    frames: Frames, tip: Tip, position: Numbers, turn: Numbers, pointing: bool
) -> tuple[Numbers, Numbers, Numbers]:
    """Offset [m] in the world, rotation left in the tool's frame, and their Jacobian.

    The Jacobian comes as six rows, each an array of shape (2S, ...).
    The rotation is its axis times twice the sine of half its angle. For ``pointing`` it is that
    of the shortest turn that takes the tool's z axis to the wanted one.
    """
    offset = turn_by(frames.base, tuple(a - b for a, b in zip(position, tip.position, strict=True)))
    own = conjugate(product(tip.quaternion, frames.tool))
    left = product(own, turn)
    zero = jnp.zeros_like(left[0])
    if pointing:
        x, y, z = turn_by(left, (zero, zero, zero + 1))
        stretch = jnp.sqrt(2 / jnp.maximum(1 + z, 1e-12))
        rotation: Numbers = (-stretch * y, stretch * x, zero)
    else:
        double = jnp.where(left[0] < 0, -2.0, 2.0)
        rotation = tuple(double * c for c in left[1:])
    linear, angular = (
        tuple(jnp.stack([column[k] for column in columns]) for k in range(3))
        for columns in (tip.linear, tip.angular)
    )
    return offset, rotation, turn_by(frames.base, linear) + turn_by(own, angular)


def sizes(offset: Numbers, rotation: Numbers, wanted: Float[Array, " 6"]) -> tuple[Array, Array]:
    """Position error [m] and angle [rad] over the axes with ``wanted`` = 1 (others 0)."""
    moved = tuple(wanted[k] * x for k, x in enumerate(offset))
    turned = tuple(wanted[3 + k] * x for k, x in enumerate(rotation))
    half = jnp.minimum(0.5 * jnp.sqrt(dot(turned, turned)), 1.0)
    return jnp.sqrt(dot(moved, moved)), 2 * jnp.arcsin(half)
