"""Plan to Program of Instructions (M Eq. 10-12, MODEL.md section 6)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Instruction:
    """One visit of an axial position (M Eq. 12). Everything counts from 1.

    Attributes:
        axial: Axial position a.
        clutches: Tendons whose clutches engage, ascending.
        servo_angles: Turn of each moving servo's shaft over the whole visit, {servo: rad};
            negative winds in.
        length_moves: The same at the tendon, {servo: m}.
        via: Displacements of the moving tendons after each leg, relative to the start of the
            visit, {servo: m} a leg; the last one equals ``length_moves``. Servos of one leg start
            and end together, so a leg is a straight line in tendon space.
    """

    axial: int
    clutches: tuple[int, ...]
    servo_angles: Mapping[int, float]
    length_moves: Mapping[int, float]
    via: tuple[Mapping[int, float], ...]


@dataclass(frozen=True)
class Program:
    """What the hardware executes.

    Attributes:
        robot: Name of the robot.
        fingerprint: Hash of the robot's values; a program runs on no other robot.
        start: Tendon displacements at the start [m], S*J of them.
        target: Tendon displacements at the end [m].
        instructions: In order.
    """

    robot: str
    fingerprint: str
    start: tuple[float, ...]
    target: tuple[float, ...]
    instructions: tuple[Instruction, ...]
