"""Run a program on a board: the host's half of docs/protocol.md.

The core is sans-IO: ``Executor.step(now, frames)`` takes what arrived and returns what to send.
What it does is one script: handshake, arm, then each visit, then disarm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from muxjax.hardware.links import Link, Trajectory
from muxjax.hardware.protocol import (
    SERVO_BITS_PER_RAD,
    SERVO_LIMIT_BITS,
    VERSION,
    BoardState,
    Frame,
    Op,
    Reason,
    check_robot_fits,
    fingerprint_words,
)
from muxjax.hardware.session import Failed, Script, Session, Wrong
from muxjax.hardware.visits import Visit, load_visits
from muxjax.robot import Robot
from muxjax.scheduler import Program

Targets = Mapping[int, int]  # {servo: 0.1 degree}

ENGAGE_TRIES = 3
MAX_TRIMS = 3
TRIM_COUNTS = 1.5  # wheel error [encoder counts] that is left alone
START_TOLERANCE_MM = 0.5  # how far the wheels may stand from program.start
CLUTCH_S = 0.5  # after this a clutch or its probe should be done
BOARD_LOST_S = 0.25  # silence of BOARD_HB; the board guards itself, so five beats may be missed
ESTOP_REPEAT_S = 0.005
ESTOP_WAIT_S = 1.0


@dataclass(frozen=True)
class InstructionRecord:
    """What one instruction did. Times count from arming, on the board's clock [s]."""

    axial: int
    start_s: float
    end_s: float
    trims: int


@dataclass(frozen=True, eq=False)
class Run:
    """How a program went.

    Attributes:
        completed: Every instruction was done and the board disarmed.
        reason: "completed", or what stopped it.
        duration_s: From arming to the end, on the board's clock [s]; NaN if it never armed.
        measured: Displacements by the wheel encoders at the end [m]; NaN for a wheel never heard.
        records: The instructions that were completed.
        trajectory: True displacements over time since arming, where the link knows them.
    """

    completed: bool
    reason: str
    duration_s: float
    measured: Float[np.ndarray, " S*J"]
    records: tuple[InstructionRecord, ...]
    trajectory: Trajectory | None


def execute(program: Program, link: Link) -> Run:
    """Run a program on the board behind a link, to its end or to the safe state.

    A keyboard interrupt stops the board by ESTOP and ends the run as not completed.

    Raises:
        ValueError: The program is wrong or for another robot, the board is another one, or the
            tendons do not stand at the program's start. Nothing has moved then.
    """
    executor = Executor(link.robot, program, link.new_session(), link.stream_divider)
    frames: list[Frame] = []
    while not executor.finished:
        try:
            link.send(executor.step(link.now, frames))
            frames = link.wait(executor.next_time)
        except KeyboardInterrupt:
            executor.estop("stopped from the keyboard")
            frames = []
    return executor.result(link.trajectory)


