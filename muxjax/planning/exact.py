"""The certified optimum of the problem's action set (MODEL.md section 5).

A table of the cost to go comes first (``table.py``), without the expensive terms. Without such
terms the plan follows the table's minimum. With them it is the table that guides a best-first
search, which asks an expensive term only about a step that the cheapest plan so far would take:
no term is negative, so the table never overestimates, and the first plan to arrive is the optimum.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.beamstep import beamstep
from muxjax.planning.lattice import Lattice, Step
from muxjax.planning.problem import Plan
from muxjax.planning.replay import failed, replay
from muxjax.planning.table import Table, TableTooLargeError, solved_table

DEFAULT_MEMORY = 2 * 2**30  # [bytes]
_CHECKED_AT_ONCE = 64  # steps about which an expensive term is asked in one call
_DECIMALS = 10  # costs that differ by less count as equal, and the plan nearer its end goes first
_EQUAL = 10.0**-_DECIMALS


def exact(
    lattice: Lattice, *, memory_limit: int = DEFAULT_MEMORY, fallback: bool = False, width: int = 64
) -> Plan:
    """The cheapest plan of the problem's action set, certified.

    Args:
        lattice: The problem on the robot.
        memory_limit: Most memory that the table may take [bytes].
        fallback: Where it would take more, use the layered beam, whose gap is bounded; the plan's
            ``method`` and ``reason`` say so.
        width: Partial plans that this beam keeps.

    Raises:
        PlanningError: The table does not fit, and the message says how large it would be; or a
            cost term is negative, or lower with a repositioning than without.
    """
    try:
        # What expensive terms add may lead off the plans that are cheapest without them.
        table = solved_table(lattice, memory_limit, whole=lattice.has_expensive_terms)
    except TableTooLargeError as refusal:
        if not fallback:
            raise
        found = beamstep(lattice, width=width)
        why = f"{refusal}; this is the beam's plan" + (found.reason and f", {found.reason}")
        return replace(found, reason=why)
    steps, reason = (_cheapest if lattice.has_expensive_terms else _follow)(lattice, table)
    if steps is None:
        return failed(lattice, method="exact", reason=reason, expansions=table.expansions)
    return replay(lattice, steps, method="exact", expansions=table.expansions, optimal=True)


def _follow(lattice: Lattice, table: Table) -> tuple[list[Step] | None, str]:
    """The table's minimum from the start; of equals the first, whatever the rounding."""
    remaining, stop, steps = lattice.steps, lattice.start_stop, list[Step]()
    while remaining.any():
        choices = table.choices(remaining, stop, first=not steps)
        through = choices.cost + choices.to_go
        best = int(np.argmax(through <= through.min() + _EQUAL))
        if not np.isfinite(through[best]):
            return None, (
                "every order passes through a state that is not defined, "
                "or whose cost is not finite"
            )
        stop = int(choices.stop[best])
        steps.append(Step(stop, choices.moves[best]))
        remaining = remaining - choices.moves[best]
    return steps, ""


@dataclass(frozen=True, eq=False)
class _Node:
    """A state reached at its least cost."""

    remaining: Int[np.ndarray, " SJ"]
    stop: int
    cost: float
    steps: tuple[Step, ...]


@dataclass(frozen=True, eq=False)
class _Edge:
    """A step that may be taken; costs are without what expensive terms add to this step."""

    begin: _Node
    step: Step
    cost: float  # from the start to its end
    to_go: float  # from there, by the table

    @property
    def leg(self) -> tuple[bytes, bytes]:
        """State and moves; first steps, which all begin at the start, have no other state."""
        return self.begin.remaining.tobytes(), self.step.moves.tobytes()

    @property
    def remaining(self) -> Int[np.ndarray, " SJ"]:
        """State after the step."""
        return self.begin.remaining - self.step.moves


class _Search:
    """Best-first search with the table as heuristic."""

    def __init__(self, lattice: Lattice, table: Table) -> None:
        self.lattice, self.table = lattice, table
        self.edges: list[_Edge] = []
        # What the expensive terms add, once asked: without and with a repositioning, by leg.
        self.extra: dict[tuple[bytes, bytes], Float[np.ndarray, " 2"]] = {}
        self.heap: list[tuple[float, int, int, bool]] = []  # estimate, steps to go, edge, final
        self.reached: set[tuple[bytes, int]] = set()

    def run(self) -> list[Step] | None:
        """The cheapest steps to the target, or None."""
        self._expand(_Node(self.lattice.steps, self.lattice.start_stop, 0.0, ()))
        while self.heap:
            _, _, number, final = heapq.heappop(self.heap)
            if not final:
                self._push(number, self._ask(number), final=True)
                continue
            edge = self.edges[number]
            cost = edge.cost + self._ask(number)
            node = _Node(edge.remaining, edge.step.stop, cost, (*edge.begin.steps, edge.step))
            if not node.remaining.any():
                return list(node.steps)
            self._expand(node)
        return None

    def _expand(self, node: _Node) -> None:
        state = (node.remaining.tobytes(), node.stop)
        if state in self.reached:
            return
        self.reached.add(state)
        choices = self.table.choices(node.remaining, node.stop, first=not node.steps)
        for stop, moves, cost, to_go in zip(*choices, strict=True):
            edge = _Edge(node, Step(int(stop), moves), node.cost + float(cost), float(to_go))
            self.edges.append(edge)
            self._push(len(self.edges) - 1, 0.0, final=False)

    def _push(self, number: int, extra: float, *, final: bool) -> None:
        edge = self.edges[number]
        estimate = edge.cost + extra + edge.to_go
        if np.isfinite(estimate):
            to_go = int(edge.remaining.sum())
            heapq.heappush(self.heap, (round(estimate, _DECIMALS), to_go, number, final))

    def _ask(self, number: int) -> float:
        """What the expensive terms add to a step; asked in one call with those soon to come."""
        edge = self.edges[number]
        if edge.leg not in self.extra:
            first = not edge.begin.steps
            legs = {edge.leg: edge}
            for _, _, n, _ in heapq.nsmallest(2 * _CHECKED_AT_ONCE, self.heap):
                other = self.edges[n]
                if other.leg not in self.extra and (not other.begin.steps) == first:
                    legs.setdefault(other.leg, other)
            asked = list(legs.values())[:_CHECKED_AT_ONCE]
            costs = self.lattice.costs(
                np.array([e.begin.remaining for e in asked]),
                np.array([e.step.moves for e in asked]),
                first=first,
                expensive=True,
            )
            self.extra.update(zip((e.leg for e in asked), costs, strict=True))
        return float(self.extra[edge.leg][int(edge.step.stop != edge.begin.stop)])


def _cheapest(lattice: Lattice, table: Table) -> tuple[list[Step] | None, str]:
    """As ``_follow``, where expensive terms have a say."""
    search = _Search(lattice, table)
    steps = search.run() if lattice.steps.any() else []
    blocked = sum(not np.isfinite(both).any() for both in search.extra.values())
    what = "a collision" if lattice.problem.world is not None else "a cost that is not finite"
    return steps, (
        f"every plan of the action set {lattice.problem.action_set!r} passes through {what} or an "
        f"undefined state: {blocked} of {len(search.extra)} steps that were looked at are blocked"
    )
