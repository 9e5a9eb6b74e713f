"""BeamStep (M Algorithm 1), in the layered reading and as printed (MODEL.md section 5)."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from time import monotonic

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.baselines import greedy, reverse, sequential
from muxjax.planning.bounds import AdmissibleBound, bound_of
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
    moves: Int[np.ndarray, "N SJ"]  # steps of each tendon in the last action

    def take(self, rows: Int[np.ndarray, " M"]) -> _Level:
        return _Level(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def beamstep(
    lattice: Lattice,
    *,
    width: int = 64,
    value_fn: ValueFunction | None = None,
    gap: float | None = None,
    deadline_s: float | None = None,
) -> Plan:
    """Level-synchronous beam search with deduplication and a certified gap.

    The baselines' plans are the first incumbents, so the result is never worse than they are. The
    lower bound is the least cost so far plus admissible bound among all that was cut off.

    Args:
        lattice: The problem on the robot.
        width: Partial plans kept at each length, B; the first one where it is doubled.
        value_fn: Orders the plans of a level instead of the admissible bound; it enters neither
            the pruning nor the certificate.
        gap: Double the width until the certified gap is no larger than this.
        deadline_s: Double the width as long as no more than this time [s] has passed; a search
            that was begun is finished.

    Raises:
        ValueError: A width below 1, or a gap or deadline that is not a number of at least 0.
    """
    _check_options(width, gap, deadline_s)
    began = monotonic()
    bound = bound_of(lattice)
    incumbent = min((rule(lattice) for rule in (sequential, reverse, greedy)), key=lambda p: p.cost)
    best = _Incumbent(incumbent.cost, None)
    proved, expansions = 0.0, 0
    while True:
        cut_off, expanded = _search(lattice, bound, width, value_fn, best)
        proved, expansions = max(proved, cut_off), expansions + expanded
        tight = proved >= best.cost or (gap is not None and best.cost - proved <= gap * best.cost)
        late = deadline_s is not None and monotonic() - began >= deadline_s
        if tight or late or (gap is None and deadline_s is None):
            break
        width *= 2
    if not np.isfinite(best.cost):
        return _none_found(lattice, width, proved, expansions)
    optimal = proved >= best.cost
    if best.steps is None:
        return replace(
            incumbent,
            method="beamstep",
            lower_bound=min(best.cost, proved),
            expansions=expansions,
            status="optimal" if optimal else "feasible",
        )
    return replay(
        lattice,
        best.steps,
        method="beamstep",
        lower_bound=proved,
        expansions=expansions,
        optimal=optimal,
    )


def _check_options(width: int, gap: float | None, deadline_s: float | None) -> None:
    if not isinstance(width, int) or width < 1:
        raise ValueError(f"width: must be a whole number, at least 1, found {width!r}")
    for name, value in (("gap", gap), ("deadline_s", deadline_s)):
        if value is not None and not value >= 0.0:
            raise ValueError(f"{name}: must be at least 0, found {value!r}")


def _none_found(lattice: Lattice, width: int, proved: float, expansions: int) -> Plan:
    what = "a collision or " if lattice.problem.world is not None else ""
    reason = (
        f"every plan of the action set {lattice.problem.action_set!r} passes through {what}a state "
        "that is not defined, or whose cost is not finite"
        if proved == np.inf
        else f"no plan found at width {width}, where others were cut off; take a larger one"
    )
    return failed(lattice, method="beamstep", reason=reason, expansions=expansions)


@dataclass
class _Incumbent:
    """The best plan so far; no steps if it is a baseline's."""

    cost: float
    steps: list[Step] | None


def _search(
    lattice: Lattice,
    bound: AdmissibleBound,
    width: int,
    value_fn: ValueFunction | None,
    best: _Incumbent,
) -> tuple[float, int]:
    """One beam; improves ``best`` and returns the least promise cut off, and its expansions."""
    cut_off, expansions = float("inf"), 0
    levels = [_root(lattice)]
    while levels[-1].remaining.any():
        expansions += len(levels[-1].cost)
        children = _children(lattice, levels[-1], first=len(levels) == 1)
        asked = np.full(len(children.cost), not lattice.has_expensive_terms)
        while True:
            rows = _deduplicated(children)
            level = children.take(rows)
            done = ~level.remaining.any(axis=1)
            promise = level.cost + bound(level.remaining, level.stop)
            hopeful = np.flatnonzero(~done & (promise < best.cost))
            order = promise
            if value_fn is not None:
                order = level.cost + _values(lattice, level, value_fn)
            ranked = hopeful[np.argsort(order[hopeful], kind="stable")]
            arriving = np.flatnonzero(done & (level.cost < best.cost))
            unsure = rows[np.concatenate([ranked[:width], arriving])]
            unsure = unsure[~asked[unsure]]
            if not len(unsure):
                break
            asked[unsure] = True
            first = len(levels) == 1
            children.cost[unsure] += _expensive(lattice, levels[-1], children.take(unsure), first)
        if len(arriving):
            row = arriving[np.argmin(level.cost[arriving])]
            best.cost, best.steps = float(level.cost[row]), _trace([*levels, level], int(row))
        cut_off = min(cut_off, float(np.min(promise[ranked[width:]], initial=np.inf)))
        levels.append(level.take(ranked[:width]))
    return cut_off, expansions


def _expensive(
    lattice: Lattice, parents: _Level, children: _Level, first: bool
) -> Float[np.ndarray, " N"]:
    """What the expensive terms add to the last steps of these plans."""
    before = children.remaining + children.moves
    both = lattice.costs(before, children.moves, first=first, expensive=True)
    stays = children.stop == parents.stop[children.parent]
    return np.where(stays, both[:, 0], both[:, 1])


def _root(lattice: Lattice) -> _Level:
    return _Level(
        remaining=lattice.steps[None],
        stop=np.array([lattice.start_stop]),
        cost=np.zeros(1),
        parent=np.zeros(1, dtype=np.int64),
        moves=np.zeros((1, len(lattice.steps)), dtype=np.int64),
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


def _deduplicated(level: _Level) -> Int[np.ndarray, " M"]:
    """Rows of the cheapest plan to each state."""
    by_cost = np.argsort(level.cost, kind="stable")
    states = np.column_stack([level.remaining, level.stop])[by_cost]
    keys = np.ascontiguousarray(states).view(np.dtype((np.void, states.itemsize * states.shape[1])))
    _, first = np.unique(keys.ravel(), return_index=True)
    return by_cost[np.sort(first)]


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
    parent = _Level(
        remaining=node.remaining[None],
        stop=np.array([node.stop]),
        cost=np.array([node.cost]),
        parent=np.zeros(1, dtype=np.int64),
        moves=np.zeros((1, len(node.remaining)), dtype=np.int64),
    )
    first = not node.steps
    level = _children(lattice, parent, first=first)
    costs = level.cost + _expensive(lattice, parent, level, first)
    return [
        _Node(remaining, int(stop), float(cost), (*node.steps, Step(int(stop), moves)))
        for remaining, stop, cost, moves in zip(
            level.remaining, level.stop, costs, level.moves, strict=True
        )
        if np.isfinite(cost)
    ]
