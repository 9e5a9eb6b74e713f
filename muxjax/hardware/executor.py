"""Run a program on a board: the host's half of docs/protocol.md.

The core is sans-IO: ``Executor.step(now, frames)`` takes what arrived and returns what to send.
What it does is one script: handshake, arm, then each visit, then disarm; after a failure that may
be gone in a new session, the same again from the measured lengths.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from muxjax.hardware.codec import layouts
from muxjax.hardware.handshake import Check
from muxjax.hardware.journal import (
    AtEntry,
    DoneEntry,
    EndEntry,
    MemoryJournal,
    ProgramEntry,
    ServoEntry,
)
from muxjax.hardware.links import Link, Trajectory
from muxjax.hardware.pauses import no_long_pauses
from muxjax.hardware.protocol import (
    OFFLINE,
    STALLED,
    BoardState,
    Frame,
    Op,
    Reason,
    check_robot_fits,
)
from muxjax.hardware.session import AFTER, After, Failed, Script, Wrong
from muxjax.hardware.transaction import CLUTCH_S, InstructionRecord, Transaction
from muxjax.hardware.visits import Visit, load_visits, make_visit
from muxjax.robot import Robot
from muxjax.scheduler import Program

RESTARTS = 2  # new sessions without a single visit done between them
MENDS = 2  # further visits of a tendon that a clutch moved on its way out
MEND_COUNTS = 2.0  # wheel error [encoder counts] that is left alone at the end
BOARD_LOST_S = 0.25  # silence of BOARD_HB; the board guards itself, so five beats may be missed
AT_S = 1.0  # between two records of where the wheels are: a wheel needs 30 s for half a turn
COME_TO_REST_S = 0.3  # the watchdog's 50 ms and the clutches
RESTART_PAUSE_S = 0.5  # before a new session: a board that browned out starts up
COOL_S = 5.0  # before a new session with coils that were too hot
EMERGENCY_WAIT_S = 0.1  # EMCY follows the answer to the command that it ended
ESTOP_REPEAT_S = 0.005
ESTOP_WAIT_S = 1.0


@dataclass(frozen=True, eq=False)
class Run:
    """How a program went.

    Attributes:
        completed: Every instruction was done and the board disarmed.
        reason: "completed", or what stopped it.
        duration_s: While armed, on the board's clock [s]; NaN if it never armed.
        measured: Displacements by the wheel encoders at the end [m]; NaN if no session came so far
            that it found the wheels where the journal has them.
        records: The instructions that were completed in this run.
        trajectory: True displacements over time since arming, where the link knows them.
        resumable: Whether ``resume`` can go on with the journal, after a power-up if the board
            was stopped by ESTOP; False too if a part is to be repaired or replaced first.
        failed_servos: Servos out of use, from 1; ``muxjax.pipeline.run_to_target``
            goes on without them.
        checks: The preflight report.
        interrupted: The host has stopped it by ESTOP, for a keyboard interrupt.
        estopped: The board is, or may be, stopped by ESTOP, and takes nobody until its power-up.
    """

    completed: bool
    reason: str
    duration_s: float
    measured: Float[np.ndarray, " S*J"]
    records: tuple[InstructionRecord, ...]
    trajectory: Trajectory | None
    resumable: bool = False
    failed_servos: tuple[int, ...] = ()
    checks: tuple[Check, ...] = ()
    interrupted: bool = False
    estopped: bool = False


@dataclass(frozen=True, eq=False)
class Progress:
    """What a run is at.

    Attributes:
        instruction: Under way, from 1; one more than ``instructions`` when all are done.
        instructions: How many there are.
        phase: In words.
        measured: Displacements by the wheel encoders [m]; NaN before the preflight.
        checks: The preflight report, once it is made.
    """

    instruction: int
    instructions: int
    phase: str
    measured: Float[np.ndarray, " S*J"]
    checks: tuple[Check, ...]


OnProgress = Callable[[Progress], None]


def execute(
    program: Program,
    link: Link,
    *,
    journal: MemoryJournal | None = None,
    on_progress: OnProgress | None = None,
) -> Run:
    """Run a program on the board behind a link, to its end or to the safe state.

    A keyboard interrupt stops the board by ESTOP and ends the run as not completed.

    Args:
        program: What to run.
        link: The way to the board.
        journal: What is written ahead of every motion, for ``resume``.
        on_progress: Is told of every new phase, and about once a second.

    Raises:
        ValueError: The program is wrong or for another robot, the journal holds one that was begun
            and is not finished, the board is another one, or the tendons do not stand at its start.
            Nothing has moved then.
    """
    journal = MemoryJournal() if journal is None else journal
    before = journal.standing
    if before.begun and not before.completed and not before.failed_servos:
        raise ValueError(
            "journal: holds a program that is not finished; go on with it by resume, or begin "
            "another journal"
        )
    begin(link.robot, program, journal)
    return _drive(_executor(journal, link), link, on_progress)


def begin(robot: Robot, program: Program, journal: MemoryJournal) -> None:
    """Check a program, pin its absolute goals and write both into a journal.

    Raises:
        ValueError: The protocol cannot carry the robot, or the program is wrong for it.
    """
    check_robot_fits(robot)
    visits = load_visits(robot, program)
    goals = tuple(tuple(dict(leg) for leg in visit.legs) for visit in visits)
    journal.write(ProgramEntry(program=program, goals=goals))


def resume(journal: MemoryJournal, link: Link, *, on_progress: OnProgress | None = None) -> Run:
    """Go on with a journal's program from where the wheels are now, to the same final lengths.

    The goals are those pinned when the program was loaded, so what was done moves nothing again,
    whether the host was killed, the board browned out or the cable was pulled.

    Args:
        journal: Of the run that was interrupted.
        link: The way to the board.
        on_progress: As for ``execute``.

    Raises:
        ValueError: The journal holds no program or one for another robot, the board is another
            one, or a tendon stands elsewhere than the journal left it. Nothing has moved then.
    """
    return _drive(_executor(journal, link), link, on_progress)


def take_stock(
    journal: MemoryJournal,
    link: Link,
    *,
    repaired_encoders: Collection[int] = (),
    on_progress: OnProgress | None = None,
) -> Run:
    """Write into a journal where the wheels are now, as a new plan has to know. Nothing moves.

    Every tendon must stand where the journal left it, but for those whose encoders were repaired:
    while an encoder stood still its clutch may have let the tendon slip unseen, further than
    ``resume`` lets pass. Whoever repaired it vouches for it by naming it here.

    Args:
        journal: Of the run that was interrupted.
        link: The way to the board.
        repaired_encoders: Tendons, from 1.
        on_progress: As for ``execute``.

    Returns:
        A run whose ``completed`` says whether they were written; its ``reason``, if not.

    Raises:
        ValueError: No such tendon, or as for ``resume``; also a repaired encoder whose tendon is
            more than 10 mm from where the journal has it.
    """
    n_tendons = link.robot.n_tendons
    unknown = sorted(set(repaired_encoders) - set(range(1, n_tendons + 1)))
    if unknown:
        raise ValueError(f"repaired_encoders: tendons are 1 to {n_tendons}, found {unknown[0]}")
    executor = _executor(journal, link)
    executor.only_take_stock(set(repaired_encoders))
    return _drive(executor, link, on_progress)


def _executor(journal: MemoryJournal, link: Link) -> Executor:
    return Executor(link.robot, journal, link.new_session(), link.stream_divider)


def _drive(executor: Executor, link: Link, on_progress: OnProgress | None) -> Run:
    layouts()  # reading the DBC takes a moment: not once the first command is under way
    frames: list[Frame] = []
    told = -1
    with no_long_pauses():
        while not executor.finished:
            try:
                link.send(executor.step(link.now, frames))
                if on_progress is not None and told != executor.news:
                    told = executor.news
                    on_progress(executor.progress())
                frames = link.wait(executor.next_time)
            except KeyboardInterrupt:
                executor.estop("stopped from the keyboard")
                frames = []
    return executor.result(link.trajectory)


class Executor(Transaction):
    """The host's state machine for the last program of a journal.

    Args:
        robot: The arm on the board.
        journal: Holds the program, and how far it has come.
        session: 16-bit number of this session, another one each time.
        stream_divider: What the board divides the rates of its feedback by.

    Raises:
        ValueError: The journal holds no program, or one that does not fit the robot; see
            ``load_visits``.
    """

    def __init__(
        self, robot: Robot, journal: MemoryJournal, session: int, stream_divider: int = 1
    ) -> None:
        before = journal.standing
        if before.program is None:
            raise ValueError("journal: holds no program")
        check_robot_fits(robot)
        super().__init__(robot, before.program, session, stream_divider, journal)
        self.visits = _pinned(robot, before.program, before.goals)
        self.records: list[InstructionRecord] = []
        self.finished = False
        self.news = 0  # grows whenever there is something to tell
        self._done, self._leg = before.done, before.leg
        self._reason = ""
        self._refused = self._completed = self._resumable = False
        self._interrupted = self._estopped = False
        self._ends_run = True
        self._guarded = False  # whether losing the board, or its armed state, ends the session
        self._first_armed_at: float | None = None  # on the link's clock
        self._duration = 0.0  # of the sessions that are over, while armed
        self._at_due = math.inf
        self._script: Script[None] = self._run()
        self._script_due = -math.inf

    # The clock

    @property
    def next_time(self) -> float:
        """When to call ``step`` next if no frame arrives [s]."""
        return min(self._script_due, self._heartbeat_due)

    def step(self, now: float, frames: Iterable[Frame] = ()) -> list[Frame]:
        """Take the frames that arrived, go on as far as possible, return what to send.

        What is to be written ahead is in the journal when this returns.
        """
        self._now, self._out = now, []
        for frame in frames:
            self._receive(frame)
        if now >= self._heartbeat_due and not self.finished:
            self._beat()
        if not self.finished:
            self._advance()
        return self._out

    def _advance(self) -> None:
        phase = self.phase
        armed_at = self._armed_at if self._guarded else None
        failure = None if armed_at is None else self._lost(armed_at)
        try:
            if failure is None and self._now >= self._at_due:
                self._at_due = self._now + AT_S
                self.news += 1
                self._write(AtEntry(lengths=self._heard_lengths()), ahead=False)
        except Failed as full:
            failure = full
        try:
            if failure is None:
                self._script_due = next(self._script)
            else:
                self._guarded = False
                self._script_due = self._script.throw(failure)
        except StopIteration:
            self.finished = True
        self.news += self.phase is not phase or self.finished

    def _lost(self, armed_at: float) -> Failed | None:
        """Why the armed board is not ours any more, if so."""
        said = self.sensors.emergency
        if said is not None:
            about = f" ({said.part})" if said.part else ""
            text = f"the board stopped: {said.reason.name}{about}"
            return Failed(text, AFTER.get(said.reason, After.AGAIN), reason=said.reason)
        if self.sensors.state in (BoardState.SAFE, BoardState.ESTOPPED):
            stopped = self.sensors.state is BoardState.ESTOPPED
            return Failed(
                f"the board went to state {self.sensors.state.name}",
                After.RESUME if stopped else After.AGAIN,
            )
        heard = max(self.sensors.heartbeat_at, armed_at)
        if self._now - heard > BOARD_LOST_S:
            return Failed("the board's heartbeat is lost")
        return None

    def estop(self, reason: str) -> None:
        """Stop everything now; the board latches it until its power-up."""
        self._interrupted = self._estopped = True
        self._script.close()
        self._script, self._script_due = self._stop_board(reason), -math.inf

    def only_take_stock(self, repaired_encoders: Collection[int]) -> None:
        """Instead of running: see ``take_stock``. The journal's run does not end by it."""
        self._script, self._ends_run = self._stock(repaired_encoders), False

    def progress(self) -> Progress:
        """What the run is at."""
        return Progress(
            min(self._done + 1, len(self.visits) + 1),
            len(self.visits),
            self.phase,
            self._measured(),
            self.checks,
        )

    def _measured(self) -> Float[np.ndarray, " S*J"]:
        return np.array(self._heard_lengths(), dtype=np.float64)

    def result(self, trajectory: Callable[[float], Trajectory | None]) -> Run:
        """The finished run.

        Args:
            trajectory: Of the link; is asked for what happened since arming, on the host's clock.

        Raises:
            ValueError: The run was refused before anything moved.
        """
        if self._refused:
            raise ValueError(self._reason)
        armed_at = self._first_armed_at
        return Run(
            completed=self._completed,
            reason=self._reason,
            duration_s=math.nan if armed_at is None else self._duration,
            measured=self._measured(),
            records=tuple(self.records),
            trajectory=None if armed_at is None else trajectory(armed_at),
            resumable=self._resumable,
            failed_servos=self.journal.standing.failed_servos,
            checks=self.checks,
            interrupted=self._interrupted,
            estopped=self._estopped,
        )

    # The script

    def _run(self) -> Script[None]:
        """Sessions until one comes to the end or fails for good."""
        left, failures = RESTARTS, list[str]()
        while True:
            done = self._done
            try:
                yield from self._session()
                self._completed, self._reason = True, "completed"
                break
            except Failed as caught:
                self._guarded = False  # the stop that this one announces is no second failure
                failure = yield from self._explain(caught)
                failures.append(str(failure))
                failures += yield from self._leave()
            if self._done > done:
                left = RESTARTS
            again = failure.after is After.AGAIN and self._first_armed_at is not None
            if not again or left == 0:
                self._reason = "; ".join(dict.fromkeys(failures))
                self._refused = isinstance(failure, Wrong) and self._first_armed_at is None
                lasting = failure.reason is Reason.WHEEL_STILL  # the clutch slips every time
                self._resumable = failure.after is not After.REPAIR and not lasting
                self._estopped = self._latched(failure)
                break
            left -= 1
            self.phase = "before a new session"
            hot = failure.reason is Reason.COIL_HOT
            yield from self._pause(COOL_S if hot else RESTART_PAUSE_S)
        self._write_end()

    def _latched(self, failure: Failed) -> bool:
        return self.sensors.state is BoardState.ESTOPPED or failure.reason is Reason.ESTOPPED

    def _session(self) -> Script[None]:
        yield from self._open()
        assert self._armed_at is not None  # as _open leaves it
        if self._first_armed_at is None:
            self._first_armed_at = self._armed_at
        self._guarded, self._at_due = True, self._now + AT_S
        while self._done < len(self.visits):
            yield from self._visit(self._done + 1, self.visits[self._done])
        yield from self._mend()
        self._guarded = False
        yield from self._command(Op.DISARM)
        self._end_session()

    def _stock(self, repaired_encoders: Collection[int]) -> Script[None]:
        try:
            yield from self._take_stock(repaired_encoders)
            self._completed, self._reason = True, "completed"
        except Failed as failure:
            self._reason, self._refused = str(failure), isinstance(failure, Wrong)
            self._resumable = failure.after is not After.REPAIR
            self._estopped = self._latched(failure)

    def _end_session(self) -> None:
        """Armed no more."""
        if self._armed_at is not None:
            self._duration += self._armed_s
        self._armed_at, self._at_due = None, math.inf

    @property
    def _armed_s(self) -> float:
        """Since the session was armed, on the board's clock [s]."""
        return self.sensors.board_s - self._armed_board_s

    def _visit(self, number: int, visit: Visit) -> Script[None]:
        """One instruction, and its end in the journal."""
        start = self._duration + self._armed_s
        try:
            trims = yield from self._transact(number, visit, max(1, self._leg))
            self._write(DoneEntry(visit=number, lengths=self._heard_lengths()))
        except Failed as failure:
            failure.args = (f"instruction {number}: {failure}",)
            raise
        finally:
            self._leg = self.journal.standing.leg
        self._done = number
        end = self._duration + self._armed_s
        self.records.append(InstructionRecord(number, visit.axial, start, end, trims))

    def _mend(self) -> Script[None]:
        """Visit again what a clutch moved on its way out, where the wheels saw it."""
        for _ in range(MENDS + 1):
            off = _off(self.robot, self.visits, self._measured(), self.sensors.metres_per_count)
            if not off:
                return
            for visit in off:
                self.phase = f"mending tendons {sorted(visit.tendons.values())}"
                yield from self._transact(len(self.visits) + 1, visit)
        raise Failed(
            f"tendons {sorted(c for visit in off for c in visit.tendons.values())} are not at "
            f"their goals after {MENDS} more visits",
            After.RESUME,
        )

    def _explain(self, failure: Failed) -> Script[Failed]:
        """A failure of a servo, with the servo: EMCY names it, or its own status does."""
        if failure.reason in (Reason.SERVO_STALLED, Reason.SERVO_OFFLINE):
            yield from self._until(lambda: self.sensors.emergency is not None, EMERGENCY_WAIT_S)
            said = self.sensors.emergency
            flags = [
                s
                for s, status in enumerate(self.sensors.servo_status, start=1)
                if status & (STALLED | OFFLINE)
            ]
            failure.servo = said.part if said is not None and said.part else (*flags, 0)[0]
            if failure.servo and f"({failure.servo})" not in str(failure):
                failure.args = (f"{failure} ({failure.servo})",)
        if failure.servo:
            self._note(ServoEntry(servo=failure.servo, reason=str(failure)))
        return failure

    def _leave(self) -> Script[list[str]]:
        """Ask for the safe state, and look where the arm came to rest; what went wrong with that.

        A board that does not hear goes to the safe state by its watchdog.
        """
        self._guarded = False
        if self._armed_at is None:
            return []
        trouble = []
        self.phase = "to the safe state"
        stopped = self.sensors.state in (BoardState.SAFE, BoardState.ESTOPPED)
        if not stopped and self.sensors.emergency is None:
            try:
                yield from self._command(Op.DISARM, takes_s=CLUTCH_S, may=(Reason.NOT_ARMED,))
            except Failed as failure:
                trouble = [str(failure)]
        self._end_session()
        yield from self._pause(COME_TO_REST_S)
        self._note(AtEntry(lengths=self._heard_lengths()))
        return trouble

    def _stop_board(self, reason: str) -> Script[None]:
        """ESTOP until the board says that it has seen it."""
        self._reason, self._guarded, self._resumable = reason, False, True
        self.phase = "emergency stop"
        deadline = self._now + ESTOP_WAIT_S
        while self.sensors.state is not BoardState.ESTOPPED:
            if self._now >= deadline:
                self._reason += "; no board confirmed the ESTOP"
                break
            self._send("ESTOP", Source=1, Reason=1)
            yield self._now + ESTOP_REPEAT_S
        self._end_session()
        self._write_end()

    def _write_end(self) -> None:
        if self._ends_run:
            self._note(
                EndEntry(
                    completed=self._completed,
                    reason=self._reason,
                    lengths=self._heard_lengths(),
                    refused=self._refused,
                )
            )

    def _note(self, entry: AtEntry | ServoEntry | EndEntry) -> None:
        """Write what is good to know, but not worth another failure."""
        try:
            self._write(entry)
        except Failed as failure:
            self._reason += f"; {failure}" if str(failure) not in self._reason else ""


