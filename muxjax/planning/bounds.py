"""What a plan still has to cost at least: admissible heuristics and certificates."""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float, Int

from muxjax.planning.arrays import (
    BoundArrays,
    LatticeArrays,
    PatternArrays,
    bound_arrays,
    lattice_arrays,
)
from muxjax.planning.lattice import Lattice
from muxjax.planning.motion import angles_at
from muxjax.planning.patterns import Prices, visit_pattern
from muxjax.planning.problem import TERMS
from muxjax.planning.stop_patterns import stop_pattern


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
        return np.asarray(self.arrays()(self.lattice_arrays, remaining, stop, np))

    def arrays(self, heuristic: str = "patterns") -> BoundArrays:
        """The bound, or a part of it, for compiled searches.

        Args:
            heuristic: "patterns" for all of it, "count" for what needs no pattern database, "none"
                for zero.
        """
        weights = {} if heuristic == "none" else self._weights
        patterns = self._patterns if heuristic == "patterns" else []
        return bound_arrays(self._lattice, weights, self._last, patterns)

    @cached_property
    def lattice_arrays(self) -> LatticeArrays:
        """The lattice, for compiled searches and for what guides them."""
        return lattice_arrays(self._lattice)

    @cached_property
    def _last(self) -> float:
        """Sum of theta^2 [rad^2] where clipped moves end: the target, up to the tolerance."""
        end = self._lattice.displacements(np.zeros_like(self._lattice.steps))
        return float(np.sum(angles_at(self._lattice.robot, end[None]) ** 2))

    @cached_property
    def _prices(self) -> Prices:
        weights, seconds = self._weights, float(self._lattice.robot.switch_time)
        return Prices(
            bending=weights.get("bending", 0.0),
            switch=weights.get("switches", 0.0) + seconds * weights.get("time", 0.0),
            waiting=seconds * weights.get("overshoot", 0.0),
        )

    @cached_property
    def _patterns(self) -> list[PatternArrays]:
        """The finer pattern, and coarse ones in its place or, where its cells are wide, beside it.

        Beside it they know more only with one servo, or with a price on overshoot.
        """
        lattice, prices = self._lattice, self._prices
        if not any(prices):
            return []
        goal = angles_at(lattice.robot, lattice.problem.target[None])[0]
        finer = stop_pattern(lattice, prices, goal)
        one_servo = int(lattice.reach.sum(axis=1).max()) == 1
        helps = one_servo or prices.waiting > 0
        enough = finer is not None and not (finer.wide and helps)
        found = [] if finer is None else [finer.arrays()]
        if not enough and (prices.bending or prices.waiting):
            # With one servo steps and actions are the same.
            for kind in (False,) if one_servo else (False, True):
                pattern = visit_pattern(lattice, prices, goal, in_actions=kind)
                found += [] if pattern is None else [pattern]
        return found


@lru_cache(maxsize=4)  # of lattices that are planned side by side
def bound_of(lattice: Lattice) -> AdmissibleBound:
    """The lattice's bound; planners that follow each other share its pattern databases."""
    return AdmissibleBound(lattice)
