"""The planning problem and the Plan (M Eq. 7-9, MODEL.md section 5).

A state is the tendon displacements and the last axial position. A step names an axial position
and explicit displacements of tendons that the available servos reach there; planners differ only
in which steps they choose. The cost of a step is a weighted sum of named terms (``terms.py``).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from muxjax.collision import World
from muxjax.config import Sourced, Strict, load_yaml, resolve
from muxjax.kinematics import check_configuration
from muxjax.planning.tension import Tension
from muxjax.planning.terms import (
    TERMS,
    ByIdentity,
    CostTerm,
    Term,
    Transition,
    check_terms,
    is_expensive,
    step,
    traced,
)
from muxjax.planning.world import Clearance, Collision, clearance_of
from muxjax.precision import host_array
from muxjax.robot import Robot
from muxjax.tendons import check_displacements, configuration_from_tendons

ACTION_SETS = ("subsets", "all", "multistep", "splits")
ASSUMED_TENSION = Tension()  # unless a problem brings its own; one object compiles once
COLLISION = "collision"  # the name under which a world's hard term stands among the weights

__all__ = ["TERMS", "Plan", "PlanningError", "Problem", "Term", "Transition", "step"]


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and math.isfinite(value)


class PlanningError(RuntimeError):
    """A planner that cannot do what was asked; the message says why and what would work."""


class PlannerConfig(Strict):
    """A preset: the weights of the cost terms, and the value network that "learned" takes."""

    file_schema: Literal["muxjax/planner/1"] = Field(alias="schema")
    name: str
    weights: dict[str, Sourced[Annotated[float, Field(ge=0)]]]
    checkpoint: str | None = None  # by default the one with the robot's name


def load_preset(name_or_path: str) -> PlannerConfig:
    """A shipped preset by name, or a YAML file by path.

    Raises:
        ConfigError: No such preset, or a file with wrong values.
    """
    path = resolve(name_or_path, "planners")
    return _preset_of_file(path, path.stat().st_mtime_ns)


@lru_cache
def _preset_of_file(path: Path, changed: int) -> PlannerConfig:
    """A file as it was when it was last changed; reading it takes longer than most plans."""
    del changed  # part of the key only
    return load_yaml(PlannerConfig, path)


def preset_weights(name_or_path: str) -> dict[str, float]:
    """Weights of a preset."""
    return {name: weight.value for name, weight in load_preset(name_or_path).weights.items()}


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
        terms: Your own cost terms by name, beside those of ``TERMS``; each gives one value for each
            transition, none may be negative, and one that is not finite forbids its step.
        world: Obstacles. A step that passes through a collision is then forbidden, and the term
            "clearance" (``world.Clearance``) may have a weight.
        axial: Axial position now, if known; otherwise the first step repositions.
        action_set: Moves are towards the target, and a step moves, at an axial position,
            ``"subsets"``: any non-empty subset of the tendons that the servos reach there, each by
            one step of the lattice; ``"all"``: all of them that still have to move (the paper's);
            ``"multistep"``: any subset, each tendon by any number of its remaining steps, in one
            straight motion;
            ``"splits"``: likewise without ``max_step``; only the longest tendon of a layer may
            stop halfway, where it has gone, or has still to go, as far as another one of the
            layer. Servos that wind side by side then lose no time.
            In all but the second a tendon may be visited more than once.

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
    world: World | None = None

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
        if self.action_set not in ACTION_SETS:
            raise ValueError(
                f"Problem.action_set: must be one of {', '.join(ACTION_SETS)}, "
                f"found {self.action_set!r}"
            )
        if self.action_set == "splits" and self.max_step is not None:
            raise ValueError("Problem.max_step: must be None with action_set 'splits'")
        if not isinstance(self.world, World | None):
            raise ValueError(f"Problem.world: must be a World or None, found {self.world!r}")
        self._check_weights()

    def _checked_servos(self) -> tuple[int, ...]:
        servos: tuple[object, ...] = ()
        if isinstance(self.servos, Iterable):
            servos = tuple(self.servos)
        whole = all(isinstance(s, (int, np.integer)) for s in servos)
        if not whole or not servos:
            raise ValueError(
                f"Problem.servos: must be a non-empty set of servos, found {self.servos!r}"
            )
        for servo in servos:
            if servos.count(servo) > 1:
                raise ValueError(
                    f"Problem.servos: servo {servo} is named twice, found {self.servos!r}"
                )
        return tuple(int(s) for s in self.servos)

    def _check_weights(self) -> None:
        if not isinstance(self.preset, str):
            raise ValueError(f"Problem.preset: must be a name or a path, found {self.preset!r}")
        known = self._known_terms
        for name, weight in self.cost_weights.items():
            if name not in known:
                hint = "; it needs a world" if name == "clearance" else ""
                raise ValueError(f"Problem.weights: no term {name!r} among {sorted(known)}{hint}")
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
        if self.world is not None:
            weights[COLLISION] = 1.0  # of a term that is zero or infinite
        return MappingProxyType(weights)

    @property
    def checkpoint(self) -> str | None:
        """Value network that the preset names."""
        return load_preset(self.preset).checkpoint if self.weights is None else None

    @cached_property
    def _known_terms(self) -> Mapping[str, Term]:
        of_world: dict[str, Term] = {}
        if self.world is not None:
            of_world = {"clearance": Clearance(self.world), COLLISION: Collision(self.world)}
        return {**TERMS, "tension": ASSUMED_TENSION, **of_world, **self.terms}

    @cached_property
    def weighted_terms(self) -> tuple[tuple[str, Term], ...]:
        """The cost terms in a fixed order, hashable for compiled functions."""
        chosen = ((name, self._known_terms[name]) for name in sorted(self.cost_weights))
        return tuple(
            (name, ByIdentity(t) if isinstance(t, eqx.Module) else t) for name, t in chosen
        )

    @property
    def weight_vector(self) -> Float[np.ndarray, " T"]:
        """Weights in the order of ``weighted_terms``."""
        return np.array([self.cost_weights[name] for name, _ in self.weighted_terms])

    def compiled_terms(
        self, *, expensive: bool | None = None, without: Collection[str] = ()
    ) -> tuple[tuple[CostTerm, ...], Float[np.ndarray, " T"]]:
        """Terms as compiled functions take them, and their weights.

        Args:
            expensive: Those that are, or are not, expensive; by default both.
            without: Names of terms to leave out.
        """
        chosen = [
            name
            for name in sorted(self.cost_weights)
            if name not in without and expensive in (None, is_expensive(self._known_terms[name]))
        ]
        terms = tuple(traced(self._known_terms[name]) for name in chosen)
        return terms, np.array([self.cost_weights[name] for name in chosen])


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
    action_set: str = eqx.field(static=True, default="subsets")  # what status and bound are for

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
        ValueError: Start or target of wrong length, beyond a tendon's range or in collision, a
            target bent beyond a segment's limit, an unknown servo or axial position, or a term
            that does not give one value for each transition.
    """
    check_ends(robot, "Problem.start", problem.start, "Problem.target", problem.target)
    n_axial, n_servos = robot.axial_map.shape
    for servo in problem.servos:
        if not 1 <= servo <= n_servos:
            raise ValueError(f"Problem.servos: the robot has servos 1 to {n_servos}, found {servo}")
    if problem.axial is not None and not 1 <= problem.axial <= n_axial:
        raise ValueError(
            f"Problem.axial: the robot has positions 1 to {n_axial}, found {problem.axial}"
        )
    check_own_terms(robot, problem)
    if problem.world is not None:
        _check_clear(robot, problem, problem.world)


