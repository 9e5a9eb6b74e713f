"""The accuracy experiment of M VI-B on the virtual board: there and back with clutches that slip.

Straight, to a target, and back, with a tendon change of about 0.5 mm at each switch of a clutch.
Errors are of the true arm, in the papers' kinematics, against the planned motion.

Open loop turns the servos by what the program says and never looks at the wheels. Closed loop is
the executor as it is. Where the wheel turns along with the slip its encoder sees it; where the
slip happens beyond the wheel nothing on the board can.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from muxjax.hardware.executor import Executor, Run
from muxjax.hardware.executor import execute as execute_closed
from muxjax.hardware.journal import LegEntry, MemoryJournal, ProgramEntry
from muxjax.hardware.links import LockstepLink
from muxjax.hardware.physics import PhysicsConfig, load_physics
from muxjax.hardware.protocol import SERVO_BITS_PER_RAD, Frame
from muxjax.hardware.session import Script
from muxjax.hardware.visits import Visit, load_visits
from muxjax.kinematics import segment_ends
from muxjax.planning import Problem, plan
from muxjax.robot import Robot
from muxjax.scheduler import Program, schedule, waypoints
from muxjax.tendons import bending_from_displacements, tendon_displacements

SEED = 7  # of the targets
SAMPLES = 40  # along each instruction
_STREAM_DIVIDER = 4


@dataclass(frozen=True)
class Case:
    """What slips, and who looks.

    Attributes:
        physics: Shipped physics of the virtual board.
        seen: Slip that turns the wheel along [m].
        unseen: Slip beyond the wheel [m].
        closed: Whether the executor looks at the wheels.
    """

    physics: str
    seen: float
    unseen: float
    closed: bool

    def load(self) -> PhysicsConfig:
        """The board's physics with this slip."""
        base = load_physics(self.physics)
        slips = {"slip_seen_m": self.seen, "slip_unseen_m": self.unseen}
        return base.model_copy(update={"clutch": base.clutch.model_copy(update=slips)})


CASES = {
    "open loop, slip alone": Case("ideal", 0.0005, 0.0, False),
    "open loop, realistic board": Case("realistic", 0.0005, 0.0, False),
    "closed loop, slip seen": Case("realistic", 0.0005, 0.0, True),
    "closed loop, slip not seen": Case("realistic", 0.0, 0.0005, True),
    "closed loop, no slip": Case("realistic", 0.0, 0.0, True),
}


class OpenLoop(Executor):
    """An executor that believes its servos: no wheel is looked at, nothing is trimmed."""

    def __init__(self, robot: Robot, journal: MemoryJournal, session: int, divider: int) -> None:
        super().__init__(robot, journal, session, divider)
        self._believed = np.array(self.program.start)

    def _move_all(self, number: int, visit: Visit, first_leg: int) -> Script[int]:
        ratio = float(self.robot.servo_per_metre)
        since = self._now
        servos, wheels = [s - 1 for s in visit.tendons], [c - 1 for c in visit.tendons.values()]
        yield from self._expect(lambda: self.sensors.fresh(servos, wheels, since), "the servos")
        zero = {
            s: self.sensors.servo_rad[s - 1] - self._believed[c - 1] * ratio
            for s, c in visit.tendons.items()
        }
        for leg, goals in enumerate(visit.legs, start=1):
            by_tendon = {visit.tendons[s]: m for s, m in goals.items()}
            self._write(
                LegEntry(visit=number, leg=leg, goals=by_tendon, lengths=self._heard_lengths())
            )
            yield from self._move(visit, _bits({s: zero[s] + m * ratio for s, m in goals.items()}))
            for tendon, metres in by_tendon.items():
                self._believed[tendon - 1] = metres
        return 0

    def _mend(self) -> Script[None]:
        return
        yield


def _bits(angles: Mapping[int, float]) -> dict[int, int]:
    return {servo: round(angle * SERVO_BITS_PER_RAD) for servo, angle in angles.items()}


@dataclass(frozen=True, eq=False)
class Trial:
    """One run to a target, or there and back.

    Attributes:
        time_s: Of the samples, since arming, on the board's clock [s].
        poses: True poses of the segments' ends [m].
        planned: The planned ones nearest to them.
        at_target: Which of the T samples is at the target.
    """

    time_s: Float[np.ndarray, " T"]
    poses: Float[np.ndarray, "T S 4 4"]
    planned: Float[np.ndarray, "T S 4 4"]
    at_target: int

    def errors(self) -> tuple[Float[np.ndarray, "T S"], Float[np.ndarray, "T S"]]:
        """Distance [m] and angle [rad] of every pose from its planned one."""
        return pose_errors(self.poses, self.planned)


