"""States and actions of clipped moves towards the target (MODEL.md section 5).

Tendon c has n_c steps to go, so a state is a vector of remaining steps and the last axial
position. Axial positions at which the available servos reach the same tendons are one *stop*:
nothing that follows can tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.motion import bending_angles
from muxjax.planning.problem import (
    PlanningError,
    Problem,
    Term,
    clipped_move,
    step,
    transition_cost,
)
from muxjax.precision import pad_rows
from muxjax.robot import Robot

Array = jax.Array | np.ndarray
_LARGEST_BATCH = 16384


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
        """n_c: steps of each tendon from the start. The tolerance guards the rounding."""
        residual = np.abs(self.problem.target - self.problem.start)
        needed = np.ceil((residual - self.problem.tolerance) / self.max_step)
        return np.maximum(needed, 0).astype(np.int64)

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
    def actions(self) -> tuple[Int[np.ndarray, " G"], Bool[np.ndarray, "G SJ"]]:
        """Stop and tendons of every action: a stop's whole reach, or each subset of it."""
        whole = self.problem.action_set == "all"
        rows = []
        for stop, reach in enumerate(self.reach):
            tendons = np.flatnonzero(reach)
            for size in range(len(tendons) if whole else 1, len(tendons) + 1):
                rows += [(stop, chosen) for chosen in combinations(tendons, size)]
        masks = np.zeros((len(rows), self.robot.n_tendons), dtype=bool)
        for mask, (_, chosen) in zip(masks, rows, strict=True):
            mask[list(chosen)] = True
        return np.array([stop for stop, _ in rows]), masks

    def displacements(self, remaining: Int[np.ndarray, "*n SJ"]) -> Float[np.ndarray, "*n SJ"]:
        """Displacements [m] of states."""
        residual = self.problem.target - self.problem.start
        made = np.minimum((self.steps - remaining) * self.max_step, np.abs(residual))
        return self.problem.start + np.sign(residual) * made

    def expand(
        self, remaining: Int[np.ndarray, "N SJ"]
    ) -> tuple[Bool[np.ndarray, "N G"], Bool[np.ndarray, "N G SJ"]]:
        """Which actions are possible in each state, and the tendons that then move.

        A subset must consist of unfinished tendons; a whole reach moves those that are unfinished.
        """
        _, masks = self.actions
        moves = masks & (remaining[:, None, :] > 0)
        if self.problem.action_set == "all":
            return np.any(moves, axis=-1), moves
        return np.all(moves == masks, axis=-1), moves

    def costs(
        self,
        remaining: Int[np.ndarray, "N SJ"],
        moves: Bool[np.ndarray, "N SJ"],
        *,
        first: bool = False,
    ) -> Float[np.ndarray, "N 2"]:
        """Cost of moving tendons one step, without and with an axial repositioning before it.

        A step into a state that the formulas do not define (tendons wound in by more than a
        segment's length), or whose cost is not finite, costs infinitely much.

        Args:
            remaining: States before the step.
            moves: Tendons that move.
            first: These are first steps: without repositioning, clutches still engage.

        Raises:
            PlanningError: A negative cost, on which no bound could rest.
        """
        before = self.displacements(remaining)
        starts = range(0, len(before), _LARGEST_BATCH)
        parts = [np.zeros((0, 2))]
        for batch in (slice(i, i + _LARGEST_BATCH) for i in starts):
            parts.append(self._costs_of_batch(before[batch], moves[batch], first))
        costs = np.concatenate(parts)
        costs = np.where(np.isfinite(costs), costs, np.inf)
        if (costs < 0).any():
            raise PlanningError("a cost term is negative; terms must be at least 0")
        return costs

    def _costs_of_batch(
        self, before: Float[np.ndarray, "N SJ"], moves: Bool[np.ndarray, "N SJ"], first: bool
    ) -> Float[np.ndarray, "N 2"]:
        with jax.enable_x64(True):
            costs = _batch_costs(
                self.robot,
                self.problem.weighted_terms,
                self.problem.weight_vector,
                pad_rows(before),
                pad_rows(moves.astype(np.float64)),
                self.problem.target,
                np.float64(self.max_step),
                np.float64(first),
            )
            return np.asarray(costs)[: len(before)]


@partial(jax.jit, static_argnums=1)
def _batch_costs(
    robot: Robot,
    terms: tuple[tuple[str, Term], ...],
    weights: Float[Array, " T"],
    before: Float[Array, "N SJ"],
    chosen: Float[Array, "N SJ"],
    target: Float[Array, " SJ"],
    max_step: Float[Array, ""],
    first: Float[Array, ""],
) -> Float[Array, "N 2"]:
    goal = bending_angles(robot, target)
    move = clipped_move(before, target, chosen, max_step)

    def cost(repositions: float) -> Float[Array, " N"]:
        flags = jnp.full(before.shape[0], repositions)
        engages = (1.0 - flags) * first
        return transition_cost(
            robot, terms, weights, step(robot, before, move, flags, engages, goal)
        )

    # A state that is not defined makes its step impossible, whatever the terms look at.
    defined = jnp.all(jnp.isfinite(bending_angles(robot, before + move)), axis=-1)
    both = jnp.stack([cost(0.0), cost(1.0)], axis=-1)
    return jnp.where(defined[:, None], both, jnp.inf)
