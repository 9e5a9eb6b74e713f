"""A board that exists only in memory: the firmware's state machine over simulated mechanics.

Sans-IO: ``step(now, frames)`` takes what arrived, lets time pass until ``now`` and returns what
the board sends. It models: the whole protocol of docs/protocol.md with its state machine,
watchdog, interlocks and range limits; durations of the axial motor, clutches, probes and servos;
the constant-speed motion of servos and wheels; braking; encoder quantisation and turn counts;
feedback streams at their rates.

It does not model: faults of any part, acceleration, backlash, clutch mis-seating and slip, INL and
noise of encoders, coil heat, currents under load, brown-out, bus arbitration and bus-off. The
load on the tendons never stalls a servo, and a relaxed servo holds still.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Generator, Iterable

import numpy as np
from jaxtyping import Float

from muxjax.hardware import feedback
from muxjax.hardware.interlocks import refusal
from muxjax.hardware.physics import Mechanics, PhysicsConfig, axial_time, load_physics, probe_time
from muxjax.hardware.protocol import (
    COUNTS_PER_TURN,
    SERVO_BITS_PER_RAD,
    WATCHDOG_S,
    BoardState,
    Fault,
    Frame,
    Op,
    Port,
    Reason,
    Refusal,
    Status,
    check_robot_fits,
    fingerprint_words,
)
from muxjax.robot import Robot
from muxjax.tendons import check_displacements, displacement_range

Job = Generator[float, None, Reason]  # yields how long to wait [s], returns how it ended

RANGE_MARGIN_M = 1e-4  # beyond the tendon range: rounding of encoders and targets, not travel
SEQUENCE_WINDOW = 16  # a new command's number is at most this far ahead of the last one
PASSING = (Reason.BUSY, Reason.NO_HEARTBEAT)  # reasons that may be gone in a moment
REMEMBERED = 32  # answers kept for duplicates


class VirtualBoard:
    """The board and its mechanics.

    Tendons, servos, layers and slots count from 0 in its attributes, from 1 on the bus.

    Args:
        robot: The arm that the board drives.
        physics: Physics, or the name or path of a file of them.
        displacements: Tendon displacements at power-up [m]; straight if None.
        axial: Axial position at power-up, from 1; between two if None.

    Attributes:
        mechanics: The truth. The controller's code reads it through its sensors only.

    Raises:
        ValueError: The protocol cannot carry the robot, the physics do not fit its switch time,
            the displacements are beyond its range, or it has no such axial position.
    """

    def __init__(
        self,
        robot: Robot,
        physics: PhysicsConfig | str = "ideal",
        displacements: Collection[float] | Float[np.ndarray, " S*J"] | None = None,
        axial: int | None = None,
    ) -> None:
        check_robot_fits(robot)
        start = np.zeros(robot.n_tendons) if displacements is None else displacements
        start = check_displacements(robot, "displacements", start)
        if start.ndim != 1:
            raise ValueError(f"displacements: must have one axis, found shape {start.shape}")
        self.robot = robot
        self.physics = load_physics(physics) if isinstance(physics, str) else physics
        self.mechanics = Mechanics(robot, start, _slot(robot, axial))
        self.limits = displacement_range(robot) + np.array([-RANGE_MARGIN_M, RANGE_MARGIN_M])
        self.facing = robot.axial_map.tolist()  # tendon that each servo meets, [slot][servo]
        self.words = fingerprint_words(robot.fingerprint)
        self.state = BoardState.SILENT
        self.faults = Fault(0)
        self.refused: dict[Refusal, int] = dict.fromkeys(Refusal, 0)
        self.session = 0
        self.words_matched: set[int] = set()
        self.last_seq = 0
        self.energised: set[int] = set()  # tendons whose coil has current
        self.verified: set[int] = set()  # tendons whose clutch both encoders saw coupled
        self.staged: dict[int, float] = {}  # servo: absolute shaft angle [rad]
        self.axial_turning = False
        self.stream_divider = 1
        self._port = Port("BOARD")
        self._out: list[Frame] = []
        self._answers: dict[int, tuple[Status, Reason]] = {}
        self._host_heard, self._watchdog = -math.inf, WATCHDOG_S
        self._axial_time = axial_time(robot, self.physics)
        self._probe_time = probe_time(robot, self.physics)
        self._job: Job | None = None
        self._job_command: tuple[int, int] | None = None  # its seq and op, if one started it
        self._job_due = math.inf
        self._ticks, self._tick_due = 0, math.inf

    # The clock

    @property
    def next_time(self) -> float:
        """When something happens next if no frame arrives [s]; inf if nothing will."""
        return min(self._job_due, self._tick_due, self._watchdog_end)

    @property
    def watchdog_due(self) -> float:
        """When the host counts as lost if it stays silent [s]."""
        return self._host_heard + self._watchdog

    @property
    def _watchdog_end(self) -> float:
        return self.watchdog_due if self.state is BoardState.ARMED else math.inf

    def step(self, now: float, frames: Iterable[Frame] = ()) -> list[Frame]:
        """Let time pass until ``now`` [s], take the frames that arrived then, answer."""
        self._out = []
        while (due := self.next_time) <= now:
            self.mechanics.advance(due)
            if due == self._watchdog_end:
                self.faults |= Fault.WATCHDOG
                self._stop(BoardState.SAFE, Reason.WATCHDOG)
            elif due == self._job_due:
                self._continue_job()
            else:
                feedback.stream(self, self._ticks)
                self._ticks += 1
                self._tick_due += feedback.TICK_S
        self.mechanics.advance(now)
        for frame in frames:
            self._receive(frame)
        return self._out

    @property
    def milliseconds(self) -> int:
        """Board clock as the bus carries it; rounded down, but not by rounding errors."""
        return int(self.mechanics.time * 1e3 + 1e-6) & 0xFFFF

    # Sending and receiving

    def send(self, name: str, **values: float) -> None:
        """Queue a message of the DBC."""
        self._out.append(self._port.pack(name, **values))

    def _receive(self, frame: Frame) -> None:
        received = self._port.unpack(frame)
        if isinstance(received, Refusal):
            self.refused[received] += 1
            self.faults |= Fault.FRAMES_REFUSED
            return
        values = received.values
        if received.name == "ESTOP":
            self._estop()
        elif received.name == "CMD":
            self._command(values["Seq"], values["Op"], values["Idx"], values["Arg"])
        elif values["Session"] == self.session:
            self._host_heard = self.mechanics.time
            self._watchdog = min(values["Watchdog"] * 1e-3, WATCHDOG_S)

    def _estop(self) -> None:
        if self.state is not BoardState.ESTOPPED:
            self.faults |= Fault.ESTOP
            self._stop(BoardState.ESTOPPED, Reason.ESTOPPED)
        self._start_streams()
        feedback.heartbeat(self)

    def _command(self, seq: int, op: int, idx: int, arg: int) -> None:
        new_session = op == Op.HELLO and arg & 0xFFFF != self.session
        if seq in self._answers and not new_session:
            status, reason = self._answers[seq]
            self._acknowledge(seq, op, Status.DUPLICATE, reason, status)
            return
        ahead = (seq - self.last_seq) & 0xFFFF
        if op != Op.HELLO and not 1 <= ahead <= SEQUENCE_WINDOW:
            self._acknowledge(seq, op, Status.REJECTED, Reason.SEQUENCE, self.last_seq)
            return
        refused = refusal(self, op, idx, arg)
        if refused is None:
            self._obey(seq, Op(op), idx, arg)
        elif refused[0] in PASSING:  # its number is not used up: it may be tried again
            self._acknowledge(seq, op, Status.BUSY, *refused)
        elif op == Op.HELLO:  # a stranger's HELLO must not shift the session's numbers
            self._acknowledge(seq, op, Status.REJECTED, *refused)
        else:
            self.last_seq = seq
            self._answer(seq, op, Status.REJECTED, *refused)

    def _obey(self, seq: int, op: Op, idx: int, arg: int) -> None:
        job = HANDLERS[op](self, idx, arg)
        self.last_seq = seq
        self._answer(seq, op, Status.DONE if job is None else Status.ACCEPTED, Reason.NONE)
        if job is not None:
            self._start_job(job, (seq, op))

    def _answer(
        self, seq: int, op: int, status: Status, reason: Reason, detail: int | None = None
    ) -> None:
        """Acknowledge, and remember the answer for duplicates."""
        self._answers[seq] = (status, reason)
        while len(self._answers) > REMEMBERED:
            del self._answers[next(iter(self._answers))]
        self._acknowledge(seq, op, status, reason, detail)

    def _acknowledge(
        self, seq: int, op: int, status: Status, reason: Reason, detail: int | None = None
    ) -> None:
        detail = self.milliseconds if detail is None else detail
        self.send("ACK", Seq=seq, Op=op, Status=status, Reason=reason, Detail=detail)

    def _start_streams(self) -> None:
        if self._tick_due == math.inf:
            self._set_stream(0, 1)

    # Jobs, one at a time

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""
        return self._job is not None

    def _start_job(self, job: Job, command: tuple[int, int] | None) -> None:
        self._job, self._job_command = job, command
        self._continue_job()

    def _continue_job(self) -> None:
        assert self._job is not None  # _job_due is finite only with a job
        try:
            self._job_due = self.mechanics.time + next(self._job)
        except StopIteration as end:
            self._end_job(end.value)

    def _end_job(self, reason: Reason) -> None:
        """Answer for the job, then show what the sensors say now, ahead of the next tick."""
        self._job, self._job_due = None, math.inf
        if self._job_command is not None:
            status = Status.DONE if reason is Reason.NONE else Status.ABORTED
            self._answer(*self._job_command, status, reason)
        feedback.axial_and_clutches(self)
        feedback.servos(self)
        feedback.wheels(self)

    def _abort_job(self, reason: Reason) -> None:
        if self._job is not None:
            self._job.close()
            self._end_job(reason)

    def _stop(self, state: BoardState, reason: Reason) -> None:
        """Abort the job, tell, brake, then take the clutches off."""
        ran = self._job_command[1] if self._job is not None and self._job_command else 0
        self.state = state
        self.words_matched.clear()
        self._abort_job(reason)
        self.send("EMCY", Severity=2, Code=reason, Subsystem=ran, Detail=self.milliseconds)
        self._start_job(self._come_to_rest(), None)

    def _come_to_rest(self) -> Job:
        self.staged.clear()
        if self.mechanics.moving:
            self.mechanics.brake(self.physics.brake_s)
            yield self.physics.brake_s
        self.axial_turning = False
        may_be_in = bool(self.energised | self.verified)  # a plug is not seen, only its coil
        self.energised.clear()
        if may_be_in:
            yield self.physics.clutch_out_s
        self.mechanics.coupled.clear()
        self.verified.clear()
        return Reason.NONE

    # What the commands do; each returns a job if it takes time

    def _hello(self, idx: int, arg: int) -> None:
        self.state, self.session = BoardState.READY, arg & 0xFFFF
        self._answers.clear()
        self.words_matched.clear()
        self._host_heard = -math.inf
        self._set_stream(0, 1)

    def _robot(self, idx: int, arg: int) -> None:
        self.words_matched.add(idx)

    def _set_stream(self, idx: int, arg: int) -> None:
        """Begin the streams anew, so that the first of each comes at once."""
        self.stream_divider, self._ticks, self._tick_due = arg, 0, self.mechanics.time

    def _arm(self, idx: int, arg: int) -> None:
        self.state = BoardState.ARMED

    def _disarm(self, idx: int, arg: int) -> Job | None:
        self.state = BoardState.READY
        self.words_matched.clear()
        if self._job is None and not self.energised | self.verified:
            return None
        self._abort_job(Reason.DISARMED)
        return self._come_to_rest()

    def _axial(self, idx: int, arg: int) -> Job | None:
        return None if arg - 1 == self.mechanics.slot else self._turn_axial(arg)

    def _turn_axial(self, arg: int) -> Job:
        self.axial_turning, self.mechanics.slot = True, -1
        self.mechanics.rotate_axial(arg - 1, self._axial_time)
        yield self._axial_time
        self.axial_turning, self.mechanics.slot = False, arg - 1
        return Reason.NONE

    def _engage(self, idx: int, arg: int) -> Job:
        wanted = self.clutches_in(arg)
        self.energised |= wanted.keys()
        yield self.physics.clutch_in_s
        self.mechanics.coupled.update({servo: tendon for tendon, servo in wanted.items()})
        followed = yield from self._probe(wanted)
        self.verified |= followed
        return Reason.NONE if followed == wanted.keys() else Reason.NOT_SEATED

    def _release(self, idx: int, arg: int) -> Job:
        wanted = self.clutches_in(arg)
        self.energised -= wanted.keys()
        yield self.physics.clutch_out_s
        for servo in wanted.values():
            self.mechanics.coupled.pop(servo, None)
        followed = yield from self._probe(wanted)
        self.verified -= wanted.keys() - followed
        return Reason.NOT_RELEASED if followed else Reason.NONE

    def _probe(self, tendons: dict[int, int]) -> Generator[float, None, set[int]]:
        """Turn the servos a little and back; which of {tendon: servo} had a wheel that followed.

        Each turns towards the middle of its tendon's range, so that no probe leaves the range.
        """
        before = self.mechanics.wheel_counts()
        angle, half = math.radians(self.physics.probe_angle_deg), self._probe_time / 2
        centre = self.limits.mean(axis=1) - self.sensed_displacements()
        by = {s: angle if centre[c] > 0 else -angle for c, s in tendons.items()}
        self.mechanics.turn(by, half)
        yield half
        moved = np.abs(self.mechanics.wheel_counts() - before)
        self.mechanics.turn({s: -a for s, a in by.items()}, half)
        yield half
        expected = angle / float(self.robot.gear_ratio) * COUNTS_PER_TURN / (2 * math.pi)
        return {c for c in tendons if moved[c] > expected / 2}

    def _stage(self, idx: int, arg: int) -> None:
        self.staged[idx - 1] = arg / SERVO_BITS_PER_RAD

    def _move(self, idx: int, arg: int) -> Job:
        by = {s: self.staged.pop(s) - float(self.mechanics.servo[s]) for s in self.servos_in(arg)}
        duration = max(abs(angle) for angle in by.values()) / float(self.robot.servo_speed)
        if duration > 0:
            self.mechanics.turn(by, duration)
            yield duration
        return Reason.NONE

    # What the controller knows

    @property
    def layer(self) -> int:
        """Layer that the servos face; -1 between slots."""
        slot = self.mechanics.slot
        return -1 if slot < 0 else self.facing[slot][0] // len(self.facing[slot])

    def clutches_in(self, mask: int) -> dict[int, int]:
        """{tendon: servo that faces it} of a clutch mask of the present layer."""
        facing = self.facing[self.mechanics.slot]
        return {c: s for s, c in enumerate(facing) if mask >> (c % len(facing)) & 1}

    def clutch_mask(self, tendons: Collection[int]) -> int:
        """Clutch mask of tendons of one layer."""
        return sum(1 << (c % self.robot.tendons_per_segment) for c in tendons)

    def servos_in(self, mask: int) -> list[int]:
        """Servos of a mask."""
        return [s for s in range(self.robot.tendons_per_segment) if mask >> s & 1]

    def tendon_of(self, servo: int) -> int | None:
        """Tendon that a servo is verified to drive."""
        if self.mechanics.slot < 0:
            return None
        tendon = self.facing[self.mechanics.slot][servo]
        return tendon if tendon in self.verified & self.energised else None

    def sensed_displacements(self) -> Float[np.ndarray, " S*J"]:
        """Displacements [m] by the wheel encoders."""
        radians = self.mechanics.wheel_counts() * (2 * math.pi / COUNTS_PER_TURN)
        return radians * float(self.robot.wheel_radius)


def _slot(robot: Robot, axial: int | None) -> int:
    if axial is not None and not 1 <= axial <= len(robot.axial_map):
        raise ValueError(f"axial: is 1 to {len(robot.axial_map)}, found {axial}")
    return -1 if axial is None else axial - 1


HANDLERS: dict[Op, Callable[[VirtualBoard, int, int], Job | None]] = {
    Op.HELLO: VirtualBoard._hello,
    Op.ROBOT: VirtualBoard._robot,
    Op.ARM: VirtualBoard._arm,
    Op.DISARM: VirtualBoard._disarm,
    Op.AXIAL: VirtualBoard._axial,
    Op.ENGAGE: VirtualBoard._engage,
    Op.RELEASE: VirtualBoard._release,
    Op.STAGE: VirtualBoard._stage,
    Op.START: VirtualBoard._move,
    Op.SET_STREAM: VirtualBoard._set_stream,
}
