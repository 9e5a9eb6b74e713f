"""Into a bent tube: where the base stands and how the arm bends at each depth.

Each point of the arm inside the tube should lie on the tube's line, as if it followed the tip; what
is still outside is weakly held to the line's straight continuation, and the base likewise.
Constant-curvature segments cannot follow exactly: a least-squares fit with more weight on the worst
points comes close to the shape with the most room on all sides. Consecutive shapes must also be
near to each other, because base and tendons do not move at the same time: the tip swings with each
degree by which either runs ahead. So changes have a price, and tilting the base a high one.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float

from muxjax.kinematics import (
    bending_from_configuration,
    configuration_from_bending,
    segment_transform,
)
from muxjax.robot import Robot
from muxjax.tendons import tendon_displacements

Array = jax.Array | np.ndarray

POINTS = 8  # a segment, at which the arm is compared with the line
OUTSIDE = 0.2  # weight of points before the mouth
TILT = 0.2  # a radian of the base's tilt counts as much as this distance inside [m]
CHANGE = 0.01  # a radian of bending's change since the last depth, likewise [m]
REWEIGHTED = 3  # fits, each with more weight on what was furthest off


@dataclass(frozen=True, eq=False)
class Posture:
    """The arm at one depth.

    Attributes:
        depth: Of the tip along the tube's line, from its mouth [m].
        base: Pose of the arm's root in the world.
        q: Configuration [rad].
        displacements: Of the tendons [m].
        off_line: Greatest distance inside the tube of the arm's axis from the line [m].
    """

    depth: float
    base: Float[np.ndarray, "4 4"]
    q: Float[np.ndarray, " dof"]
    displacements: Float[np.ndarray, " SJ"]
    off_line: float


class TubeLine:
    """A tube's line by its depth: straight on before the mouth and beyond the end."""

    def __init__(self, through: Float[np.ndarray, "m 3"]) -> None:
        self.points = np.asarray(through, dtype=np.float64)
        self.depths = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))]
        )
        self.length = float(self.depths[-1])
        ends = self.points[[1, -1]] - self.points[[0, -2]]
        self.before, self.after = ends / np.linalg.norm(ends, axis=1, keepdims=True)

    def at(self, depth: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Points at depths [m]."""
        inside = np.stack([np.interp(depth, self.depths, c) for c in self.points.T], axis=-1)
        short, over = np.minimum(depth, 0.0), np.maximum(depth - self.length, 0.0)
        return np.asarray(inside + short[:, None] * self.before + over[:, None] * self.after)

    def mouth(self, turn: Float[np.ndarray, "3 3"], back: float) -> Float[np.ndarray, "4 4"]:
        """A frame that looks into the tube from a distance before it [m].

        Its x axis is as near as can be to that of ``turn``.
        """
        z = self.before
        x = turn[:, 0] - (turn[:, 0] @ z) * z
        if np.linalg.norm(x) < 1e-3:
            x = turn[:, 2] - (turn[:, 2] @ z) * z
        x = x / np.linalg.norm(x)
        axes = scipy.spatial.transform.Rotation.from_matrix(
            np.stack([x, np.cross(z, x), z], axis=1)
        )
        return np.asarray(
            scipy.spatial.transform.RigidTransform.from_components(
                self.points[0] - back * z, axes
            ).as_matrix()
        )


def posture_at(
    robot: Robot, line: TubeLine, depth: float, before: Posture | None = None
) -> Posture:
    """The base pose and bending with which the arm lies along a tube down to a depth.

    Args:
        robot: The arm; of its ``base`` only the rotation about its axis matters.
        line: Of the tube.
        depth: Of the tip [m]; negative before the mouth.
        before: Posture at the depth before, to stay near to.

    Raises:
        ValueError: The root would have to enter the tube.
    """
    n, total = robot.n_segments, float(np.sum(robot.length))
    if depth > total:
        raise ValueError(
            f"depth: the arm is {1e3 * total:.0f} mm long, its tip cannot be {1e3 * depth:.0f} mm "
            "deep with its root outside the tube"
        )
    arcs = np.concatenate(
        [np.arange(1, POINTS + 1) / POINTS * length for length in robot.length]
    ) + np.repeat(np.cumsum(robot.length) - robot.length, POINTS)
    depths = arcs - (total - depth)
    wanted, inside = line.at(depths), depths > 0
    nominal = line.mouth(np.asarray(robot.base)[:3, :3], total - depth)
    if before is None:
        guess = np.zeros(6 + 2 * n)
    else:
        bent = np.asarray(bending_from_configuration(before.q), dtype=np.float64).reshape(-1)
        shift = nominal[:3, :3].T @ (before.base[:3, 3] - nominal[:3, 3])
        advance = np.array([0.0, 0.0, depth - before.depth])
        turned = scipy.spatial.transform.Rotation.from_matrix(
            nominal[:3, :3].T @ before.base[:3, :3]
        ).as_rotvec()
        guess = np.concatenate([shift + advance, turned, bent])
    weight = np.where(inside, 1.0, OUTSIDE)
    limit = np.repeat(np.asarray(robot.theta_max), 2)
    low = np.concatenate([np.full(6, -np.inf), -limit])
    scale = np.concatenate([np.full(3, 0.05), np.ones(3 + 2 * n)])
    v = guess.copy()
    for _ in range(REWEIGHTED):
        data = (nominal, wanted, weight, guess)
        with jax.enable_x64(True):
            # SciPy's first trust region is as large as its first guess: not next to nothing.
            v[2] += 1e-3
            v = scipy.optimize.least_squares(
                lambda x, data=data: np.asarray(_residual(robot, x, *data)),
                np.clip(v, low + 1e-9, -low - 1e-9),
                jac=lambda x, data=data: np.asarray(_jacobian(robot, x, *data)),
                bounds=(low, -low),
                x_scale=scale,
                xtol=1e-10,
            ).x
            base, points = (np.asarray(a) for a in _laid(robot, v, nominal))
        off = np.linalg.norm(points - wanted, axis=1)
        if not inside.any():
            break
        # Lawson: the weights of a minimax fit grow where the misfit is large.
        weight = np.where(
            inside, weight * np.sqrt(0.2 + off / max(off[inside].max(), 1e-9)), weight
        )
    q = np.asarray(configuration_from_bending(v[6:].reshape(n, 2)), dtype=np.float64)
    return Posture(
        depth=depth,
        base=base,
        q=q,
        displacements=np.asarray(tendon_displacements(robot, q)),
        off_line=float(np.max(off[inside], initial=0.0)),
    )


def _laid_out(
    robot: Robot, v: Float[Array, " n"], nominal: Float[Array, "4 4"]
) -> tuple[Array, Array]:
    """Base pose and points along the backbone of the variables."""
    shift, turn, b = v[:3], v[3:6], v[6:].reshape(-1, 2)
    base = nominal @ _rigid(shift, turn)
    frame, points = base, []
    share = np.arange(1, POINTS + 1) / POINTS
    for i in range(robot.n_segments):
        parts = segment_transform(share[:, None] * b[i], share * robot.length[i])
        frames = frame @ parts
        points.append(frames[:, :3, 3])
        frame = frames[-1]
    return base, jnp.concatenate(points)


def _rigid(shift: Array, turn: Array) -> Array:
    """A rigid transform with the rotation vector's Cayley map: exact to second order."""
    half = 0.5 * turn
    zero = jnp.zeros(())
    skew = jnp.array(
        [[zero, -half[2], half[1]], [half[2], zero, -half[0]], [-half[1], half[0], zero]]
    )
    rotation = jnp.linalg.solve(jnp.eye(3) - skew, jnp.eye(3) + skew)
    top = jnp.concatenate([rotation, shift[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0.0, 0.0, 0.0, 1.0]])])


_laid = jax.jit(_laid_out)


def _misfit(
    robot: Robot, v: Array, nominal: Array, wanted: Array, weight: Array, guess: Array
) -> Array:
    _, points = _laid_out(robot, v, nominal)
    return jnp.concatenate(
        [
            (weight[:, None] * (points - wanted)).reshape(-1),
            TILT * v[3:6],
            CHANGE * (v[6:] - guess[6:]),
        ]
    )


_residual = jax.jit(_misfit)
_jacobian = jax.jit(jax.jacfwd(_misfit, argnums=1))
