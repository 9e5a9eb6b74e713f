"""The trade of time against overshoot: certified optima for a series of weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.planning.exact import exact
from muxjax.planning.lattice import Lattice
from muxjax.planning.motion import bending_angles
from muxjax.planning.problem import Plan, Problem, check_problem
from muxjax.planning.terms import overshoot, step, time
from muxjax.precision import pad_rows
from muxjax.robot import Robot

Array = jax.Array | np.ndarray


@dataclass(frozen=True, eq=False)
class FrontPoint:
    """One plan of a front.

    Attributes:
        weight: Weight of overshoot against time at which the plan is the optimum.
        time_s: Execution time [s] (M Eq. 14).
        overshoot_s: Relative overshoot integrated over it [s].
        stages: Visits of an axial position.
        plan: The plan.
    """

    weight: float
    time_s: float
    overshoot_s: float
    stages: int
    plan: Plan


def front(robot: Robot, problem: Problem, weights: Sequence[float]) -> list[FrontPoint]:
    """Plans of which none is both faster and with less overshoot than another, by time.

    Each is the certified optimum of time plus a weight times the overshoot integral, so the front
    is that of the action set's lower convex hull. On a lattice of partial moves (``max_step``) a
    tendon may be visited more than once: these are the extra stages that buy less overshoot.

    Args:
        robot: The arm.
        problem: Start, target, servos and lattice; its own weights do not count.
        weights: Weights of overshoot, at least 0.

    Raises:
        ValueError: A problem or weight that does not fit.
        PlanningError: The lattice does not fit in the exact planner's memory.
    """
    points = []
    for weight in weights:
        weighted = replace(problem, weights={"time": 1.0, "overshoot": float(weight)}, terms={})
        check_problem(robot, weighted)
        found = exact(Lattice(robot, weighted))
        if found.status == "failed":
            return []
        seconds, excess, stages = _figures(robot, found)
        points.append(FrontPoint(float(weight), seconds, excess, stages, found))
    points.sort(key=lambda p: (p.time_s, p.overshoot_s))
    kept: list[FrontPoint] = []
    for point in points:
        if not kept or point.overshoot_s < kept[-1].overshoot_s - 1e-9:
            kept.append(point)
    return kept


def _figures(robot: Robot, plan: Plan) -> tuple[float, float, int]:
    """Time [s], overshoot integral [s] and stages."""
    repositions = np.diff(plan.axial, prepend=plan.problem.axial or 0) != 0
    engages = ~repositions & (np.arange(len(repositions)) == 0)
    with jax.enable_x64(True):
        sums = _time_and_overshoot(
            robot,
            pad_rows(plan.displacements[:-1]),
            pad_rows(np.diff(plan.displacements, axis=0)),
            pad_rows(repositions.astype(float)),
            pad_rows(engages.astype(float)),
            plan.problem.target,
        )
        seconds, excess = np.asarray(sums)[:, : len(repositions)].sum(axis=1)
    return float(seconds), float(excess), int(np.sum(repositions | engages))


@jax.jit
def _time_and_overshoot(
    robot: Robot,
    before: Float[Array, "P SJ"],
    move: Float[Array, "P SJ"],
    repositions: Float[Array, " P"],
    engages: Float[Array, " P"],
    target: Float[Array, " SJ"],
) -> Float[Array, "2 P"]:
    goal = bending_angles(robot, target)
    moved = step(robot, before, move, repositions, engages, goal)
    return jnp.stack([time(robot, moved), overshoot(robot, moved)])
