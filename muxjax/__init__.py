"""A JAX workbench for time-multiplexed tendon-driven arms."""

from muxjax.config import ConfigError
from muxjax.kinematics import backbone, forward_kinematics, jacobian
from muxjax.robot import Robot, load_robot
from muxjax.tendons import configuration_from_tendons, tendon_displacements

__all__ = [
    "ConfigError",
    "Robot",
    "backbone",
    "configuration_from_tendons",
    "forward_kinematics",
    "jacobian",
    "load_robot",
    "tendon_displacements",
]
