"""BeamStep (M Algorithm 1), in the layered reading and as printed (MODEL.md section 5)."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.baselines import greedy, reverse, sequential
from muxjax.planning.bounds import AdmissibleBound
from muxjax.planning.lattice import Lattice
from muxjax.planning.problem import Plan
from muxjax.planning.replay import Step, failed, replay

ValueFunction = Callable[
    [Float[np.ndarray, "N SJ"], Int[np.ndarray, " N"]], Float[np.ndarray, " N"]
]
"""Estimated cost to go of states: displacements [m] and axial position (from 1, 0 = unknown)."""


@dataclass(frozen=True)
class _Level:
    """Partial plans of equal length; arrays with a row each."""

    remaining: Int[np.ndarray, "N SJ"]
    stop: Int[np.ndarray, " N"]
    cost: Float[np.ndarray, " N"]
    parent: Int[np.ndarray, " N"]  # row in the level above
    moves: Bool[np.ndarray, "N SJ"]  # tendons moved by the last step

    def take(self, rows: Int[np.ndarray, " M"]) -> _Level:
        return _Level(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def beamstep(lattice: Lattice, *, width: int = 64, value_fn: ValueFunction | None = None) -> Plan:
    """Level-synchronous beam search with deduplication and a certified gap.

    The baselines' plans are the first incumbents, so the result is never worse than they are. The
    lower bound is the least cost so far plus admissible bound among all that was cut off.

    Args:
        lattice: The problem on the robot.
        width: Partial plans kept at each length, B.
        value_fn: Orders the plans of a level instead of the admissible bound; it enters neither
            the pruning nor the certificate.

    Raises:
        ValueError: A width below 1.
    """
    if not isinstance(width, int) or width < 1:
        raise ValueError(f"width: must be a whole number, at least 1, found {width!r}")
    bound = AdmissibleBound(lattice)
    incumbent = min((rule(lattice) for rule in (sequential, reverse, greedy)), key=lambda p: p.cost)
    best_cost, best_steps = incumbent.cost, None
    cut_off, expansions = float("inf"), 0
    levels = [_root(lattice)]
    while levels[-1].remaining.any():
        expansions += len(levels[-1].cost)
        level = _deduplicated(_children(lattice, levels[-1], first=len(levels) == 1))
        done = ~level.remaining.any(axis=1)
        if done.any() and level.cost[done].min() < best_cost:
            best_cost = float(level.cost[done].min())
            best_steps = _trace(
                [*levels, level], int(np.argmin(np.where(done, level.cost, np.inf)))
            )
        promise = level.cost + bound(level.remaining, level.stop)
        hopeful = np.flatnonzero(~done & (promise < best_cost))
        order = promise if value_fn is None else level.cost + _values(lattice, level, value_fn)
        ranked = hopeful[np.argsort(order[hopeful], kind="stable")]
        cut_off = min(cut_off, float(np.min(promise[ranked[width:]], initial=np.inf)))
        levels.append(level.take(ranked[:width]))
    optimal = cut_off >= best_cost
    if best_steps is None and incumbent.status == "failed":
        return replace(incumbent, method="beamstep", expansions=expansions)
    if best_steps is None:
        return replace(
            incumbent,
            method="beamstep",
            lower_bound=min(best_cost, cut_off),
            expansions=expansions,
            status="optimal" if optimal else "feasible",
        )
    return replay(
        lattice,
        best_steps,
        method="beamstep",
        lower_bound=cut_off,
        expansions=expansions,
        optimal=optimal,
    )


def _root(lattice: Lattice) -> _Level:
    return _Level(
        remaining=lattice.steps[None],
        stop=np.array([lattice.start_stop]),
        cost=np.zeros(1),
        parent=np.zeros(1, dtype=np.int64),
        moves=np.zeros((1, len(lattice.steps)), dtype=bool),
    )


def _children(lattice: Lattice, level: _Level, *, first: bool) -> _Level:
    """Every possible step from every plan of a level; ``first`` if these plans are still empty."""
    stops, _ = lattice.actions
    possible, moves = lattice.expand(level.remaining)
    row, action = np.nonzero(possible)
    moved, stop = moves[row, action], stops[action]
    both = lattice.costs(level.remaining[row], moved, first=first)
    return _Level(
        remaining=level.remaining[row] - moved,
        stop=stop,
        cost=level.cost[row] + np.where(stop == level.stop[row], both[:, 0], both[:, 1]),
        parent=row,
        moves=moved,
    )


def _deduplicated(level: _Level) -> _Level:
    """The cheapest plan to each state."""
    by_cost = np.argsort(level.cost, kind="stable")
    states = np.column_stack([level.remaining, level.stop])[by_cost]
    keys = np.ascontiguousarray(states).view(np.dtype((np.void, states.itemsize * states.shape[1])))
    _, first = np.unique(keys.ravel(), return_index=True)
    return level.take(by_cost[np.sort(first)])


def _values(lattice: Lattice, level: _Level, value_fn: ValueFunction) -> Float[np.ndarray, " N"]:
    axial = np.where(level.stop >= 0, lattice.axial_of(level.stop), 0)
    return value_fn(lattice.displacements(level.remaining), axial)


def _trace(levels: list[_Level], row: int) -> list[Step]:
    steps: list[Step] = []
    for level in reversed(levels[1:]):
        steps.append(Step(int(level.stop[row]), level.moves[row]))
        row = int(level.parent[row])
    return steps[::-1]


@dataclass(frozen=True)
class _Node:
    """A partial plan of the printed algorithm."""

    remaining: Int[np.ndarray, " SJ"]
    stop: int
    cost: float
    steps: tuple[Step, ...]


def beamstep_printed(lattice: Lattice, *, width: int = 64, max_expansions: int = 100_000) -> Plan:
    """Algorithm 1 to the letter: pop the cheapest partial plan, keep the B cheapest in the heap.

    That is a truncated uniform-cost search: it favours short partial plans and may discard every
    one that leads to a good end, so it has no certificate beyond the bound at the start. A set of
    tendons is, as in the paper, all that the available servos reach (MODEL.md section 5), whatever
    the problem's action set.

    Args:
        lattice: The problem on the robot.
        width: Heap size B after each truncation.
        max_expansions: Pops after which the search gives up and says so.

    Raises:
        ValueError: A width below 1.
    """
    if not isinstance(width, int) or width < 1:
        raise ValueError(f"width: must be a whole number, at least 1, found {width!r}")
    if lattice.problem.action_set != "all":
        lattice = Lattice(lattice.robot, replace(lattice.problem, action_set="all"))
    tie = count()
    heap = [(0.0, next(tie), _Node(lattice.steps, lattice.start_stop, 0.0, ()))]
    for expansions in range(max_expansions):
        heap = heapq.nsmallest(width, heap)  # sorted, hence again a heap
        if not heap:
            return failed(
                lattice,
                method="beamstep_printed",
                reason=f"the heap of width {width} ran empty",
                expansions=expansions,
            )
        _, _, node = heapq.heappop(heap)
        if not node.remaining.any():
            return replay(
                lattice, list(node.steps), method="beamstep_printed", expansions=expansions
            )
        for child in _successors(lattice, node):
            heapq.heappush(heap, (child.cost, next(tie), child))
    return failed(
        lattice,
        method="beamstep_printed",
        reason=f"no plan within {max_expansions} expansions at width {width}",
        expansions=max_expansions,
    )


def _successors(lattice: Lattice, node: _Node) -> list[_Node]:
    level = _children(
        lattice,
        _Level(
            remaining=node.remaining[None],
            stop=np.array([node.stop]),
            cost=np.array([node.cost]),
            parent=np.zeros(1, dtype=np.int64),
            moves=np.zeros((1, len(node.remaining)), dtype=bool),
        ),
        first=not node.steps,
    )
    return [
        _Node(remaining, int(stop), float(cost), (*node.steps, Step(int(stop), moves)))
        for remaining, stop, cost, moves in zip(
            level.remaining, level.stop, level.cost, level.moves, strict=True
        )
        if np.isfinite(cost)
    ]
