"""What the arm does over time while tendons move (M Eq. 14-15).

A leg is a straight line in tendon space: the servos of one instruction start and end together.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from muxjax.precision import pad_rows
from muxjax.robot import Robot
from muxjax.tendons import bending_from_displacements

Array = jax.Array | np.ndarray

# An angle below this counts as straight: relative to it, overshoot would mean nothing.
STRAIGHT = 0.02  # [rad]
# |theta| > |theta_inf| is judged with this margin, or rounding would count the time after arrival.
ANGLE_TOLERANCE = 1e-6  # [rad]
LEG_POINTS = 8
_PROFILE_INTERVALS = 128


def bending_angles(robot: Robot, displacements: Float[Array, "*n SJ"]) -> Float[Array, "*n S"]:
    """Bending angles [rad] for displacements [m], also off the image of M Eq. 6."""
    b = bending_from_displacements(robot, displacements)
    u = jnp.sum(b * b, axis=-1)
    straight = u == 0.0  # the root's slope is infinite there; the angle's slope is taken as zero
    return jnp.where(straight, 0.0, jnp.sqrt(jnp.where(straight, 1.0, u)))


def angles_at(robot: Robot, displacements: Float[np.ndarray, "P SJ"]) -> Float[np.ndarray, "P S"]:
    """``bending_angles`` on the host, in float64."""
    with jax.enable_x64(True):
        return np.asarray(_angles(robot, pad_rows(displacements)))[: len(displacements)]


@jax.jit
def _angles(robot: Robot, displacements: Float[Array, "P SJ"]) -> Float[Array, "P S"]:
    return bending_angles(robot, displacements)


def leg_time(robot: Robot, move: Float[Array, "*n SJ"]) -> Float[Array, "*n"]:
    """Duration [s] of a leg, max_s |dbeta_s| / omega of M Eq. 14, for tendon moves [m]."""
    return jnp.max(jnp.abs(move), axis=-1) / robot.tendon_speed


def relative_excess(
    angles: Float[Array, "*n S"], goal: Float[Array, "*#n S"]
) -> Float[Array, "*n"]:
    """Sum over segments of (theta - theta_goal)_+ / theta_goal, the integrand of overshoot."""
    return jnp.sum(jnp.maximum(angles - goal, 0.0) / jnp.maximum(goal, STRAIGHT), axis=-1)


def leg_points(
    before: Float[Array, "*n SJ"], after: Float[Array, "*n SJ"]
) -> Float[Array, "*n points SJ"]:
    """Displacements [m] at the midpoints of 8 equal parts of a leg, for integrals over it."""
    fraction = (jnp.arange(LEG_POINTS) + 0.5) / LEG_POINTS
    return before[..., None, :] + fraction[:, None] * (after - before)[..., None, :]


def angles_along(
    robot: Robot, before: Float[Array, "*n SJ"], after: Float[Array, "*n SJ"]
) -> Float[Array, "*n points S"]:
    """Bending angles [rad] at ``leg_points``."""
    return bending_angles(robot, leg_points(before, after))


def overshoot_profile(
    robot: Robot,
    before: Float[Array, "P SJ"],
    after: Float[Array, "P SJ"],
    duration: Float[Array, " P"],
    goal: Float[Array, " S"],
) -> tuple[Float[Array, " S"], Float[Array, " S"]]:
    """Seconds above the final bending, and greatest excess [rad], of each segment (M Eq. 15).

    Every leg is sampled at 129 points; between two of them the angle is taken as linear, so that
    a crossing is found within the interval. Legs of equal ends and positive duration are holds.
    """
    fraction = jnp.linspace(0.0, 1.0, _PROFILE_INTERVALS + 1)
    points = before[:, None, :] + fraction[:, None] * (after - before)[:, None, :]
    excess = bending_angles(robot, points) - goal  # (P, points, S)
    return _time_above(excess - ANGLE_TOLERANCE, duration), jnp.max(excess, axis=(0, 1))


def _time_above(
    excess: Float[Array, "P points S"], duration: Float[Array, " P"]
) -> Float[Array, " S"]:
    """Measure of {excess > 0} on piecewise linear curves."""
    left, right = excess[:, :-1], excess[:, 1:]
    above: Bool[Array, "P intervals S"] = (left > 0) & (right > 0)
    crossing = (left > 0) != (right > 0)
    top = jnp.maximum(left, right)
    share = top / jnp.where(crossing, jnp.abs(left - right), 1.0)
    return jnp.einsum(
        "p,pks->s",
        duration / left.shape[1],
        jnp.where(above, 1.0, jnp.where(crossing, share, 0.0)),
        precision="highest",
    )
