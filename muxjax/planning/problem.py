"""The planning problem: transition rule, cost terms and the Plan (M Eq. 7-9, MODEL.md section 5).

A state is the tendon displacements and the last axial position. A step names an axial position
and explicit displacements of tendons that the available servos reach there; planners differ only
in which steps they choose. The cost of a step is a weighted sum of named terms, each a small
function of the transition.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from muxjax.config import Sourced, Strict, load_yaml, resolve
from muxjax.kinematics import check_configuration
from muxjax.planning.motion import bending_angles, leg_overshoot, leg_time, relative_excess
from muxjax.precision import host_array
from muxjax.robot import Robot
from muxjax.tendons import check_displacements, configuration_from_tendons

Array = jax.Array | np.ndarray


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and math.isfinite(value)


class PlanningError(RuntimeError):
    """A planner that cannot do what was asked; the message says why and what would work."""


class Transition(NamedTuple):
    """One step of the arm, as cost terms see it. Any leading batch axes."""

    before: Float[Array, "*n SJ"]  # displacements [m]
    after: Float[Array, "*n SJ"]  # [m]
    repositions: Float[Array, "*n"]  # 1 where the axial motor moves first, else 0
    wait: Float[Array, "*n"]  # time spent at `before` until the tendons move [s]: t_sw, or the
    # engagement alone for a first step at the axial position where the drum stands, or 0
    goal: Float[Array, "*#n S"]  # bending angles of the target [rad]


Term = Callable[[Robot, Transition], Float[Array, "*n"]]


def travel(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Sum of |dl| [m] (M Eq. 8)."""
    return jnp.sum(jnp.abs(t.after - t.before), axis=-1)


