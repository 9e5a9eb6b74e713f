"""One step of the arm, and what it costs: a weighted sum of named terms (M Eq. 8, 14-15).

A term is a function ``term(robot, transition)`` of any batch of transitions, none may be negative,
and one that is not finite forbids its step. A term that needs data of its own (a world, a chain, a
fitted surrogate) is an ``equinox.Module`` with that method as ``__call__``: its arrays are traced,
so that other data of the same shapes need no other compilation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.planning.motion import (
    LEG_POINTS,
    angles_along,
    bending_angles,
    leg_time,
    relative_excess,
)
from muxjax.robot import Robot

Array = jax.Array | np.ndarray


class Transition(NamedTuple):
    """One step of the arm, as cost terms see it. Any leading batch axes."""

    before: Float[Array, "*n SJ"]  # displacements [m]
    after: Float[Array, "*n SJ"]  # [m]
    repositions: Float[Array, "*n"]  # 1 where the axial motor moves first, else 0
    wait: Float[Array, "*n"]  # time spent at `before` until the tendons move [s]: t_sw, or the
    # engagement alone for a first step at the axial position where the drum stands, or 0
    duration: Float[Array, "*n"]  # of the leg, until the last tendon arrives [s]
    goal: Float[Array, "*#n S"]  # bending angles of the target [rad]
    theta_before: Float[Array, "*n S"]  # bending angles [rad]
    theta_after: Float[Array, "*n S"]
    theta_along: Float[Array, "*n points S"]  # at the midpoints of 8 equal parts of the leg
    excess_before: Float[Array, "*n"]  # relative overshoot of all segments together
    excess_mean: Float[Array, "*n"]  # of it at those points
    excess_peak: Float[Array, "*n"]


Term = Callable[[Robot, Transition], Float[Array, "*n"]]


def travel(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Sum of |dl| [m] (M Eq. 8).

    Column by column here and in ``bending``: compiled tables then need no array of all tendons.
    """
    each = (jnp.abs(t.after[..., c] - t.before[..., c]) for c in range(robot.n_tendons))
    return sum(each, start=jnp.zeros_like(t.wait))