def check_own_terms(robot: Robot, problem: Problem) -> None:
    """Whether each of a problem's own terms gives one value for each transition.

    Raises:
        ValueError: One does not; see ``terms.check_terms``.
    """
    # The shipped class is known to be right, and takes most of a second to trace.
    own = {name: term for name, term in problem.terms.items() if type(term) is not Tension}
    check_terms(robot, own)


def check_ends(robot: Robot, start_name: str, start: Any, target_name: str, target: Any) -> None:
    """Starts and targets, one or many, that the robot can hold.

    Raises:
        ValueError: See ``check_problem``.
    """
    check_displacements(robot, start_name, start)
    check_displacements(robot, target_name, target)
    bent = configuration_from_tendons(robot, target)
    if not np.isfinite(bent).all():
        raise ValueError(f"{target_name}: tendons are wound in by more than a segment's length")
    try:
        check_configuration(robot, bent)
    except ValueError as error:
        raise ValueError(f"{target_name}: {error}") from None


def _check_clear(robot: Robot, problem: Problem, world: World) -> None:
    for name in ("start", "target"):
        distance = clearance_of(robot, getattr(problem, name), world)
        if not distance >= 0.0:
            raise ValueError(
                f"Problem.{name}: the arm is {-1e3 * distance:.3g} mm deep in an obstacle or itself"
            )
