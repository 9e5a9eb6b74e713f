"""Configuration to tendon displacements and back (M Eq. 4-6, MODEL.md section 3).

A displacement is a tendon's length change from the straight arm in metres; negative = wound in.
Tendon j of segment i has index c = J i + j.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.kinematics import bending_from_configuration, configuration_from_bending, stumpff
from muxjax.precision import check_last_axis, host_array, numpy_in_numpy_out
from muxjax.robot import Robot

Array = jax.Array | np.ndarray


def segment_contributions(
    robot: Robot, b: Float[Array, "*batch 2"], segment: int, azimuth: Float[Array, "*tendons"]
) -> Float[Array, "*batch *tendons"]:
    """Length change [m] inside one segment of tendons at the given azimuths [rad].

    One term of M Eq. 6, with A_n = theta sinc(theta / (2 xi)) and theta cos(psi - phi) = b . e_psi
    so that nothing is divided by theta.
    """
    length, radius = robot.length[segment], robot.tendon_radius
    scale = _chord_ratio(robot, b, segment)
    axes = (1,) * jnp.ndim(azimuth)
    bx, by, scale = (x.reshape(*x.shape, *axes) for x in (b[..., 0], b[..., 1], scale))
    towards = bx * jnp.cos(azimuth) + by * jnp.sin(azimuth)
    return scale * (length - radius * towards) - length


def _chord_ratio(robot: Robot, b: Float[Array, "*batch 2"], segment: int) -> Float[Array, "*batch"]:
    """sinc(theta / (2 xi)): the discs' straight chords over the arc they replace."""
    u = b[..., 0] * b[..., 0] + b[..., 1] * b[..., 1]
    return stumpff(u / (4 * robot.n_discs[segment] ** 2), 1)


def displacements_from_bending(
    robot: Robot, b: Float[Array, "*batch S 2"]
) -> Float[Array, "*batch SJ"]:
    """Tendon displacements of the Cartesian bending (M Eq. 6)."""
    psi = jnp.asarray(robot.tendon_azimuth)
    per_segment = [
        segment_contributions(robot, b[..., n, :], n, psi[n]) for n in range(robot.n_segments)
    ]
    total = jnp.stack(
        [sum(per_segment[n][..., i, :] for n in range(i + 1)) for i in range(robot.n_segments)],
        axis=-2,
    )
    return total.reshape(*total.shape[:-2], -1)


def bending_from_displacements(
    robot: Robot, displacements: Float[Array, "*batch SJ"]
) -> Float[Array, "*batch S 2"]:
    """Cartesian bending that the displacements define (M Eq. 4-5 for J = 3).

    Segment by segment from the base: what the proximal segments did to these tendons is
    subtracted first. Then mean c and first harmonic m of the rest give b = -m L / (r_a (c + L)).
    Lengths off the image of ``tendon_displacements``, as in the middle of a plan, are mapped by
    the same formula. NaN where tendons are wound in by more than the segment's length.
    """
    n, j = robot.n_segments, robot.tendons_per_segment
    own = displacements.reshape(*displacements.shape[:-1], n, j)
    psi = jnp.asarray(robot.tendon_azimuth)
    bending: list[jax.Array] = []
    for i in range(n):
        rest = own[..., i, :]
        for proximal, b in enumerate(bending):
            rest = rest - segment_contributions(robot, b, proximal, psi[proximal, i])
        arc = jnp.mean(rest, axis=-1) + robot.length[i]
        scale = robot.length[i] / (robot.tendon_radius * jnp.where(arc > 0, arc, jnp.nan))
        mx = 2.0 / j * jnp.sum(rest * jnp.cos(psi[i, i]), axis=-1)
        my = 2.0 / j * jnp.sum(rest * jnp.sin(psi[i, i]), axis=-1)
        bending.append(jnp.stack([-mx * scale, -my * scale], axis=-1))
    return jnp.stack(bending, axis=-2)


@numpy_in_numpy_out()
def tendon_displacements(robot: Robot, q: Float[Array, "*batch dof"]) -> Float[Array, "*batch SJ"]:
    """Tendon displacements [m] of a configuration [rad] (M Eq. 6); negative = wound in.

    Raises:
        ValueError: Last axis is not 2S, or (on host data) an entry is not finite.
    """
    check_last_axis("q", q.shape, 2 * robot.n_segments)
    return displacements_from_bending(robot, bending_from_configuration(q))


@numpy_in_numpy_out()
def configuration_from_tendons(
    robot: Robot,
    l: Float[Array, "*batch SJ"],  # noqa: E741 - the papers' symbol
) -> Float[Array, "*batch dof"]:
    """Configuration [rad] of tendon displacements [m] (M Eq. 4-5); theta >= 0, phi in [0, 2 pi).

    Exact inverse of ``tendon_displacements`` on its image. NaN for a segment whose tendons are
    wound in by more than its length on average, and for the segments beyond it.

    Raises:
        ValueError: Last axis is not S*J, or (on host data) an entry is not finite.
    """
    check_last_axis("l", l.shape, robot.n_tendons)
    return configuration_from_bending(bending_from_displacements(robot, l))


def displacement_range(robot: Robot) -> Float[np.ndarray, "SJ 2"]:
    """Least and greatest displacement [m] of each tendon over all allowed configurations.

    In each segment a tendon's change is extreme in its own bending plane, towards or away from
    it; along that plane the extreme is searched on a grid of 1 / 2000 of the limit.
    """
    theta = np.linspace(0.0, 1.0, 2001)[:, None] * robot.theta_max
    chord = np.sinc(theta / (2 * robot.n_discs) / np.pi)
    reach = robot.tendon_radius * theta
    least = np.min(chord * (robot.length - reach), axis=0) - robot.length
    most = np.max(chord * (robot.length + reach), axis=0) - robot.length
    limits = np.stack([np.cumsum(least), np.cumsum(most)], axis=-1)
    return np.repeat(limits, robot.tendons_per_segment, axis=0)


def check_displacements(
    robot: Robot, name: str, displacements: object
) -> Float[np.ndarray, "*batch SJ"]:
    """Host check of tendon displacements that the robot is to hold.

    Returns:
        The displacements as a float64 NumPy array.

    Raises:
        ValueError: Wrong shape, not finite, or beyond the range of a tendon.
    """
    checked = host_array(name, displacements, last=robot.n_tendons)
    limits = displacement_range(robot)
    beyond = np.argwhere((checked < limits[:, 0] - 1e-9) | (checked > limits[:, 1] + 1e-9))
    if len(beyond):
        *row, tendon = (int(i) for i in beyond[0])
        low, high = 1e3 * limits[tendon]
        raise ValueError(
            f"{name}{row if row else ''}: tendon {tendon + 1} is at "
            f"{1e3 * checked[tuple(beyond[0])]:.4g} mm, its range is {low:.4g} to {high:.4g} mm"
        )
    return checked
