"""Cost term of tendon tension, by a reduced statics of 2 S unknowns.

The full statics has two unknowns a disc (``muxjax.statics``); a planner asks about a hundred
thousand states. Here every segment bends with constant curvature, and its bending b minimises

    E(b) = sum_i K |b_i|^2 / (2 xi_i) + sum_c ramp-spring(l_c(b) - dl_c) - weight,

with the chords of a universal joint between any two discs, l = L (cos(theta / 2 xi) - 1)
- r_a (b . e_psi) sinc(theta / 2 xi) in each segment (half a gap before and after the joint; M
Eq. 6 has the arc's chord instead). How far its tensions are from those of the full statics is
measured in tests/benchmarks/tension.py and stated in the docs.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.kinematics import stumpff
from muxjax.planning.terms import Transition
from muxjax.precision import matmul
from muxjax.robot import Robot
from muxjax.statics.recursion import solve_pivotless
from muxjax.statics.tension import ramp
from muxjax.tendons import bending_from_displacements

Array = Any  # jax.Array | np.ndarray; mypy knows no operators of their union

ITERATIONS = 14
SCALES = (1.0, 0.5, 0.2, 0.05)  # of a step; the one with the least energy is taken
GAUSS = ((0.21132486540518713, 0.5), (0.7886751345948129, 0.5))  # points of a segment's weight


class Tension(eqx.Module):
    """Tension of the tendon that is pulled hardest, integrated over waiting and motion [N s].

    All values are assumed ones (nothing is published): state results with their range.

    Attributes:
        bending_stiffness: Of the joint between two discs [N m/rad].
        tendon_stiffness: Of a tendon [N/m].
        mass: Of the arm beyond its base [kg], spread evenly over its length.
        gravity: In the world [m/s^2].
    """

    bending_stiffness: float = 15.0
    tendon_stiffness: float = 2e4
    mass: float = 0.5
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)

    def __check_init__(self) -> None:
        for name in ("bending_stiffness", "tendon_stiffness", "mass"):
            value = getattr(self, name)
            if isinstance(value, (int, float, np.number)) and not (
                np.isfinite(value) and (value > 0 or (name == "mass" and value == 0))
            ):
                raise ValueError(f"Tension.{name}: must be finite and above 0, found {value!r}")

    def __call__(self, robot: Robot, t: Transition) -> Float[Array, "*n"]:
        """The term's value."""
        points = jnp.stack([t.before, 0.5 * (t.before + t.after), t.after])
        before, halfway, after = self.largest(robot, points)
        along = (before + 4 * halfway + after) / 6  # Simpson's rule
        return t.wait * before + t.duration * along

    def largest(self, robot: Robot, displacements: Float[Array, "*n SJ"]) -> Float[Array, "*n"]:
        """Tension of the tendon that is pulled hardest [N]."""
        return jnp.max(self.tensions(robot, displacements), axis=-1)

    def tensions(self, robot: Robot, displacements: Float[Array, "*n SJ"]) -> Float[Array, "*n SJ"]:
        """Tension of every tendon held at displacements [m], in [N]."""
        rows = displacements.reshape(-1, robot.n_tendons)
        start = bending_from_displacements(robot, rows).reshape(len(rows), -1)
        # Where the formulas define nothing, the straight arm is as good a start as any.
        start = jnp.clip(jnp.where(jnp.isfinite(start), start, 0.0), -np.pi, np.pi)
        found = self._equilibrium(robot, start.T, rows.T)
        return self._pull(_lengths(robot, found)[0] - rows.T)[0].T.reshape(displacements.shape)

    def _pull(self, excess: Float[Array, "SJ B"]) -> tuple[Array, Array, Array]:
        """Tension [N], its slope [N/m] and energy [J] of tendons longer by ``excess`` [m]."""
        kt = self.tendon_stiffness
        value, slope, integral = ramp(kt * excess, jnp.asarray(0.05))
        return value, kt * slope, integral / kt

    def _equilibrium(
        self, robot: Robot, start: Float[Array, "dof B"], displacements: Float[Array, "SJ B"]
    ) -> Float[Array, "dof B"]:
        spring = self.bending_stiffness / np.repeat(robot.n_discs, 2)[:, None]

        def energy(b: Array) -> Array:
            pull = self._pull(_lengths(robot, b)[0] - displacements)[2]
            elastic = 0.5 * jnp.sum(spring * b * b, axis=0)
            return elastic + jnp.sum(pull, axis=0) + self._weight(robot, b)

        def improve(_: Array, b: Array) -> Array:
            lengths, gradient = _lengths(robot, b)
            tension, slope, _unused = self._pull(lengths - displacements)
            weight = jax.grad(lambda x: jnp.sum(self._weight(robot, x)))(b)
            force = spring * b + jnp.sum(tension[:, None] * gradient, axis=0) + weight
            # Springs and taut tendons only: positive definite, so the step goes downhill.
            hessian = jnp.sum(
                slope[:, None, None] * gradient[:, :, None] * gradient[:, None], axis=0
            )
            hessian = hessian + spring[:, None] * np.eye(len(spring))[..., None]
            step = solve_pivotless(hessian, -force[:, None])[0][:, 0]
            step = step * jnp.minimum(1.0, 0.5 / (jnp.max(jnp.abs(step), axis=0) + 1e-12))
            tried = jnp.stack([b, *(b + scale * step for scale in SCALES)])
            energies = jax.vmap(energy)(tried)
            # Within rounding of the energy it is the gradient that knows: the full step is taken,
            # so that the result does not depend on how the energies were rounded.
            energies = energies.at[1].add(-1e-12 * (1.0 + jnp.abs(energies[0])))
            best = jnp.argmin(jnp.where(jnp.isfinite(energies), energies, jnp.inf), axis=0)
            return jnp.take_along_axis(tried, best[None, None], axis=0)[0]

        return jax.lax.fori_loop(0, ITERATIONS, improve, start)

    def _weight(self, robot: Robot, b: Float[Array, "dof B"]) -> Float[Array, " B"]:
        """Potential of the arm's weight [J]."""
        down = matmul(robot.base[:3, :3].T, jnp.asarray(self.gravity))
        per_metre = self.mass / jnp.sum(jnp.asarray(robot.length))
        shares = jnp.asarray([*(share for share, _ in GAUSS), 1.0])[:, None, None]
        own = b.reshape(robot.n_segments, 2, -1)
        u = jnp.sum(own * own, axis=1)
        # Points of every arc at once, in its segment's frame: (shares, S, B) each.
        aside = shares**2 * stumpff(shares**2 * u, 2)
        onward = shares * stumpff(shares**2 * u, 1)
        position = [jnp.zeros_like(b[0])] * 3
        rotation = [[jnp.full_like(b[0], float(i == j)) for j in range(3)] for i in range(3)]
        energy = jnp.zeros_like(b[0])
        for n in range(robot.n_segments):
            x, y = own[n]
            length = robot.length[n]
            points = []
            for k in range(len(GAUSS) + 1):
                local = (aside[k, n] * x, aside[k, n] * y, onward[k, n])
                points.append([position[i] + length * _dot(rotation[i], local) for i in range(3)])
            for (_, portion), point in zip(GAUSS, points[:-1], strict=True):
                energy = energy - per_metre * length * portion * _dot(down, point)
            # The last share is 1, where c_1 and c_2 also make the rotation (M Eq. 1).
            turn = _turn(x, y, onward[-1, n], aside[-1, n])
            columns = list(zip(*turn, strict=True))
            position = points[-1]
            rotation = [[_dot(row, column) for column in columns] for row in rotation]
        return energy


