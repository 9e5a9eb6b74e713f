"""What a plan still has to cost at least: admissible heuristics and certificates."""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.lattice import Lattice
from muxjax.planning.motion import angles_at
from muxjax.planning.patterns import Prices, VisitPattern
from muxjax.planning.problem import TERMS
from muxjax.planning.stop_patterns import StopPattern, stop_pattern


class AdmissibleBound:
    """Lower bound on the cost to go from states of a lattice, term by term.

    - travel: the residuals, exactly, since moves never turn back;
    - switches: stops still needed by the unfinished tendons that the present stop does not reach;
    - time: those stops' repositioning, and the motion if every servo could always work (a first
      engagement without repositioning is left out);
    - bending: the last step ends at the target's bending, and a pattern database knows more; so it
      does about switches beyond those needed, and about overshoot while the drum moves
      (``stop_patterns.py``, or ``patterns.py`` where that does not fit);
    - other terms, and overshoot while tendons move: nothing, which is a bound because no term may
      be negative.
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
        self, remaining: Int[np.ndarray, "N SJ"], stop: Int[np.ndarray, " N"]
    ) -> Float[np.ndarray, " N"]:
        """Bound at states: steps that each tendon has to go, and the present stop, or -1."""
        unfinished = remaining > 0
        residual = np.abs(self._end - self._lattice.displacements(remaining)) * unfinished
        visits = self._stops_needed(unfinished, stop)
        stops = visits.sum(axis=-1)
        by_term = {
            "travel": residual.sum(axis=-1),
            "switches": stops,
            "time": stops * float(self._lattice.robot.switch_time) + self._motion_time(residual),
            "bending": unfinished.any(axis=-1) * float(np.sum(self._end_angles**2)),
        }
        total = np.zeros(len(remaining))
        for name, weight in self._weights.items():
            if name in by_term:
                total = total + weight * by_term[name]
        more = known = self._weights.get("bending", 0.0) * by_term["bending"]
        if self._pattern is not None:
            # Of its switches, which are those into the layers that it knows, some are in the total.
            counted = self._prices.switch * visits[:, : self._pattern.layers].sum(axis=-1)
            more = np.maximum(more, self._pattern(remaining, stop) - counted)
        for pattern in self._coarse_patterns:
            more = np.maximum(more, pattern(remaining, stop, visits))
        return total + (more - known)

    @cached_property
    def _prices(self) -> Prices:
        weights, seconds = self._weights, float(self._lattice.robot.switch_time)
        return Prices(
            bending=weights.get("bending", 0.0),
            switch=weights.get("switches", 0.0) + seconds * weights.get("time", 0.0),
            waiting=seconds * weights.get("overshoot", 0.0),
        )

    @cached_property
    def _goal(self) -> Float[np.ndarray, " S"]:
        return angles_at(self._lattice.robot, self._lattice.problem.target[None])[0]

    @cached_property
    def _pattern(self) -> StopPattern | None:
        prices = self._prices
        return stop_pattern(self._lattice, prices, self._goal) if any(prices) else None

    @cached_property
    def _coarse_patterns(self) -> list[VisitPattern]:
        """Where there is no finer pattern; beside one of wide cells, where they often know more."""
        prices, finer = self._prices, self._pattern
        one_servo = int(self._lattice.reach.sum(axis=1).max()) == 1
        helps = one_servo or prices.waiting > 0
        enough = finer is not None and not (finer.wide and helps)
        if enough or not (prices.bending or prices.waiting):
            return []
        # With one servo steps and actions are the same.
        return [
            VisitPattern(self._lattice, prices, self._goal, in_actions=kind)
            for kind in ((False,) if one_servo else (False, True))
        ]

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
    ) -> Int[np.ndarray, "N groups"]:
        reach = self._lattice.reach
        here = np.where((stop >= 0)[:, None], reach[stop], False)
        elsewhere = self._by_layer(unfinished & ~here).sum(axis=-1)
        return np.ceil(elsewhere / reach.sum(axis=-1).max()).astype(np.int64)

    def _motion_time(self, residual: Float[np.ndarray, "N SJ"]) -> Float[np.ndarray, " N"]:
        layers = self._by_layer(residual)
        servos = self._lattice.reach.sum(axis=-1).max()
        shortest = np.maximum(layers.max(axis=-1), layers.sum(axis=-1) / servos)
        return shortest.sum(axis=-1) / float(self._lattice.robot.tendon_speed)


@lru_cache(maxsize=1)
def bound_of(lattice: Lattice) -> AdmissibleBound:
    """The lattice's bound; planners that follow each other share its pattern databases."""
    return AdmissibleBound(lattice)
