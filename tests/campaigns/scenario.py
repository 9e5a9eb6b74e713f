"""What one run of a campaign is made of, drawn from its seed."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from muxjax.hardware import PhysicsConfig, load_physics
from muxjax.hardware.bus import BusConfig
from muxjax.hardware.faults import OF_SERVOS, OF_TENDONS, FaultConfig, FaultKind
from muxjax.robot import Robot
from muxjax.scheduler import Instruction, Program
from muxjax.tendons import displacement_range, tendon_displacements

# What ends by itself or by an operator's hand, and after how long at most [s].
PASSING: dict[FaultKind, float] = {
    FaultKind.SERVO_STALL: 1.0,  # an overload: the host goes on without the servo all the same
    FaultKind.CLUTCH_SLIP: 0.0,
    FaultKind.ENCODER_PARITY: 1.0,
    FaultKind.COIL_HEAT: 3.0,
    FaultKind.UNDERVOLTAGE: 1.0,
    FaultKind.BROWN_OUT: 1.0,
    FaultKind.HANG: 0.0,
    FaultKind.BUS_OFF: 0.0,
    FaultKind.CABLE: 2.0,
}
# What lasts, and what of a reason tells of it, with {n} for the servo or tendon.
_SERVO = r"SERVO_(STALLED|OFFLINE) \({n}\)|\[.*\b{n}\b.*\] stalled or offline|servo {n} is at fault"
_WHEEL = r"WHEEL_STILL \({n}\)|tendon {n}: its wheel"
_SEATED = r"clutch {n} not seated"
_FLAGS = r"ENCODER_FAULT \({n}\)|encoder of wheel {n} flags"
LASTING: dict[FaultKind, str] = {
    FaultKind.SERVO_STALL: _SERVO,
    FaultKind.SERVO_OFFLINE: _SERVO,
    FaultKind.CLUTCH_DEAD: _SEATED,
    FaultKind.CLUTCH_STUCK: r"NOT_RELEASED, clutches \[.*\b{n}\b.*\]",
    FaultKind.ENCODER_STUCK: f"{_WHEEL}|{_SEATED}",
    FaultKind.ENCODER_PARITY: _FLAGS,
    FaultKind.ENCODER_MAGNET: _FLAGS,
}
TRIGGERS = ("AXIAL", "ENGAGE", "START", "RELEASE")


@dataclass(frozen=True)
class Scenario:
    """A run to be made.

    Attributes:
        seed: From which all of it is drawn.
        physics: Of the board and its bus.
        program: What is to be run.
        axial: Axial position at power-up, from 1; None if unknown.
        faults: Of the board's parts.
        kills: When the host is killed [s], and whether before it sends what it then decides (or
            else while it waits).
        stream_divider: Of the feedback.
    """

    seed: int
    physics: PhysicsConfig
    program: Program
    axial: int | None
    faults: tuple[FaultConfig, ...]
    kills: tuple[tuple[float, bool], ...]
    stream_divider: int

    @property
    def lasting(self) -> tuple[FaultConfig, ...]:
        """Faults that do not pass."""
        return tuple(f for f in self.faults if f.for_s is None and f.kind in LASTING)

    def explains(self, reason: str) -> bool:
        """Whether a reason names what lasts, and the servo or tendon that has it."""
        told = (LASTING[f.kind].format(n=f.index) for f in self.lasting)
        return any(re.search(pattern, reason) for pattern in told)


def draw(robot: Robot, seed: int) -> Scenario:
    """The scenario of a seed."""
    rng = np.random.default_rng(seed)
    physics = load_physics("realistic" if rng.random() < 0.8 else "ideal")
    bus = BusConfig(
        bit_rate=physics.bus.bit_rate,
        loss=rng.choice([0.0, 0.01, 0.03]),
        doubling=rng.choice([0.0, 0.02]),
        corruption=rng.choice([0.0, 0.01]),
        delay=rng.choice([0.0, 0.02]),
        delay_s=0.02,
    )
    at_the_limit = rng.random() < 0.15
    program = _draw_program(robot, rng, at_the_limit)
    kills = np.cumsum(rng.uniform(0.0, 20.0, int(rng.choice([0, 0, 1, 2]))))
    axial = int(rng.integers(1, 10)) if rng.random() < 0.5 else None
    faults = _draw_faults(robot, rng, replanning=not at_the_limit)
    divider = int(rng.choice([2, 4, 10]))
    unsent = rng.random(len(kills)) < 0.5
    return Scenario(
        seed=seed,
        physics=physics.model_copy(update={"bus": bus}),
        program=program,
        axial=axial,
        faults=faults,
        kills=tuple(zip(kills.tolist(), unsent.tolist(), strict=True)),
        stream_divider=divider,
    )


def _draw_program(robot: Robot, rng: np.random.Generator, at_the_limit: bool) -> Program:
    """2 to 4 short instructions from a bent arm, or where some tendons are at their range's end.

    The latter are lengths of no configuration, so that nothing can be planned for them anew.
    """
    limits = displacement_range(robot)
    theta = rng.uniform(0.0, 0.6, robot.n_segments) * robot.theta_max
    phi = rng.uniform(0.0, 2 * np.pi, robot.n_segments)
    start = np.array(tendon_displacements(robot, np.stack([theta, phi], axis=-1).ravel()))
    if at_the_limit:
        near = rng.random(len(start)) < 0.4
        start[near] = (limits[:, 1] - 0.002)[near]
    held, instructions, axial = start.copy(), [], int(rng.integers(9))
    for _ in range(int(rng.integers(2, 5))):
        axial = (axial + int(rng.integers(1, len(robot.axial_map)))) % len(robot.axial_map)
        servos = rng.permutation(robot.tendons_per_segment)[: int(rng.integers(1, 4))]
        tendons = robot.axial_map[axial, servos]
        legs = int(rng.choice([1, 1, 2]))
        moves = rng.uniform(0.002, 0.008, (legs, len(servos))) * rng.choice([-1, 1], len(servos))
        points = np.clip(held[tendons] + np.cumsum(moves, axis=0), *limits[tendons].T)
        instructions.append(_instruction(robot, axial, servos, points - held[tendons]))
        held[tendons] = points[-1]
    return Program(
        robot=robot.config.name,
        fingerprint=robot.fingerprint,
        start=tuple(start.tolist()),
        target=tuple(held.tolist()),
        axial=None,
        servos=tuple(range(1, robot.tendons_per_segment + 1)),
        instructions=tuple(instructions),
    )


def _instruction(robot: Robot, axial: int, servos: np.ndarray, legs: np.ndarray) -> Instruction:
    via = tuple({int(s) + 1: float(m) for s, m in zip(servos, leg, strict=True)} for leg in legs)
    ratio = float(robot.servo_per_metre)
    return Instruction(
        axial=axial + 1,
        clutches=tuple(sorted(int(c) + 1 for c in robot.axial_map[axial, servos])),
        servo_angles={s: m * ratio for s, m in via[-1].items()},
        length_moves=via[-1],
        via=via,
    )


def _draw_faults(
    robot: Robot, rng: np.random.Generator, replanning: bool
) -> tuple[FaultConfig, ...]:
    """None to two that pass, and, where one can plan anew, in every third run one that lasts."""
    faults = []
    for _ in range(int(rng.choice([0, 1, 1, 2]))):
        kinds = [k.value for k in PASSING if replanning or k is not FaultKind.SERVO_STALL]
        kind = FaultKind(rng.choice(kinds))
        for_s = float(rng.uniform(0.05, PASSING[kind])) if PASSING[kind] else None
        faults.append(_fault(robot, rng, kind, for_s))
    if replanning and rng.random() < 1 / 3:
        faults.append(_fault(robot, rng, FaultKind(rng.choice([k.value for k in LASTING])), None))
    return tuple(faults)


def _fault(
    robot: Robot, rng: np.random.Generator, kind: FaultKind, for_s: float | None
) -> FaultConfig:
    index = None
    if kind in OF_SERVOS:
        index = int(rng.integers(1, robot.tendons_per_segment + 1))
    elif kind in OF_TENDONS:
        index = int(rng.integers(1, robot.n_tendons + 1))
    if rng.random() < 0.3:
        return FaultConfig(kind=kind, index=index, for_s=for_s, at_s=float(rng.uniform(0, 20)))
    return FaultConfig(
        kind=kind,
        index=index,
        for_s=for_s,
        at_op=str(rng.choice(TRIGGERS)),
        nth=int(rng.integers(1, 4)),
        delay_s=float(rng.uniform(0, 1.5)),
    )
