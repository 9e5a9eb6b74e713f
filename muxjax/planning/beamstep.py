"""BeamStep (M Algorithm 1), in the layered reading and as printed (MODEL.md section 5)."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from itertools import count
from time import monotonic

import numpy as np
from jaxtyping import Int

from muxjax.planning.baselines import greedy, reverse, sequential
from muxjax.planning.beam import WIDEST, Beam
from muxjax.planning.lattice import Lattice, Step
from muxjax.planning.problem import Plan
from muxjax.planning.replay import failed, replay
from muxjax.planning.search import ValueFunction

HEURISTICS = ("patterns", "count", "none")


def beamstep(
    lattice: Lattice,
    *,
    width: int = 64,
    heuristic: str = "patterns",
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
        heuristic: Admissible bound that orders, prunes and certifies: "patterns" (all that
            ``bounds.py`` knows), "count" (stops, travel and time still needed) or "none".
        value_fn: Orders the most promising plans of a level (``search.ValueFunction``); it enters
            neither the pruning nor the certificate.
        gap: Double the width until the certified gap is no larger than this.
        deadline_s: Double the width as long as no more than this time [s] has passed; a search
            that was begun is finished.

    Raises:
        ValueError: A width below 1 or too large, an unknown heuristic, or a gap or deadline that
            is not a number of at least 0.
        PlanningError: A cost term is negative.
    """
    _check_options(width, heuristic, gap, deadline_s)
    began = monotonic()
    known = (rule(lattice, lower_bound=0.0) for rule in (sequential, reverse, greedy))
    incumbent = min(known, key=lambda plan: plan.cost)
    cost, steps = incumbent.cost, None
    proved, expansions = 0.0, 0
    beam = Beam(lattice, heuristic, value_fn)
    while True:
        found = beam.search(width, cost)
        if found.length:
            cost, steps = float(found.cost), beam.steps(found)
        proved = max(proved, min(float(found.cut_off), cost))
        expansions += int(found.expansions)
        tight = proved >= cost or (gap is not None and cost - proved <= gap * cost)
        late = deadline_s is not None and monotonic() - began >= deadline_s
        if tight or late or (gap is None and deadline_s is None) or 2 * width > WIDEST:
            break
        width *= 2
    if not np.isfinite(cost):
        return _none_found(lattice, width, proved, expansions)
    if steps is None:
        return replace(
            incumbent,
            method="beamstep",
            lower_bound=proved,
            expansions=expansions,
            status="optimal" if proved >= cost else "feasible",
        )
    return replay(
        lattice,
        steps,
        method="beamstep",
        lower_bound=proved,
        expansions=expansions,
        optimal=proved >= cost,
    )


def _check_options(width: int, heuristic: str, gap: float | None, deadline_s: float | None) -> None:
    if not isinstance(width, int) or not 1 <= width <= WIDEST:
        raise ValueError(f"width: must be a whole number from 1 to {WIDEST}, found {width!r}")
    if heuristic not in HEURISTICS:
        raise ValueError(f"heuristic: must be one of {', '.join(HEURISTICS)}, found {heuristic!r}")
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
    stops, _ = lattice.actions
    possible, moves = lattice.expand(node.remaining[None])
    actions = np.flatnonzero(possible[0])
    moved, before = moves[0, actions], np.repeat(node.remaining[None], len(actions), axis=0)
    first = not node.steps
    both = lattice.costs(before, moved, first=first)
    both = both + lattice.costs(before, moved, first=first, expensive=True)
    costs = node.cost + np.where(stops[actions] == node.stop, both[:, 0], both[:, 1])
    return [
        _Node(node.remaining - m, int(stop), float(cost), (*node.steps, Step(int(stop), m)))
        for stop, m, cost in zip(stops[actions], moved, costs, strict=True)
        if np.isfinite(cost)
    ]