def bending(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """|theta(l^k)|^2 [rad^2] at the end of the step (M Eq. 8)."""
    each = (t.theta_after[..., i] ** 2 for i in range(robot.n_segments))
    return sum(each, start=jnp.zeros_like(t.wait))


def switches(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Axial repositionings, the first one included (M Eq. 8)."""
    return t.repositions


def time(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Execution time [s] (M Eq. 14)."""
    return t.wait + t.duration


def overshoot(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Relative overshoot integrated over waiting and motion [s] (M Eq. 15, made additive)."""
    return t.wait * t.excess_before + t.duration * t.excess_mean


def overshoot_peak(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Greatest relative overshoot on the leg, all segments together; the sum over legs counts.

    The peak of a whole plan (M Eq. 15b) is a maximum and does not add up. The sum over legs does;
    at the points looked at (8 on a leg, and its end) it is never below the maximum, and both are
    zero together.
    """
    return jnp.maximum(t.excess_peak, relative_excess(t.theta_after, t.goal))


TERMS: Mapping[str, Term] = {
    "travel": travel,
    "bending": bending,
    "switches": switches,
    "time": time,
    "overshoot": overshoot,
    "overshoot_peak": overshoot_peak,
}


@dataclass(frozen=True, eq=False)
class ByIdentity:
    """A term with arrays of its own, hashable: equal only to itself."""

    term: Term

    def __call__(self, robot: Robot, t: Transition) -> Float[Array, "*n"]:
        """The term's value."""
        return self.term(robot, t)


class Traced(eqx.Module):
    """A function in a form that compiled ones take: its arrays traced, all else static."""

    arrays: Any
    rest: Any = eqx.field(static=True)

    def __call__(self, *args: Any) -> Any:
        """The function's value."""
        return eqx.combine(self.arrays, self.rest)(*args)


CostTerm = Traced  # called with (robot, transition)


def traced(function: Callable[..., Any]) -> Traced:
    """Separate what is traced in a function from what selects the compiled code."""
    return Traced(*eqx.partition(function, _is_traced))


def _is_traced(leaf: object) -> bool:
    return isinstance(leaf, (jax.Array, np.ndarray, np.generic, float))


def check_terms(robot: Robot, terms: Mapping[str, Term]) -> None:
    """Look at the shapes that a user's terms return; nothing is computed.

    A term that forgets an axis would be spread over the batch, and plans be certified for another
    cost than was meant. Each is traced once; after that the compiler's cache knows it.

    Raises:
        ValueError: A term that is no function, does not return one value for each transition, or
            needs the numbers in its arrays.
    """
    for name, term in terms.items():
        where = f"Problem.terms[{name!r}]"
        if not callable(term):
            raise ValueError(f"{where}: must be a function of (robot, transition), found {term!r}")
        for batch in ((3,), (2, 5)):  # planners ask in batches of one axis and of more
            found = _traced_shape(robot, term, where, batch)
            if not isinstance(found, jax.ShapeDtypeStruct):
                raise ValueError(f"{where}: must return one array, found {type(found).__name__}")
            if found.shape != batch:
                raise ValueError(
                    f"{where}: returned shape {found.shape}, must be one value for each "
                    f"transition, shape {batch}; sum over axis=-1"
                )


def _traced_shape(robot: Robot, term: Term, where: str, batch: tuple[int, ...]) -> Any:
    try:
        with jax.enable_x64(True):
            return _value.eval_shape(robot, traced(term), transition_shapes(robot, batch))
    except (
        jax.errors.TracerArrayConversionError,
        jax.errors.TracerIntegerConversionError,
        jax.errors.ConcretizationTypeError,
    ):
        raise ValueError(
            f"{where}: needs the numbers in its arrays, which are not known while it is compiled; "
            "write it with jax.numpy (jax.numpy.where for an if), not with numpy, math or float()"
        ) from None
    except Exception as error:
        error.add_note(f"in {where}, asked about transitions of shape {batch}")
        raise


@jax.jit
def _value(robot: Robot, term: Traced, t: Transition) -> Any:
    return term(robot, t)


def transition_shapes(robot: Robot, batch: tuple[int, ...]) -> Transition:
    """The shapes of what ``step`` makes of a batch of moves towards one goal."""

    def numbers(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, np.float64)

    displacements, each = numbers(*batch, robot.n_tendons), numbers(*batch)
    angles = numbers(*batch, robot.n_segments)
    return Transition(
        before=displacements,
        after=displacements,
        repositions=each,
        wait=each,
        duration=each,
        goal=numbers(robot.n_segments),
        theta_before=angles,
        theta_after=angles,
        theta_along=numbers(*batch, LEG_POINTS, robot.n_segments),
        excess_before=each,
        excess_mean=each,
        excess_peak=each,
    )


def is_expensive(term: Term) -> bool:
    """Whether planners should ask a term only about steps that they would otherwise take.

    Such a term says so by an attribute ``expensive = True``. Nothing is lost: no term is negative,
    so until it is asked it counts as zero, which is a lower bound.
    """
    return bool(getattr(term, "expensive", False))


def step(
    robot: Robot,
    displacements: Float[Array, "*#n SJ"],
    move: Float[Array, "*n SJ"],
    repositions: Float[Array, "*n"],
    engages: Float[Array, "*n"],
    goal: Float[Array, "*#n S"],
) -> Transition:
    """The one transition rule: reposition and engage as needed, then move the tendons.

    Args:
        robot: The arm.
        displacements: Before the step [m]; axes of size 1 are shared by the moves along them.
        move: Displacement of each tendon [m].
        repositions: 1 where the axial motor moves first, else 0.
        engages: 1 where clutches engage at the position where the drum already stands, else 0.
        goal: Bending angles of the target [rad].
    """
    after = displacements + move
    theta_before = bending_angles(robot, displacements)
    theta_before = jnp.broadcast_to(theta_before, (*after.shape[:-1], theta_before.shape[-1]))
    before = jnp.broadcast_to(displacements, after.shape)
    theta_along = angles_along(robot, before, after)
    excess_along = relative_excess(theta_along, goal[..., None, :])
    return Transition(
        before=before,
        after=after,
        repositions=repositions,
        wait=waiting_time(robot, repositions, engages),
        duration=leg_time(robot, move),
        goal=goal,
        theta_before=theta_before,
        theta_after=bending_angles(robot, after),
        theta_along=theta_along,
        excess_before=relative_excess(theta_before, goal),
        excess_mean=jnp.mean(excess_along, axis=-1),
        excess_peak=jnp.max(excess_along, axis=-1),
    )


def waiting_time(
    robot: Robot, repositions: Float[Array, "*n"], engages: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Seconds until the tendons move (M Eq. 14's t_sw; less where the drum need not turn)."""
    return repositions * robot.switch_time + engages * robot.engage_time


def transition_cost(
    robot: Robot,
    terms: tuple[Term, ...],
    weights: Float[Array, " T"],
    transition: Transition,
) -> Float[Array, "*n"]:
    """Weighted sum of the terms over one transition."""
    return sum(
        (weights[i] * term(robot, transition) for i, term in enumerate(terms)),
        start=jnp.zeros_like(transition.repositions),
    )
