"""One lattice's compiled search: its arrays once, then any width and any plan to better."""

from __future__ import annotations

import jax
import numpy as np

from muxjax.planning.arrays import level_room
from muxjax.planning.bounds import bound_of
from muxjax.planning.lattice import Lattice, Step
from muxjax.planning.problem import PlanningError
from muxjax.planning.search import Found, ValueFunction, search
from muxjax.planning.terms import traced

# For the plans of a level: one compilation each.
_ROOMS = (1, 16, 64, 256, 1024, 4096, 16384, 65536)
WIDEST = _ROOMS[-1]


class Beam:
    """The compiled search of one lattice, for any width and any plan to better.

    Args:
        lattice: The problem on the robot.
        heuristic: As in ``beamstep``.
        value_fn: As in ``beamstep``.

    Attributes:
        arrays: The lattice's and the bound's, on the device.
    """

    def __init__(
        self, lattice: Lattice, heuristic: str = "patterns", value_fn: ValueFunction | None = None
    ) -> None:
        self.lattice = lattice
        self._terms = (
            *lattice.problem.compiled_terms(expensive=False),
            *lattice.problem.compiled_terms(expensive=True),
        )
        self._value = None if value_fn is None else traced(value_fn)
        bound = bound_of(lattice)
        with jax.enable_x64(True):
            self.arrays = jax.device_put((bound.lattice_arrays, bound.arrays(heuristic)))

    def search(self, width: int, best: float = np.inf) -> Found:
        """The best plan of at most ``width`` a level, if it costs less than ``best``.

        Raises:
            PlanningError: A cost term is negative.
        """
        with jax.enable_x64(True):
            found = search(
                self.lattice.robot,
                *self._terms,
                *self.arrays,
                self._value,
                np.int32(width),
                np.float64(best),
                rows=next(room for room in _ROOMS if room >= width),
                levels=level_room(self.lattice),
            )
            found = jax.device_get(found)
        if found.negative:
            raise PlanningError("a cost term is negative; terms must be at least 0")
        return found

    def steps(self, found: Found) -> list[Step]:
        """The steps of the plan that was found."""
        actions, row = [int(found.action)], int(found.parent)
        for level in reversed(range(int(found.length) - 1)):
            actions.append(int(found.actions[level, row]))
            row = int(found.parents[level, row])
        stops, counts = self.lattice.actions
        remaining, steps = self.lattice.steps, list[Step]()
        for action in reversed(actions):
            steps.append(Step(int(stops[action]), np.minimum(counts[action], remaining)))
            remaining = remaining - steps[-1].moves
        return steps
