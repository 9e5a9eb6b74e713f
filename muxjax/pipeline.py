"""From a pose to an arm that is there: the one room that knows the whole order.

pose -> q (ik) -> l (tendons) -> Plan (planning) -> Program (scheduler) -> frames (hardware)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from muxjax.config import TargetConfig, TaskConfig
from muxjax.hardware import LockstepLink, Run, execute
from muxjax.ik import IkResult, rotation_error, solve_ik
from muxjax.kinematics import forward_kinematics
from muxjax.metrics import Metrics, evaluate
from muxjax.planning import Plan, PlanningError, Problem, plan
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule
from muxjax.tendons import configuration_from_tendons, tendon_displacements

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
        ik: The configuration found; nothing was planned unless it ``converged``.
        moves: By method name.
        refusals: Why a method has no move, by method name.
    """

    target: TargetConfig
    servos: tuple[int, ...]
    ik: IkResult
    moves: dict[str, Move]
    refusals: dict[str, str]


def target_pose(target: TargetConfig) -> Float[np.ndarray, "4 4"]:
    """Homogeneous transform of a target [m]."""
    if target.quaternion_wxyz is not None:
        turn = Rotation.from_quat(target.quaternion_wxyz, scalar_first=True)
    else:
        turn = Rotation.from_euler("xyz", target.rpy_deg, degrees=True)
    return RigidTransform.from_components(target.position_m, turn).as_matrix()


def problem_for_pose(
    robot: Robot,
    pose: Float[np.ndarray, "4 4"],
    *,
    start: Float[np.ndarray, " SJ"] | None = None,
    **fields: Any,
) -> tuple[IkResult, Problem]:
    """The planning problem of moving the tool to a pose, from displacements ``start``.

    Args:
        robot: The arm.
        pose: Tool pose in the world [m].
        start: Displacements now [m]; the straight arm by default. Of several configurations, one
            near to this one is taken.
        **fields: Other fields of ``Problem``.

    Raises:
        IkError: The pose was not reached; the message gives the residual and the limits.
    """
    begin = np.zeros(robot.n_tendons) if start is None else np.asarray(start, dtype=np.float64)
    found = solve_ik(robot, pose, q0=configuration_from_tendons(robot, begin)).check()
    return found, Problem(begin, tendon_displacements(robot, found.q), **fields)


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


def pose_error(
    robot: Robot, displacements: Float[np.ndarray, " SJ"], pose: Float[np.ndarray, "4 4"]
) -> tuple[float, float]:
    """Distance [m] and angle [rad] between a pose and the tool at displacements [m]."""
    tool = forward_kinematics(robot, configuration_from_tendons(robot, displacements))
    with jax.enable_x64(True):
        _, angle = rotation_error(tool[:3, :3], pose[:3, :3])
    return float(np.linalg.norm(tool[:3, 3] - pose[:3, 3])), float(angle)


def run_task(
    robot: Robot,
    task: TaskConfig,
    *,
    servo_sets: Sequence[tuple[int, ...]],
    methods: Sequence[str],
    **fields: Any,
) -> Iterator[Outcome]:
    """Every target of a task from the straight arm, for each servo set and method in turn.

    A pose that cannot be reached yields an outcome without moves, a planner that refuses is named
    in ``refusals``, and the rest goes on.

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
                goal = tendon_displacements(robot, found.q)
                problem = Problem(np.zeros(robot.n_tendons), goal, servos=servos, **fields)
                for method in methods:
                    try:
                        outcome.moves[method] = carry_out(robot, problem, pose, method)
                    except PlanningError as refusal:
                        outcome.refusals[method] = str(refusal)
            yield outcome
