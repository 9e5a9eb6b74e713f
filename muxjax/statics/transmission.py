"""From servo torque to tendon force, and what limits it (M III-A, VI-C).

A servo's torque M acts through the clutch, the gear train and the worm on the winding wheel:
F = M * gear ratio * efficiency / wheel radius. Holding needs no servo: the worm locks itself.
"""

from __future__ import annotations

from dataclasses import dataclass

from muxjax.precision import host_array
from muxjax.robot import Robot

STANDARD_GRAVITY = 9.80665  # [m/s^2]


@dataclass(frozen=True)
class TendonForces:
    """Greatest tension that a winding wheel can pull with [N], by what limits it.

    Attributes:
        rated: The servo's rated torque, for continuous winding.
        peak: Its peak torque.
        stall: Its stall torque, at which it stands still.
        clutch: The torque at which the clutch slips.
    """

    rated: float
    peak: float
    stall: float
    clutch: float

    @property
    def continuous(self) -> float:
        """Tension that can be wound in without end [N]."""
        return min(self.rated, self.clutch)

    @property
    def momentary(self) -> float:
        """Tension that can be wound in at all [N]."""
        return min(self.peak, self.clutch)


@dataclass(frozen=True)
class LoadTest:
    """A weight that hangs on one wheel's tendon (M VI-C, Fig. 8b).

    Attributes:
        mass_kg: Of the weight.
        tension: It puts in the tendon [N].
        servo_torque: Needed to lift it [N m].
        margin_rated, margin_peak, margin_stall, margin_clutch: Greatest tension over the weight's.
    """

    mass_kg: float
    tension: float
    servo_torque: float
    margin_rated: float
    margin_peak: float
    margin_stall: float
    margin_clutch: float


def tendon_forces(robot: Robot, *, worm_efficiency: float | None = None) -> TendonForces:
    """Greatest tension of one winding wheel.

    Args:
        robot: The arm; its configuration states servo, wheel, gear ratio and drive strength.
        worm_efficiency: Instead of the configuration's, in (0, 1].

    Raises:
        ValueError: An efficiency outside (0, 1], or a robot whose configuration has no
            ``drive_strength``.
    """
    strength = robot.config.drive_strength
    if strength is None:
        raise ValueError(
            f"robot: the configuration of {robot.config.name!r} has no drive_strength (efficiency "
            "and clutch torque), from which tendon forces follow"
        )
    given = strength.worm_efficiency.value if worm_efficiency is None else worm_efficiency
    efficiency = float(host_array("worm_efficiency", given))
    if not 0 < efficiency <= 1:
        raise ValueError(f"worm_efficiency: must be above 0 and at most 1, found {efficiency:g}")
    force = float(robot.servo_per_metre) * efficiency
    servo = robot.config.servo
    return TendonForces(
        rated=force * servo.rated_torque_nm.value,
        peak=force * servo.peak_torque_nm.value,
        stall=force * servo.stall_torque_nm.value,
        clutch=force * strength.clutch_torque_nm.value,
    )


def load_test(
    robot: Robot, *, mass: float | None = None, worm_efficiency: float | None = None
) -> LoadTest:
    """Margins with which one wheel lifts a weight; by default the published driver payload.

    Args:
        robot: The arm.
        mass: Of the weight [kg].
        worm_efficiency: As for ``tendon_forces``.

    Raises:
        ValueError: A mass that is not above 0, or as for ``tendon_forces``.
    """
    weight = float(
        host_array("mass", robot.config.body.driver_payload_kg.value if mass is None else mass)
    )
    if weight <= 0:
        raise ValueError(f"mass: must be above 0 kg, found {weight:g}")
    greatest = tendon_forces(robot, worm_efficiency=worm_efficiency)
    tension = weight * STANDARD_GRAVITY
    return LoadTest(
        mass_kg=weight,
        tension=tension,
        servo_torque=tension * robot.config.servo.rated_torque_nm.value / greatest.rated,
        margin_rated=greatest.rated / tension,
        margin_peak=greatest.peak / tension,
        margin_stall=greatest.stall / tension,
        margin_clutch=greatest.clutch / tension,
    )