def _pinned(
    robot: Robot, program: Program, goals: tuple[tuple[Mapping[int, float], ...], ...]
) -> tuple[Visit, ...]:
    """The program's visits, after making sure that their goals are the journal's."""
    visits = load_visits(robot, program)
    for number, (visit, legs) in enumerate(zip(visits, goals, strict=True), start=1):
        if tuple(map(dict, visit.legs)) != tuple(map(dict, legs)):
            raise ValueError(
                f"journal: instruction {number}: its goals are not those of the program"
            )
    return visits


def _off(
    robot: Robot,
    visits: tuple[Visit, ...],
    measured: Float[np.ndarray, " S*J"],
    metres_per_count: float,
) -> list[Visit]:
    """Last legs, to be done again, of tendons that are not where the whole program leaves them."""
    last = {
        tendon: (visit, servo)
        for visit in visits
        if visit.legs
        for servo, tendon in visit.tendons.items()
    }
    by_visit: dict[int, tuple[Visit, dict[int, int]]] = {}
    for tendon, (visit, servo) in last.items():
        if abs(measured[tendon - 1] - visit.legs[-1][servo]) > MEND_COUNTS * metres_per_count:
            by_visit.setdefault(id(visit), (visit, {}))[1][servo] = tendon
    return [
        make_visit(robot, visit.axial, tendons, ({s: visit.legs[-1][s] for s in tendons},))
        for visit, tendons in by_visit.values()
    ]
