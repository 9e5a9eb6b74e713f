"""A JAX workbench for time-multiplexed tendon-driven arms."""

from muxjax.collision import World, clearance, load_world
from muxjax.config import ConfigError
from muxjax.hardware import BusLink, Journal, LockstepLink, Run, execute, resume
from muxjax.ik import (
    AllIkResult,
    IkError,
    IkResult,
    IkStatus,
    PathResult,
    all_ik,
    attach_derivatives,
    solve_ik,
    solve_path,
)
from muxjax.kinematics import backbone, forward_kinematics, jacobian
from muxjax.metrics import Metrics, evaluate, tension_along
from muxjax.planning import Plan, PlanningError, Problem, Tension, plan
from muxjax.robot import Robot, load_robot
from muxjax.scheduler import Instruction, Program, schedule
from muxjax.statics import (
    ElasticChain,
    Equilibrium,
    InverseResult,
    StaticsError,
    StaticsStatus,
    elastic_chain,
    forward_statics,
    inverse_statics,
    load_chain,
    true_posture,
)
from muxjax.tendons import configuration_from_tendons, tendon_displacements
from muxjax.workspace import load_sweep, sweep

__all__ = [
    "AllIkResult",
    "BusLink",
    "ConfigError",
    "ElasticChain",
    "Equilibrium",
    "IkError",
    "IkResult",
    "IkStatus",
    "Instruction",
    "InverseResult",
    "Journal",
    "LockstepLink",
    "Metrics",
    "PathResult",
    "Plan",
    "PlanningError",
    "Problem",
    "Program",
    "Robot",
    "Run",
    "StaticsError",
    "StaticsStatus",
    "Tension",
    "World",
    "all_ik",
    "attach_derivatives",
    "backbone",
    "clearance",
    "configuration_from_tendons",
    "elastic_chain",
    "evaluate",
    "execute",
    "forward_kinematics",
    "forward_statics",
    "inverse_statics",
    "jacobian",
    "load_chain",
    "load_robot",
    "load_sweep",
    "load_world",
    "plan",
    "resume",
    "schedule",
    "solve_ik",
    "solve_path",
    "sweep",
    "tendon_displacements",
    "tension_along",
    "true_posture",
]
