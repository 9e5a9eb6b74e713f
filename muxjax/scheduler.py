"""Plan to Program of Instructions (M Eq. 10-12, MODEL.md section 6).

The plan's steps already have their axial positions (``planning.axial``, M Eq. 10). Consecutive
steps at one position are fused into one instruction, and tendon displacements become servo angles.
An instruction keeps its steps as via points, so what was planned is what is executed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.planning.problem import Plan
from muxjax.robot import Robot


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
        target: Tendon displacements wanted at the end [m].
        axial: Axial position at the start, if known.
        servos: Servos that may be used.
        instructions: In order.
    """

    robot: str
    fingerprint: str
    start: tuple[float, ...]
    target: tuple[float, ...]
    axial: int | None
    servos: tuple[int, ...]
    instructions: tuple[Instruction, ...]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Tendon displacements as a polyline in time: of a program, or as a board has made them.

    Attributes:
        time_s: When each point is reached [s], never falling.
        displacements: Tendon displacements at the points [m]; straight lines in between.
    """

    time_s: Float[np.ndarray, " P"]
    displacements: Float[np.ndarray, "P SJ"]

    def at(self, times: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T SJ"]:
        """Displacements [m] at any times [s]; constant before the first and after the last."""
        columns = [np.interp(times, self.time_s, column) for column in self.displacements.T]
        return np.stack(columns, axis=-1)


def schedule(robot: Robot, plan: Plan) -> Program:
    """Instructions that execute a plan (M Eq. 10-12).

    Displacements whose sum over an instruction is below the problem's tolerance are dropped.

    Raises:
        ValueError: The plan failed, was made for another robot, or has a step that the
            problem's servos do not reach at its axial position.
    """
    problem = plan.problem
    if plan.status == "failed":
        raise ValueError(f"plan: {plan.method} found none ({plan.reason})")
    if plan.fingerprint != robot.fingerprint:
        raise ValueError(
            f"plan: made for robot {plan.fingerprint}, this is {robot.config.name!r} "
            f"({robot.fingerprint})"
        )
    moves = np.diff(plan.displacements, axis=0)
    _check_feasible(robot, moves != 0, plan.axial, problem.servos)
    instructions = []
    for position, run in groupby(range(len(moves)), key=lambda k: int(plan.axial[k])):
        fused = _fuse(robot, position, moves[list(run)], problem.servos, problem.tolerance)
        if fused is not None:
            instructions.append(fused)
    return Program(
        robot=robot.config.name,
        fingerprint=robot.fingerprint,
        start=tuple(plan.displacements[0].tolist()),
        target=tuple(problem.target.tolist()),
        axial=problem.axial,
        servos=problem.servos,
        instructions=tuple(instructions),
    )


def _check_feasible(
    robot: Robot,
    moving: Bool[np.ndarray, "K SJ"],
    axial: Int[np.ndarray, " K"],
    servos: tuple[int, ...],
) -> None:
    reached = robot.reach(servos)[axial - 1]
    for k, missed in enumerate(moving & ~reached, start=1):
        if missed.any():
            raise ValueError(
                f"plan: step {k} moves tendon {int(np.argmax(missed)) + 1}, which servos {servos} "
                f"do not reach at axial position {axial[k - 1]}"
            )


def _fuse(
    robot: Robot,
    axial: int,
    moves: Float[np.ndarray, "k SJ"],
    servos: tuple[int, ...],
    tolerance: float,
) -> Instruction | None:
    """One instruction of consecutive steps at one axial position (M Eq. 11-12)."""
    path = np.cumsum(moves, axis=0)
    total = path[-1]
    by_servo = {s: int(robot.axial_map[axial - 1, s - 1]) for s in sorted(servos)}
    kept = {s: c for s, c in by_servo.items() if abs(total[c]) >= tolerance}
    if not kept:
        return None
    length_moves = {s: float(total[c]) for s, c in kept.items()}
    factor = float(robot.servo_per_metre)
    return Instruction(
        axial=axial,
        clutches=tuple(sorted(c + 1 for c in kept.values())),
        servo_angles={s: factor * dl for s, dl in length_moves.items()},
        length_moves=length_moves,
        via=tuple({s: float(leg[c]) for s, c in kept.items()} for leg in path),
    )


def waypoints(robot: Robot, program: Program) -> list[Float[np.ndarray, "states SJ"]]:
    """Displacements [m] at the start and after each leg of every instruction.

    Raises:
        ValueError: The program was made for another robot.
    """
    check_same_robot(robot, program)
    now = np.array(program.start)
    visits = []
    for instruction in program.instructions:
        tendons = robot.axial_map[instruction.axial - 1]
        points = np.tile(now, (len(instruction.via) + 1, 1))
        for row, leg in zip(points[1:], instruction.via, strict=True):
            for servo, moved in leg.items():
                row[tendons[servo - 1]] += moved
        visits.append(points)
        now = points[-1]
    return visits


def check_same_robot(robot: Robot, program: Program) -> None:
    """Raise ValueError unless the program was made for this very robot."""
    if program.fingerprint != robot.fingerprint:
        raise ValueError(
            f"program: made for robot {program.robot!r} ({program.fingerprint}), this is "
            f"{robot.config.name!r} ({robot.fingerprint})"
        )
