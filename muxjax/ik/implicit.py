"""Derivatives of a solved configuration by the implicit function theorem.

Where the pose of the tool f(robot, b) equals the wanted one, a change of the pose or of the robot
moves the bending by J db = dx - (df / d robot) d robot, with J the Jacobian of f. For more
freedoms than six the least db is taken, for fewer the least-squares one.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.kinematics import (
    bending_from_configuration,
    bending_jacobian,
    configuration_from_bending,
    pose_from_bending,
)
from muxjax.robot import Robot

Array = jax.Array | np.ndarray


@jax.custom_jvp
def attach_derivatives(
    robot: Robot, pose: Float[Array, "*batch 4 4"], q: Float[Array, "*batch dof"]
) -> Float[Array, "*batch dof"]:
    """Q itself, with the derivatives that a solution of the pose has.

    Traceable and differentiable once, forwards or backwards, with respect to the pose and to every
    value of the robot; q is taken as found, not as a variable. A change of the pose counts by the
    rigid motion in it. phi has no derivative where theta = 0, and nothing has one where the
    Jacobian is singular: NaN or huge values tell.

    Args:
        robot: The arm.
        pose: Wanted tool poses.
        q: Solutions of them [rad].
    """
    del robot, pose
    return jnp.asarray(q)


@attach_derivatives.defjvp
def _jvp(primals, tangents):  # type: ignore[no-untyped-def]
    robot, pose, q = primals
    d_robot, d_pose, _ = tangents
    b = bending_from_configuration(jnp.asarray(q))
    _, d_own = jax.jvp(lambda r: pose_from_bending(r, b), (robot,), (d_robot,))
    wanted = _twist(pose, d_pose) - _twist(pose, d_own)
    jac = bending_jacobian(robot, b, "mixed")
    if jac.shape[-1] == 6:
        db = jnp.linalg.solve(jac, wanted[..., None])
    else:
        db = jnp.linalg.pinv(jac) @ wanted[..., None]
    _, dq = jax.jvp(configuration_from_bending, (b,), (db.reshape(b.shape),))
    return jnp.asarray(q), dq


def _twist(
    pose: Float[Array, "*batch 4 4"], change: Float[Array, "*batch 4 4"]
) -> Float[Array, "*batch 6"]:
    """Velocity in the world and angular velocity in the tool frame of a pose's change."""
    spin = jnp.swapaxes(pose[..., :3, :3], -1, -2) @ change[..., :3, :3]
    spin = 0.5 * (spin - jnp.swapaxes(spin, -1, -2))
    angular = jnp.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], axis=-1)
    return jnp.concatenate([change[..., :3, 3], angular], axis=-1)
