"""A JAX workbench for time-multiplexed tendon-driven arms."""

from muxjax.config import ConfigError
from muxjax.hardware import LockstepLink, Run, execute
from muxjax.ik import IkError, IkResult, IkStatus, solve_ik
from muxjax.kinematics import backbone, forward_kinematics, jacobian
from muxjax.metrics import Metrics, evaluate
from muxjax.planning import Plan, PlanningError, Problem, plan
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import Instruction, Program, schedule
from muxjax.tendons import configuration_from_tendons, tendon_displacements

__all__ = [
    "ConfigError",
    "IkError",
    "IkResult",
    "IkStatus",
    "Instruction",
    "LockstepLink",
    "Metrics",
    "Plan",
    "PlanningError",
    "Problem",
    "Program",
    "Robot",
    "Run",
    "backbone",
    "configuration_from_tendons",
    "evaluate",
    "execute",
    "forward_kinematics",
    "jacobian",
    "load_robot",
    "plan",
    "schedule",
    "solve_ik",
    "tendon_displacements",
]
