"""The layered beam, level by level on the host: the oracle of the compiled one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.bounds import bound_of
from muxjax.planning.lattice import Lattice


@dataclass(frozen=True)
class _Level:
    """Partial plans of equal length; arrays with a row each."""

    remaining: Int[np.ndarray, "N SJ"]
    stop: Int[np.ndarray, " N"]
    cost: Float[np.ndarray, " N"]
    moves: Int[np.ndarray, "N SJ"]  # steps of each tendon in the last action

    def take(self, rows: Int[np.ndarray, " M"]) -> _Level:
        return _Level(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def beam(lattice: Lattice, width: int, best: float) -> tuple[float, float, int]:
    """Cost of the best plan below ``best``, or that; least promise cut off; expansions."""
    bound, cut_off, expansions = bound_of(lattice), float("inf"), 0
    level = _root(lattice)
    while level.remaining.any():
        expansions += len(level.cost)
        children = _children(lattice, level, first=len(level.moves) == 1 and not level.moves.any())
        level = children.take(_deduplicated(children))
        done = ~level.remaining.any(axis=1)
        promise = level.cost + bound(level.remaining, level.stop)
        hopeful = np.flatnonzero(~done & (promise < best))
        ranked = hopeful[np.argsort(promise[hopeful], kind="stable")]
        best = min(best, float(np.min(level.cost[done], initial=np.inf)))
        cut_off = min(cut_off, float(np.min(promise[ranked[width:]], initial=np.inf)))
        level = level.take(ranked[:width])
    return best, cut_off, expansions


def _root(lattice: Lattice) -> _Level:
    return _Level(
        remaining=lattice.steps[None],
        stop=np.array([lattice.start_stop]),
        cost=np.zeros(1),
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
        moves=moved,
    )


def _deduplicated(level: _Level) -> Int[np.ndarray, " M"]:
    """Rows of the cheapest plan to each state."""
    by_cost = np.argsort(level.cost, kind="stable")
    states = np.column_stack([level.remaining, level.stop])[by_cost]
    keys = np.ascontiguousarray(states).view(np.dtype((np.void, states.itemsize * states.shape[1])))
    _, first = np.unique(keys.ravel(), return_index=True)
    return by_cost[np.sort(first)]
