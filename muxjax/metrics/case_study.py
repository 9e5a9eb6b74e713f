"""One target, every planner of the paper's Fig. 6 and two of ours (M VI-A3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from muxjax.metrics.program import Metrics, evaluate
from muxjax.metrics.protocol import Protocol, Setting
from muxjax.planning import plan
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule

# Panels (b) to (g) of M Fig. 6 in its order, then ours: name, of a robot of {n} tendons, setting of
# the protocol, servos.
PANELS = (
    ("BeamStep, 3 servos", "BeamStep, as printed", 3),
    ("BeamStep, 2 servos", "BeamStep, as printed", 2),
    ("greedy, 1 servo", "greedy", 1),
    ("tendons 1 to {n}, 1 servo", "tendons 1 to 9", 1),
    ("tendons {n} to 1, 1 servo", "tendons 9 to 1", 1),
    ("BeamStep, 1 servo", "BeamStep, as printed", 1),
    ("ours, 1 servo", "exact, least overshoot", 1),
    ("ours, 3 servos", "exact, least overshoot", 3),
)


@dataclass(frozen=True, eq=False)
class Panel:
    """A program of the case study.

    Attributes:
        name: Of the planner, with its servos.
        setting: Of the protocol.
        servos: How many.
        program: What is executed.
        metrics: Its figures.
    """

    name: str
    setting: str
    servos: int
    program: Program
    metrics: Metrics


def case_study(
    robot: Robot, protocol: Protocol, target: Float[np.ndarray, " SJ"]
) -> Iterator[Panel]:
    """Programs from straight to one target, under the settings of a protocol of Table II.

    Args:
        robot: The arm.
        protocol: With the settings that ``PANELS`` names.
        target: Tendon displacements [m].

    Raises:
        ValueError: The protocol lacks a setting, or the target does not fit the robot.
    """
    settings = {setting.name: setting for setting in protocol.settings}
    for name, wanted, servos in PANELS:
        if wanted not in settings:
            raise ValueError(
                f"protocol {protocol.name!r}: no setting is named {wanted!r}; "
                "configs/bench/table2.yaml has all of them"
            )
        yield _panel(
            robot, protocol, target, name.format(n=robot.n_tendons), settings[wanted], servos
        )


def _panel(
    robot: Robot,
    protocol: Protocol,
    target: Float[np.ndarray, " SJ"],
    name: str,
    setting: Setting,
    servos: int,
) -> Panel:
    problem = protocol.problem(target, tuple(range(1, servos + 1)), setting)
    program = schedule(robot, plan(robot, problem, setting.method))
    return Panel(name, setting.name, servos, program, evaluate(robot, program))
