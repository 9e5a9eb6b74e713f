"""Bending angles on a grid of points that is a product over layers.

The bending of segment i depends on the tendons of layers 1 to i only (M Eq. 4-6), so on a product
grid the proximal segments need few evaluations, and of a proximal segment the later ones need only
its share in their mean and first harmonic: three numbers, linear in the chord ratio and in its
product with the bending vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.kinematics import stumpff
from muxjax.robot import Robot

Array = jax.Array | np.ndarray


class Rest(NamedTuple):
    """What a layer's tendons have left for their own segment, on a grid of layers up to it."""

    arc: Any  # mean plus the segment's length [m]
    mx: Any  # first harmonic [m]
    my: Any


def layered_angles(robot: Robot, points: Sequence[Float[Array, "_ J"]], xp: Any = jnp) -> list[Any]:
    """Bending angle [rad] of each segment: entry i has shape (P_1, ..., P_i).

    Equal to ``motion.bending_angles`` at every combination of points; NaN where that is.

    Args:
        robot: The arm.
        points: For each layer, displacements [m] of its tendons at P_i points.
        xp: ``jax.numpy`` in compiled code, or ``numpy``.
    """
    angles = []
    for i, rest in layered_rests(robot, points, xp):
        bx, by = _bending(robot, i, rest, xp)
        angle = xp.sqrt(bx * bx + by * by)
        # Without the barrier XLA would compute an angle anew for every use of it.
        angles.append(angle if xp is np else jax.lax.optimization_barrier(angle))
    return angles


def layered_rests(
    robot: Robot, points: Sequence[Float[Array, "_ J"]], xp: Any = jnp
) -> list[tuple[int, Rest]]:
    """Each segment's number and its ``Rest``, as in ``layered_angles``."""
    psi, radius = xp.asarray(robot.tendon_azimuth), robot.tendon_radius
    shares: list[tuple[Any, Any, Any]] = []  # chord ratio s - 1, and s times b, by segment
    rests = []
    for i, own in enumerate(points):
        functionals = _mean_and_harmonic(psi[i, i], xp)
        arc, mx, my = (own @ f for f in functionals)
        arc = arc + robot.length[i]
        for n, share in enumerate(shares):
            longer, sx, sy = (x.reshape(*x.shape, *(1,) * (i - n)) for x in share)
            constant, cosine, sine = (
                [xp.sum(f * w) for f in functionals]
                for w in (1.0, xp.cos(psi[n, i]), xp.sin(psi[n, i]))
            )
            through = [
                robot.length[n] * longer * constant[k] - radius * (sx * cosine[k] + sy * sine[k])
                for k in range(3)
            ]
            arc, mx, my = arc - through[0], mx - through[1], my - through[2]
        rests.append((i, Rest(arc, mx, my)))
        bx, by = _bending(robot, i, rests[-1][1], xp)
        u = (bx * bx + by * by) / (4 * robot.n_discs[i] ** 2)
        ratio = xp.sinc(xp.sqrt(u) / xp.pi) if xp is np else stumpff(u, 1)
        share = (ratio - 1.0, ratio * bx, ratio * by)
        # Without the barrier XLA would compute a share anew for every point of the later layers.
        shares.append(share if xp is np else jax.lax.optimization_barrier(share))
    return rests


def _bending(robot: Robot, segment: int, rest: Rest, xp: Any) -> tuple[Any, Any]:
    """Bending vector [rad] of a segment (M Eq. 4-5)."""
    arc = xp.where(rest.arc > 0, rest.arc, xp.nan)
    scale = robot.length[segment] / (robot.tendon_radius * arc)
    return -rest.mx * scale, -rest.my * scale


def _mean_and_harmonic(azimuth: Float[Array, " J"], xp: Any) -> list[Any]:
    """Weights of the tendons of a layer in their mean and in the two parts of its harmonic."""
    j = azimuth.shape[0]
    return [xp.full(j, 1.0 / j), 2.0 / j * xp.cos(azimuth), 2.0 / j * xp.sin(azimuth)]
