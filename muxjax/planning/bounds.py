"""What a plan still has to cost at least: admissible heuristics and certificates."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.lattice import Lattice
from muxjax.planning.motion import angles_at
from muxjax.planning.patterns import BendingPattern
from muxjax.planning.problem import TERMS


class AdmissibleBound:
    """Lower bound on the cost to go from states of a lattice, term by term.

    - travel: the residuals, exactly, since moves never turn back;
    - switches: stops still needed by the unfinished tendons that the present stop does not reach;
    - time: those stops' repositioning, and the motion if every servo could always work (a first
      engagement without repositioning is left out);
    - bending: the last step ends at the target's bending, and a pattern database knows more where
      its tables are small enough (``patterns.py``);
    - overshoot and terms of a user: nothing, which is a bound because no term may be negative.
    """

    def __init__(self, lattice: Lattice) -> None:
        self._lattice = lattice
        problem = lattice.problem
        # A user's term may take the name of a shipped one; no bound is known for it.
        self._weights = {
            name: problem.cost_weights[name]
            for name, term in problem.weighted_terms
            if term is TERMS.get(name)
        }

    def __call__(
        self,
        remaining: Int[np.ndarray, "N SJ"],
        stop: Int[np.ndarray, " N"],
        *,
        for_order: bool = False,
    ) -> Float[np.ndarray, " N"]:
        """Bound at states.

        Args:
            remaining: Steps that each tendon has to go.
            stop: The present one, or -1.
            for_order: Leave out the pattern by actions: it rises in jumps, and tighter as it is, it
                ranks the states of a level worse than the pattern by steps alone.
        """
        unfinished = remaining > 0
        residual = np.abs(self._end - self._lattice.displacements(remaining)) * unfinished
        stops = self._stops_needed(unfinished, stop)
        by_term = {
            "travel": residual.sum(axis=-1),
            "switches": stops,
            "time": stops * float(self._lattice.robot.switch_time) + self._motion_time(residual),
            "bending": self._bending(
                remaining, self._patterns[:1] if for_order else self._patterns
            ),
        }
        total = np.zeros(len(remaining))
        for name, weight in self._weights.items():
            if name in by_term:
                total = total + weight * by_term[name]
        return total

    def _bending(
        self, remaining: Int[np.ndarray, "N SJ"], patterns: list[BendingPattern]
    ) -> Float[np.ndarray, " N"]:
        end = float(np.sum(self._end_angles**2))
        last = np.where((remaining > 0).any(axis=-1), end, 0.0)
        for pattern in patterns:
            last = np.maximum(last, pattern(remaining))
        return last

    @cached_property
    def _patterns(self) -> list[BendingPattern]:
        if not self._weights.get("bending"):
            return []
        one_servo = int(self._lattice.reach.sum(axis=1).max()) == 1  # the two are then the same
        kinds = (False,) if one_servo else (False, True)
        return [BendingPattern(self._lattice, in_actions=kind) for kind in kinds]

    @cached_property
    def _end(self) -> Float[np.ndarray, " SJ"]:
        """Where clipped moves end: the target, up to the tolerance."""
        return self._lattice.displacements(np.zeros_like(self._lattice.steps))

    @cached_property
    def _end_angles(self) -> Float[np.ndarray, " S"]:
        return angles_at(self._lattice.robot, self._end[None])[0]

    def _by_layer(self, values: np.ndarray) -> np.ndarray:
        """Tendons that may share a step, in a group each: the layers, or else all in one."""
        robot = self._lattice.robot
        if not self._lattice.one_layer_a_step:
            return values[:, None, :]
        return values.reshape(-1, robot.n_segments, robot.tendons_per_segment)

    def _stops_needed(
        self, unfinished: Bool[np.ndarray, "N SJ"], stop: Int[np.ndarray, " N"]
    ) -> Int[np.ndarray, " N"]:
        reach = self._lattice.reach
        here = np.where((stop >= 0)[:, None], reach[stop], False)
        elsewhere = self._by_layer(unfinished & ~here).sum(axis=-1)
        return np.ceil(elsewhere / reach.sum(axis=-1).max()).astype(np.int64).sum(axis=-1)

    def _motion_time(self, residual: Float[np.ndarray, "N SJ"]) -> Float[np.ndarray, " N"]:
        layers = self._by_layer(residual)
        servos = self._lattice.reach.sum(axis=-1).max()
        shortest = np.maximum(layers.max(axis=-1), layers.sum(axis=-1) / servos)
        return shortest.sum(axis=-1) / float(self._lattice.robot.tendon_speed)
