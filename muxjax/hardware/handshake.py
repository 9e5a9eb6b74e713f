"""From a silent board to an armed one: greeting, turn counts, preflight checks, ARM."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from muxjax.hardware.journal import (
    AtEntry,
    Entry,
    Lengths,
    MemoryJournal,
    RepairEntry,
    SessionEntry,
    Standing,
)
from muxjax.hardware.protocol import (
    COUNTS_PER_TURN,
    OFFLINE,
    STALLED,
    VERSION,
    Fault,
    Op,
    Reason,
    fingerprint_words,
)
from muxjax.hardware.sensors import Sensors
from muxjax.hardware.session import After, Failed, Script, Session, Wrong
from muxjax.robot import Robot
from muxjax.scheduler import Program

START_TOLERANCE_MM = 0.5  # how far the wheels may stand from program.start
RESUME_TOLERANCE_MM = 2.0  # and from where the journal left them: clutches that dropped out slip
# A tendon may slip twenty times while its encoder stands still. Much further, a board that lost its
# turn counts could be told the wrong turn, and nobody would see it.
REPAIRED_TOLERANCE_MM = 10.0
TAKEOVER_S = 1.0  # by then a board is up, and its watchdog has let go of a host that died
READING_TRIES = 12
READING_S = 0.1  # for one frame of every stream, right after it began anew
MIN_VOLTAGE_V = 18.0  # below this a 24 V servo has not its torque
MAX_COIL_C = 80.0  # the shipped boards arm nobody above it


@dataclass(frozen=True)
class Check:
    """One line of the preflight report.

    Attributes:
        name: What was looked at.
        passed: Whether it lets the run begin.
        detail: What was found.
    """

    name: str
    passed: bool
    detail: str


class Handshake(Session):
    """A session up to the armed board.

    Args:
        robot: The arm on the board.
        program: What is to run.
        session: As for ``Session``.
        stream_divider: What the board divides the rates of its feedback by.
        journal: Where the wheels were last, and what is written ahead.
    """

    def __init__(
        self,
        robot: Robot,
        program: Program,
        session: int,
        stream_divider: int,
        journal: MemoryJournal,
    ) -> None:
        super().__init__(robot, session)
        self.robot = robot
        self.program = program
        self.stream_divider = stream_divider
        self.journal = journal
        self.checks: tuple[Check, ...] = ()
        self.phase = ""
        self._armed_board_s = math.nan
        self._lengths: Lengths = (None,) * robot.n_tendons  # last ones heard
        self._lengths_agree = False  # with the journal, in this session

    # The journal

    def _write(self, entry: Entry, *, ahead: bool = True) -> None:
        try:
            self.journal.write(entry, ahead=ahead)
        except OSError as error:
            raise Failed(f"journal: {error}", After.RESUME) from error

    def _heard_lengths(self) -> Lengths:
        """Displacements [m], of each wheel the last one heard in any session of this run.

        Not of a session that has not yet compared them with the journal: a board that lost its
        turn counts says nonsense until then, and an arm that was moved must stay refused.
        """
        if not self._lengths_agree:
            return self._lengths
        heard = self.sensors.displacements().tolist()
        known = zip(heard, self._lengths, strict=True)
        self._lengths = tuple(old if math.isnan(new) else new for new, old in known)
        return self._lengths

    # The script

    def _open(self) -> Script[None]:
        """Greet, learn where everything is, check it, arm."""
        expected = yield from self._look()
        self.phase = "preflight"
        self.checks = self._preflight(expected)
        self._lengths_agree = self._lengths_check(expected).passed
        for check in self.checks:
            if not check.passed:
                self._refuse(check, expected)
        self.phase = "arming"
        self._beat()  # the board arms nobody whose heart it has not heard since HELLO
        yield from self._command(Op.ARM, arg=self.session)
        self._armed_at, self._armed_board_s = self._now, self.sensors.board_s
        self.sensors.emergency = self.sensors.state = None  # what was heard before is past
        self._write(
            SessionEntry(
                session=self.session,
                boot_count=self.sensors.boot_count,
                lengths=self._heard_lengths(),
            )
        )

    def _look(self) -> Script[Standing]:
        """Greet and learn where everything is; where the journal has it."""
        self.phase = "handshake"
        self._armed_at, self.sensors, self.checks = None, Sensors(self.robot), ()
        self._lengths_agree = False
        yield from self._greet()
        expected = self.journal.standing
        yield from self._learn_turns(expected)
        return expected

    def _take_stock(self, encoders: Collection[int]) -> Script[None]:
        """Write down where the wheels are, also of tendons (from 1) with repaired encoders."""
        expected = yield from self._look()
        off = 1e3 * beyond(self.sensors.displacements(), expected)
        believed = [
            Check(f"encoder {c}", True, f"repaired; {off[c - 1]:.3g} mm from where the journal was")
            for c in sorted(encoders)
        ]
        self.checks = (self._lengths_check(expected, encoders), *believed)
        self._lengths_agree = self.checks[0].passed
        if not self._lengths_agree:
            self._refuse(self.checks[0], expected)
        lengths = self._heard_lengths()
        if encoders:
            lengths = tuple(m if c in encoders else None for c, m in enumerate(lengths, start=1))
            self._write(RepairEntry(encoders=tuple(sorted(encoders)), lengths=lengths))
        else:
            self._write(AtEntry(lengths=lengths))

    def _greet(self) -> Script[None]:
        """HELLO, as soon as the board is up or its watchdog has let go of a host that died."""
        deadline = self._now + TAKEOVER_S
        hello = VERSION << 16 | self.session
        while True:
            try:
                reason = yield from self._command(Op.HELLO, arg=hello, may=(Reason.ARMED_ALREADY,))
                if reason is Reason.NONE:
                    break
                trouble = Failed(
                    "HELLO: the board is armed by another host that lives", After.RESUME
                )
                yield from self._pause(TAKEOVER_S / 20)
            except Failed as failure:
                if failure.after is not After.AGAIN:
                    raise
                trouble = failure
            if self._now >= deadline:
                raise trouble
        greeted = self._now
        for number, word in enumerate(fingerprint_words(self.program.fingerprint), start=1):
            yield from self._command(Op.ROBOT, number, word)
        yield from self._command(Op.SET_STREAM, arg=self.stream_divider)
        yield from self._expect(lambda: self.sensors.heartbeat_at >= greeted, "BOARD_HB")

    def _learn_turns(self, expected: Standing) -> Script[None]:
        """Read every sensor; tell a board that lost its turn counts what they are.

        What a wheel reports at the end of a turn, or is told there, can be off by a whole turn:
        a frame was lost, or noise took the angle across in between. Then both begin anew.
        """
        lost = Fault.TURNS_LOST in self.sensors.faults
        wheels = list(range(self.robot.n_tendons))
        turn = COUNTS_PER_TURN * self.sensors.metres_per_count
        for _ in range(READING_TRIES):
            if lost:
                yield from self._read_anew(lambda: self.sensors.angles_known)
                yield from self._give_turns(wheels, expected)
            yield from self._read_anew(lambda: self.sensors.complete)
            off = beyond(self.sensors.displacements(), expected)
            wheels = np.flatnonzero(off > turn / 4).tolist()
            if not wheels:
                return

    def _read_anew(self, condition: Callable[[], bool]) -> Script[None]:
        """Let every stream begin anew, so that one of each message comes at once."""
        for _ in range(READING_TRIES):
            self.sensors.forget_turns()
            yield from self._command(Op.SET_STREAM, arg=self.stream_divider)
            if (yield from self._until(condition, READING_S)):
                return
        if self.sensors.unreadable:
            wheel = min(self.sensors.unreadable) + 1
            raise Failed(f"the encoder of wheel {wheel} flags every sample", After.REPAIR)
        raise Failed(f"not every sensor reported in {READING_TRIES * READING_S:g} s")

    def _give_turns(self, wheels: Iterable[int], expected: Standing) -> Script[None]:
        """Say in which turn wheels stand (from 0): the one nearest to where they may be."""
        low, high = _interval(expected)
        last = np.array(expected.lengths, dtype=np.float64)
        count = self.sensors.metres_per_count
        for wheel in wheels:
            angle = self.sensors.angles()[wheel]
            middle = round((last[wheel] / count - angle) / COUNTS_PER_TURN)
            turns = np.arange(middle - 4, middle + 5)
            at = (turns * COUNTS_PER_TURN + angle) * count
            # Somewhere on the way it had then; a slipping clutch may have taken it a bit beyond.
            beyond = np.maximum(low[wheel] - at, at - high[wheel]).clip(min=0.0)
            best = np.lexsort((np.abs(at - last[wheel]), beyond))[0]
            arg = (wheel + 1) << 16 | (int(turns[best]) & 0xFFFF)
            yield from self._command(Op.TURNS, arg=arg, may=(Reason.TENDON_RANGE,))

    # The preflight report

    def _preflight(self, expected: Standing) -> tuple[Check, ...]:
        sensors, robot = self.sensors, self.robot
        servos, bad = self._needed_servos(expected), self._silent_servos(expected)
        asked = f"{servos} needed, they answer" if servos else "none needed, nothing is left to do"
        inl_mm = 1e3 * math.radians(robot.config.encoder.inl_deg.value) * float(robot.wheel_radius)
        return (
            Check("protocol version", True, f"{VERSION}"),
            Check("robot", True, f"{robot.config.name} ({robot.fingerprint})"),
            Check("ranges", True, f"{len(self.program.instructions)} instructions within them"),
            self._lengths_check(expected),
            Check(
                "servos",
                not bad,
                f"{bad} stalled or offline" if bad else asked,
            ),
            Check("wheel encoders", True, f"{robot.n_tendons} answer"),
            Check(
                "supply",
                not sensors.voltage < MIN_VOLTAGE_V,
                f"{sensors.voltage:.1f} V, at least {MIN_VOLTAGE_V:g} V",
            ),
            Check(
                "coils",
                not sensors.coil_temperature > MAX_COIL_C,
                f"{sensors.coil_temperature:.0f} degC, at most {MAX_COIL_C:g} degC",
            ),
            Check(
                "INL table", True, f"of the board; without one, lengths are true to {inl_mm:.2f} mm"
            ),
        )

    def _needed_servos(self, expected: Standing) -> list[int]:
        """Servos of the instructions that are left."""
        left = self.program.instructions[expected.done :]
        return sorted({servo for instruction in left for servo in instruction.length_moves})

    def _silent_servos(self, expected: Standing) -> list[int]:
        """Those of the needed ones that say that they cannot be used, or say nothing."""
        status = self.sensors.servo_status
        return [s for s in self._needed_servos(expected) if status[s - 1] & (STALLED | OFFLINE)]

    def _lengths_check(self, expected: Standing, believed: Collection[int] = ()) -> Check:
        """Whether the arm is where the program starts, or where the journal left it.

        A tendon (from 1) that is believed may be further away.
        """
        begun = expected.begun
        limits = np.full(self.robot.n_tendons, RESUME_TOLERANCE_MM if begun else START_TOLERANCE_MM)
        limits[[tendon - 1 for tendon in believed]] = REPAIRED_TOLERANCE_MM
        off = 1e3 * beyond(self.sensors.displacements(), expected)
        worst = int((off / limits).argmax())
        what = "where the journal left it" if begun else "it"
        name = "lengths" if begun else "program.start"
        return Check(
            name,
            bool((off <= limits).all()),
            f"tendon {worst + 1} stands {off[worst]:.3g} mm from {what}, at most "
            f"{limits[worst]:.3g} mm",
        )

    def _refuse(self, check: Check, expected: Standing) -> None:
        text = f"{check.name}: {check.detail}"
        if check.name == "program.start":
            raise Wrong(
                f"{text}; plan from where the arm stands: muxjax plan --after PROGRAM or "
                "--start-q-deg, in Python Problem(start, ...). A virtual board made in Python "
                "stands straight unless LockstepLink(robot, displacements=program.start) says so"
            )
        if check.name == "lengths":
            raise Wrong(
                f"{text}; if encoders were repaired and read right now, muxjax resume "
                "--repaired-encoders names their tendons, which may be up to "
                f"{REPAIRED_TOLERANCE_MM:g} mm away"
            )
        if check.name == "servos":
            raise Failed(text, After.REPAIR, servo=self._silent_servos(expected)[0])
        raise Failed(text, After.RESUME)


def _interval(
    expected: Standing,
) -> tuple[Float[np.ndarray, " S*J"], Float[np.ndarray, " S*J"]]:
    """Least and greatest displacement [m] of each tendon that the journal leaves possible."""
    low = np.array(expected.lengths, dtype=np.float64)
    high = low.copy()
    for tendon, goal in (expected.toward or {}).items():
        low[tendon - 1] = min(low[tendon - 1], goal)
        high[tendon - 1] = max(high[tendon - 1], goal)
    return low, high


def beyond(measured: Float[np.ndarray, " S*J"], expected: Standing) -> Float[np.ndarray, " S*J"]:
    """How far each tendon is from where it may be [m]."""
    low, high = _interval(expected)
    return np.maximum(low - measured, measured - high).clip(min=0.0)
