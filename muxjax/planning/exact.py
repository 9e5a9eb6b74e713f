"""The certified optimum by dynamic programming over the lattice (MODEL.md section 5)."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.lattice import Lattice
from muxjax.planning.problem import Plan, PlanningError
from muxjax.planning.replay import Step, failed, replay

DEFAULT_MEMORY = 2 * 2**30  # [bytes]
# Beside its values (float64 at every stop), a state has its steps to go and its place in the order.
_BYTES_PER_STATE = 24
# A possible step of a state while its chunk is worked on: masks and states, by tendon.
_BYTES_PER_STEP_AND_TENDON = 48
_CHUNK_BYTES = 64 * 2**20


def exact(lattice: Lattice, *, memory_limit: int = DEFAULT_MEMORY) -> Plan:
    """The cheapest plan of the problem's action set, certified.

    States are solved in the order of their steps to go, so that every successor is known: with
    V[s, p] the cost to go from state s at stop p,
    V[s, p] = min over actions (k, moves) of cost(s, moves, p != k) + V[s - moves, k].

    Args:
        lattice: The problem on the robot.
        memory_limit: Most memory that the table may take [bytes].

    Raises:
        PlanningError: The table does not fit, and the message says how large it would be; or a
            cost term is negative, or lower with a repositioning than without.
    """
    solver = _Table(lattice, memory_limit)
    solver.fill()
    return solver.plan()


class _Table:
    """The value table and the sweep that fills it."""

    def __init__(self, lattice: Lattice, memory_limit: int) -> None:
        self.lattice = lattice
        self.shape = lattice.steps + 1
        states, stops = math.prod(int(n) for n in self.shape), len(lattice.reach)
        actions, tendons = lattice.actions[1].shape
        a_state = actions * tendons * _BYTES_PER_STEP_AND_TENDON
        self.chunk = min(max(1, _CHUNK_BYTES // a_state), states)
        needed = states * (8 * stops + _BYTES_PER_STATE) + self.chunk * a_state
        if needed > memory_limit:
            raise PlanningError(
                f"exact: {states:.3g} states at {stops} stops need {needed / 2**30:.3g} GiB, the "
                f"limit is {memory_limit / 2**30:.3g} GiB; take a larger max_step, or 'beamstep', "
                "which reports its gap"
            )
        self.strides = np.concatenate([np.cumprod(self.shape[::-1])[::-1][1:], [1]])
        self.value = np.full((states, stops), np.inf)
        self.expansions = 0

    def remaining(self, index: Int[np.ndarray, " N"]) -> Int[np.ndarray, "N SJ"]:
        """Mixed-radix digits of flat indices."""
        return index[:, None] // self.strides % self.shape

    def fill(self) -> None:
        """Solve all states, those with fewer steps to go first."""
        to_go = np.zeros(1, dtype=np.int32)
        for n in self.shape:
            to_go = (to_go[:, None] + np.arange(n, dtype=np.int32)).reshape(-1)
        order = np.argsort(to_go, kind="stable")
        layers = np.split(order, np.cumsum(np.bincount(to_go))[:-1])
        self.value[layers[0]] = 0.0
        for layer in layers[1:]:
            for i in range(0, len(layer), self.chunk):
                chunk = layer[i : i + self.chunk]
                stay, switch = self.action_values(chunk)
                self.value[chunk] = self.best_by_stop(stay, switch)

    def action_values(
        self, index: Int[np.ndarray, " N"], *, first: bool = False
    ) -> tuple[Float[np.ndarray, "N G"], Float[np.ndarray, "N G"]]:
        """Cost to go through each action, without and with a repositioning before it."""
        remaining = self.remaining(index)
        stops, masks = self.lattice.actions
        possible, moves = self.lattice.expand(remaining)
        state, action = np.nonzero(possible)
        self.expansions += len(index)
        moved = moves[state, action]
        after = self.value[index[state] - moved @ self.strides, stops[action]]
        costs = self.lattice.costs(remaining[state], moved, first=first)
        if (costs[:, 1] < costs[:, 0]).any():
            raise PlanningError("exact: a cost term pays for repositioning, which has no optimum")
        through = np.full((2, len(index), len(masks)), np.inf)
        through[:, state, action] = costs.T + after
        return through[0], through[1]

    def best_by_stop(
        self, stay: Float[np.ndarray, "N G"], switch: Float[np.ndarray, "N G"]
    ) -> Float[np.ndarray, "N stops"]:
        """Minimum over actions, for every stop the axial motor may be at."""
        stops, _ = self.lattice.actions
        elsewhere = switch.min(axis=1, keepdims=True)
        # Actions of one stop stand next to each other.
        here = np.minimum.reduceat(stay, np.flatnonzero(np.diff(stops, prepend=-1)), axis=1)
        return np.minimum(here, elsewhere)

    def plan(self) -> Plan:
        """Follow the minimum from the start."""
        stops, masks = self.lattice.actions
        index, stop = len(self.value) - 1, self.lattice.start_stop
        steps: list[Step] = []
        expansions = self.expansions
        while index:
            stay, switch = self.action_values(np.array([index]), first=not steps)
            if not np.isfinite(min(stay.min(), switch.min())):
                return failed(
                    self.lattice,
                    method="exact",
                    reason="every order passes through a state that is not defined",
                    expansions=expansions,
                )
            action = int(np.argmin(np.where(stops == stop, stay[0], switch[0])))
            moves = masks[action] & (self.remaining(np.array([index]))[0] > 0)
            stop = int(stops[action])
            steps.append(Step(stop, moves))
            index -= int(moves @ self.strides)
        return replay(self.lattice, steps, method="exact", expansions=expansions, optimal=True)
