"""The truth behind the virtual board: servos, clutches, axial motor and winding wheels.

The board's controller reads this through sensors only (``wheel_counts``, ``servo_bits``); the
displacements and their record are for plots and judges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field

from muxjax.config import NotNegative, Positive, Strict, load_yaml, resolve
from muxjax.hardware.protocol import COUNTS_PER_TURN, SERVO_BITS_PER_RAD, WHEEL_BITS
from muxjax.robot import Robot


class PhysicsConfig(Strict):
    """Physics of a virtual board, as a file in configs/hardware states it."""

    file_schema: Literal["muxjax/hardware/1"] = Field(alias="schema")
    clutch_in_s: NotNegative
    clutch_out_s: NotNegative
    probe_angle_deg: Annotated[float, Field(gt=0, le=90)]
    brake_s: Annotated[float, Field(ge=0, le=0.05)]
    supply_v: Annotated[float, Field(gt=0, le=60)]
    frame_latency_s: Positive


def load_physics(name_or_path: str | Path) -> PhysicsConfig:
    """Read physics: shipped ones by name (``"ideal"``), or a YAML file by path.

    Raises:
        ConfigError: No such file, or a wrong value; the message names field, value and limit.
    """
    return load_yaml(PhysicsConfig, resolve(name_or_path, "hardware"))


def probe_time(robot: Robot, physics: PhysicsConfig) -> float:
    """Duration [s] of the servo's oscillation out and back at full speed."""
    return 2 * math.radians(physics.probe_angle_deg) / float(robot.servo_speed)


def axial_time(robot: Robot, physics: PhysicsConfig) -> float:
    """Time [s] the axial motor has, so that a visit's switching adds up to t_sw (M Eq. 14).

    Raises:
        ValueError: Clutches and probes alone already take longer than t_sw.
    """
    rest = physics.clutch_in_s + physics.clutch_out_s + 2 * probe_time(robot, physics)
    left = float(robot.switch_time) - rest
    if left <= 0:
        raise ValueError(
            f"clutch_in_s, clutch_out_s and two probes take {rest:.3g} s, must be below the "
            f"robot's axial.switch_time_s of {float(robot.switch_time):.3g} s"
        )
    return left


class Mechanics:
    """State of the moving parts on a clock that only goes forward.

    All motion is at constant speed, so the recorded break points are the whole trajectory.
    Servos, tendons and slots count from 0 in here; slot -1 is between two slots.
    """

    def __init__(
        self, robot: Robot, displacements: Float[np.ndarray, " S*J"], slot: int = -1
    ) -> None:
        self.time = 0.0
        self.displacements = np.array(displacements, dtype=np.float64)  # true ones [m]
        self.servo = np.zeros(robot.tendons_per_segment)  # shaft angle [rad]
        self.slot = slot
        self._slot_angle = 2 * math.pi / len(robot.axial_map)
        self.axial = self._slot_angle * max(slot, 0)  # [rad]
        self.coupled: dict[int, int] = {}  # servo: tendon
        self._end = 0.0  # of the motion under way [s]
        self._servo_rate = np.zeros_like(self.servo)  # [rad/s]
        self._axial_rate = 0.0  # [rad/s]
        self._metres_per_rad = 1 / float(robot.servo_per_metre)
        self._lost_bits = max(0, WHEEL_BITS - robot.config.encoder.bits.value)
        steps_per_turn = COUNTS_PER_TURN >> self._lost_bits
        self._steps_per_metre = steps_per_turn / (2 * math.pi * float(robot.wheel_radius))
        self._times = [0.0]
        self._points = [self.displacements.copy()]

    @property
    def moving(self) -> bool:
        """Whether any part moves now."""
        return self.time < self._end

    def advance(self, now: float) -> None:
        """Let time pass until ``now`` [s]."""
        if self.moving and now > self.time:
            step = min(now, self._end) - self.time
            turned = self._servo_rate * step
            self.servo += turned
            self.axial += self._axial_rate * step
            for servo, tendon in self.coupled.items():
                self.displacements[tendon] += turned[servo] * self._metres_per_rad
            if now >= self._end:
                self.time = self._end
                self._note()
        self.time = max(self.time, now)

    def turn(self, by: Mapping[int, float], duration: float) -> None:
        """Turn servos {servo: rad} during ``duration`` [s]; they start and end together."""
        self._begin(duration)
        for servo, angle in by.items():
            self._servo_rate[servo] = angle / duration

    def rotate_axial(self, slot: int, duration: float) -> None:
        """Turn the axial motor to a slot during ``duration`` [s]."""
        self._begin(duration)
        goal = self._slot_angle * slot
        self._axial_rate = (goal - self.axial) / duration

    def brake(self, duration: float) -> None:
        """Decelerate what moves to a stand within ``duration`` [s], not past its target.

        The parabola of constant deceleration is taken as a straight line of half the speed.
        """
        if not self.moving:
            return
        duration = min(duration, 2 * (self._end - self.time))
        rates = self._servo_rate / 2, self._axial_rate / 2
        self._begin(duration)
        self._servo_rate, self._axial_rate = rates

    def _begin(self, duration: float) -> None:
        self._note()
        self._end = self.time + duration
        self._servo_rate = np.zeros_like(self.servo)
        self._axial_rate = 0.0

    def _note(self) -> None:
        self._times.append(self.time)
        self._points.append(self.displacements.copy())

    def wheel_counts(self) -> Int[np.ndarray, " S*J"]:
        """What the wheel encoders read, whole turns included [counts of 14 bits].

        An encoder of fewer bits leaves the low ones 0; of a finer one the bus carries 14.
        """
        steps = np.rint(self.displacements * self._steps_per_metre).astype(np.int64)
        return steps << self._lost_bits

    def servo_bits(self) -> Int[np.ndarray, " J"]:
        """What the servo encoders read [0.1 degree]."""
        return np.rint(self.servo * SERVO_BITS_PER_RAD).astype(np.int64)

    def trajectory(
        self, since: float
    ) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K S*J"]]:
        """Break points of the true displacements from ``since`` [s] to now: times, values [m].

        Between two points every tendon moves at constant speed.
        """
        times = np.array([*self._times, self.time])
        points = np.array([*self._points, self.displacements])
        kept = times > since
        first = [np.interp(since, times, column) for column in points.T]
        return np.r_[since, times[kept]], np.vstack([first, points[kept]])
