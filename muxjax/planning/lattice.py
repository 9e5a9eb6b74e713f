"""States and actions of clipped moves towards the target (MODEL.md section 5).

Tendon c has n_c steps to go, so a state is a vector of remaining steps and the last axial
position. Axial positions at which the available servos reach the same tendons are one *stop*:
nothing that follows can tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations, product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.motion import bending_angles
from muxjax.planning.problem import PlanningError, Problem
from muxjax.planning.terms import CostTerm, step, transition_cost
from muxjax.precision import pad_rows
from muxjax.robot import Robot

Array = jax.Array | np.ndarray
_LARGEST_BATCH = 16384
_EXPENSIVE_BATCH = 64  # always this many: such terms take long to compile


@dataclass(frozen=True)
class Step:
    """One chosen action: the stop, and the steps that each tendon moves there."""

    stop: int
    moves: Int[np.ndarray, " SJ"]


@dataclass(frozen=True, eq=False)
class Lattice:
    """The lattice of one problem on one robot. Host side; arrays count from 0.

    Attributes:
        robot: The arm.
        problem: The problem, already checked against the robot.
    """

    robot: Robot
    problem: Problem

    @cached_property
    def max_step(self) -> float:
        """Delta_max [m]; without a limit, the largest residual."""
        largest = float(np.max(np.abs(self.problem.target - self.problem.start)))
        return self.problem.max_step or max(largest, self.problem.tolerance)

    @cached_property
    def steps(self) -> Int[np.ndarray, " SJ"]:
        """n_c: steps of each tendon from the start."""
        return np.array([len(stops) for stops in self._stops], dtype=np.int64)

    @cached_property
    def _stops(self) -> list[Float[np.ndarray, " n"]]:
        """Ways [m] from its start at which each tendon may stop: its end last."""
        ways = np.abs(self.problem.target - self.problem.start)
        if self.problem.action_set == "splits":
            layers = ways.reshape(self.robot.n_segments, -1)
            return [self._splits(way, layer) for layer in layers for way in layer]
        # The tolerance guards the rounding.
        needed = np.maximum(np.ceil((ways - self.problem.tolerance) / self.max_step), 0)
        return [
            np.minimum(np.arange(1, n + 1) * self.max_step, way)
            for n, way in zip(needed, ways, strict=True)
        ]

    def _splits(self, way: float, layer: Float[np.ndarray, " J"]) -> Float[np.ndarray, " n"]:
        """Stops of one tendon of a layer with these ways.

        Servos that wind two tendons of a layer lose no time while both go equally far, so its
        longest one may stop after another one's way, or with another one's way left to go.
        """
        tolerance = self.problem.tolerance
        if way <= tolerance:
            return np.zeros(0)
        others = layer[layer < way] if way == layer.max() else layer[:0]
        kept = [0.0]
        for stop in np.sort([*others, *(way - others)]):
            if min(stop - kept[-1], way - stop) > tolerance:
                kept.append(stop)
        return np.array([*kept[1:], way])

    @cached_property
    def _made(self) -> Float[np.ndarray, "SJ most"]:
        """Way [m] that each tendon has gone after k of its steps; zero behind its last."""
        made = np.zeros((len(self.steps), self.steps.max() + 1))
        for row, stops in zip(made, self._stops, strict=True):
            row[1 : len(stops) + 1] = stops
        return made

    @cached_property
    def reach(self) -> Bool[np.ndarray, "stops SJ"]:
        """Tendons that the available servos meet at each stop."""
        return np.unique(self.robot.reach(self.problem.servos), axis=0)[::-1]

    @cached_property
    def stop_of_axial(self) -> Int[np.ndarray, " A"]:
        """Stop to which each axial position belongs."""
        by_axial = self.robot.reach(self.problem.servos)
        same = (by_axial[:, None] == self.reach[None]).all(axis=-1)
        return np.argmax(same, axis=1)

    @cached_property
    def start_stop(self) -> int:
        """Stop of the problem's axial position; -1 when it is not known."""
        return -1 if self.problem.axial is None else int(self.stop_of_axial[self.problem.axial - 1])

    def axial_of(self, stops: Int[np.ndarray, " K"]) -> Int[np.ndarray, " K"]:
        """Axial position, from 1, of each stop: the one the drum is at, or the lowest."""
        axial = np.argmax(self.stop_of_axial == np.arange(len(self.reach))[:, None], axis=1) + 1
        if self.problem.axial is not None:
            axial[self.start_stop] = self.problem.axial
        return axial[stops]

    @cached_property
    def actions(self) -> tuple[Int[np.ndarray, " G"], Int[np.ndarray, "G SJ"]]:
        """Stop of every action, and how many steps it moves each tendon, at most."""
        rows = []
        for stop, reach in enumerate(self.reach):
            tendons = np.flatnonzero(reach)
            for counts in self._counts(tendons):
                row = np.zeros(self.robot.n_tendons, dtype=np.int64)
                row[tendons] = counts
                rows.append((stop, row))
        return np.array([stop for stop, _ in rows]), np.array([row for _, row in rows])

    @cached_property
    def one_layer_a_step(self) -> bool:
        """Whether all tendons that can move in one step belong to one layer."""
        by_layer = self.reach.reshape(len(self.reach), self.robot.n_segments, -1).any(axis=-1)
        return bool((by_layer.sum(axis=-1) == 1).all())

    def _counts(self, tendons: Int[np.ndarray, " n"]) -> list[tuple[int, ...]]:
        """Steps of the tendons reached at one stop, for each action there."""
        if self.problem.action_set == "all":
            return [(1,) * len(tendons)]
        if self.problem.action_set == "subsets":
            sizes = range(1, len(tendons) + 1)
            subsets = (c for size in sizes for c in combinations(range(len(tendons)), size))
            return [tuple(int(i in chosen) for i in range(len(tendons))) for chosen in subsets]
        return list(product(*(range(int(n) + 1) for n in self.steps[tendons])))[1:] or [
            (1,) * len(tendons)
        ]

    def displacements(self, remaining: Int[np.ndarray, "*n SJ"]) -> Float[np.ndarray, "*n SJ"]:
        """Displacements [m] of states."""
        made = self._made[np.arange(len(self.steps)), self.steps - remaining]
        return self.problem.start + np.sign(self.problem.target - self.problem.start) * made

    def remaining(self, displacements: Float[np.ndarray, "N SJ"]) -> Int[np.ndarray, "N SJ"]:
        """States with these displacements [m], which must be of the lattice; see the one above."""
        gone = np.abs(displacements - self.problem.start)
        taken = [
            np.argmin(np.abs(own[: n + 1] - way[:, None]), axis=1)
            for own, n, way in zip(self._made, self.steps, gone.T, strict=True)
        ]
        return self.steps - np.stack(taken, axis=-1)

    def expand(
        self, remaining: Int[np.ndarray, "N SJ"]
    ) -> tuple[Bool[np.ndarray, "N G"], Int[np.ndarray, "N G SJ"]]:
        """Which actions are possible in each state, and the steps that each tendon then moves.

        A subset must consist of unfinished tendons; a whole reach moves those that are unfinished.
        """
        _, counts = self.actions
        moves = np.minimum(counts, remaining[:, None, :])
        if self.problem.action_set == "all":
            return np.any(moves, axis=-1), moves
        return np.all(moves == counts, axis=-1), moves

    def costs(
        self,
        remaining: Int[np.ndarray, "N SJ"],
        moves: Int[np.ndarray, "N SJ"],
        *,
        first: bool | Bool[np.ndarray, " N"] = False,
        expensive: bool = False,
    ) -> Float[np.ndarray, "N 2"]:
        """Cost of moving tendons by some steps, without and with a repositioning before it.

        A step into a state that the formulas do not define (tendons wound in by more than a
        segment's length), or whose cost is not finite, costs infinitely much.

        Args:
            remaining: States before the step.
            moves: Steps that each tendon moves.
            first: Which are first steps: without repositioning, clutches still engage.
            expensive: The cost by the expensive terms instead of that by the others.

        Raises:
            PlanningError: A negative cost, on which no bound could rest.
        """
        terms, weights = self._compiled_terms[expensive]
        if expensive and not terms:
            return np.zeros((len(remaining), 2))
        before, after = self.displacements(remaining), self.displacements(remaining - moves)
        firsts = np.zeros((len(before), 1))
        firsts[:, 0] = first
        size = _EXPENSIVE_BATCH if expensive else _LARGEST_BATCH
        parts: list[np.ndarray] = [np.zeros((0, 2))]
        for i in range(0, len(before), size):
            batch = slice(i, i + size)
            with jax.enable_x64(True):
                batch_costs = _batch_costs(
                    self.robot,
                    terms,
                    weights,
                    _padded(before[batch], expensive),
                    _padded((after - before)[batch], expensive),
                    self.problem.target,
                    _padded(firsts[batch], expensive),
                    one_code=expensive,
                )
                parts.append(np.asarray(batch_costs)[: len(before[batch])])
        costs = np.concatenate(parts)
        costs = np.where(np.isfinite(costs), costs, np.inf)
        if (costs < 0).any():
            raise PlanningError("a cost term is negative; terms must be at least 0")
        return costs

    @property
    def has_expensive_terms(self) -> bool:
        """Whether some terms are to be asked only about steps that would otherwise be taken."""
        return len(self._compiled_terms[True][0]) > 0

    @cached_property
    def _compiled_terms(
        self,
    ) -> dict[bool, tuple[tuple[CostTerm, ...], Float[np.ndarray, " T"]]]:
        return {e: self.problem.compiled_terms(expensive=e) for e in (False, True)}


