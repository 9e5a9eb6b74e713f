"""Certified full-move optima of many problems at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from muxjax.planning import full_moves
from muxjax.planning.exact import exact
from muxjax.planning.lattice import Lattice
from muxjax.planning.problem import Plan, Problem, check_ends, check_problem
from muxjax.precision import by_device, host_array, in_threads
from muxjax.robot import Robot

_CHUNK = 16  # problems in one compiled call: their tables then stay in a core's cache
_CHUNK_ELSEWHERE = 256  # on a GPU


@dataclass(frozen=True, eq=False)
class PlanBatch:
    """Optimal costs of full-move problems that differ in start and target alone.

    Attributes:
        robot: The arm.
        common: What the problems share; its start and target are the first ones.
        starts: Displacements at the start [m].
        targets: Displacements wanted [m].
        cost: Cost of the optimum; infinite where every order passes through an undefined state.
    """

    robot: Robot
    common: Problem
    starts: Float[np.ndarray, "N SJ"]
    targets: Float[np.ndarray, "N SJ"]
    cost: Float[np.ndarray, " N"]

    def problem(self, number: int) -> Problem:
        """Problem of one row."""
        return replace(self.common, start=self.starts[number], target=self.targets[number])

    def plan(self, number: int) -> Plan:
        """Optimal plan of one row."""
        return exact(Lattice(self.robot, self.problem(number)))


def plan_batch(robot: Robot, starts: Any, targets: Any, **fields: Any) -> PlanBatch:
    """Cost of the optimum of full moves for every pair of start and target.

    Args:
        robot: The arm.
        starts: Displacements at the start [m], (N, S*J), or one start for all.
        targets: Displacements wanted [m], (N, S*J).
        **fields: Other fields of ``Problem``; not ``max_step`` nor ``world``.

    Raises:
        ValueError: A start, target or field that does not fit, a limit on steps, a term that is
            expensive, or a robot with too many states for the compiled table.
    """
    goals = host_array("targets", targets, last=robot.n_tendons)
    begins = host_array("starts", starts, last=robot.n_tendons)
    if goals.ndim != 2 or begins.ndim > 2 or (begins.ndim == 2 and len(begins) != len(goals)):
        raise ValueError(
            f"targets: must be a matrix and starts fit it, found shapes {goals.shape} and "
            f"{begins.shape}"
        )
    begins = np.broadcast_to(begins, goals.shape)
    if not len(goals):
        raise ValueError("targets: must not be empty")
    common = Problem(begins[0], goals[0], **fields)
    check_problem(robot, common)
    check_ends(robot, "starts", begins, "targets", goals)
    full = common.max_step is None and common.action_set != "splits"
    if not full or common.compiled_terms(expensive=True)[0]:
        raise ValueError("plan_batch: is for full moves without obstacles; use plan for the others")
    if not full_moves.fits(robot):
        raise ValueError(
            f"plan_batch: takes robots of at most {full_moves.MOST_TENDONS} tendons, whose servos "
            "meet one layer at an axial position"
        )
    size = by_device(_CHUNK, _CHUNK_ELSEWHERE)
    chunks = [slice(i, i + size) for i in range(0, len(goals), size)]
    parts = in_threads(lambda rows: _costs(robot, common, size, begins[rows], goals[rows]), chunks)
    return PlanBatch(robot, common, begins, goals, np.concatenate(parts))


def _costs(
    robot: Robot,
    common: Problem,
    size: int,
    starts: Float[np.ndarray, "n SJ"],
    targets: Float[np.ndarray, "n SJ"],
) -> Float[np.ndarray, " n"]:
    """A chunk, filled up with its first problem."""
    n = len(targets)
    starts, targets = (
        np.concatenate([x, np.repeat(x[:1], size - n, axis=0)]) for x in (starts, targets)
    )
    moves = np.abs(targets - starts) > common.tolerance
    unfinished = full_moves.number(moves, robot.tendons_per_segment)
    terms, weights = common.compiled_terms(expensive=False)
    healthy = np.isin(np.arange(1, robot.tendons_per_segment + 1), common.servos)
    with jax.enable_x64(True):
        ends = np.where(moves, targets, starts)
        edges = full_moves.edge_costs(robot, terms, weights, starts.T, ends.T, targets.T)
        cost = full_moves.costs_from_start(
            robot,
            edges,
            unfinished,
            np.int64(-1 if common.axial is None else common.axial - 1),
            healthy,
            np.asarray(common.action_set == "all"),
        )
        return np.asarray(cost)[:n]
