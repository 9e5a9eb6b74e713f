"""From poses to an arm that is there: the one room that knows the whole order.

pose -> q (ik) -> l (tendons) -> Plan (planning) -> Program (scheduler) -> frames (hardware)
"""

from muxjax.pipeline.faults import Stranded, replan, run_to_target, without_axial_motor
from muxjax.pipeline.paths import PathPlan, plan_path, plan_task
from muxjax.pipeline.poses import (
    Alternative,
    PosePlan,
    plan_to_pose,
    pose_error,
    problem_for_pose,
    target_pose,
)
from muxjax.pipeline.tasks import Move, Outcome, carry_out, run_task

__all__ = [
    "Alternative",
    "Move",
    "Outcome",
    "PathPlan",
    "PosePlan",
    "Stranded",
    "carry_out",
    "plan_path",
    "plan_task",
    "plan_to_pose",
    "pose_error",
    "problem_for_pose",
    "replan",
    "run_task",
    "run_to_target",
    "target_pose",
    "without_axial_motor",
]
