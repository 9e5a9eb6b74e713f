"""Planners: which tendons move, in which order (M Eq. 7-9, 13, Algorithm 1)."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from muxjax.planning.baselines import greedy, reverse, sequential
from muxjax.planning.batch import PlanBatch, plan_batch
from muxjax.planning.beamstep import beamstep, beamstep_printed
from muxjax.planning.exact import exact
from muxjax.planning.front import FrontPoint, front
from muxjax.planning.lattice import Lattice
from muxjax.planning.learned import learned
from muxjax.planning.problem import (
    TERMS,
    Plan,
    PlanningError,
    Problem,
    Transition,
    check_problem,
)
from muxjax.planning.tension import Tension
from muxjax.precision import in_threads
from muxjax.robot import Robot

METHODS: Mapping[str, Callable[..., Plan]] = {
    "exact": exact,
    "beamstep": beamstep,
    "beamstep_printed": beamstep_printed,
    "learned": learned,
    "sequential": sequential,
    "reverse": reverse,
    "greedy": greedy,
}

__all__ = [
    "METHODS",
    "TERMS",
    "FrontPoint",
    "Plan",
    "PlanBatch",
    "PlanningError",
    "Problem",
    "Tension",
    "Transition",
    "front",
    "plan",
    "plan_batch",
    "plan_each",
]


def plan(robot: Robot, problem: Problem, method: str = "exact", **options: Any) -> Plan:
    """Plan the steps from ``problem.start`` to ``problem.target``.

    Args:
        robot: The arm.
        problem: Start, target, available servos and objective.
        method: "exact" (certified optimum), "beamstep" (layered), "beamstep_printed" (M Algorithm
            1 to the letter), "learned" (layered, in the order of a value network), "sequential",
            "reverse" or "greedy" (M Eq. 13).
        **options: Options of the method, such as ``width`` of BeamStep.

    Returns:
        The plan; a search that found none says so in ``status`` and ``reason``.

    Raises:
        ValueError: Unknown method or option, or a problem that does not fit the robot; the
            message names the field and the limit.
        PlanningError: "exact" on a lattice that does not fit in its memory.
    """
    if method not in METHODS:
        raise ValueError(f"method: must be one of {', '.join(METHODS)}; found {method!r}")
    unknown = set(options) - set(inspect.signature(METHODS[method]).parameters)
    if unknown:
        raise ValueError(f"{method}: has no option {', '.join(sorted(unknown))}")
    check_problem(robot, problem)
    return METHODS[method](Lattice(robot, problem), **options)


def plan_each(
    robot: Robot, problems: Iterable[Problem], method: str = "beamstep", **options: Any
) -> list[Plan]:
    """``plan`` for many problems on all cores, in their order.

    Problems may differ in everything; those of one robot share the compiled search. For the costs
    of full moves alone, ``plan_batch`` is faster.

    Raises:
        ValueError: See ``plan``.
        PlanningError: See ``plan``.
    """
    return in_threads(lambda problem: plan(robot, problem, method, **options), problems)
