"""The true posture of an arm whose tendons have given lengths, beside constant curvature (PCC)."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from muxjax.kinematics import forward_kinematics
from muxjax.robot import Robot
from muxjax.statics.chain import ElasticChain
from muxjax.statics.follow import payload_wrench
from muxjax.statics.forward import forward_statics
from muxjax.tendons import check_displacements, configuration_from_tendons

Array = jax.Array | np.ndarray


class Posture(eqx.Module):
    """Where the arm is and where constant curvature says it is, for any leading batch axes.

    Where ``converged`` is false the true posture is not a solution.
    """

    pose: Float[np.ndarray, "*batch 4 4"]  # of the tool, by statics
    pose_pcc: Float[np.ndarray, "*batch 4 4"]  # of the tool, by constant curvature
    bending: Float[np.ndarray, "*batch S"]  # of each segment, end against end [rad]
    bending_pcc: Float[np.ndarray, "*batch S"]  # [rad]
    tension: Float[np.ndarray, "*batch SJ"]  # [N]
    converged: Bool[np.ndarray, "*batch"]
    stable: Bool[np.ndarray, "*batch"]

    @property
    def position_gap(self) -> Float[np.ndarray, "*batch"]:
        """Distance between the two tool positions [m]."""
        gap = self.pose[..., :3, 3] - self.pose_pcc[..., :3, 3]
        return np.asarray(np.linalg.norm(gap, axis=-1))

    @property
    def angle_gap(self) -> Float[np.ndarray, "*batch"]:
        """Angle between the two tool orientations [rad]."""
        turn = np.swapaxes(self.pose[..., :3, :3], -1, -2) @ self.pose_pcc[..., :3, :3]
        vee = np.stack(
            [turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1
        )
        cosine = 0.5 * (np.trace(turn, axis1=-2, axis2=-1) - 1)
        return np.asarray(np.arctan2(0.5 * np.linalg.norm(vee, axis=-1), cosine))


def true_posture(
    robot: Robot,
    chain: ElasticChain,
    displacements: Float[Array, "*batch SJ"],
    *,
    payload: float = 0.0,
) -> Posture:
    """Posture under weight for length commands, beside the constant-curvature one.

    Args:
        robot: The arm.
        chain: Its elastic model, from ``elastic_chain(robot, ...)``.
        displacements: Length commands [m], negative = wound in.
        payload: Mass at the tool frame's origin [kg].

    Raises:
        ValueError: Displacements of wrong shape, not finite or beyond a tendon's range, a chain of
            another arm, a payload below 0; names the field and the limit.
    """
    values = check_displacements(robot, "displacements", displacements)
    check_chain_of(robot, chain)
    found = forward_statics(chain, displacements=values, tip_wrench=payload_wrench(chain, payload))
    q = np.asarray(configuration_from_tendons(robot, values))
    return Posture(
        pose=np.asarray(found.pose),
        pose_pcc=np.asarray(forward_kinematics(robot, q)),
        bending=segment_bending(np.asarray(chain.base), np.asarray(found.segment_ends)),
        bending_pcc=q[..., 0::2],
        tension=np.asarray(found.tension),
        converged=np.asarray(found.converged),
        stable=np.asarray(found.stable),
    )


def segment_bending(
    base: Float[np.ndarray, "4 4"], segment_ends: Float[np.ndarray, "*batch S 4 4"]
) -> Float[np.ndarray, "*batch S"]:
    """Angle between the axes of each segment's two ends [rad]; frames in the world."""
    axes = np.concatenate(
        [
            np.broadcast_to(base[:3, 2], (*segment_ends.shape[:-3], 1, 3)),
            segment_ends[..., :3, 2],
        ],
        axis=-2,
    )
    below, above = axes[..., :-1, :], axes[..., 1:, :]
    sine = np.linalg.norm(np.cross(below, above), axis=-1)
    angle: np.ndarray = np.arctan2(sine, np.sum(below * above, axis=-1))
    return angle


def check_chain_of(robot: Robot, chain: ElasticChain) -> None:
    """Raise ValueError unless the chain has the tendons and segments of the robot."""
    found = (chain.n_tendons, len(chain.segment_bodies), chain.name)
    wanted = (robot.n_tendons, robot.n_segments, robot.config.name)
    if found != wanted:
        raise ValueError(
            f"chain: has {found[0]} tendons in {found[1]} segments and the name {found[2]!r}; "
            f"robot {wanted[2]!r} has {wanted[0]} in {wanted[1]}: use elastic_chain(robot)"
        )
