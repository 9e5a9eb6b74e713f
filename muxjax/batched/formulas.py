"""Batched kinematics in float32: the formulas, on structures of arrays.

``kinematics`` and ``tendons`` are the readable forms. This is the same mathematics arranged for
throughput: an array for each number, batch inside, no transcendental function and no division.

With e = S u / 2 and C, where S = sinc(|u|/2) and C = cos(|u|/2) are polynomials in x = |u|^2 / 4,
a segment turns by the quaternion (C, -e_y, e_x, 0) and ends at L S (e_x, e_y, C). Segments are
composed from the tip to the base, as v <- R_i v + d_i: a vector is cheaper to turn by a pure
bend than two bends are to multiply, so a position alone never pays for the orientation.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial import Chebyshev, Polynomial

from muxjax.robot import Robot

Array = jax.Array | np.ndarray
Output = Literal["position", "quaternion", "matrix"]
Vector = tuple[jax.Array, ...]

SERIES_ERROR = 2.0**-25  # largest error of the polynomials for S and C: half a float32 ulp of 1
# XLA leaves 512-bit vectors idle unless asked; processors without them take no notice.
WIDE_VECTORS: dict[str, bool | str] = {"xla_cpu_prefer_vector_width": "512"}


class Series(eqx.Module):
    """Polynomials in x for S = sinc(sqrt x) and C = cos(sqrt x), lowest power first."""

    sinc: tuple[float, ...] = eqx.field(static=True)
    cosine: tuple[float, ...] = eqx.field(static=True)
    x_max: float = eqx.field(static=True)

    def evaluate(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(S, C) at x, each within SERIES_ERROR for 0 <= x <= x_max, before rounding."""
        return _horner(self.sinc, x), _horner(self.cosine, x)


class Chain(eqx.Module):
    """What of a robot the batched forms need; any float may be traced."""

    length: Float[Array, " S"]  # [m]
    base: Float[Array, "4 4"]
    tool: Float[Array, "4 4"]
    base_turn: Float[Array, " 4"]  # the base frame's quaternion (w, x, y, z)
    tool_turn: Float[Array, " 4"]
    tendon_radius: Float[Array, ""]  # [m]
    guide: Float[Array, "S S J 2"]  # (cos psi, sin psi) of tendon (i, j) inside segment n
    n_discs: tuple[int, ...] = eqx.field(static=True)
    angle_limit: float = eqx.field(static=True)  # bending angles beyond it give NaN [rad]
    has_base: bool = eqx.field(static=True)
    has_tool_offset: bool = eqx.field(static=True)
    has_tool_turn: bool = eqx.field(static=True)

    @property
    def n_segments(self) -> int:
        """S."""
        return len(self.n_discs)

    @property
    def n_tendons(self) -> int:
        """S * J."""
        return self.guide.shape[1] * self.guide.shape[2]


def chain(robot: Robot) -> Chain:
    """The batched form of a robot, its frames included.

    The range of the polynomials is the largest theta_max rounded up to a multiple of pi / 4, so
    that designs which differ a little share one compilation.

    Raises:
        ValueError: A bending limit above 2 pi.
    """
    widest = float(np.max(robot.theta_max))
    if widest > 2 * np.pi + 1e-9:
        raise ValueError(
            f"theta_max: {np.degrees(widest):.4g} degrees, batched kinematics go to 360"
        )
    psi = np.asarray(robot.tendon_azimuth)
    base, tool = np.asarray(robot.base), np.asarray(robot.tool)
    return Chain(
        length=np.asarray(robot.length, np.float32),
        base=base.astype(np.float32),
        tool=tool.astype(np.float32),
        base_turn=_quaternion(base[:3, :3]).astype(np.float32),
        tool_turn=_quaternion(tool[:3, :3]).astype(np.float32),
        tendon_radius=np.asarray(robot.tendon_radius, np.float32),
        guide=np.stack([np.cos(psi), np.sin(psi)], axis=-1).astype(np.float32),
        n_discs=tuple(int(n) for n in robot.n_discs),
        angle_limit=math.ceil(widest / (np.pi / 4) - 1e-9) * (np.pi / 4),
        has_base=not np.array_equal(base, np.eye(4)),
        has_tool_offset=bool(np.any(tool[:3, 3])),
        has_tool_turn=not np.array_equal(tool[:3, :3], np.eye(3)),
    )


@lru_cache(maxsize=256)
def series(x_max: float) -> Series:
    """Polynomials of the lowest degree that meet SERIES_ERROR on [0, x_max].

    They interpolate at Chebyshev nodes; the error is measured on 1001 points.
    """
    grid = np.linspace(0.0, x_max, 1001)

    def fit(exact: np.ndarray, name: str) -> tuple[float, ...]:
        function = _sinc_sqrt if name == "sinc" else _cos_sqrt
        for degree in range(1, 24):
            node = 0.5 * x_max * (1 - np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)))
            curve = Chebyshev.fit(node, function(node), degree, domain=[0.0, x_max])
            if np.max(np.abs(curve(grid) - exact)) <= SERIES_ERROR:
                return tuple(float(c) for c in curve.convert(kind=Polynomial).coef)
        raise ValueError(f"x_max: no polynomial of degree below 24 reaches {x_max:g}")

    return Series(fit(_sinc_sqrt(grid), "sinc"), fit(_cos_sqrt(grid), "cosine"), x_max)