def _padded(rows: Float[np.ndarray, "N SJ"], expensive: bool) -> Float[np.ndarray, "M SJ"]:
    if not expensive:
        return pad_rows(rows)
    return np.pad(rows, ((0, _EXPENSIVE_BATCH - len(rows)), (0, 0)))


@partial(jax.jit, static_argnames="one_code")
def _batch_costs(
    robot: Robot,
    terms: tuple[CostTerm, ...],
    weights: Float[Array, " T"],
    before: Float[Array, "N SJ"],
    move: Float[Array, "N SJ"],
    target: Float[Array, " SJ"],
    first: Float[Array, "N 1"],
    *,
    one_code: bool,
) -> Float[Array, "N 2"]:
    """Both costs of steps; ``one_code`` runs the terms twice rather than compile them twice."""
    goal = bending_angles(robot, target)

    def cost(repositions: Float[Array, ""] | float) -> jax.Array:
        flags = jnp.full(before.shape[0], repositions)
        engages = (1.0 - flags) * first[:, 0]
        moved = step(robot, before, move, flags, engages, goal)
        return jnp.asarray(transition_cost(robot, terms, weights, moved))

    # A state that is not defined makes its step impossible, whatever the terms look at.
    defined = jnp.all(jnp.isfinite(bending_angles(robot, before + move)), axis=-1)
    if one_code:
        both = jax.lax.map(cost, jnp.array([0.0, 1.0])).T
    else:
        both = jnp.stack([cost(0.0), cost(1.0)], axis=-1)
    return jnp.where(defined[:, None], both, jnp.inf)
