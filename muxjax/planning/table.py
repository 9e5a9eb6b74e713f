"""Cost to go from every state of a problem: the dynamic programme behind the exact planner.

Two tables answer the same questions: ``LatticeTable`` for any lattice, on the host, and
``FullMoveTable`` for full moves, compiled (``full_moves.py``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from muxjax.planning import full_moves
from muxjax.planning.beam import Beam
from muxjax.planning.bounds import bound_of
from muxjax.planning.lattice import Lattice
from muxjax.planning.problem import PlanningError

# Beside its values (float64 at every stop), a state has its steps to go and its place in the order.
_BYTES_PER_STATE = 24
# A possible step of a state while its chunk is worked on: masks and states, by tendon.
_BYTES_PER_STEP_AND_TENDON = 48
_CHUNK_BYTES = 64 * 2**20
# States times actions of a table that is solved before the beam has an answer.
_SOON_SOLVED = 2**15
_WIDTH = 64  # of the beam whose plan bounds what is solved
_ROUNDING = 1e-9  # relative; costs that differ by less may be the same


class TableTooLargeError(PlanningError):
    """The table would take more memory than allowed."""


class Choices(NamedTuple):
    """The possible steps from one state; a row each."""

    stop: Int[np.ndarray, " N"]
    moves: Int[np.ndarray, "N SJ"]  # steps of each tendon
    cost: Float[np.ndarray, " N"]  # of the step itself
    to_go: Float[np.ndarray, " N"]  # cost from the state after it to the target


class LatticeTable:
    """Any lattice, state by state in the order of steps to go.

    With V[s, p] the cost to go from state s at stop p,
    V[s, p] = min over actions (k, moves) of cost(s, moves, p != k) + V[s - moves, k].

    Args:
        lattice: The problem on the robot.
        memory_limit: Most memory that the table may take [bytes].
        whole: False leaves out, at infinity, states through which no plan as cheap as the layered
            beam's can go: those on the cheapest plans from the start keep their cost to go.

    Raises:
        PlanningError: The table does not fit, and the message says how large it would be; or a
            cost term is negative, or lower with a repositioning than without.
    """

    def __init__(self, lattice: Lattice, memory_limit: int, *, whole: bool = True) -> None:
        self.lattice = lattice
        self.shape = lattice.steps + 1
        states, stops = math.prod(int(n) for n in self.shape), len(lattice.reach)
        actions, tendons = lattice.actions[1].shape
        a_state = actions * tendons * _BYTES_PER_STEP_AND_TENDON
        self.chunk = min(max(1, _CHUNK_BYTES // a_state), states)
        needed = states * (8 * stops + _BYTES_PER_STATE) + self.chunk * a_state
        if needed > memory_limit:
            raise TableTooLargeError(
                f"exact: {states:.3g} states at {stops} stops need {needed / 2**30:.3g} GiB, the "
                f"limit is {memory_limit / 2**30:.3g} GiB; take a larger max_step, or 'beamstep', "
                "which reports its gap"
            )
        self.strides = np.concatenate([np.cumprod(self.shape[::-1])[::-1][1:], [1]])
        self.value = np.full((states, stops), np.inf)
        self.expansions = 0
        layers = self._layers()
        whole = whole or states * actions <= _SOON_SOLVED
        self._fill(layers if whole else self._promising(layers))

    def remaining(self, index: Int[np.ndarray, " N"]) -> Int[np.ndarray, "N SJ"]:
        """Mixed-radix digits of flat indices."""
        return index[:, None] // self.strides % self.shape

    def _layers(self) -> list[Int[np.ndarray, " _"]]:
        """All states by their steps to go."""
        to_go = np.zeros(1, dtype=np.int32)
        for n in self.shape:
            to_go = (to_go[:, None] + np.arange(n, dtype=np.int32)).reshape(-1)
        order = np.argsort(to_go, kind="stable")
        return np.split(order, np.cumsum(np.bincount(to_go))[:-1])

    def _promising(self, layers: list[Int[np.ndarray, " _"]]) -> list[Int[np.ndarray, " _"]]:
        """Of each layer, the states whose cost from the start and bound leave a plan some hope."""
        lattice = self.lattice
        most = float(Beam(lattice).search(_WIDTH).cost) * (1 + _ROUNDING)
        from_start = self.value  # its memory, until the table is filled
        at, moves, cost, _ = self.choices(lattice.steps, lattice.start_stop, first=True)
        np.minimum.at(from_start, ((lattice.steps - moves) @ self.strides, at), cost)
        kept = [layers[-1]]
        for layer in layers[-2::-1]:
            reached = layer[np.isfinite(from_start[layer]).any(axis=1)]
            chunks = [reached[:0]]
            for i in range(0, len(reached), self.chunk):
                chunks.append(self._pass_on(reached[i : i + self.chunk], most))
            kept.append(np.concatenate(chunks))
        from_start.fill(np.inf)
        return kept[::-1]

    def _pass_on(self, index: Int[np.ndarray, " N"], most: float) -> Int[np.ndarray, " M"]:
        """States of these with some hope; the cost from the start of those after them improves."""
        state, stop = np.nonzero(np.isfinite(self.value[index]))
        bound = bound_of(self.lattice)(self.remaining(index[state]), stop)
        hopeful = self.value[index[state], stop] + bound <= most
        kept, row = np.unique(state[hopeful], return_inverse=True)
        index = index[kept]
        from_start = np.full((len(index), self.value.shape[1]), np.inf)
        from_start[row, stop[hopeful]] = self.value[index[row], stop[hopeful]]
        state, action, costs, after = self._steps(self.remaining(index), first=False)
        at = self.lattice.actions[0][action]
        there = from_start[state, at] + costs[:, 0]
        moved = from_start.min(axis=1)[state] + costs[:, 1]
        np.minimum.at(self.value, (after, at), np.minimum(there, moved))
        return index

    def _fill(self, layers: list[Int[np.ndarray, " _"]]) -> None:
        """Solve the states, those with fewer steps to go first."""
        self.value[0] = 0.0
        for layer in layers[1:]:
            for i in range(0, len(layer), self.chunk):
                self._solve(layer[i : i + self.chunk])

    def _solve(self, index: Int[np.ndarray, " N"]) -> None:
        stops, counts = self.lattice.actions
        state, action, costs, after = self._steps(self.remaining(index), first=False)
        if (costs[:, 1] < costs[:, 0]).any():
            raise PlanningError("exact: a cost term pays for repositioning, which has no optimum")
        through = np.full((2, len(index), len(counts)), np.inf)
        through[:, state, action] = costs.T + self.value[after, stops[action]]
        elsewhere = through[1].min(axis=1, keepdims=True)
        # Actions of one stop stand next to each other.
        bounds = np.flatnonzero(np.diff(stops, prepend=-1))
        here = np.minimum.reduceat(through[0], bounds, axis=1)
        self.value[index] = np.minimum(here, elsewhere)
        self.expansions += len(index)

    def _steps(
        self, remaining: Int[np.ndarray, "N SJ"], *, first: bool
    ) -> tuple[
        Int[np.ndarray, " E"],
        Int[np.ndarray, " E"],
        Float[np.ndarray, "E 2"],
        Int[np.ndarray, " E"],
    ]:
        """State and action of every possible step, its two costs, and the state after it."""
        possible, moves = self.lattice.expand(remaining)
        state, action = np.nonzero(possible)
        moved = moves[state, action]
        after = (remaining[state] - moved) @ self.strides
        costs = self.lattice.costs(remaining[state], moved, first=first)
        return state, action, costs, after

    def choices(
        self, remaining: Int[np.ndarray, " SJ"], stop: int, *, first: bool = False
    ) -> Choices:
        """Steps from a state at a stop (-1: not known); ``first`` if it is the start."""
        stops, counts = self.lattice.actions
        _, action, costs, after = self._steps(remaining[None], first=first)
        at = stops[action]
        cost = np.where(at == stop, costs[:, 0], costs[:, 1])
        return Choices(at, np.minimum(counts[action], remaining), cost, self.value[after, at])


class FullMoveTable:
    """Full moves of one problem."""

    def __init__(self, lattice: Lattice) -> None:
        robot, problem = lattice.robot, lattice.problem
        self.lattice = lattice
        self._tables = full_moves.tables(robot.n_segments, robot.tendons_per_segment)
        healthy = np.isin(np.arange(1, robot.tendons_per_segment + 1), problem.servos)
        self._whole = np.asarray(problem.action_set == "all")
        self._axials, self._reach = full_moves.reach_by_layer(robot, healthy, np)
        terms, weights = problem.compiled_terms(expensive=False)
        end = lattice.displacements(0 * lattice.steps)
        with jax.enable_x64(True):
            ends = (x[:, None] for x in (problem.start, end, problem.target))
            priced = full_moves.edge_costs(robot, terms, weights, *ends)
            edges = tuple(full_moves.EdgeCosts(*map(np.asarray, costs)) for costs in priced)
        self._edges = [[c[:, 0] for c in costs] for costs in edges]
        self.value = full_moves.values(robot, edges, healthy, self._whole, np)[..., 0]
        self._representative = [
            int(np.argmax(lattice.stop_of_axial == stop)) for stop in range(len(lattice.reach))
        ]
        self.expansions = len(self.value) - 1

    @staticmethod
    def fits(lattice: Lattice) -> bool:
        """Whether every move of a lattice goes all the way, and the states are few."""
        return bool(lattice.steps.max() <= 1) and full_moves.fits(lattice.robot)

    def check(self) -> None:
        """Refuse costs that have no optimum.

        Raises:
            PlanningError: A cost term is negative, or lower with a repositioning than without.
        """
        for stay, switch, _ in self._edges:
            if (np.minimum(stay, switch) < 0).any():
                raise PlanningError("a cost term is negative; terms must be at least 0")
            if (switch < stay).any():
                raise PlanningError(
                    "exact: a cost term pays for repositioning, which has no optimum"
                )

    def choices(
        self, remaining: Int[np.ndarray, " SJ"], stop: int, *, first: bool = False
    ) -> Choices:
        """Steps from a state at a stop (-1: not known); ``first`` if it is the start."""
        j = self._tables.j
        place = self._tables.place[full_moves.number(remaining > 0, j)]
        rows = []
        for layer, everywhere in enumerate(self._tables.legs_of):
            steps = full_moves.Level(*(a[place][None] for a in everywhere))
            may = full_moves.allowed(steps, self._reach[layer], self._whole)[0]
            stay, switch, engage = self._edges[layer]
            for slot, a in np.argwhere(may):
                axial = int(self._axials[layer][a])
                at = int(self.lattice.stop_of_axial[axial])
                if axial != self._representative[at]:
                    continue  # another position of the same stop
                edge, moved = steps.edge[0, slot], int(steps.moved[0, slot])
                moves = np.zeros_like(remaining)
                moves[layer * j : (layer + 1) * j] = (moved >> np.arange(j)) & 1
                here = engage if first else stay
                cost = here[edge] if at == stop else switch[edge]
                rows.append((at, moves, cost, self.value[steps.after[0, slot], axial]))
        return Choices(*(np.array(column) for column in zip(*rows, strict=True)))


Table = LatticeTable | FullMoveTable


def solved_table(lattice: Lattice, memory_limit: int, *, whole: bool) -> Table:
    """The compiled table where it fits, else the one on the host (``whole``: see there).

    Raises:
        PlanningError: See the tables.
    """
    if FullMoveTable.fits(lattice):
        table = FullMoveTable(lattice)
        table.check()
        return table
    return LatticeTable(lattice, memory_limit, whole=whole)