class Executor(Session):
    """The host's state machine for one program.

    Args:
        robot: The arm on the board.
        program: What to run.
        session: 16-bit number of this session, another one each time.
        stream_divider: What the board divides the rates of its feedback by.

    Raises:
        ValueError: The program does not fit the robot; see ``load_visits``.
    """

    def __init__(
        self, robot: Robot, program: Program, session: int, stream_divider: int = 1
    ) -> None:
        check_robot_fits(robot)
        super().__init__(robot, session)
        self.robot = robot
        self.program = program
        self.visits = load_visits(robot, program)
        self.stream_divider = stream_divider
        self.records: list[InstructionRecord] = []
        self.finished = False
        self._reason = ""
        self._wrong = False
        self._guarded = False  # whether losing the board, or its armed state, ends the run
        self._armed_board_s = self._ended_board_s = math.nan
        self._script: Script[None] = self._run()
        self._script_due = -math.inf

    # The clock

    @property
    def next_time(self) -> float:
        """When to call ``step`` next if no frame arrives [s]."""
        return min(self._script_due, self._heartbeat_due)

    def step(self, now: float, frames: Iterable[Frame] = ()) -> list[Frame]:
        """Take the frames that arrived, go on as far as possible, return what to send."""
        self._now, self._out = now, []
        for frame in frames:
            self._receive(frame)
        if now >= self._heartbeat_due and not self.finished:
            self._beat()
        if not self.finished:
            self._advance()
        return self._out

    def _advance(self) -> None:
        lost = self._lost(self._armed_at) if self._guarded and self._armed_at is not None else None
        try:
            if lost is None:
                self._script_due = next(self._script)
            else:
                self._script_due = self._script.throw(Failed(lost))
        except StopIteration:
            self.finished = True

    def _lost(self, armed_at: float) -> str | None:
        """Why the armed board is not ours any more, if so."""
        if self.sensors.emergency is not None:
            return f"the board stopped: {self.sensors.emergency.name}"
        if self.sensors.state in (BoardState.SAFE, BoardState.ESTOPPED):
            return f"the board went to state {self.sensors.state.name}"
        heard = max(self.sensors.heartbeat_at, armed_at)
        if self._now - heard > BOARD_LOST_S:
            return "the board's heartbeat is lost"
        return None

    def estop(self, reason: str) -> None:
        """Stop everything now; the board latches it until its power-up."""
        self._script.close()
        self._script, self._script_due = self._stop_board(reason), -math.inf

    def result(self, trajectory: Callable[[float], Trajectory | None]) -> Run:
        """The finished run.

        Args:
            trajectory: Of the link; is asked for what happened since arming, on the host's clock.

        Raises:
            ValueError: The run was refused before anything moved.
        """
        if self._wrong:
            raise ValueError(self._reason)
        return Run(
            completed=self._reason == "completed",
            reason=self._reason,
            duration_s=self._ended_board_s - self._armed_board_s,
            measured=self.sensors.displacements(),
            records=tuple(self.records),
            trajectory=None if self._armed_at is None else trajectory(self._armed_at),
        )

    # The script

    def _run(self) -> Script[None]:
        try:
            yield from self._handshake()
            yield from self._arm()
            for number, visit in enumerate(self.visits, start=1):
                yield from self._visit(number, visit)
            self._guarded = False
            yield from self._command(Op.DISARM)
            self._reason = "completed"
        except Failed as failure:
            self._reason, self._wrong = str(failure), isinstance(failure, Wrong)
            yield from self._leave()
        self._ended_board_s = self.sensors.board_s

    def _leave(self) -> Script[None]:
        """Ask for the safe state; a board that does not hear goes there by its watchdog."""
        self._guarded = False
        stopped = self.sensors.state in (BoardState.SAFE, BoardState.ESTOPPED)
        if self._armed_at is None or stopped:
            return
        try:
            yield from self._command(Op.DISARM, takes_s=CLUTCH_S)
        except Failed as failure:
            self._reason += f"; {failure}"

    def _stop_board(self, reason: str) -> Script[None]:
        """ESTOP until the board says that it has seen it."""
        self._reason, self._guarded = reason, False
        deadline = self._now + ESTOP_WAIT_S
        while self.sensors.state is not BoardState.ESTOPPED:
            if self._now >= deadline:
                self._reason += "; no board confirmed the ESTOP"
                break
            self._send("ESTOP", Source=1, Reason=1)
            yield self._now + ESTOP_REPEAT_S
        self._ended_board_s = self.sensors.board_s

    def _handshake(self) -> Script[None]:
        yield from self._command(Op.HELLO, arg=VERSION << 16 | self.session)
        for number, word in enumerate(fingerprint_words(self.program.fingerprint), start=1):
            yield from self._command(Op.ROBOT, number, word)
        if self.stream_divider > 1:
            yield from self._command(Op.SET_STREAM, arg=self.stream_divider)
        yield from self._expect(lambda: self.sensors.complete, "every sensor to report")
        off = 1e3 * np.abs(self.sensors.displacements() - np.array(self.program.start))
        if off.max() > START_TOLERANCE_MM:
            raise Wrong(
                f"program.start: tendon {int(off.argmax()) + 1} stands {off.max():.3g} mm from "
                f"it, at most {START_TOLERANCE_MM:g} mm"
            )

    def _arm(self) -> Script[None]:
        self._beat()  # the board arms nobody whose heart it has not heard since HELLO
        yield from self._command(Op.ARM, arg=self.session)
        self._armed_at, self._armed_board_s = self._now, self.sensors.board_s
        self.sensors.emergency = self.sensors.state = None  # what was heard before is past
        self._guarded = True

    def _visit(self, number: int, visit: Visit) -> Script[None]:
        """One instruction as a transaction: all of it, or a failure that names it."""
        start = self.sensors.board_s - self._armed_board_s
        try:
            yield from self._go_to(visit)
            yield from self._engage(visit)
            trims = yield from self._move_all(visit)
            yield from self._release(visit)
        except Failed as failure:
            raise Failed(f"instruction {number}: {failure}") from failure
        end = self.sensors.board_s - self._armed_board_s
        self.records.append(InstructionRecord(visit.axial, start, end, trims))

    def _go_to(self, visit: Visit) -> Script[None]:
        yield from self._expect(lambda: self.sensors.clutches_out, "all clutches to be out")
        takes_s = float(self.robot.switch_time)
        yield from self._command(Op.AXIAL, arg=visit.axial, takes_s=takes_s)
        yield from self._expect(
            lambda: self.sensors.slot == visit.axial, f"axial position {visit.axial}"
        )

    def _engage(self, visit: Visit) -> Script[None]:
        """The board oscillates the servos and believes both encoders; here its word is checked."""
        for _ in range(ENGAGE_TRIES):
            reason = yield from self._command(
                Op.ENGAGE, visit.layer, visit.clutch_mask, takes_s=CLUTCH_S
            )
            if reason is not Reason.NOT_SEATED:
                break
        else:
            raise Failed(f"clutches not seated after {ENGAGE_TRIES} tries")
        wanted = visit.layer, visit.clutch_mask, visit.clutch_mask
        yield from self._expect(lambda: self.sensors.clutches == wanted, "the clutches to be in")

    def _release(self, visit: Visit) -> Script[None]:
        yield from self._command(Op.RELEASE, visit.layer, visit.clutch_mask, takes_s=CLUTCH_S)
        yield from self._expect(lambda: self.sensors.clutches_out, "the clutches to be out")

    def _move_all(self, visit: Visit) -> Script[int]:
        """Every leg, then trims until the wheels stand right; how many trims."""
        targets = yield from self._servo_targets(visit)
        for goals in visit.legs:
            yield from self._move(targets(goals))
        trims = 0
        while visit.legs:
            targets = yield from self._servo_targets(visit)
            off = self._wheel_error(visit)
            if off <= TRIM_COUNTS:
                break
            if trims == MAX_TRIMS:
                raise Failed(f"a wheel is {off:.1f} counts off after {trims} trims")
            yield from self._move(targets(visit.legs[-1]))
            trims += 1
        return trims

    def _servo_targets(self, visit: Visit) -> Script[Callable[[Mapping[int, float]], Targets]]:
        """Absolute servo angles {servo: 0.1 degree} for tendon goals {servo: m}.

        One reading of servos and wheels fixes how they stand to each other while the clutches
        hold, so that every leg's targets are absolute.
        """
        servos, wheels = [s - 1 for s in visit.tendons], [c - 1 for c in visit.tendons.values()]
        since = self._now
        yield from self._expect(
            lambda: self.sensors.fresh(servos, wheels, since), "servos and wheels to report"
        )
        ratio = float(self.robot.servo_per_metre)
        held = self.sensors.displacements()
        zero = {
            s: self.sensors.servo_rad[s - 1] - held[c - 1] * ratio for s, c in visit.tendons.items()
        }

        def targets(goals: Mapping[int, float]) -> Targets:
            return {s: round((zero[s] + m * ratio) * SERVO_BITS_PER_RAD) for s, m in goals.items()}

        return targets

    def _wheel_error(self, visit: Visit) -> float:
        """Largest distance of a moved wheel from its goal [encoder counts]."""
        held, goals = self.sensors.displacements(), visit.legs[-1]
        off = max(abs(held[c - 1] - goals[s]) for s, c in visit.tendons.items())
        return float(off) / self.sensors.metres_per_count

    def _move(self, targets: Targets) -> Script[None]:
        """Stage every servo, then start them together."""
        longest = 0.0
        for servo, target in targets.items():
            if abs(target) > SERVO_LIMIT_BITS:
                raise Failed(f"servo {servo} is at the end of its multi-turn range")
            yield from self._command(Op.STAGE, servo, target)
            turn = target / SERVO_BITS_PER_RAD - self.sensors.servo_rad[servo - 1]
            longest = max(longest, abs(float(turn)))
        mask = sum(1 << (servo - 1) for servo in targets)
        yield from self._command(
            Op.START, arg=mask, takes_s=longest / float(self.robot.servo_speed)
        )
