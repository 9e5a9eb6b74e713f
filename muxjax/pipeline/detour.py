"""In-between shapes: where every direct order of moves is blocked, a way around.

A lazy roadmap. Shapes are drawn near the straight interpolation of the two ends, each segment on
its own, and those that are clear become nodes. An edge is a plan with the world, which is the
expensive part: so the way that would take the least time if all its edges were free is asked for
first, counting edges whose straight line in bending runs through obstacles as longer, and an edge
that turns out blocked is never asked for again. Before a plan, all 2^(S J) states between full
moves are looked at in one batch: where the clear ones do not even connect, there is none.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool, Float

from muxjax.collision import World
from muxjax.kinematics import bending_from_configuration, configuration_from_bending
from muxjax.pipeline.swept import clearances
from muxjax.planning import METHODS, Plan, PlanningError, Problem, plan
from muxjax.planning.full_moves import MOST_TENDONS
from muxjax.planning.lattice import Lattice
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule
from muxjax.tendons import configuration_from_tendons, tendon_displacements

ROUNDS = 4  # of drawing shapes, each wider spread than the one before
SHAPES = 48  # clear ones kept a round
FIRST_SPREAD = 0.15  # [rad], of each bending component; doubles every round
_DRAWN = 8  # times as many are drawn as are kept
_BETWEEN = 7  # shapes looked at on the straight line in bending from one shape to another
_DETERRENT = 400.0  # time [s] that a line wholly in collision counts for
_START, _GOAL = 0, 1


@dataclass(frozen=True, eq=False)
class Detour:
    """A motion by way of in-between shapes; without any, it is the direct plan.

    Attributes:
        q: Configurations from the start to the target [rad].
        plans: From each to the next, the drum's position carried on.
        program: All of them as one.
        edges_asked: Plans that were tried between shapes, the direct one included.
        shapes: Clear shapes that were drawn.
    """

    q: Float[np.ndarray, "shapes dof"]
    plans: tuple[Plan, ...]
    program: Program
    edges_asked: int
    shapes: int

    @property
    def points(self) -> Float[np.ndarray, "P SJ"]:
        """Displacements after every step [m], the start first."""
        first = self.plans[0].displacements[:1]
        return np.concatenate([first, *(p.displacements[1:] for p in self.plans)])


def joined(robot: Robot, plans: tuple[Plan, ...]) -> Program:
    """Plans, each beginning where the one before it ended, as one program."""
    programs = [schedule(robot, p) for p in plans]
    return replace(
        programs[0],
        target=programs[-1].target,
        instructions=tuple(item for program in programs for item in program.instructions),
    )


def plan_around(
    robot: Robot,
    problem: Problem,
    *,
    method: str = "exact",
    seed: int = 0,
    most_edges: int = 200,
    deadline_s: float | None = None,
    options: Mapping[str, Any] | None = None,
) -> Detour:
    """A plan from start to target, by way of in-between shapes if no direct one is free.

    The same seed gives the same motion, unless the deadline ends the search.

    Args:
        robot: The arm.
        problem: Start, target, servos, and the ``world`` to stay clear of.
        method: Planner of each edge.
        seed: Of the shapes drawn.
        most_edges: Plans tried before the search gives up.
        deadline_s: Time after which it gives up [s]; none by default.
        options: Of the method.

    Raises:
        ValueError: The problem does not fit the robot, among others start or target in collision,
            or a limit below 1.
        PlanningError: No way was found; the message says which end is shut in, or that both have
            free plans to shapes that were not joined.
    """
    if most_edges < 1:
        raise ValueError(f"most_edges: must be at least 1, found {most_edges}")
    direct = plan(robot, problem, method, **(options or {}))
    if direct.status != "failed":
        return _detour(robot, (direct,), edges_asked=1, shapes=0)
    if problem.world is None:
        raise PlanningError(f"{method}: {direct.reason}")
    search = _Search(robot, problem, method, dict(options or {}), seed, most_edges)
    give_up = np.inf if deadline_s is None else time.monotonic() + deadline_s
    nodes = search.run(give_up)
    if nodes is None:
        raise PlanningError(f"no way around: {direct.reason}; {search.report()}")
    plans, axial = list[Plan](), problem.axial
    for edge in pairwise(nodes):
        found = search.ask(edge, axial)
        plans.append(search.free[edge] if found.status == "failed" else found)
        axial = int(plans[-1].axial[-1])
    return _detour(robot, tuple(plans), edges_asked=search.asked + 1, shapes=len(search.nodes) - 2)


def _detour(robot: Robot, plans: tuple[Plan, ...], *, edges_asked: int, shapes: int) -> Detour:
    ends = np.array([plans[0].problem.start, *(p.problem.target for p in plans)])
    q = np.asarray(configuration_from_tendons(robot, ends))
    return Detour(q, plans, joined(robot, plans), edges_asked, shapes)


@dataclass(eq=False)
class _Search:
    """The roadmap so far. Nodes are displacements [m]: start, target, then shapes."""

    robot: Robot
    problem: Problem
    method: str
    options: dict[str, Any]
    seed: int
    most_edges: int
    asked: int = 0
    gave_up: str = ""
    free: dict[tuple[int, int], Plan] = field(default_factory=dict)
    blocked: set[tuple[int, int]] = field(default_factory=set)

    def __post_init__(self) -> None:
        assert self.problem.world is not None
        self.world: World = self.problem.world
        self.nodes: Float[np.ndarray, "n SJ"] = np.stack([self.problem.start, self.problem.target])
        self.blocked.add((_START, _GOAL))
        self._masks = _move_masks(self.robot, self.problem.servos)

    def run(self, give_up: float) -> list[int] | None:
        """Nodes of a free way from the start to the target."""
        rng, from_goal = np.random.default_rng(self.seed), False
        for number in range(ROUNDS):
            shapes = self._draw(rng, FIRST_SPREAD * 2**number)
            self.nodes = np.concatenate([self.nodes, shapes])
            self._weight = self._least_times() + _DETERRENT * self._in_the_way()
            while (way := self._shortest()) is not None:
                unknown = [edge for edge in pairwise(way) if edge not in self.free]
                if not unknown:
                    return way
                if self.asked >= self.most_edges or time.monotonic() > give_up:
                    self.gave_up = f"gave up after {self.asked} plans"
                    return None
                # From both ends in turn: if one of them is shut in, that shows early.
                from_goal = not from_goal
                self._try(unknown[-1] if from_goal else unknown[0])
        return None

    def _draw(self, rng: np.random.Generator, spread: float) -> Float[np.ndarray, "n SJ"]:
        """Clear shapes: each segment anywhere between its two ends, and some way off that."""
        ends = bending_from_configuration(configuration_from_tendons(self.robot, self.nodes[:2]))
        begin, end = np.asarray(ends, dtype=np.float64)
        n, size = self.robot.n_segments, _DRAWN * SHAPES
        share = rng.uniform(0.0, 1.0, (size, n, 1))
        drawn = begin + share * (end - begin) + rng.normal(0.0, spread, (size, n, 2))
        theta = np.linalg.norm(drawn, axis=-1, keepdims=True)
        drawn *= np.minimum(1.0, self.robot.theta_max[:, None] / np.maximum(theta, 1e-12))
        q = np.asarray(configuration_from_bending(drawn), dtype=np.float64)
        shapes = np.asarray(tendon_displacements(self.robot, q))
        clear = clearances(self.robot, self.world, shapes)
        # Those with the most room are the likeliest to be reached, but not the only ones needed.
        roomy = np.argsort(-clear, kind="stable")[: SHAPES // 2]
        any_clear = np.setdiff1d(np.flatnonzero(clear > 0), roomy, assume_unique=True)
        kept = np.concatenate([roomy, any_clear[: SHAPES - len(roomy)]])
        return shapes[kept[clear[kept] > 0]]

    def _shortest(self) -> list[int] | None:
        """The way of least time among the edges not known to be blocked."""
        weight = self._weight.copy()
        for a, b in self.blocked:
            weight[a, b] = 0.0  # no edge, to scipy
        reached, before = scipy.sparse.csgraph.dijkstra(
            weight, indices=_START, return_predecessors=True
        )
        if not np.isfinite(reached[_GOAL]):
            return None
        way = [_GOAL]
        while way[-1] != _START:
            way.append(int(before[way[-1]]))
        return way[::-1]

    def _least_times(self) -> Float[np.ndarray, "n n"]:
        """A lower bound on the time between any two nodes [s]: visits, and the longest moves."""
        move = np.abs(self.nodes[:, None] - self.nodes[None])
        by_layer = move.reshape(*move.shape[:2], self.robot.n_segments, -1)
        moving = np.sum(by_layer > self.problem.tolerance, axis=-1)
        visits = np.sum(-(-moving // len(self.problem.servos)), axis=-1)
        motion = np.sum(np.max(by_layer, axis=-1), axis=-1) / float(self.robot.tendon_speed)
        return np.asarray(visits * float(self.robot.switch_time) + motion)

    def _in_the_way(self) -> Float[np.ndarray, "n n"]:
        """Share of the straight line in bending between two nodes that is in collision."""
        q = configuration_from_tendons(self.robot, self.nodes)
        bent = np.asarray(bending_from_configuration(q), dtype=np.float64)
        first, second = np.triu_indices(len(bent), k=1)
        share = (np.arange(1, _BETWEEN + 1) / (_BETWEEN + 1))[:, None, None, None]
        between = (1 - share) * bent[first] + share * bent[second]
        flat = between.reshape(-1, *bent.shape[1:])
        at = np.asarray(configuration_from_bending(flat), dtype=np.float64)
        drawn = np.asarray(tendon_displacements(self.robot, at))
        clear = clearances(self.robot, self.world, drawn)
        blocked = np.mean((clear < 0).reshape(_BETWEEN, -1), axis=0)
        matrix = np.zeros((len(bent), len(bent)))
        matrix[first, second] = matrix[second, first] = blocked
        return matrix

    def _try(self, edge: tuple[int, int]) -> None:
        found = None
        if self._corners_connect(*edge):
            self.asked += 1
            found = self.ask(edge, None)
        if found is None or found.status == "failed":
            self.blocked.add(edge)
        else:
            self.free[edge] = found

    def ask(self, edge: tuple[int, int], axial: int | None) -> Plan:
        """The plan from one node to another; both were judged when they were drawn."""
        start, target = self.nodes[list(edge)]
        problem = replace(self.problem, start=start, target=target, axial=axial)
        return METHODS[self.method](Lattice(self.robot, problem), **self.options)

    def _corners_connect(self, begin: int, end: int) -> bool:
        """Whether clear states between full moves lead from one node to the other at all."""
        if self.robot.n_tendons > MOST_TENDONS or self.problem.max_step is not None:
            return True
        bits = np.arange(2**self.robot.n_tendons)
        done = (bits[:, None] >> np.arange(self.robot.n_tendons)) & 1
        start, target = self.nodes[begin], self.nodes[end]
        clear = clearances(self.robot, self.world, start + done * (target - start)) >= 0
        reached = np.zeros(len(bits), dtype=bool)
        reached[0] = True
        for state in bits:  # numbers grow along every move
            if reached[state] and clear[state]:
                reached[state | self._masks[(self._masks & state) == 0]] = True
        return bool(reached[-1])

    def report(self) -> str:
        """Why nothing was found."""
        ends = []
        for end, name in ((_START, "start"), (_GOAL, "target")):
            free = sum(end in edge for edge in self.free)
            blocked = sum(end in edge for edge in self.blocked) - 1
            state = "is shut in: none" if not free else f"has free plans: {free}"
            ends.append(f"the {name} {state} of {free + blocked} plans to other shapes")
        drawn = f"{len(self.nodes) - 2} clear shapes, {self.asked} plans"
        return "; ".join([*ends, drawn, *([self.gave_up] if self.gave_up else [])])


def _move_masks(robot: Robot, servos: tuple[int, ...]) -> np.ndarray:
    """Tendons that one step may move, as bits."""
    reach: Bool[np.ndarray, "A SJ"] = robot.reach(servos)
    masks = {
        sum(1 << int(c) for c in chosen)
        for row in reach
        for size in range(1, int(row.sum()) + 1)
        for chosen in combinations(np.flatnonzero(row), size)
    }
    return np.array(sorted(masks))
