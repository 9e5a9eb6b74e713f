"""A list of poses becomes one program: which configurations, in which order of tendons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from muxjax.config import TaskConfig
from muxjax.ik import IkError
from muxjax.kinematics import forward_kinematics
from muxjax.metrics import tip_deviation
from muxjax.pipeline.poses import configurations, target_pose
from muxjax.planning import Plan, PlanningError, Problem, plan
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule
from muxjax.tendons import check_displacements, configuration_from_tendons, tendon_displacements


@dataclass(frozen=True, eq=False)
class PathPlan:
    """A motion through poses.

    Attributes:
        q: Configuration at each pose [rad].
        plans: From each configuration to the next.
        programs: Of each plan; each starts where the one before it ended.
        program: All of them as one, for ``execute``.
        cost: Sum over the plans.
        deviations: Greatest distance of the tool from the straight line between two poses, on the
            way between them [m].
    """

    q: Float[np.ndarray, "poses dof"]
    plans: tuple[Plan, ...]
    programs: tuple[Program, ...]
    program: Program
    cost: float
    deviations: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class _Label:
    """The cheapest way found to one configuration that leaves the drum at one axial position."""

    q: Float[np.ndarray, " dof"]
    displacements: Float[np.ndarray, " SJ"]
    axial: int | None
    cost: float
    plan: Plan | None = None
    before: _Label | None = None


def plan_path(
    robot: Robot,
    poses: Sequence[Float[np.ndarray, "4 4"]],
    *,
    near: Sequence[Float[np.ndarray, " dof"] | None] | None = None,
    start: Float[np.ndarray, " SJ"] | None = None,
    axial: int | None = None,
    method: str = "exact",
    candidates: int = 4,
    **fields: Any,
) -> PathPlan:
    """The cheapest motion through poses, over the configurations that reach each.

    A dynamic programme over configurations and the axial position at which a plan leaves the
    drum: the next plan starts from there. It is exact for what it chooses from, one plan of
    ``method`` between any two configurations; a dearer plan that would leave the drum better
    placed for the next is not looked for.

    Args:
        robot: The arm.
        poses: Tool poses in the world [m], in order.
        near: For each pose, a configuration [rad] to stay near to instead of choosing; or None.
        start: Displacements now [m]; the straight arm by default.
        axial: Axial position now, if known.
        method: Planner.
        candidates: Most configurations considered for a pose: those nearest, in the
            configuration's displacements, to the ones considered for the pose before.
        **fields: Other fields of ``Problem``.

    Returns:
        The plans and their program, a stop at each pose.

    Raises:
        ValueError: No poses, another number of entries in ``near``, candidates below 1, or
            fields that do not fit the robot.
        IkError: A pose cannot be reached; the message counts it from 1.
        PlanningError: No plan leads to any configuration of a pose; the message counts it from 1.
    """
    given = [None] * len(poses) if near is None else list(near)
    if not len(poses) or len(given) != len(poses):
        raise ValueError(f"poses, near: found {len(poses)} poses and {len(given)} entries in near")
    if candidates < 1:
        raise ValueError(f"candidates: must be at least 1, found {candidates}")
    begin = check_displacements(
        robot, "start", np.zeros(robot.n_tendons) if start is None else start
    )
    labels = [_Label(np.asarray(configuration_from_tendons(robot, begin)), begin, axial, 0.0)]
    for number, (pose, wanted) in enumerate(zip(poses, given, strict=True), start=1):
        try:
            goals = _goals(robot, pose, wanted, labels, candidates, fields)
            labels = _advance(robot, labels, goals, method, fields)
        except (IkError, PlanningError) as error:
            raise type(error)(f"pose {number}: {error}") from None
    return _collected(robot, min(labels, key=lambda label: label.cost))


def plan_task(robot: Robot, task: TaskConfig, **options: Any) -> PathPlan:
    """``plan_path`` through the targets of a task, each near its ``near_q_deg`` if it has one."""
    near = [None if t.near_q_deg is None else np.radians(t.near_q_deg) for t in task.targets]
    return plan_path(robot, [target_pose(t) for t in task.targets], near=near, **options)


def _goals(
    robot: Robot,
    pose: Float[np.ndarray, "4 4"],
    near: Float[np.ndarray, " dof"] | None,
    labels: list[_Label],
    candidates: int,
    fields: dict[str, Any],
) -> Float[np.ndarray, "K dof"]:
    """Configurations of a pose that the path may take."""
    reference = labels[0].q if near is None else near
    found, _ = configurations(robot, pose, reference, fields.get("world"))
    ends = tendon_displacements(robot, found)
    if near is not None:
        wanted = tendon_displacements(robot, near)
        return found[[int(np.argmin(np.abs(ends - wanted).sum(axis=1)))]]
    away = [np.abs(ends - label.displacements).sum(axis=1) for label in labels]
    return found[np.argsort(np.min(away, axis=0), kind="stable")[:candidates]]


def _advance(
    robot: Robot,
    labels: list[_Label],
    goals: Float[np.ndarray, "K dof"],
    method: str,
    fields: dict[str, Any],
) -> list[_Label]:
    """The cheapest label of each goal and last axial position.

    What follows can tell two ways to one configuration apart only by where they leave the drum.
    """
    best: dict[tuple[int, int | None], _Label] = {}
    refusals: list[str] = []
    for k, (goal, end) in enumerate(zip(goals, tendon_displacements(robot, goals), strict=True)):
        for label in labels:
            problem = Problem(label.displacements, end, axial=label.axial, **fields)
            try:
                found = plan(robot, problem, method)
            except PlanningError as refusal:
                refusals.append(str(refusal))
                continue
            if found.status == "failed":
                refusals.append(f"{method}: {found.reason}")
                continue
            last = int(found.axial[-1]) if found.n_steps else label.axial
            way = _Label(goal, found.displacements[-1], last, label.cost + found.cost, found, label)
            if (k, last) not in best or way.cost < best[k, last].cost:
                best[k, last] = way
    if not best:
        raise PlanningError(f"no plan to any of {len(goals)} configurations; {refusals[-1]}")
    return list(best.values())


def _collected(robot: Robot, last: _Label) -> PathPlan:
    way: list[_Label] = []
    label: _Label | None = last
    while label is not None and label.plan is not None:
        way.append(label)
        label = label.before
    way.reverse()
    plans = tuple(label.plan for label in way if label.plan is not None)
    programs = tuple(schedule(robot, found) for found in plans)
    return PathPlan(
        q=np.array([label.q for label in way]),
        plans=plans,
        programs=programs,
        program=replace(
            programs[0],
            target=programs[-1].target,
            instructions=tuple(item for program in programs for item in program.instructions),
        ),
        cost=last.cost,
        deviations=tuple(_deviation(robot, program) for program in programs),
    )


def _deviation(robot: Robot, program: Program) -> float:
    ends = configuration_from_tendons(robot, np.array([program.start, program.target]))
    return tip_deviation(robot, program, np.asarray(forward_kinematics(robot, ends))[:, :3, 3])
