"""Physics of a virtual board as a file in configs/hardware states it.

A section that is left out is ideal: no inertia, no backlash, no errors, no faults.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from muxjax.config import NotNegative, Positive, Strict, load_yaml, resolve
from muxjax.hardware.bus import BusConfig
from muxjax.hardware.faults import FaultConfig
from muxjax.hardware.motion import fastest
from muxjax.robot import Robot

Share = Annotated[float, Field(ge=0, le=1)]


class ServoPhysics(Strict):
    """The servos behind the controller's UART."""

    acceleration_rad_s2: Positive | None = Field(None, description="at the shaft; None: at once")
    uart_period_s: Annotated[float, Field(ge=0, le=0.03)] = Field(
        0.0, description="every servo is told and asked once in this time"
    )
    backlash_m: NotNegative = Field(0.0, description="of the gear, as tendon displacement")


class AxialPhysics(Strict):
    """The axial motor, where its time is not simply what t_sw leaves."""

    speed_deg_s: Positive
    acceleration_deg_s2: Positive


class ClutchPhysics(Strict):
    """Plugs and slots."""

    slot_pitch_deg: Positive = Field(360.0, description="between slots, at the servo's shaft")
    slot_window_deg: Positive = Field(360.0, description="a plug within it drops in")
    miss_rate: Share = Field(0.0, description="of passing a window without dropping in")
    slip_seen_m: NotNegative = Field(0.0, description="tendon change of a switch, wheel turns too")
    slip_unseen_m: NotNegative = Field(0.0, description="the same beyond the wheel")


class EncoderPhysics(Strict):
    """The wheels' encoders."""

    inl_deg: NotNegative = Field(0.0, description="largest smooth error over a turn")
    noise_counts: NotNegative = Field(0.0, description="standard deviation of a reading")
    parity_rate: Share = Field(0.0, description="of readings with a parity error")
    calibration_points: Annotated[int, Field(ge=0, le=1024)] = Field(
        0, description="angles of a turn at which the lab measured the error; 0: not calibrated"
    )


class CoilPhysics(Strict):
    """Heat of the clutches' coils; M III-B2 says about 40 degC."""

    ambient_c: float = 25.0
    rise_k: NotNegative = Field(5.0, description="of each energised coil in the end")
    time_constant_s: Positive = 120.0
    limit_c: float = Field(80.0, description="above it the board stops")


class ControllerPhysics(Strict):
    """What happens when the controller does not run."""

    horizon_s: Annotated[float, Field(gt=0, le=0.05)] = Field(
        0.03, description="how far ahead of now a servo's target lies at most"
    )
    hardware_watchdog_s: Annotated[float, Field(gt=0, le=0.2)] = 0.1
    boot_s: NotNegative = 0.3
    brown_out_v: NotNegative = Field(9.0, description="below it the controller resets")
    lowest_v: NotNegative = Field(18.0, description="below it an armed board stops")


class PhysicsConfig(Strict):
    """Physics and faults of a virtual board and its bus."""

    file_schema: Literal["muxjax/hardware/1"] = Field(alias="schema")
    clutch_in_s: NotNegative
    clutch_out_s: NotNegative
    probe_angle_deg: Annotated[float, Field(gt=0, le=90)]
    brake_s: Annotated[float, Field(ge=0, le=0.05)]
    supply_v: Annotated[float, Field(gt=0, le=60)]
    frame_latency_s: Positive
    servo: ServoPhysics = ServoPhysics()
    axial: AxialPhysics | None = None
    clutch: ClutchPhysics = ClutchPhysics()
    encoder: EncoderPhysics = EncoderPhysics()
    coil: CoilPhysics = CoilPhysics()
    controller: ControllerPhysics = ControllerPhysics()
    bus: BusConfig = BusConfig()
    faults: tuple[FaultConfig, ...] = ()


def load_physics(name_or_path: str | Path) -> PhysicsConfig:
    """Read physics: shipped ones by name (``"ideal"``), or a YAML file by path.

    Raises:
        ConfigError: No such file, or a wrong value; the message names field, value and limit.
    """
    return load_yaml(PhysicsConfig, resolve(name_or_path, "hardware"))


def move_time(robot: Robot, physics: PhysicsConfig, way: float) -> float:
    """Shortest time [s] in which a servo turns by ``way`` [rad]."""
    return fastest(way, float(robot.servo_speed), physics.servo.acceleration_rad_s2)


def probe_time(robot: Robot, physics: PhysicsConfig) -> float:
    """Duration [s] of the servo's oscillation out and back at full speed."""
    return 2 * move_time(robot, physics, math.radians(physics.probe_angle_deg))


def axial_time(robot: Robot, physics: PhysicsConfig, way: float) -> float:
    """Time [s] in which the axial motor turns by ``way`` [rad].

    Without physics of its own, whatever the way, the time that makes a visit's switching add up
    to t_sw (M Eq. 14).

    Raises:
        ValueError: Clutches and probes alone already take longer than t_sw.
    """
    if physics.axial is not None:
        limits = physics.axial.speed_deg_s, physics.axial.acceleration_deg_s2
        return fastest(way, *map(math.radians, limits))
    rest = physics.clutch_in_s + physics.clutch_out_s + 2 * probe_time(robot, physics)
    left = float(robot.switch_time) - rest
    if left <= 0:
        raise ValueError(
            f"clutch_in_s, clutch_out_s and two probes take {rest:.3g} s, must be below the "
            f"robot's axial.switch_time_s of {float(robot.switch_time):.3g} s"
        )
    return left