def random_targets(robot: Robot, count: int, seed: int = SEED) -> Float[np.ndarray, "N SJ"]:
    """Tendon displacements [m] of targets that bend each segment by 0.2 to 1.6 rad.

    Less, if its limit is less.
    """
    rng = np.random.default_rng(seed)
    low, high = np.minimum(0.2, robot.theta_max), np.minimum(1.6, robot.theta_max)
    q = np.stack(
        [rng.uniform(low, high, (count, robot.n_segments)),
         rng.uniform(0.0, 2 * np.pi, (count, robot.n_segments))], axis=-1,
    ).reshape(count, -1)  # fmt: skip
    return np.asarray(tendon_displacements(robot, q))


def program_to(robot: Robot, target: Float[np.ndarray, " SJ"], servos: tuple[int, ...]) -> Program:
    """The cheapest program from straight to a target [m], by the paper's cost."""
    straight = np.zeros_like(target)
    return schedule(robot, plan(robot, Problem(straight, target, servos=servos)))


def there_and_back(
    robot: Robot, target: Float[np.ndarray, " SJ"], servos: tuple[int, ...]
) -> tuple[Program, int]:
    """One program to a target [m] and back, and how many instructions it takes to the target."""
    out = program_to(robot, target, servos)
    straight = np.zeros_like(target)
    home = schedule(robot, plan(robot, Problem(target, straight, servos=servos)))
    whole = Program(
        robot=out.robot,
        fingerprint=out.fingerprint,
        start=out.start,
        target=home.target,
        axial=None,
        servos=servos,
        instructions=(*out.instructions, *home.instructions),
    )
    return whole, len(out.instructions)


def run_trial(robot: Robot, program: Program, outward: int, case: Case, seed: int) -> Trial:
    """Run a program and compare every instruction with its planned path.

    Args:
        robot: The arm.
        program: To the target, or there and back.
        outward: How many of its instructions lead to the target.
        case: What slips, and whether the loop is closed.
        seed: Of the slip, and of whatever else the board draws.

    Raises:
        RuntimeError: The run did not complete.
    """
    link = LockstepLink(robot, case.load(), stream_divider=_STREAM_DIVIDER, seed=seed)
    run = execute_closed(program, link) if case.closed else _execute_open(program, link)
    if not run.completed or run.trajectory is None:
        raise RuntimeError(f"seed {seed}: {run.reason}")
    times, true, planned, at_target = [], [], [], 0
    for number, (path, record) in enumerate(
        zip(waypoints(robot, program), run.records, strict=True), start=1
    ):
        times.append(np.linspace(record.start_s, record.end_s, SAMPLES))
        points = run.trajectory.at(times[-1])
        true.append(points)
        on_path = nearest(path, points)
        on_path[-1] = path[-1]  # at its end an instruction has a place to be
        planned.append(on_path)
        if number == outward:
            at_target = sum(map(len, true)) - 1
    return Trial(
        np.concatenate(times),
        _poses(robot, np.vstack(true)),
        _poses(robot, np.vstack(planned)),
        at_target,
    )


def _execute_open(program: Program, link: LockstepLink) -> Run:
    journal = MemoryJournal()
    goals = tuple(tuple(dict(leg) for leg in v.legs) for v in load_visits(link.robot, program))
    journal.write(ProgramEntry(program=program, goals=goals))
    host = OpenLoop(link.robot, journal, link.new_session(), link.stream_divider)
    frames: list[Frame] = []
    while not host.finished:
        link.send(host.step(link.now, frames))
        frames = link.wait(host.next_time)
    return host.result(link.trajectory)


def nearest(
    path: Float[np.ndarray, "C SJ"], points: Float[np.ndarray, "P SJ"]
) -> Float[np.ndarray, "P SJ"]:
    """Points on a polyline nearest to some points, all in tendon space [m]."""
    a, b = path[:-1], path[1:]
    way = b - a
    length = np.maximum((way**2).sum(axis=1), 1e-30)
    part = np.clip(np.einsum("psd,sd->ps", points[:, None] - a, way) / length, 0.0, 1.0)
    on = a + part[..., None] * way
    best = ((points[:, None] - on) ** 2).sum(axis=-1).argmin(axis=1)
    return on[np.arange(len(points)), best]


def _poses(robot: Robot, displacements: Float[np.ndarray, "T SJ"]) -> Float[np.ndarray, "T S 4 4"]:
    return np.asarray(segment_ends(robot, bending_from_displacements(robot, displacements)))


def pose_errors(
    poses: Float[np.ndarray, "*n 4 4"], planned: Float[np.ndarray, "*n 4 4"]
) -> tuple[Float[np.ndarray, " *n"], Float[np.ndarray, " *n"]]:
    """Distances [m] and angles [rad] between poses."""
    position = np.linalg.norm(poses[..., :3, 3] - planned[..., :3, 3], axis=-1)
    turn = np.swapaxes(planned[..., :3, :3], -1, -2) @ poses[..., :3, :3]
    vee = np.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0],
         turn[..., 1, 0] - turn[..., 0, 1]], axis=-1,
    )  # fmt: skip
    trace = np.trace(turn, axis1=-2, axis2=-1)
    return position, np.arctan2(np.linalg.norm(vee, axis=-1), trace - 1)


def rmse(values: Float[np.ndarray, " *n"]) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
