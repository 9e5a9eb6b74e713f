"""Poses of the tool as positions and quaternions of the last disc, seen from the arm's root."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from muxjax.robot import Robot


def disc_goals(robot: Robot, pose: Float[np.ndarray, "rows 4 4"]) -> Float[np.ndarray, "7 rows"]:
    """Position [m] and unit quaternion (w, x, y, z) of the last disc from the root, as columns.

    base^-1 pose tool^-1, after rounding is taken off the rotation.
    """
    inner = (
        inverse(np.asarray(robot.base)) @ without_rounding(pose) @ inverse(np.asarray(robot.tool))
    )
    return np.concatenate([inner[:, :3, 3].T, quaternion(inner[:, :3, :3])])


def without_rounding(pose: Float[np.ndarray, "rows 4 4"]) -> Float[np.ndarray, "rows 4 4"]:
    """``checks.orthonormalised`` on the host, where it costs less than a JAX call."""
    rotation = pose[:, :3, :3]
    for _ in range(2):
        rotation = rotation @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(rotation, -1, -2) @ rotation)
    result = pose.copy()
    result[:, :3, :3] = rotation
    return result


def inverse(frame: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Inverse of a rigid transform."""
    result = np.eye(4)
    result[:3, :3] = frame[:3, :3].T
    result[:3, 3] = -frame[:3, :3].T @ frame[:3, 3]
    return result


def quaternion(rotation: Float[np.ndarray, "rows 3 3"]) -> Float[np.ndarray, "4 rows"]:
    """Unit quaternions (w, x, y, z), by Shepperd's rule: the largest component divides."""
    r = rotation
    trace = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    outer = np.empty((4, 4, len(r)))  # 4 q q'
    outer[0, 0] = 1 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[i + 1, i + 1] = 1 - trace + 2 * r[:, i, i]
        outer[0, i + 1] = outer[i + 1, 0] = r[:, k, j] - r[:, j, k]
        outer[i + 1, j + 1] = outer[j + 1, i + 1] = r[:, i, j] + r[:, j, i]
    largest = np.argmax(np.einsum("iin->in", outer), axis=0)
    q = outer[largest, :, np.arange(len(r))].T
    return q / np.sqrt(np.sum(q * q, axis=0))