def _sinc_sqrt(x: np.ndarray) -> np.ndarray:
    return np.sinc(np.sqrt(x) / np.pi)


def _cos_sqrt(x: np.ndarray) -> np.ndarray:
    return np.cos(np.sqrt(x))


def _horner(coefficients: tuple[float, ...], x: jax.Array) -> jax.Array:
    value = jnp.full_like(x, np.float32(coefficients[-1]))
    for c in coefficients[-2::-1]:
        value = value * x + np.float32(c)
    return value


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z), w >= 0, from the dominant eigenvector of its 4 x 4 form."""
    r = rotation
    k = np.array(
        [
            [np.trace(r), r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0.0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0.0, 0.0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0.0, 0.0, 0.0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    q = np.linalg.eigh(k + np.triu(k, 1).T)[1][:, -1]
    return q if q[0] >= 0 else -q


def half_squares(u: Vector) -> list[jax.Array]:
    """x_i = |u_i|^2 / 4 of each segment, from the rows (u_1x, u_1y, u_2x, ...)."""
    return [(ux * ux + uy * uy) * np.float32(0.25) for ux, uy in zip(u[0::2], u[1::2], strict=True)]


def pose_values(arm: Chain, u: Vector, output: Output, *, in_base: bool = False) -> Vector:
    """Tool pose of a batch: an array for each number, to be used inside a larger kernel.

    Args:
        arm: The robot.
        u: 2S arrays of one shape, the Cartesian bending (u_1x, u_1y, u_2x, ...) [rad]. The
            caller keeps |u_i| within ``arm.angle_limit``.
        output: ``"position"``: x, y, z [m]; ``"quaternion"``: these and w, x, y, z;
            ``"matrix"``: these and the rotation matrix by rows.
        in_base: Leave out the base frame: the pose as seen from the arm's root.
    """
    polynomials = series(0.25 * arm.angle_limit**2)
    bends = [polynomials.evaluate(x) for x in half_squares(u)]
    turning = output != "position"
    place = tuple(arm.tool[:3, 3]) if arm.has_tool_offset else None
    turn = tuple(arm.tool_turn) if turning and arm.has_tool_turn else None
    for i in reversed(range(arm.n_segments)):
        s, c = bends[i]
        ex, ey = 0.5 * s * u[2 * i], 0.5 * s * u[2 * i + 1]
        place = _advance(place, ex, ey, c, arm.length[i] * s)
        if turning:
            turn = _bend(turn, ex, ey, c)
    assert place is not None
    if arm.has_base and not in_base:
        base = arm.base
        place = tuple(
            base[r, 0] * place[0] + base[r, 1] * place[1] + base[r, 2] * place[2] + base[r, 3]
            for r in range(3)
        )
        if turn is not None:
            turn = product(tuple(arm.base_turn), turn)
    if turn is None:
        return place
    return place + (turn if output == "quaternion" else _matrix(turn))


def _advance(
    v: Vector | None, ex: jax.Array, ey: jax.Array, c: jax.Array, chord: jax.Array
) -> Vector:
    """R v + d of one segment: v in its distal frame, the result in its proximal one.

    R = 1 + 2 c [w] + 2 [w]^2 with w = (-e_y, e_x, 0) and d = chord (e_x, e_y, c).
    """
    if v is None:
        return chord * ex, chord * ey, chord * c
    x, y, z = v
    along = ex * x + ey * y
    sideways = 2 * (c * z - along) + chord
    up = z * (2 * c * c - 1) + c * (chord - 2 * along)
    return x + sideways * ex, y + sideways * ey, up


def _bend(q: Vector | None, ex: jax.Array, ey: jax.Array, c: jax.Array) -> Vector:
    """Quaternion product (c, -e_y, e_x, 0) q."""
    if q is None:
        return c, -ey, ex, jnp.zeros_like(c)
    w, x, y, z = q
    return (
        c * w + ey * x - ex * y,
        c * x - ey * w + ex * z,
        c * y + ey * z + ex * w,
        c * z - ey * y - ex * x,
    )


def product(p: tuple[Any, ...], q: tuple[Any, ...]) -> tuple[Any, ...]:
    """Quaternion product, (w, x, y, z)."""
    (a, b, c, d), (w, x, y, z) = p, q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def _matrix(q: Vector) -> Vector:
    w, x, y, z = q
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


def length_values(arm: Chain, u: Vector) -> Vector:
    """Tendon displacements [m] of a batch (M Eq. 6), an array for each of the S*J tendons.

    sinc(theta / (2 xi)) needs few terms: a gap between two discs bends by little.
    """
    chords = []
    for n, x in enumerate(half_squares(u)):
        per_gap = 1.0 / arm.n_discs[n] ** 2
        ratio, _ = series(0.25 * arm.angle_limit**2 * per_gap).evaluate(x * np.float32(per_gap))
        chords.append(ratio)
    totals = []
    for i in range(arm.n_segments):
        for j in range(arm.n_tendons // arm.n_segments):
            total: jax.Array = jnp.zeros_like(chords[0])
            for n in range(i + 1):
                towards = u[2 * n] * arm.guide[n, i, j, 0] + u[2 * n + 1] * arm.guide[n, i, j, 1]
                length = arm.length[n]
                total += chords[n] * (length - arm.tendon_radius * towards) - length
            totals.append(total)
    return tuple(totals)