def bending(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """|theta(l^k)|^2 [rad^2] at the end of the step (M Eq. 8)."""
    return jnp.sum(bending_angles(robot, t.after) ** 2, axis=-1)


def switches(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Axial repositionings, the first one included (M Eq. 8)."""
    return t.repositions


def time(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Execution time [s] (M Eq. 14)."""
    return t.wait + leg_time(robot, t.after - t.before)


def overshoot(robot: Robot, t: Transition) -> Float[Array, "*n"]:
    """Relative overshoot integrated over waiting and motion [s] (M Eq. 15, made additive)."""
    waiting = t.wait * relative_excess(robot, t.before, t.goal)
    return waiting + leg_overshoot(robot, t.before, t.after, t.goal)


TERMS: Mapping[str, Term] = {
    "travel": travel,
    "bending": bending,
    "switches": switches,
    "time": time,
    "overshoot": overshoot,
}


class PlannerConfig(Strict):
    """A preset: the weights of the cost terms."""

    file_schema: Literal["muxjax/planner/1"] = Field(alias="schema")
    name: str
    weights: dict[str, Sourced[Annotated[float, Field(ge=0)]]]


def preset_weights(name_or_path: str) -> dict[str, float]:
    """Weights of a shipped preset by name, or of a YAML file by path.

    Raises:
        ConfigError: No such preset, or a file with wrong values.
    """
    preset = load_yaml(PlannerConfig, resolve(name_or_path, "planners"))
    return {name: weight.value for name, weight in preset.weights.items()}


@dataclass(frozen=True, eq=False)
class Problem:
    """A planning problem. Axial positions and servos count from 1.

    Attributes:
        start: Displacements now [m], S*J of them; any array-like, kept as a float64 array.
        target: Displacements wanted [m], likewise.
        servos: Available servos.
        max_step: Greatest displacement of a tendon in one step [m], Delta_max; None = no limit.
        tolerance: The target is reached when no tendon is further off than this [m].
        preset: Name of a shipped set of weights, or the path of a YAML file.
        weights: Weights by term name instead of a preset.
        terms: Your own cost terms by name, beside those of ``TERMS``; none may be negative, and
            one that is not finite forbids its step.
        axial: Axial position now, if known; otherwise the first step repositions.
        action_set: ``"subsets"``: any non-empty subset of the tendons that the servos reach at an
            axial position; ``"all"``: all of them that still have to move (the paper's).

    Raises:
        ValueError: A field that no robot could satisfy. What depends on the robot is checked by
            ``plan``.
    """

    start: Any
    target: Any
    servos: tuple[int, ...] = (1, 2, 3)
    max_step: float | None = None
    tolerance: float = 1e-5
    preset: str = "paper"
    weights: Mapping[str, float] | None = None
    terms: Mapping[str, Term] = field(default_factory=dict)
    axial: int | None = None
    action_set: str = "subsets"

    def __post_init__(self) -> None:
        for name in ("start", "target"):
            value = host_array(f"Problem.{name}", getattr(self, name))
            if value.ndim != 1:
                raise ValueError(f"Problem.{name}: must be a vector, found shape {value.shape}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "servos", self._checked_servos())
        if not (_is_number(self.tolerance) and self.tolerance > 0):
            raise ValueError(f"Problem.tolerance: must be above 0, found {self.tolerance!r}")
        if self.max_step is not None and not (
            _is_number(self.max_step) and self.max_step > self.tolerance
        ):
            raise ValueError(
                f"Problem.max_step: must be finite and above the tolerance {self.tolerance:g} m, "
                f"or None, found {self.max_step!r}"
            )
        if self.axial is not None and not isinstance(self.axial, (int, np.integer)):
            raise ValueError(f"Problem.axial: must be a whole number or None, found {self.axial!r}")
        if self.action_set not in ("subsets", "all"):
            raise ValueError(
                f"Problem.action_set: must be 'subsets' or 'all', found {self.action_set!r}"
            )
        self._check_weights()

    def _checked_servos(self) -> tuple[int, ...]:
        servos: tuple[object, ...] = ()
        if isinstance(self.servos, Iterable):
            servos = tuple(self.servos)
        whole = all(isinstance(s, (int, np.integer)) for s in servos)
        if not whole or not servos or len(set(servos)) < len(servos):
            raise ValueError(
                f"Problem.servos: must be a non-empty set of servos, found {self.servos!r}"
            )
        return tuple(int(s) for s in self.servos)

    def _check_weights(self) -> None:
        if not isinstance(self.preset, str):
            raise ValueError(f"Problem.preset: must be a name or a path, found {self.preset!r}")
        known = {**TERMS, **self.terms}
        for name, weight in self.cost_weights.items():
            if name not in known:
                raise ValueError(f"Problem.weights: no term {name!r} among {sorted(known)}")
            if not (_is_number(weight) and weight >= 0):
                raise ValueError(f"Problem.weights[{name!r}]: must be at least 0, found {weight!r}")
        if not self.cost_weights:
            raise ValueError("Problem.weights: needs at least one term")
        unweighted = set(self.terms) - set(self.cost_weights)
        if unweighted:
            raise ValueError(f"Problem.terms: {sorted(unweighted)} have no entry in weights")

    @cached_property
    def cost_weights(self) -> Mapping[str, float]:
        """Weight of each cost term."""
        weights = preset_weights(self.preset) if self.weights is None else dict(self.weights)
        return MappingProxyType(weights)

    @property
    def weighted_terms(self) -> tuple[tuple[str, Term], ...]:
        """The cost terms in a fixed order, for compiled functions."""
        known = {**TERMS, **self.terms}
        return tuple((name, known[name]) for name in sorted(self.cost_weights))

    @property
    def weight_vector(self) -> Float[np.ndarray, " T"]:
        """Weights in the order of ``weighted_terms``."""
        return np.array([self.cost_weights[name] for name, _ in self.weighted_terms])


class Plan(eqx.Module):
    """A sequence of steps.

    A plan that reaches the target has ``status`` "optimal" (certified for its action set) or
    "feasible". Otherwise ``status`` is "failed", ``cost`` is infinite and ``reason`` says why.
    """

    displacements: Float[np.ndarray, "states SJ"]  # [m], K + 1 of them, start to end
    axial: Int[np.ndarray, " K"]  # axial position of each step, from 1
    cost: float  # weighted sum over the steps
    lower_bound: float  # no plan of this action set costs less
    expansions: int  # states whose steps were evaluated
    problem: Problem = eqx.field(static=True)
    fingerprint: str = eqx.field(static=True)  # of the robot it was made for
    method: str = eqx.field(static=True)
    status: Literal["optimal", "feasible", "failed"] = eqx.field(static=True)
    reason: str = eqx.field(static=True, default="")

    @property
    def gap(self) -> float:
        """Certified relative distance to the optimum: (cost - lower_bound) / cost.

        0 for a plan that costs nothing, 1 for one that failed.
        """
        if not math.isfinite(self.cost):
            return 1.0
        return (self.cost - self.lower_bound) / self.cost if self.cost > 0 else 0.0

    @property
    def n_steps(self) -> int:
        """K."""
        return len(self.axial)


def check_problem(robot: Robot, problem: Problem) -> None:
    """Everything about a problem that depends on the robot.

    Raises:
        ValueError: Start or target of wrong length or beyond a tendon's range, a target bent
            beyond a segment's limit, an unknown servo or axial position.
    """
    check_displacements(robot, "Problem.start", problem.start)
    check_displacements(robot, "Problem.target", problem.target)
    bent = configuration_from_tendons(robot, problem.target)
    if not np.isfinite(bent).all():
        raise ValueError("Problem.target: tendons are wound in by more than a segment's length")
    try:
        check_configuration(robot, bent)
    except ValueError as error:
        raise ValueError(f"Problem.target: {error}") from None
    n_axial, n_servos = robot.axial_map.shape
    for servo in problem.servos:
        if not 1 <= servo <= n_servos:
            raise ValueError(f"Problem.servos: the robot has servos 1 to {n_servos}, found {servo}")
    if problem.axial is not None and not 1 <= problem.axial <= n_axial:
        raise ValueError(
            f"Problem.axial: the robot has positions 1 to {n_axial}, found {problem.axial}"
        )


def clipped_move(
    displacements: Float[Array, "*n SJ"],
    target: Float[Array, " SJ"],
    chosen: Float[Array, "*n SJ"],
    max_step: Float[Array, ""] | float,
) -> Float[Array, "*n SJ"]:
    """clip(l* - l, -d_max, d_max) for the chosen tendons, 0 for the others (MODEL.md section 5)."""
    return jnp.clip(target - displacements, -max_step, max_step) * chosen


def step(
    robot: Robot,
    displacements: Float[Array, "*n SJ"],
    move: Float[Array, "*n SJ"],
    repositions: Float[Array, "*n"],
    engages: Float[Array, "*n"],
    goal: Float[Array, "*#n S"],
) -> Transition:
    """The one transition rule: reposition and engage as needed, then move the tendons.

    Args:
        robot: The arm.
        displacements: Before the step [m].
        move: Displacement of each tendon [m].
        repositions: 1 where the axial motor moves first, else 0.
        engages: 1 where clutches engage at the position where the drum already stands, else 0.
        goal: Bending angles of the target [rad].
    """
    return Transition(
        before=displacements,
        after=displacements + move,
        repositions=repositions,
        wait=repositions * robot.switch_time + engages * robot.engage_time,
        goal=goal,
    )


def transition_cost(
    robot: Robot,
    terms: tuple[tuple[str, Term], ...],
    weights: Float[Array, " T"],
    transition: Transition,
) -> Float[Array, "*n"]:
    """Weighted sum of the terms over one transition."""
    return sum(
        (weights[i] * term(robot, transition) for i, (_, term) in enumerate(terms)),
        start=jnp.zeros_like(transition.repositions),
    )
