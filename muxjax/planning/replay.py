"""From chosen steps to a priced Plan."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.axial import fewest_repositionings
from muxjax.planning.bounds import bound_of
from muxjax.planning.lattice import Lattice, Step
from muxjax.planning.problem import Plan
from muxjax.planning.table import FullMoveTable

_ROUNDING = 1e-12  # relative, between the sums of two plans of equal cost


def replay(
    lattice: Lattice,
    steps: list[Step],
    *,
    method: str,
    lower_bound: float | None = None,
    expansions: int = 0,
    optimal: bool = False,
) -> Plan:
    """The Plan of a sequence of steps that ends at the target, with its cost, or a failed one.

    Every planner's result is priced here, so that their costs can be compared to the last bit.
    Axial positions are the planner's, or those with the fewest repositionings where that is
    cheaper.

    Args:
        lattice: The problem on the robot.
        steps: From the start to the target.
        method: Name of the planner.
        lower_bound: What the planner has proved; by default the bound at the start.
        expansions: States whose steps were evaluated.
        optimal: The planner has proved that nothing is cheaper.
    """
    moved = np.array([s.moves for s in steps], dtype=np.int64).reshape(-1, lattice.robot.n_tendons)
    remaining = lattice.steps - np.concatenate([0 * lattice.steps[None], np.cumsum(moved, axis=0)])
    displacements = lattice.displacements(remaining)
    off = float(np.max(np.abs(displacements[-1] - lattice.problem.target)))
    # The slack is for start + (target - start) != target in floating point.
    if remaining[-1].any() or off > lattice.problem.tolerance * (1 + 1e-9):
        raise AssertionError(f"{method}: the plan ends {off:g} m from the target")
    own = lattice.axial_of(np.array([s.stop for s in steps], dtype=np.int64))
    first = np.arange(len(moved)) == 0
    both, obstacles = (
        lattice.costs(remaining[:-1], moved, first=first, expensive=e) for e in (False, True)
    )
    cost, axial = min(
        (
            (_cost(lattice, both + obstacles, axial), axial)
            for axial in (own, _fewest(lattice, moved > 0, own))
        ),
        key=lambda priced: priced[0],
    )
    if not np.isfinite(cost):
        return failed(lattice, method=method, reason=_why(lattice, both), expansions=expansions)
    if optimal:
        lower_bound = cost
    elif lower_bound is None:
        lower_bound = _bound_at_start(lattice)
    return Plan(
        displacements=displacements,
        axial=axial,
        cost=cost,
        lower_bound=min(cost, lower_bound),
        expansions=expansions,
        problem=lattice.problem,
        fingerprint=lattice.robot.fingerprint,
        method=method,
        status="optimal" if optimal else "feasible",
        action_set=lattice.problem.action_set,
    )


def _why(lattice: Lattice, both: Float[np.ndarray, "K 2"]) -> str:
    if lattice.problem.world is not None and np.isfinite(both).all():
        return "it passes through a collision"
    return "it passes through a state that is not defined, or whose cost is not finite"


def _cost(lattice: Lattice, both: Float[np.ndarray, "K 2"], axial: Int[np.ndarray, " K"]) -> float:
    """Sum over steps whose cost depends on whether the axial motor moves before them."""
    repositions = np.diff(axial, prepend=lattice.problem.axial or 0) != 0
    return float(np.sum(np.where(repositions, both[:, 1], both[:, 0])))


def _fewest(
    lattice: Lattice, moving: Bool[np.ndarray, "K SJ"], own: Int[np.ndarray, " K"]
) -> Int[np.ndarray, " K"]:
    problem = lattice.problem
    return fewest_repositionings(lattice.robot, moving, problem.servos, problem.axial, own)


def failed(lattice: Lattice, *, method: str, reason: str, expansions: int) -> Plan:
    """The Plan that says that none was found."""
    return Plan(
        displacements=lattice.problem.start[None],
        axial=np.zeros(0, dtype=np.int64),
        cost=float("inf"),
        lower_bound=_bound_at_start(lattice),
        expansions=expansions,
        problem=lattice.problem,
        fingerprint=lattice.robot.fingerprint,
        method=method,
        status="failed",
        reason=reason,
        action_set=lattice.problem.action_set,
    )


@lru_cache(maxsize=4)  # of lattices that are planned side by side
def _bound_at_start(lattice: Lattice) -> float:
    """What no plan can beat: of full moves their optimum, which takes less than patterns do."""
    if FullMoveTable.fits(lattice) and lattice.steps.any():
        choices = FullMoveTable(lattice).choices(lattice.steps, lattice.start_stop, first=True)
        optimum = float(np.min(choices.cost + choices.to_go))
        if np.isfinite(optimum):
            return optimum * (1 - _ROUNDING)
    start = lattice.steps[None], np.array([lattice.start_stop])
    return float(bound_of(lattice)(*start)[0])
