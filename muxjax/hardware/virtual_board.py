"""A board that exists only in memory: the firmware's state machine over simulated mechanics.

Sans-IO: ``step(now, frames)`` takes what arrived, lets time pass until ``now`` and returns what
the board sends. What it models is stated by configs/hardware/*.yaml: the whole protocol of
docs/protocol.md with its state machine, watchdog, interlocks and range limits; inertia of axial
motor and servos; backlash; plugs that look for their slots; tendons that slip when a clutch
switches; encoders with quantisation, noise, smooth errors, parity; the servos' UART; heat of the
coils; loss of supply, a hung controller, and every fault of ``faults.FaultKind``.

It does not model: the load on the tendons (nothing stalls by itself, a relaxed servo holds
still), elasticity, servo tuning, temperature of anything but the coils, CAN's own error frames.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Collection, Iterable
from itertools import count

import numpy as np
from jaxtyping import Float

from muxjax.hardware import feedback, upsets
from muxjax.hardware.coils import Coils
from muxjax.hardware.commands import HANDLERS, Job, come_to_rest
from muxjax.hardware.encoders import COUNTS_PER_RAD, EncoderCalibration, Encoders
from muxjax.hardware.faults import FaultClock, FaultConfig, FaultKind
from muxjax.hardware.guards import FAULTS, WINDOW_COUNTS, Guards, Trip
from muxjax.hardware.interlocks import refusal
from muxjax.hardware.mechanics import Mechanics
from muxjax.hardware.physics import PhysicsConfig, axial_time, load_physics
from muxjax.hardware.protocol import (
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
from muxjax.hardware.sensing import Senses
from muxjax.robot import Robot
from muxjax.tendons import check_displacements, displacement_range

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
        faults: Faults beyond those of the physics.
        seed: Of everything that is drawn.

    Attributes:
        mechanics: The truth. The controller's code reads it through ``senses`` only.
        senses: What the controller's sensors say.

    Raises:
        ValueError: The protocol cannot carry the robot, the physics do not fit its switch time,
            the displacements are beyond its range, it has no such axial position, or a fault
            names a servo or tendon that it has not.
    """

    def __init__(
        self,
        robot: Robot,
        physics: PhysicsConfig | str = "ideal",
        displacements: Collection[float] | Float[np.ndarray, " S*J"] | None = None,
        axial: int | None = None,
        faults: Iterable[FaultConfig] = (),
        seed: int = 0,
    ) -> None:
        check_robot_fits(robot)
        start = np.zeros(robot.n_tendons) if displacements is None else displacements
        start = check_displacements(robot, "displacements", start)
        if start.ndim != 1:
            raise ValueError(f"displacements: must have one axis, found shape {start.shape}")
        self.robot = robot
        self.physics = load_physics(physics) if isinstance(physics, str) else physics
        axial_time(robot, self.physics, 0.0)  # physics that do not fit are refused here
        for_mechanics, for_encoders, for_faults = np.random.default_rng(seed).spawn(3)
        slot = _slot(robot, axial)
        self.mechanics = Mechanics(robot, self.physics, start, slot, for_mechanics)
        self.senses = Senses(robot, self.mechanics, _encoders(robot, self.physics, for_encoders))
        self.coils = Coils(self.physics.coil)
        self.guards = Guards()
        self.volts = self.physics.supply_v
        self.limits = displacement_range(robot) + np.array([-RANGE_MARGIN_M, RANGE_MARGIN_M])
        play = self.physics.servo.backlash_m / float(robot.wheel_radius) * COUNTS_PER_RAD
        self.window_counts = WINDOW_COUNTS + 2 * play  # in which a wheel must follow its servo
        ratio = float(robot.gear_ratio)
        self.counts_per_bit = COUNTS_PER_RAD / SERVO_BITS_PER_RAD / ratio  # of wheel and servo
        self.facing = robot.axial_map.tolist()  # tendon that each servo meets, [slot][servo]
        self.words = fingerprint_words(robot.fingerprint)
        self.cut_off: set[FaultKind] = set()  # what keeps frames from the board
        self.boots = 0
        self._faults_due = FaultClock(
            (*self.physics.faults, *faults), robot.tendons_per_segment, robot.n_tendons, for_faults
        )
        self._plans: list[tuple[float, int, Callable[[], object]]] = []
        self._number = count()
        self._start_controller(slot)

    def _start_controller(self, slot: int) -> None:
        """Everything that the controller keeps in memory, as it is after a reset."""
        self.state = BoardState.SILENT
        self.faults = Fault(0)
        self.refused: dict[Refusal, int] = dict.fromkeys(Refusal, 0)
        self.session = 0
        self.words_matched: set[int] = set()
        self.last_seq = 0
        self.slot = slot  # where the controller knows the drum to stand
        self.energised: set[int] = set()  # tendons whose coil has current
        self.verified: set[int] = set()  # tendons whose clutch both encoders saw coupled
        self.suspects: set[int] = set()  # tendons whose clutch nobody saw come out
        self.staged: dict[int, float] = {}  # servo: absolute shaft angle [rad]
        self.axial_turning = False
        self.stream_divider = 1
        self.boots += 1
        self.running = True  # the controller's program
        self._booted_at = self.mechanics.time
        self._port = Port("BOARD")
        self._out: list[Frame] = []
        self._answers: dict[int, tuple[Status, Reason]] = {}
        self._host_heard, self._watchdog = -math.inf, WATCHDOG_S
        self._job: Job | None = None
        self._job_command: tuple[int, int] | None = None  # its seq and op, if one started it
        self._job_due = math.inf
        self._ticks, self._tick_due = 0, math.inf

    def calibrate(self, table: EncoderCalibration) -> None:
        """Enter a lab's table of encoder errors; the board then reports corrected angles."""
        self.senses.encoders.calibration = table

    # The clock

    @property
    def now(self) -> float:
        """Time that has passed [s]."""
        return self.mechanics.time

    @property
    def next_time(self) -> float:
        """When something happens next if no frame arrives [s]; inf if nothing will."""
        plan = self._plans[0][0] if self._plans else math.inf
        outside = min(plan, self._faults_due.next_time)
        if not self.running:
            return outside
        return min(self._job_due, self._tick_due, self._watchdog_end, outside)

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
            self._happen(due)
        self.mechanics.advance(now)
        if self.running and not self.cut_off:
            for frame in frames:
                self._receive(frame)
        return self._out

    def _happen(self, due: float) -> None:
        if self._plans and due == self._plans[0][0]:
            heapq.heappop(self._plans)[2]()
        elif due == self._faults_due.next_time:
            upsets.upset(self, *self._faults_due.take())
        elif due == self._watchdog_end:
            self.faults |= Fault.WATCHDOG
            self._stop(BoardState.SAFE, Reason.WATCHDOG)
        elif due == self._job_due:
            self._continue_job()
        else:
            self._tick()

    def _tick(self) -> None:
        """Every 10 ms since the first HELLO: guards, then streams."""
        self.coils.pass_time(self.now, len(self.energised))
        if self.state is BoardState.ARMED:
            try:
                self.guards.look(self)
            except Trip as trip:
                self._trip(trip)
        feedback.stream(self, self._ticks)
        self._ticks += 1
        self._tick_due += feedback.TICK_S

    def plan(self, after: float, what: Callable[[], object]) -> None:
        """Let something happen outside the controller ``after`` so long [s]."""
        heapq.heappush(self._plans, (self.now + after, next(self._number), what))

    @property
    def milliseconds(self) -> int:
        """Board clock as the bus carries it; rounded down, but not by rounding errors."""
        return int((self.now - self._booted_at) * 1e3 + 1e-6) & 0xFFFF

    # Supply

    def power_cycle(self, off_s: float = 0.5) -> None:
        """Somebody switches the board off and on again; it comes up after booting.

        The servos run on to the last target they were given. Coils lose their current at once.
        """
        self.halt()
        self.energised = set()
        every = range(self.robot.n_tendons)
        self.plan(self.physics.clutch_out_s, lambda: self.mechanics.unseat(every))
        boots = self.boots
        self.plan(off_s + self.physics.controller.boot_s, lambda: self._power_up(boots))

    def halt(self) -> None:
        """The controller's program stands still; servos run on to their last target."""
        self.running = False
        self.mechanics.brake(self.physics.controller.horizon_s)

    def _power_up(self, boots: int) -> None:
        if boots != self.boots:  # another one came first
            return
        self._start_controller(slot=-1)
        self.cut_off.discard(FaultKind.BUS_OFF)
        self.volts = self.physics.supply_v
        self.senses.lose_turns()
        self.faults = Fault.TURNS_LOST

    # Sending and receiving

    def send(self, name: str, **values: float) -> None:
        """Queue a message of the DBC."""
        if not self.cut_off:
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
            self._host_heard = self.now
            self._watchdog = min(values["Watchdog"] * 1e-3, WATCHDOG_S)

    def _estop(self) -> None:
        if self.state is not BoardState.ESTOPPED:
            self.faults |= Fault.ESTOP
            self._stop(BoardState.ESTOPPED, Reason.ESTOPPED)
        if self._tick_due == math.inf:
            self.start_streams(1)
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
        self._faults_due.executed(op, self.now)
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

    def greet(self, session: int) -> None:
        """A session begins."""
        self.state, self.session = BoardState.READY, session
        self._answers.clear()
        self.words_matched.clear()
        self._host_heard = -math.inf
        self.start_streams(1)

    def start_streams(self, divider: int) -> None:
        """Begin the streams anew, so that the first of each comes at once."""
        self.stream_divider, self._ticks, self._tick_due = divider, 0, self.now

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
            self._job_due = next(self._job)
        except StopIteration as end:
            self._end_job(end.value)
        except Trip as trip:
            self._trip(trip)

    def _end_job(self, reason: Reason) -> None:
        """Answer for the job, then show what the sensors say now, ahead of the next tick."""
        self._job, self._job_due = None, math.inf
        if self._job_command is not None:
            status = Status.DONE if reason is Reason.NONE else Status.ABORTED
            self._answer(*self._job_command, status, reason)
        feedback.axial_and_clutches(self)
        feedback.servos(self)
        feedback.wheels(self)

    def abort_job(self, reason: Reason) -> None:
        """Break off the job, if there is one, and answer for it."""
        if self._job is not None:
            self._job.close()
            self._end_job(reason)

    def _trip(self, trip: Trip) -> None:
        self.faults |= FAULTS[trip.reason]
        self._stop(BoardState.SAFE, trip.reason, trip.index)

    def _stop(self, state: BoardState, reason: Reason, index: int = 0) -> None:
        """Abort the job, tell, brake, then take the clutches off."""
        ran = self._job_command[1] if self._job is not None and self._job_command else 0
        self.state = state
        self.words_matched.clear()
        self.abort_job(reason)
        detail = self.milliseconds
        self.send("EMCY", Severity=2, Code=reason, Subsystem=ran, Index=index, Detail=detail)
        self._start_job(come_to_rest(self), None)

    # What the controller knows

    @property
    def layer(self) -> int:
        """Layer that the servos face; -1 between slots."""
        slot = self.slot
        return -1 if slot < 0 else self.facing[slot][0] // len(self.facing[slot])

    def clutches_in(self, mask: int) -> dict[int, int]:
        """{tendon: servo that faces it} of a clutch mask of the present layer."""
        facing = self.facing[self.slot]
        return {c: s for s, c in enumerate(facing) if mask >> (c % len(facing)) & 1}

    def clutch_mask(self, tendons: Collection[int]) -> int:
        """Clutch mask of tendons of one layer."""
        return sum(1 << (c % self.robot.tendons_per_segment) for c in tendons)

    def servos_in(self, mask: int) -> list[int]:
        """Servos of a mask."""
        return [s for s in range(self.robot.tendons_per_segment) if mask >> s & 1]

    def tendon_of(self, servo: int) -> int | None:
        """Tendon that a servo is verified to drive."""
        if self.slot < 0:
            return None
        tendon = self.facing[self.slot][servo]
        return tendon if tendon in self.verified & self.energised else None

    def in_use(self) -> dict[int, int]:
        """{servo: tendon} whose clutch has current."""
        if not self.energised:
            return {}
        facing = self.facing[self.slot]
        return {s: c for s, c in enumerate(facing) if c in self.energised}


def _slot(robot: Robot, axial: int | None) -> int:
    if axial is not None and not 1 <= axial <= len(robot.axial_map):
        raise ValueError(f"axial: is 1 to {len(robot.axial_map)}, found {axial}")
    return -1 if axial is None else axial - 1


def _encoders(robot: Robot, physics: PhysicsConfig, rng: np.random.Generator) -> Encoders:
    """The robot's encoders, calibrated if the physics say so."""
    errors = physics.encoder
    encoders = Encoders(
        robot.n_tendons,
        robot.config.encoder.bits.value,
        errors.inl_deg,
        errors.noise_counts,
        errors.parity_rate,
        rng,
    )
    if errors.calibration_points:
        encoders.calibration = encoders.measure(errors.calibration_points)
    return encoders
