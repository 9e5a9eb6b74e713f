"""The paper's baselines (M Eq. 13): sequential scan, reverse scan and greedy.

A policy names a tendon; the axial motor goes to a stop where an available servo meets it, and
every available servo that meets an unfinished tendon there moves it along. The scans finish what
they started, the greedy rule chooses again after every clipped step. A caller that knows a lower
bound saves the time to find one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.lattice import Lattice, Step
from muxjax.planning.problem import Plan
from muxjax.planning.replay import replay

Policy = Callable[[Int[np.ndarray, " SJ"], Float[np.ndarray, " SJ"]], int]


def sequential(lattice: Lattice, lower_bound: float | None = None) -> Plan:
    """Tendons 1 to S*J in order (M Eq. 13a)."""
    return _run(
        lattice,
        lambda remaining, _: int(np.flatnonzero(remaining)[0]),
        True,
        "sequential",
        lower_bound,
    )


def reverse(lattice: Lattice, lower_bound: float | None = None) -> Plan:
    """Tendons S*J to 1 in order (M Eq. 13b)."""
    return _run(
        lattice,
        lambda remaining, _: int(np.flatnonzero(remaining)[-1]),
        True,
        "reverse",
        lower_bound,
    )


def greedy(lattice: Lattice, lower_bound: float | None = None) -> Plan:
    """The tendon with the largest residual, anew at every step (M Eq. 13c)."""
    return _run(lattice, lambda _, residual: int(np.argmax(residual)), False, "greedy", lower_bound)


def _run(
    lattice: Lattice, choose: Policy, to_the_end: bool, method: str, lower_bound: float | None
) -> Plan:
    remaining, stop = lattice.steps.copy(), lattice.start_stop
    steps: list[Step] = []
    while remaining.any():
        residual = np.abs(lattice.problem.target - lattice.displacements(remaining))
        residual[remaining == 0] = 0.0
        stop = _stop_for(lattice, choose(remaining, residual), stop, residual)
        while True:
            moves = (lattice.reach[stop] & (remaining > 0)).astype(np.int64)
            steps.append(Step(stop, moves))
            remaining = remaining - moves
            if not (to_the_end and _unfinished_at(lattice, stop, remaining)):
                break
    return replay(lattice, steps, method=method, lower_bound=lower_bound)


def _unfinished_at(lattice: Lattice, stop: int, remaining: Int[np.ndarray, " SJ"]) -> bool:
    at_stop: Bool[np.ndarray, " SJ"] = lattice.reach[stop] & (remaining > 0)
    return bool(at_stop.any())


def _stop_for(
    lattice: Lattice, tendon: int, present: int, residual: Float[np.ndarray, " SJ"]
) -> int:
    """Stop at which to move a tendon: the present one if it serves, else the most useful one.

    Eq. 13 leaves the choice open when several servos are available; the stop whose servos find
    the largest total residual needs the fewest stops later.
    """
    if present >= 0 and lattice.reach[present, tendon]:
        return present
    useful = np.where(lattice.reach[:, tendon], lattice.reach @ residual, -1.0)
    return int(np.argmax(useful))
