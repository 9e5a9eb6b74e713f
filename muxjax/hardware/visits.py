"""Program to visits: what the executor does, checked and pinned before anything moves.

Every leg is turned into absolute tendon goals when the program is loaded (start plus what the
instructions before have moved), so that repeating a leg moves nothing twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from muxjax.precision import host_array
from muxjax.robot import Robot
from muxjax.scheduler import Instruction, Program, check_same_robot
from muxjax.tendons import check_displacements

SAME_M = 1e-9  # how closely the numbers of one instruction must agree [m]
SAME_DIRECTION = 1e-9  # difference of unit vectors below which two legs are one motion


@dataclass(frozen=True)
class Visit:
    """One instruction, ready to run. Axial, layer, servos and tendons count from 1.

    Attributes:
        axial: Axial position.
        layer: Layer (segment) whose clutches engage.
        clutch_mask: Bit j - 1 for tendon j of the layer.
        tendons: {servo: tendon} that moves.
        legs: Absolute displacement of each tendon after each motion, {servo: m}.
    """

    axial: int
    layer: int
    clutch_mask: int
    tendons: Mapping[int, int]
    legs: tuple[Mapping[int, float], ...]


def load_visits(robot: Robot, program: Program) -> tuple[Visit, ...]:
    """Check a program against the robot and pin its goals.

    Raises:
        ValueError: A program for another robot; an axial position that does not exist; a servo
            that does not, or that the program may not use; a number that is not finite; fields of
            an instruction that contradict each other or the axial map; a tendon beyond its range.
            The message names the instruction, counting from 1.
    """
    check_same_robot(robot, program)
    held = check_displacements(robot, "program.start", program.start).copy()
    visits = []
    for number, instruction in enumerate(program.instructions, start=1):
        where = f"instruction {number}"
        tendons = _check(robot, where, instruction)
        unusable = sorted(tendons.keys() - set(program.servos))
        if unusable:
            raise ValueError(f"{where}: servo {unusable[0]} is not among {program.servos}")
        legs = []
        for leg in motions(instruction):
            goals = {s: float(held[c - 1]) + leg[s] for s, c in tendons.items()}
            after = held.copy()
            after[[c - 1 for c in tendons.values()]] = list(goals.values())
            check_displacements(robot, where, after)
            legs.append(goals)
        if legs:
            held = after
        visits.append(make_visit(robot, instruction.axial, tendons, tuple(legs)))
    host_array("program.target", program.target, last=robot.n_tendons)
    return tuple(visits)


def motions(instruction: Instruction) -> tuple[Mapping[int, float], ...]:
    """Via points between which the servos stop, {servo: m} from the visit's start.

    Consecutive legs in one direction, with the same proportions, are one motion at full speed;
    legs that go nowhere are dropped.
    """
    servos = tuple(instruction.length_moves)
    kept: list[np.ndarray] = []
    at, heading = np.zeros(len(servos)), np.zeros(len(servos))
    for via in instruction.via:
        point = np.array([via.get(s, 0.0) for s in servos])
        length = float(np.linalg.norm(point - at))
        if length < SAME_M:
            continue
        direction = (point - at) / length
        if kept and np.abs(direction - heading).max() < SAME_DIRECTION:
            kept[-1] = point
        else:
            kept.append(point)
        at, heading = point, direction
    return tuple(dict(zip(servos, point.tolist(), strict=True)) for point in kept)


def make_visit(
    robot: Robot, axial: int, tendons: Mapping[int, int], legs: tuple[Mapping[int, float], ...]
) -> Visit:
    """Visit of an axial position at which servos meet these tendons, {servo: tendon}."""
    per_layer = robot.tendons_per_segment
    layer = int(robot.axial_map[axial - 1, 0]) // per_layer + 1
    mask = sum(1 << ((c - 1) % per_layer) for c in tendons.values())
    return Visit(axial, layer, mask, tendons, legs)


def _check(robot: Robot, where: str, instruction: Instruction) -> dict[int, int]:
    """{servo: tendon} of one instruction whose fields all agree."""
    positions, n_servos = len(robot.axial_map), robot.tendons_per_segment
    if not 1 <= instruction.axial <= positions:
        raise ValueError(f"{where}: axial is 1 to {positions}, found {instruction.axial}")
    if not instruction.length_moves:
        raise ValueError(f"{where}: moves no servo")
    for field in ("length_moves", "servo_angles"):
        unknown = [s for s in getattr(instruction, field) if not 1 <= s <= n_servos]
        if unknown:
            raise ValueError(f"{where}: {field}: servos are 1 to {n_servos}, found {unknown[0]}")
    moves = _checked_moves(where, "length_moves", instruction.length_moves)
    for number, leg in enumerate(instruction.via, start=1):
        extra = sorted(leg.keys() - moves.keys())
        if extra:
            raise ValueError(f"{where}: via[{number}]: servo {extra[0]} is not in length_moves")
        _checked_moves(where, f"via[{number}]", leg)
    last = instruction.via[-1] if instruction.via else {}
    ratio = float(robot.servo_per_metre)
    angles = _checked_moves(where, "servo_angles", instruction.servo_angles)
    for servo, move in moves.items():
        _check_equal(where, f"via ends servo {servo}", last.get(servo, 0.0), move)
        _check_equal(where, f"servo_angles[{servo}] / N", angles.get(servo, 0.0) / ratio, move)
    facing = robot.axial_map[instruction.axial - 1]
    tendons = {s: int(facing[s - 1]) + 1 for s in moves}
    if sorted(instruction.clutches) != sorted(tendons.values()):
        raise ValueError(
            f"{where}: servos {sorted(moves)} at axial {instruction.axial} drive tendons "
            f"{sorted(tendons.values())}, clutches are {sorted(instruction.clutches)}"
        )
    return tendons


def _checked_moves(where: str, field: str, moves: Mapping[int, float]) -> Mapping[int, float]:
    for servo, value in moves.items():
        if not np.isfinite(value):
            raise ValueError(f"{where}: {field}[{servo}] is {value}, must be finite")
    return moves


def _check_equal(where: str, what: str, found: float, move: float) -> None:
    if abs(found - move) > SAME_M:
        raise ValueError(f"{where}: {what} at {found:.9g} m, length_moves says {move:.9g} m")
