"""A pose becomes the cheapest plan over the configurations that reach it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import scipy
from jaxtyping import Float

from muxjax.collision import World, clearance
from muxjax.config import TargetConfig
from muxjax.ik import IkResult, all_ik, rotation_error, solve_ik
from muxjax.ik.every import is_exhaustive
from muxjax.kinematics import forward_kinematics
from muxjax.planning import Plan, PlanningError, Problem, plan
from muxjax.robot import Robot
from muxjax.tendons import configuration_from_tendons, tendon_displacements

CANDIDATES = 8


@dataclass(frozen=True, eq=False)
class Alternative:
    """One configuration that reaches a pose.

    Attributes:
        q: Configuration [rad].
        lower_bound: No plan to it costs less.
        plan: The plan to it; None if it was not planned because another's cost is below
            ``lower_bound``, or because ``refusal`` says why there is none.
        refusal: Why the planner has no plan, else empty.
    """

    q: Float[np.ndarray, " dof"]
    lower_bound: float
    plan: Plan | None = None
    refusal: str = ""

    @property
    def cost(self) -> float:
        """Of the plan; infinite without one."""
        return float("inf") if self.plan is None else self.plan.cost


@dataclass(frozen=True, eq=False)
class PosePlan:
    """The cheapest plan to a pose, and what else would reach it.

    Attributes:
        chosen: Its ``plan`` is the cheapest of all.
        alternatives: The other configurations, in order of their lower bounds.
        complete: Every configuration that reaches the pose was considered.
    """

    chosen: Alternative
    alternatives: tuple[Alternative, ...]
    complete: bool

    @property
    def plan(self) -> Plan:
        """The chosen plan."""
        assert self.chosen.plan is not None
        return self.chosen.plan


def target_pose(target: TargetConfig) -> Float[np.ndarray, "4 4"]:
    """Homogeneous transform of a target [m]."""
    if target.quaternion_wxyz is not None:
        turn = scipy.spatial.transform.Rotation.from_quat(target.quaternion_wxyz, scalar_first=True)
    else:
        turn = scipy.spatial.transform.Rotation.from_euler("xyz", target.rpy_deg, degrees=True)
    return scipy.spatial.transform.RigidTransform.from_components(
        target.position_m, turn
    ).as_matrix()


def problem_for_pose(
    robot: Robot,
    pose: Float[np.ndarray, "4 4"],
    *,
    start: Float[np.ndarray, " SJ"] | None = None,
    near: Float[np.ndarray, " dof"] | None = None,
    **fields: Any,
) -> tuple[IkResult, Problem]:
    """The planning problem of moving the tool to a pose by the nearest configuration.

    Args:
        robot: The arm.
        pose: Tool pose in the world [m].
        start: Displacements now [m]; the straight arm by default.
        near: Of several configurations the one nearest to this [rad]; to the present one by
            default. ``plan_to_pose`` chooses by cost instead.
        **fields: Other fields of ``Problem``.

    Raises:
        IkError: The pose was not reached; the message gives the residual and the limits.
    """
    begin = _begin(robot, start)
    reference = configuration_from_tendons(robot, begin) if near is None else near
    found = solve_ik(robot, pose, q0=reference).check()
    return found, Problem(begin, tendon_displacements(robot, found.q), **fields)


def plan_to_pose(
    robot: Robot,
    pose: Float[np.ndarray, "4 4"],
    *,
    start: Float[np.ndarray, " SJ"] | None = None,
    method: str = "exact",
    candidates: int = CANDIDATES,
    **fields: Any,
) -> PosePlan:
    """The cheapest plan to a pose over the configurations that reach it.

    Where all of them are known (three segments), each is planned unless its lower bound already
    exceeds the cheapest plan found; for other arms the one nearest to the present configuration
    is taken.

    Args:
        robot: The arm.
        pose: Tool pose in the world [m].
        start: Displacements now [m]; the straight arm by default.
        method: Planner.
        candidates: Most configurations considered, those of least lower bound first.
        **fields: Other fields of ``Problem``; with a ``world``, configurations in collision are
            left out.

    Raises:
        ValueError: Candidates below 1, or fields that do not fit the robot.
        IkError: No configuration reaches the pose; the message says how far off the closest is.
        PlanningError: There is a plan to none of them; the message says why.
    """
    begin = _begin(robot, start)
    found, complete = configurations(
        robot, pose, np.asarray(configuration_from_tendons(robot, begin)), fields.get("world")
    )
    goals = tendon_displacements(robot, found)
    problems = [Problem(begin, goal, **fields) for goal in goals]
    return cheapest(robot, found, problems, method, candidates, complete)


def cheapest(
    robot: Robot,
    configurations: Float[np.ndarray, "K dof"],
    problems: list[Problem],
    method: str,
    candidates: int,
    complete: bool,
) -> PosePlan:
    """The cheapest plan among problems that end in different configurations.

    Raises:
        ValueError: Candidates below 1, or a problem that does not fit the robot.
        PlanningError: There is a plan for none of them; the message says why.
    """
    if candidates < 1:
        raise ValueError(f"candidates: must be at least 1, found {candidates}")
    bounds = [plan(robot, problem, "sequential").lower_bound for problem in problems]
    order = np.argsort(bounds, kind="stable")[:candidates]
    tried: list[Alternative] = []
    best = float("inf")
    for k in order:
        option = Alternative(configurations[k], bounds[k])
        if option.lower_bound < best:
            option = _planned(robot, option, problems[k], method)
            best = min(best, option.cost)
        tried.append(option)
    chosen = min(tried, key=lambda option: option.cost)
    if chosen.plan is None:
        raise PlanningError(f"pose: {len(tried)} configurations reach it; {chosen.refusal}")
    others = tuple(option for option in tried if option is not chosen)
    return PosePlan(chosen, others, complete and len(tried) == len(problems))


def _planned(robot: Robot, option: Alternative, problem: Problem, method: str) -> Alternative:
    try:
        found = plan(robot, problem, method)
    except PlanningError as refusal:
        return replace(option, refusal=str(refusal))
    if found.status == "failed":
        return replace(option, refusal=f"{method}: {found.reason}")
    return replace(option, plan=found)


def configurations(
    robot: Robot,
    pose: Float[np.ndarray, "4 4"],
    near: Float[np.ndarray, " dof"],
    world: World | None = None,
) -> tuple[Float[np.ndarray, "K dof"], bool]:
    """Configurations that reach a pose, and whether these are all.

    Raises:
        IkError: There is none, or every one is in collision.
    """
    if is_exhaustive(robot):
        every = all_ik(robot, pose)
        found = np.asarray(every.q)[np.asarray(every.mask)]
        if world is not None and len(found):
            with jax.enable_x64(True):
                found = found[np.asarray(clearance(robot, found, world)) > 0]
        if len(found):
            return found, bool(every.complete)
    return np.asarray(solve_ik(robot, pose, q0=near, world=world).check().q)[None], False


def pose_error(
    robot: Robot, displacements: Float[np.ndarray, " SJ"], pose: Float[np.ndarray, "4 4"]
) -> tuple[float, float]:
    """Distance [m] and angle [rad] between a pose and the tool at displacements [m]."""
    tool = forward_kinematics(robot, configuration_from_tendons(robot, displacements))
    with jax.enable_x64(True):
        _, angle = rotation_error(tool[:3, :3], pose[:3, :3])
    return float(np.linalg.norm(tool[:3, 3] - pose[:3, 3])), float(angle)


def _begin(robot: Robot, start: Float[np.ndarray, " SJ"] | None) -> Float[np.ndarray, " SJ"]:
    return np.zeros(robot.n_tendons) if start is None else np.asarray(start, dtype=np.float64)
