"""Configuration to pose: constant-curvature segments in series (M Eq. 1-2, MODEL.md section 2).

Everything here works on the Cartesian bending b_i = theta_i (cos phi_i, sin phi_i), which has no
singularity at theta = 0; the polar q = (theta_1, phi_1, ...) is what people read and write.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.precision import check_last_axis, host_array, matmul, numpy_in_numpy_out
from muxjax.robot import Robot

Array = jax.Array | np.ndarray
Frame = Literal["base", "body", "mixed"]

_SERIES_BELOW = 4.0
_SERIES_TERMS = 14  # the first one left out is below 4^14 / 28! = 1e-21


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def stumpff(u: Float[Array, "*n"], k: int) -> Float[Array, "*n"]:
    """c_k(u) = sum_n (-u)^n / (2n + k)!, for u = theta^2 >= 0.

    c_0 = cos theta, c_1 = sinc theta, c_2 = (1 - cos theta) / theta^2,
    c_3 = (theta - sin theta) / theta^3: every function of M Eq. 1 and of its derivatives,
    analytic at theta = 0 where the printed quotients are 0/0.

    Its derivative is again a sum of them, c_k' = (k c_{k+2} - c_{k+1}) / 2, and is defined so
    below: derivatives of any order never differentiate the choice between series and recursion.
    """
    u = jnp.asarray(u)
    # For small u the recursion cancels; for large u the series does.
    near = u < _SERIES_BELOW
    small = jnp.where(near, u, 0.0)
    series = jnp.zeros_like(u)
    for n in reversed(range(_SERIES_TERMS)):
        series = 1.0 / math.factorial(2 * n + k) - small * series
    large = jnp.where(near, _SERIES_BELOW, u)
    theta = jnp.sqrt(large)
    closed = jnp.cos(theta) if k % 2 == 0 else jnp.sin(theta) / theta
    for lower in range(k % 2, k, 2):
        closed = (1.0 / math.factorial(lower) - closed) / large
    return jnp.where(near, series, closed)


@stumpff.defjvp
def _stumpff_jvp(k, primals, tangents):  # type: ignore[no-untyped-def]
    (u,), (du,) = primals, tangents
    return stumpff(u, k), 0.5 * (k * stumpff(u, k + 2) - stumpff(u, k + 1)) * du


def bending_from_configuration(q: Float[Array, "*batch dof"]) -> Float[Array, "*batch S 2"]:
    """b_i = theta_i (cos phi_i, sin phi_i) of the polar q, both in rad."""
    theta, phi = q[..., 0::2], q[..., 1::2]
    return jnp.stack([theta * jnp.cos(phi), theta * jnp.sin(phi)], axis=-1)


def configuration_from_bending(b: Float[Array, "*batch S 2"]) -> Float[Array, "*batch dof"]:
    """Polar q with theta >= 0 and phi in [0, 2 pi); phi = 0 where theta = 0.

    Not differentiable at theta = 0, as polar coordinates are not.
    """
    theta = jnp.hypot(b[..., 0], b[..., 1])
    phi = jnp.arctan2(b[..., 1], b[..., 0]) % (2 * jnp.pi)
    # -1e-17 % 2 pi rounds to 2 pi itself, and atan2(-0, -0) is not 0.
    phi = jnp.where((theta == 0) | (phi >= 2 * jnp.pi), 0.0, phi)
    q = jnp.stack([theta, phi], axis=-1)
    return q.reshape(*q.shape[:-2], -1)


def segment_transform(
    b: Float[Array, "*batch 2"], length: Float[Array, "*#batch"]
) -> Float[Array, "*batch 4 4"]:
    """Distal disc in the proximal disc's frame (M Eq. 1), from the bending [rad] and length [m].

    With w = (-b_y, b_x, 0), R = exp([w]) = 1 + c_1 [w] + c_2 [w]^2 and p = L (c_2 b, c_1).
    """
    bx, by = b[..., 0], b[..., 1]
    u = bx * bx + by * by
    c1, c2 = stumpff(u, 1), stumpff(u, 2)
    one, zero = jnp.ones_like(u), jnp.zeros_like(u)
    rows: list[list[Array]] = [
        [1 - c2 * bx * bx, -c2 * bx * by, c1 * bx, length * c2 * bx],
        [-c2 * bx * by, 1 - c2 * by * by, c1 * by, length * c2 * by],
        [-c1 * bx, -c1 * by, 1 - c2 * u, length * c1],
        [zero, zero, zero, one],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def pose_from_bending(robot: Robot, b: Float[Array, "*batch S 2"]) -> Float[Array, "*batch 4 4"]:
    """Tool pose in the world (M Eq. 2, between the base and the tool frame)."""
    return matmul(segment_ends(robot, b)[..., -1, :, :], robot.tool)


def segment_ends(robot: Robot, b: Float[Array, "*batch S 2"]) -> Float[Array, "*batch S 4 4"]:
    """Poses in the world of the distal discs T_1 ... T_S."""
    steps = segment_transform(b, jnp.asarray(robot.length))
    pose = matmul(robot.base, steps[..., 0, :, :])
    ends = [pose]
    for i in range(1, robot.n_segments):
        pose = matmul(pose, steps[..., i, :, :])
        ends.append(pose)
    return jnp.stack(ends, axis=-3)


@numpy_in_numpy_out()
def forward_kinematics(robot: Robot, q: Float[Array, "*batch dof"]) -> Float[Array, "*batch 4 4"]:
    """Tool pose in the world for a configuration (M Eq. 1-2).

    Args:
        robot: The arm; its base and tool frames are included.
        q: (theta_1, phi_1, ..., theta_S, phi_S) [rad], any leading batch axes.

    Returns:
        Homogeneous transforms; positions in metres.

    Raises:
        ValueError: Last axis is not 2S, or (on host data) an entry is not finite.
    """
    check_last_axis("q", q.shape, 2 * robot.n_segments)
    return pose_from_bending(robot, bending_from_configuration(q))


@numpy_in_numpy_out(static=("n",))
def backbone(
    robot: Robot, q: Float[Array, "*batch dof"], n: int
) -> Float[Array, "*batch frames 4 4"]:
    """Frames along the backbone, n a segment at equal arc length, base first, tip last.

    The last one is the distal disc of the last segment, before the tool frame.

    Args:
        robot: The arm.
        q: Configuration [rad].
        n: Intervals a segment, at least 1.

    Raises:
        ValueError: n below 1, last axis not 2S, or (on host data) an entry that is not finite.
    """
    check_last_axis("q", q.shape, 2 * robot.n_segments)
    if not isinstance(n, int) or n < 1:
        raise ValueError(f"n: must be a whole number of intervals, at least 1, found {n!r}")
    b = bending_from_configuration(q)
    fraction = jnp.arange(1, n + 1, dtype=b.dtype) / n
    # A part of a constant-curvature arc is one too: bending and length shrink together.
    partial_arcs = segment_transform(
        b[..., None, :] * fraction[:, None], jnp.asarray(robot.length)[:, None] * fraction
    )
    pose = jnp.broadcast_to(jnp.asarray(robot.base, b.dtype), (*b.shape[:-2], 1, 4, 4))
    frames = [pose]
    for i in range(robot.n_segments):
        frames.append(matmul(pose, partial_arcs[..., i, :, :, :]))
        pose = frames[-1][..., -1:, :, :]
    return jnp.concatenate(frames, axis=-3)


@numpy_in_numpy_out(static=("frame",))
def jacobian(
    robot: Robot, q: Float[Array, "*batch dof"], frame: Frame = "mixed"
) -> Float[Array, "*batch 6 dof"]:
    """Analytic Jacobian of the tool's motion with respect to q; linear rows, then angular.

    Args:
        robot: The arm.
        q: Configuration [rad].
        frame: Axes of the rows. ``"base"``: both in the world; ``"body"``: both in the tool
            frame; ``"mixed"``: linear in the world and angular in the tool frame, as the pose
            error of M Eq. 3 has them. The linear rows are always the tool point's velocity.

    At theta_i = 0 the column of phi_i vanishes (polar coordinates); ``bending_jacobian`` has no
    such singularity.

    Raises:
        ValueError: Unknown frame, last axis not 2S, or (on host data) an entry not finite.
    """
    check_last_axis("q", q.shape, 2 * robot.n_segments)
    if frame not in ("base", "body", "mixed"):
        raise ValueError(f"frame: must be 'base', 'body' or 'mixed', found {frame!r}")
    theta, phi = q[..., 0::2], q[..., 1::2]
    radial = jnp.stack([jnp.cos(phi), jnp.sin(phi)], axis=-1)
    tangential = theta[..., None] * jnp.stack([-jnp.sin(phi), jnp.cos(phi)], axis=-1)
    polar = jnp.stack([radial, tangential], axis=-1)  # d b_i / d (theta_i, phi_i)
    by_bending = bending_jacobian(robot, bending_from_configuration(q), frame)
    columns = by_bending.reshape(*by_bending.shape[:-1], robot.n_segments, 2)
    by_q = jnp.einsum("...rsx,...sxy->...rsy", columns, polar, precision="highest")
    return by_q.reshape(*by_bending.shape)


def bending_jacobian(
    robot: Robot, b: Float[Array, "*batch S 2"], frame: Frame = "mixed"
) -> Float[Array, "*batch 6 dof"]:
    """Analytic Jacobian with respect to the Cartesian bending; rows as in ``jacobian``.

    Each segment adds the twist of its distal disc, carried to the tool by the rigid remainder.
    """
    ends = segment_ends(robot, b)
    tip = matmul(ends[..., -1, :, :], robot.tool)
    starts = jnp.concatenate(
        [
            jnp.broadcast_to(jnp.asarray(robot.base), ends[..., :1, :, :].shape),
            ends[..., :-1, :, :],
        ],
        axis=-3,
    )
    linear, angular = _segment_twist(b, jnp.asarray(robot.length))
    # Body of the distal disc -> world, (..., S, 3, 2).
    angular = matmul(ends[..., :3, :3], angular)
    linear = matmul(starts[..., :3, :3], linear)
    arm = tip[..., None, :3, 3] - ends[..., :3, 3]
    linear = linear + jnp.cross(angular, arm[..., None], axis=-2)
    rotation = jnp.swapaxes(tip[..., :3, :3], -1, -2)
    linear, angular = (
        jnp.moveaxis(rows, -3, -2).reshape(*rows.shape[:-3], 3, -1) for rows in (linear, angular)
    )
    if frame == "body":
        linear = matmul(rotation, linear)
    if frame != "base":
        angular = matmul(rotation, angular)
    return jnp.concatenate([linear, angular], axis=-2)


def _segment_twist(
    b: Float[Array, "*batch 2"], length: Float[Array, "*#batch"]
) -> tuple[Float[Array, "*batch 3 2"], Float[Array, "*batch 3 2"]]:
    """Velocity (proximal frame) and angular velocity (distal frame) of a segment's end by b.

    dp/db from p = L (c_2 b, c_1) with c_1' = (c_3 - c_2) / 2 and c_2' = c_4 - c_3 / 2 in u = b.b.
    The angular part is the right Jacobian of the rotation group, 1 - c_2 [w] + c_3 [w]^2, times
    dw/db with w = (-b_y, b_x, 0).
    """
    bx, by = b[..., 0], b[..., 1]
    u = bx * bx + by * by
    c2, c3, c4 = (stumpff(u, k) for k in (2, 3, 4))
    slope = 2 * c4 - c3
    linear = [
        [c2 + slope * bx * bx, slope * bx * by],
        [slope * bx * by, c2 + slope * by * by],
        [(c3 - c2) * bx, (c3 - c2) * by],
    ]
    angular = [
        [-c3 * bx * by, c3 * bx * bx - 1],
        [1 - c3 * by * by, c3 * bx * by],
        [c2 * by, -c2 * bx],
    ]
    stack = [
        jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2) for rows in (linear, angular)
    ]
    return stack[0] * length[..., None, None], stack[1]


def check_configuration(robot: Robot, q: object) -> Float[np.ndarray, "*batch dof"]:
    """Host check of a configuration that is to be used on the robot.

    Returns:
        q as a float64 NumPy array.

    Raises:
        ValueError: Wrong shape, not finite, or a bending angle beyond the robot's limit.
    """
    checked = host_array("q", q, last=2 * robot.n_segments)
    theta = np.abs(checked[..., 0::2])
    beyond = np.argwhere(theta > robot.theta_max + 1e-9)
    if len(beyond):
        *row, segment = (int(i) for i in beyond[0])
        raise ValueError(
            f"q{row if row else ''}: bending of segment {segment + 1} is "
            f"{np.degrees(theta[tuple(beyond[0])]):.4g} degrees, limit "
            f"{np.degrees(robot.theta_max[segment]):.4g}"
        )
    return checked


def roll_pitch_yaw(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Angles [rad] about the fixed axes x, y, z, one after the other, for a person to read.

    Where the pitch is 90 degrees roll and yaw turn about one axis: the yaw is then 0.
    """
    r = np.asarray(rotation, dtype=np.float64)
    level = float(np.hypot(r[0, 0], r[1, 0]))
    pitch = np.arctan2(-r[2, 0], level)
    if level < 1e-7:
        return np.array([np.arctan2(-r[1, 2], r[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])
