"""What the drive costs, and what an actuator for every tendon would (M VI-D, Table III)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from muxjax.config import ConfigError, PartConfig
from muxjax.robot import Robot


@dataclass(frozen=True)
class CostSheet:
    """A robot's parts beside one actuator a tendon. Prices in USD, shares from 0 to 1.

    Attributes:
        parts: Lines of the sheet.
        total: Sum of the parts.
        motors: How many of them are motors: the servos and the axial one.
        motors_total: Sum of the motors' prices.
        single_name: The actuator that every tendon would have of its own.
        single_count: How many of these, one a tendon.
        single_total: Their price.
        saving: Of the whole sheet against the single actuators alone, 1 - total / single_total.
        motors_saving: Of the motors against the single actuators, 1 - motors_total / single_total.
        fewer_motors: 1 - motors / single_count.
    """

    parts: tuple[PartConfig, ...]
    total: float
    motors: int
    motors_total: float
    single_name: str
    single_count: int
    single_total: float
    saving: float
    motors_saving: float
    fewer_motors: float


def cost_sheet(robot: Robot) -> CostSheet:
    """The cost sheet of a robot whose file has one.

    Raises:
        ConfigError: The robot's file has no section ``cost``.
    """
    cost = robot.config.cost
    if cost is None:
        raise ConfigError(
            f"cost: the file of robot {robot.config.name!r} has no parts list; "
            "configs/robots/muxarm.yaml shows one"
        )
    motors = [part for part in cost.parts if part.kind == "motor"]
    total = math.fsum(part.price_usd for part in cost.parts)
    motors_total = math.fsum(part.price_usd for part in motors)
    count, single = robot.n_tendons, robot.n_tendons * cost.single_actuator.price_usd.value
    n_motors = robot.tendons_per_segment + 1  # the file's count is checked against it
    return CostSheet(
        parts=cost.parts,
        total=total,
        motors=n_motors,
        motors_total=motors_total,
        single_name=cost.single_actuator.name,
        single_count=count,
        single_total=single,
        saving=1 - total / single,
        motors_saving=1 - motors_total / single,
        fewer_motors=1 - n_motors / count,
    )
