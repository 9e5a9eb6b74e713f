"""Targets of a task, one after the other, planned and executed on a virtual board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from muxjax.config import TargetConfig, TaskConfig
from muxjax.hardware import LockstepLink, Run, execute
from muxjax.ik import IkResult, solve_ik
from muxjax.metrics import Metrics, evaluate
from muxjax.pipeline.poses import plan_to_pose, pose_error, problem_for_pose, target_pose
from muxjax.planning import Plan, PlanningError, Problem, plan
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule

# The virtual board's feedback at a tenth of its full rates: the same run, coded in less time.
_STREAM_DIVIDER = 10


@dataclass(frozen=True, eq=False)
class Move:
    """One planned and executed motion.

    Attributes:
        plan: The steps.
        program: What was executed.
        metrics: Predicted time, stages and overshoot of the program.
        run: What the board did.
        position_error: Tool position against the pose that was asked for [m].
        orientation_error: Angle of the remaining rotation [rad].
    """

    plan: Plan
    program: Program
    metrics: Metrics
    run: Run
    position_error: float
    orientation_error: float


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one target of a task for one servo set.

    Attributes:
        target: The target.
        servos: Available servos, from 1.
        ik: The configuration nearest to the wanted one; nothing was planned unless it
            ``converged``.
        moves: By method name.
        refusals: Why a method has no move, by method name.
    """

    target: TargetConfig
    servos: tuple[int, ...]
    ik: IkResult
    moves: dict[str, Move]
    refusals: dict[str, str]


def carry_out(
    robot: Robot, problem: Problem, pose: Float[np.ndarray, "4 4"], method: str = "exact"
) -> Move:
    """Plan, schedule and execute on a virtual board, then look where the tool is.

    Raises:
        ValueError: The problem does not fit the robot.
        PlanningError: The planner found no plan, or the lattice is too large for the exact one.
    """
    found = plan(robot, problem, method)
    if found.status == "failed":
        raise PlanningError(f"{method}: {found.reason}")
    program = schedule(robot, found)
    link = LockstepLink(
        robot, displacements=problem.start, axial=problem.axial, stream_divider=_STREAM_DIVIDER
    )
    run = execute(program, link)
    end = run.measured if run.trajectory is None else run.trajectory.displacements[-1]
    position_error, orientation_error = pose_error(robot, end, pose)
    return Move(
        plan=found,
        program=program,
        metrics=evaluate(robot, program),
        run=run,
        position_error=position_error,
        orientation_error=orientation_error,
    )


def run_task(
    robot: Robot,
    task: TaskConfig,
    *,
    servo_sets: Sequence[tuple[int, ...]],
    methods: Sequence[str],
    **fields: Any,
) -> Iterator[Outcome]:
    """Every target of a task from the straight arm, for each servo set and method in turn.

    A target goes to the configuration nearest to its ``near_q_deg``; without one, to that of the
    cheapest plan of the first method, so that the others are compared on the same problem. A pose
    that cannot be reached yields an outcome without moves, a planner that refuses is named in
    ``refusals``, and the rest goes on.

    Args:
        robot: The arm.
        task: Target poses.
        servo_sets: Sets of available servos, from 1.
        methods: Planner names.
        **fields: Other fields of ``Problem``, such as ``max_step`` and ``preset``.
    """
    for target in task.targets:
        pose = target_pose(target)
        near = None if target.near_q_deg is None else np.radians(target.near_q_deg)
        found = solve_ik(robot, pose, q0=near)
        for servos in servo_sets:
            outcome = Outcome(target, servos, found, {}, {})
            if bool(found.converged):
                problem = _problem(robot, pose, near, methods[0], {"servos": servos, **fields})
                for method in methods:
                    try:
                        outcome.moves[method] = carry_out(robot, problem, pose, method)
                    except PlanningError as refusal:
                        outcome.refusals[method] = str(refusal)
            yield outcome


def _problem(
    robot: Robot,
    pose: Float[np.ndarray, "4 4"],
    near: Float[np.ndarray, " dof"] | None,
    method: str,
    fields: dict[str, Any],
) -> Problem:
    if near is None:
        try:
            return plan_to_pose(robot, pose, method=method, **fields).plan.problem
        except PlanningError:
            pass  # every method says for itself why the nearest configuration has no plan either
    return problem_for_pose(robot, pose, near=near, **fields)[1]