def _lengths(
    robot: Robot, b: Float[Array, "dof B"]
) -> tuple[Float[Array, "SJ B"], Float[Array, "SJ dof B"]]:
    """Length changes of the tendons' paths [m] and their derivative by the bending [m/rad]."""
    psi, radius = jnp.asarray(robot.tendon_azimuth), robot.tendon_radius
    s, j = robot.n_segments, robot.tendons_per_segment
    total = [jnp.zeros((j, b.shape[-1]), b.dtype) for _ in range(s)]
    parts: list[list[Array]] = [[jnp.zeros((j, 2, b.shape[-1]), b.dtype)] * s for _ in range(s)]
    for n in range(s):
        own, quarter = b[2 * n : 2 * n + 2], 1 / (4 * robot.n_discs[n] ** 2)
        v = quarter * jnp.sum(own * own, axis=0)
        # A joint turns by well under a radian: the next terms are below 1e-8 there.
        sinc = 1 - v / 6 + v**2 / 120 - v**3 / 5040
        slope = -1 / 6 + v / 60 - v**2 / 1680
        versine = v * (-1 / 2 + v / 24 - v**2 / 720 + v**3 / 40320)
        for i in range(n, s):
            towards = jnp.stack([jnp.cos(psi[n, i]), jnp.sin(psi[n, i])], axis=-1)
            lever = matmul(towards, own)  # b . e_psi
            total[i] = total[i] + robot.length[n] * versine - radius * lever * sinc
            along = -0.5 * robot.length[n] * sinc - radius * lever * slope
            parts[i][n] = 2 * quarter * along[:, None] * own - radius * sinc * towards[..., None]
    gradient = jnp.concatenate([jnp.concatenate(row, axis=1) for row in parts], axis=0)
    return jnp.concatenate(total, axis=0), gradient


def _dot(a: Any, b: Any) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _turn(x: Array, y: Array, sinc: Array, versed: Array) -> list[list[Array]]:
    """Rotation from a segment's base to its end."""
    return [
        [1 - x * x * versed, -x * y * versed, x * sinc],
        [-x * y * versed, 1 - y * y * versed, y * sinc],
        [-x * sinc, -y * sinc, 1 - (x * x + y * y) * versed],
    ]
