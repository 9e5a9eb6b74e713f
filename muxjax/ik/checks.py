"""Host checks of poses and reference configurations."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.kinematics import check_configuration
from muxjax.precision import host_array
from muxjax.robot import Robot

Array = jax.Array | np.ndarray

ROTATION_TOLERANCE = 1e-5  # largest entry of R'R - 1 taken for rounding and orthonormalised
UNIT_SUSPICION = 10.0  # a pose farther away than this many arm lengths is taken for millimetres


def check_pose(
    robot: Robot, pose: object, project: bool = False
) -> Float[np.ndarray, "*batch 4 4"]:
    """Host check of tool poses that the robot is asked to reach.

    Args:
        robot: The arm.
        pose: Homogeneous transforms [m].
        project: Take the nearest rotation in place of a 3 x 3 part that is none, as for
            measured or averaged poses. Reflections are refused all the same.

    Returns:
        The poses as a float64 NumPy array.

    Raises:
        ValueError: Wrong shape, not finite, not a rigid transform, or so far away that its unit
            must be wrong; names the row of the batch.
    """
    checked = host_array("pose", pose, last=4)
    if checked.shape[-2:-1] != (4,):
        raise ValueError(f"pose: must have shape (..., 4, 4), found {checked.shape}")
    rotation = checked[..., :3, :3]
    determinant = np.linalg.det(rotation)
    if project:
        u, _, vt = np.linalg.svd(rotation)
        rotation = checked[..., :3, :3] = u @ vt
    skew = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-1, -2))
    last_row = np.abs(checked[..., 3, :] - [0, 0, 0, 1]).max(axis=-1)
    distance = distance_from_root(robot, checked)
    limit = UNIT_SUSPICION * reach(robot)
    for wrong, message, found in (
        (last_row > 0, "last row must be (0, 0, 0, 1); it is off by", last_row),
        (
            skew > ROTATION_TOLERANCE,
            f"not a rotation: the largest entry of R'R - 1 must be below {ROTATION_TOLERANCE:g}, "
            "found",
            skew,
        ),
        (
            determinant <= 0,
            "not a rotation but a reflection: the determinant must be 1, found",
            determinant,
        ),
        (
            distance > limit,
            f"position must be within {limit:.4g} m of the arm's root ({UNIT_SUSPICION:g} times "
            "its length; positions are in metres: are these millimetres?), found",
            distance,
        ),
    ):
        rows = np.argwhere(wrong)
        if len(rows):
            row = tuple(int(i) for i in rows[0])
            raise ValueError(f"pose{list(row) if row else ''}: {message} {found[row]:.4g}")
    return checked


def check_reference(
    robot: Robot, q0: object, batch: tuple[int, ...]
) -> Float[np.ndarray, "*batch dof"]:
    """q0, or the straight arm, for every pose of the batch."""
    if q0 is None:
        return np.zeros((*batch, 2 * robot.n_segments))
    try:
        reference = check_configuration(robot, q0)
    except ValueError as error:
        raise ValueError("q0" + str(error).removeprefix("q")) from None
    try:
        return np.broadcast_to(reference, (*batch, reference.shape[-1]))
    except ValueError:
        raise ValueError(
            f"q0: batch axes {reference.shape[:-1]} must broadcast to those of pose, {batch}"
        ) from None


def orthonormalised(pose: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 4 4"]:
    """Two Newton steps towards the nearest rotation: an error of 1e-5 becomes 1e-20."""
    rotation = jnp.asarray(pose)[..., :3, :3]
    for _ in range(2):
        gram = jnp.swapaxes(rotation, -1, -2) @ rotation
        rotation = rotation @ (1.5 * jnp.eye(3) - 0.5 * gram)
    return jnp.asarray(pose).at[..., :3, :3].set(rotation)


def reach(robot: Robot) -> Any:
    """Length of the straight arm and of its tool [m]: no position is farther from the root."""
    return robot.length.sum() + (robot.tool[:3, 3] ** 2).sum() ** 0.5


def distance_from_root(robot: Robot, pose: Float[Array, "*batch 4 4"]) -> Any:
    """Of the tool from the arm's root [m]."""
    return ((pose[..., :3, 3] - robot.base[:3, 3]) ** 2).sum(axis=-1) ** 0.5
