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


def layered_angles(
    robot: Robot, points: Sequence[Float[Array, "_ J *batch"]], xp: Any = jnp
) -> list[Any]:
    """Bending angle [rad] of each segment: entry i has shape (P_1, ..., P_i, *batch).

    Equal to ``motion.bending_angles`` at every combination of points; NaN where that is.

    Args:
        robot: The arm.
        points: For each layer, displacements [m] of its tendons at P_i points.
        xp: ``jax.numpy`` in compiled code, or ``numpy``.
    """
    angles = []
    for i, rest in layered_rests(robot, points, xp):
        harmonic = xp.sqrt(rest.mx * rest.mx + rest.my * rest.my)
        angles.append(harmonic * _per_harmonic(robot, i, rest, xp))
    return angles


def layered_rests(
    robot: Robot, points: Sequence[Float[Array, "_ J *batch"]], xp: Any = jnp
) -> list[tuple[int, Rest]]:
    """Each segment's number and its ``Rest``, as in ``layered_angles``.

    What later layers use again comes out of matrix products: XLA computes these once, where it
    would compute sums anew at every point of the grid.
    """
    psi, radius = xp.asarray(robot.tendon_azimuth), robot.tendon_radius
    shares: list[Any] = []  # chord ratio s - 1, and s times b, by segment
    rests = []
    for i, layer in enumerate(points):
        functionals = xp.stack(_mean_and_harmonic(psi[i, i], xp))
        arc, mx, my = xp.tensordot(functionals, layer, axes=(1, 1))
        arc = arc + robot.length[i]
        for n, share in enumerate(shares):
            waves = [robot.length[n] * xp.ones_like(psi[n, i])]
            waves += [-radius * xp.cos(psi[n, i]), -radius * xp.sin(psi[n, i])]
            through = xp.tensordot(functionals @ xp.stack(waves, axis=1), share, axes=1)
            through = through.reshape(*through.shape[: n + 2], *(1,) * (i - n), *layer.shape[2:])
            arc, mx, my = arc - through[0], mx - through[1], my - through[2]
        rest = Rest(arc, mx, my)
        rests.append((i, rest))
        if i + 1 < len(points):
            scale = _per_harmonic(robot, i, rest, xp)
            bx, by = -mx * scale, -my * scale
            u = (bx * bx + by * by) / (4 * robot.n_discs[i] ** 2)
            ratio = xp.sinc(xp.sqrt(u) / xp.pi) if xp is np else stumpff(u, 1)
            shares.append(xp.stack([ratio - 1.0, ratio * bx, ratio * by]))
    return rests


def _per_harmonic(robot: Robot, segment: int, rest: Rest, xp: Any) -> Any:
    """Bending of a segment by its first harmonic [rad/m] (M Eq. 4-5)."""
    arc = xp.where(rest.arc > 0, rest.arc, xp.nan)
    return robot.length[segment] / (robot.tendon_radius * arc)


def _mean_and_harmonic(azimuth: Float[Array, " J"], xp: Any) -> list[Any]:
    """Weights of the tendons of a layer in their mean and in the two parts of its harmonic."""
    j = azimuth.shape[0]
    return [xp.full(j, 1.0 / j), 2.0 / j * xp.cos(azimuth), 2.0 / j * xp.sin(azimuth)]
