"""Cost terms of the surroundings: no step through an obstacle, and the price of coming close.

Both ask for the distance along the whole leg, which takes much longer than the other terms: they
are expensive (``terms.is_expensive``).
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.collision import World, clearance
from muxjax.kinematics import configuration_from_bending
from muxjax.planning.motion import LEG_POINTS, leg_points
from muxjax.planning.terms import Transition
from muxjax.precision import matmul
from muxjax.robot import Robot
from muxjax.tendons import bending_from_displacements

Array = jax.Array | np.ndarray

SWEEP_TOLERANCE = 1e-3  # [m]; a collision along a leg that is less deep may be missed
DEFAULT_MARGIN = 0.02  # [m]


def clearance_at(
    robot: Robot, displacements: Float[Array, "*n SJ"], world: World
) -> Float[Array, "*n"]:
    """Signed distance [m] of the arm at displacements [m] to obstacles and itself."""
    b = bending_from_displacements(robot, displacements)
    return clearance(robot, configuration_from_bending(b), world)


def clearance_of(robot: Robot, displacements: Float[np.ndarray, " SJ"], world: World) -> float:
    """``clearance_at`` of one state on the host, in float64."""
    with jax.enable_x64(True):
        return float(_compiled_clearance(robot, displacements, world))


_compiled_clearance = eqx.filter_jit(clearance_at)


def speed_bound(
    robot: Robot, before: Float[Array, "*n SJ"], after: Float[Array, "*n SJ"], world: World
) -> Float[Array, "*n"]:
    """Upper bound on how far any point goes in a leg, were it all at its fastest [m].

    Points are those of the arm, its tool, and what the tool carries.

    While a segment's bending vector changes by db, its directions turn by at most |db| s / L at
    arc s; so no point moves by more than |db| (L / 2 + what is beyond the segment). The speed of b
    is taken from the differences over 8 parts of the leg, the fastest of which counts for all.
    """
    fraction = jnp.linspace(0.0, 1.0, LEG_POINTS + 1)[:, None]
    points = before[..., None, :] + fraction * (after - before)[..., None, :]
    b = bending_from_displacements(robot, points)
    change = jnp.linalg.norm(jnp.diff(b, axis=-3), axis=-1)  # (*n, parts, S)
    length = jnp.asarray(robot.length)
    tool, carried = jnp.asarray(robot.tool), jnp.asarray(world.carried)
    beyond = jnp.concatenate([tool[None, :3, 3], matmul(carried, tool[:3, :3].T) + tool[:3, 3]])
    reach = jnp.max(jnp.linalg.norm(beyond, axis=-1))
    lever = length / 2 + jnp.sum(length) - jnp.cumsum(length) + reach
    return LEG_POINTS * jnp.max(matmul(change, lever), axis=-1)


class Collision(eqx.Module):
    """Infinite for a step that passes through a collision, else zero.

    The leg is walked in strides no longer than the distance to the nearest obstacle, and not
    shorter than the tolerance: between two points looked at, nothing is missed by more than that.
    """

    world: World
    tolerance: float = SWEEP_TOLERANCE
    expensive: ClassVar[bool] = True

    def __call__(self, robot: Robot, t: Transition) -> Float[Array, "*n"]:
        """The term's value."""
        before, move = t.before, t.after - t.before
        speed = speed_bound(robot, before, t.after, self.world)
        shortest = self.tolerance / jnp.maximum(speed, self.tolerance)

        def distance(fraction: jax.Array) -> jax.Array:
            return jnp.asarray(clearance_at(robot, before + fraction[..., None] * move, self.world))

        def unfinished(state: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
            _, depth, arrived = state
            return jnp.any(~arrived & (depth >= 0.0))

        def stride(state: tuple[jax.Array, jax.Array, jax.Array]) -> Any:
            fraction, depth, arrived = state
            found = distance(fraction)
            goes_on = ~arrived & (depth >= 0.0)
            free = jnp.maximum(found / jnp.maximum(speed, self.tolerance), shortest)
            ahead = jnp.minimum(fraction + free, 1.0)
            return (
                jnp.where(goes_on, ahead, fraction),
                jnp.where(goes_on, found, depth),
                arrived | (fraction >= 1.0),
            )

        begin = (jnp.zeros_like(speed), jnp.zeros_like(speed), jnp.zeros(speed.shape, bool))
        _, depth, _ = jax.lax.while_loop(unfinished, stride, begin)
        return jnp.where(depth >= 0.0, 0.0, jnp.inf)


class Clearance(eqx.Module):
    """How far inside a margin around the obstacles the arm is, integrated over time [m s].

    Attributes:
        world: Obstacles.
        margin: Distance [m] below which closeness counts.
    """

    world: World
    margin: float = DEFAULT_MARGIN
    expensive: ClassVar[bool] = True

    def __call__(self, robot: Robot, t: Transition) -> Float[Array, "*n"]:
        """The term's value."""
        points = leg_points(t.before, t.after)
        along = jnp.mean(self._inside(robot, points), axis=-1)
        waiting = t.wait * self._inside(robot, t.before)
        return waiting + t.duration * along

    def _inside(self, robot: Robot, displacements: Float[Array, "*n SJ"]) -> Float[Array, "*n"]:
        distance = clearance_at(robot, displacements, self.world)
        return jnp.maximum(self.margin - distance, 0.0)
