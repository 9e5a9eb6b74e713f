"""Does a board keep the promises of docs/protocol.md? Asked over its bus, so of any board.

``run_checks`` takes a link: a virtual board in lockstep, or a real one behind python-can. Every
check begins from a board that is not armed, and leaves one. Checks that move the arm run only when
the caller allows motion; the arm should then hang free. The last check leaves the board in ESTOP:
switch it off and on afterwards.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from muxjax.hardware.codec import database
from muxjax.hardware.links import Link
from muxjax.hardware.pauses import no_long_pauses
from muxjax.hardware.protocol import (
    BOARD_BEAT_S,
    COUNTS_PER_TURN,
    ESTOP_ID,
    HOST_BEAT_S,
    MAX_DIVIDER,
    SERVO_BITS_PER_RAD,
    SERVO_LIMIT_BITS,
    VERSION,
    WATCHDOG_S,
    BoardState,
    Fault,
    Frame,
    Op,
    Port,
    Reason,
    Received,
    Refusal,
    Status,
    fingerprint_words,
    frame_crc,
)
from muxjax.hardware.sensors import Sensors
from muxjax.hardware.virtual_board import RANGE_MARGIN_M, SEQUENCE_WINDOW
from muxjax.robot import Robot
from muxjax.tendons import displacement_range

Verdict = Literal["pass", "fail", "skipped"]

ANSWER_S = 0.2  # a board that has not answered by then does not answer
JOB_S = 1.0  # clutches and their probe
BRAKE_S = 0.05  # beyond the watchdog, until nothing moves (HARDWARE.md, host loss)
WAY_M = 0.004  # how far the checks move a tendon from where it stands
STILL_COUNTS = 4  # an encoder's noise
SWITCH_M = 1e-3  # what a wheel may do when its clutch goes in and out again: 0.5 mm each (M VI-B)
FRAME_BITS = 135  # of a frame with worst-case stuffing
BIT_RATE = 1e6
MAX_LOAD = 0.15
FOREIGN = 0x5A5A  # another session


@dataclass(frozen=True)
class Finding:
    """What one check found.

    Attributes:
        name: Of the check.
        verdict: pass, fail or skipped.
        reason: What was wrong, or why it was skipped; "" for pass.
    """

    name: str
    verdict: Verdict
    reason: str


class Broken(Exception):  # noqa: N818 - a way out of a check, never seen outside
    """The board does not keep the promise."""


class Skipped(Exception):  # noqa: N818 - likewise
    """The check cannot be made here."""


def run_checks(
    link: Link,
    *,
    allow_motion: bool = False,
    just_powered: bool = False,
    straight: bool = False,
    only: Iterable[str] | None = None,
    on_finding: Callable[[Finding], None] | None = None,
) -> tuple[Finding, ...]:
    """Make the checks in their order.

    Args:
        link: A way to the board.
        allow_motion: The arm may move; without it, checks that move it are skipped.
        just_powered: Nobody has spoken to the board since its power-up.
        straight: The arm stands straight: a board that has lost its wheels' whole turns is told
            those next to displacement 0.
        only: Names of the checks to make; all if None.
        on_finding: Called after each check.

    Raises:
        ValueError: ``only`` names a check that does not exist.
    """
    wanted = set(CHECKS if only is None else only)
    if unknown := sorted(wanted - CHECKS.keys()):
        raise ValueError(f"only: no check {unknown[0]!r}; there are {', '.join(CHECKS)}")
    bench = Bench(link, allow_motion, just_powered, straight)
    findings = []
    with no_long_pauses():
        for name in (name for name in CHECKS if name in wanted):
            finding = _make(bench, name)
            findings.append(finding)
            if on_finding is not None:
                on_finding(finding)
    return tuple(findings)


def _make(bench: Bench, name: str) -> Finding:
    if name in MOVING and not bench.allow_motion:
        return Finding(name, "skipped", "it moves the arm, which was not allowed")
    skipped = ""
    try:
        bench.begin()
        try:
            CHECKS[name](bench)
        except Skipped as why:
            skipped = str(why)
        bench.leave()
    except Broken as broken:
        bench.abandon()
        return Finding(name, "fail", str(broken))
    return Finding(name, "skipped" if skipped else "pass", skipped)


class Bench:
    """A host at the bench: sends what a check, or a person, tells it, keeps what it hears.

    Args:
        link: A way to the board.
        allow_motion: As for ``run_checks``.
        just_powered: Likewise.
        straight: Likewise.
    """

    def __init__(
        self,
        link: Link,
        allow_motion: bool = False,
        just_powered: bool = False,
        straight: bool = False,
    ) -> None:
        self.link = link
        self.allow_motion = allow_motion
        self.robot: Robot = link.robot
        self.just_powered = just_powered
        self.straight = straight
        self.session = link.new_session()
        self.seq = (self.session * 257) & 0xFFFF
        self.port = Port("HOST")
        self.ears = Port("HOST")
        self.sensors = Sensors(self.robot)
        self.heard: list[tuple[float, Received]] = []
        self.acks: list[Mapping[str, Any]] = []
        self.emergencies: list[tuple[float, Mapping[str, Any]]] = []
        self.beats = 0  # BOARD_HB heard
        self.refused: Counter[Refusal] = Counter()
        self.faults = Fault(0)  # of the last BOARD_HB
        self.refused_by_board: int | None = None  # of the last POWER_FB
        self.beating = False
        self._beat_due = -math.inf

    # Time and frames

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Listen, and send heartbeats if that is on; whether ``until`` came true in time."""
        end = self.link.now + seconds
        while not until():
            if self.link.now >= end:
                return False
            if self.beating and self.link.now >= self._beat_due:
                self.beat()
                self._beat_due = self.link.now + HOST_BEAT_S
            self._hear(self.link.wait(min(end, self._beat_due if self.beating else end)))
        return True

    def _hear(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            received = self.ears.unpack(frame)
            if isinstance(received, Refusal):
                self.refused[received] += 1
            else:
                self.heard.append((self.link.now, received))
                self._sort(received)
                self.sensors.update(self.link.now, received.name, received.values)

    def _sort(self, received: Received) -> None:
        if received.name == "ACK":
            self.acks.append(received.values)
        elif received.name == "EMCY":
            self.emergencies.append((self.link.now, received.values))
        elif received.name == "BOARD_HB":
            self.beats += 1
            self.faults = Fault(received.values["Faults"])
        elif received.name == "POWER_FB":
            self.refused_by_board = received.values["Refused"]

    def send(self, *frames: Frame) -> None:
        """Put frames on the bus."""
        self.link.send(frames)

    def beat(self, session: int | None = None, watchdog_ms: int = 150) -> None:
        """Send one HOST_HB."""
        session = self.session if session is None else session
        self.send(self.port.pack("HOST_HB", Armed=1, Session=session, Watchdog=watchdog_ms))

    def begin(self) -> None:
        """A clean page; what the board said before does not count."""
        self._hear(self.link.wait(self.link.now))
        self.heard.clear()
        self.refused.clear()
        self.acks.clear()
        self.emergencies.clear()

    # Commands

    def ask(
        self, op: int, idx: int = 0, arg: int = 0, seq: int | None = None
    ) -> tuple[Status, Reason, int]:
        """Status, reason and detail of the first answer to a command."""
        if seq is None:
            self.seq = seq = (self.seq + 1) & 0xFFFF
        mark = len(self.acks)
        self.send(self.port.pack("CMD", Seq=seq, Op=op, Idx=idx, Arg=arg))
        self.wait(ANSWER_S, lambda: any(self._acks(seq, mark)))
        for values in self._acks(seq, mark):
            return Status(values["Status"]), Reason(values["Reason"]), values["Detail"]
        raise Broken(f"no answer to {_name(op)} within {ANSWER_S:g} s")

    def _acks(self, seq: int, since: int) -> Iterator[Mapping[str, Any]]:
        return (ack for ack in self.acks[since:] if ack["Seq"] == seq)

    def do(self, op: int, idx: int = 0, arg: int = 0, within: float = 0.0) -> None:
        """A command that must succeed, its job included."""
        mark = len(self.acks)
        status, reason, _ = self.ask(op, idx, arg)
        seq = self.seq
        if status is Status.ACCEPTED:
            ended = [Status.DONE, Status.ABORTED]
            self.wait(
                within + ANSWER_S, lambda: any(a["Status"] in ended for a in self._acks(seq, mark))
            )
            last = list(self._acks(seq, mark))[-1]
            status, reason = Status(last["Status"]), Reason(last["Reason"])
        if status is not Status.DONE:
            found = _say(status, reason) + self._stopped()
            raise Broken(f"{_name(op)} {idx} {arg}: expected DONE, got {found}")

    def refuses(
        self, op: int, idx: int, arg: int, reason: Reason, status: Status = Status.REJECTED
    ) -> None:
        """A command that must be refused for this reason."""
        found_status, found, _ = self.ask(op, idx, arg)
        if (found_status, found) != (status, reason):
            raise Broken(
                f"{_name(op)} {idx} {arg}: expected {_say(status, reason)}, "
                f"got {_say(found_status, found)}{self._stopped()}"
            )
        if status is Status.BUSY:
            self.seq = (self.seq - 1) & 0xFFFF  # the number is not used up

    def _stopped(self) -> str:
        if not self.emergencies:
            return ""
        return f"; the board had stopped: {Reason(self.emergencies[-1][1]['Code']).name}"

    # Ways to a state

    def greet(self) -> None:
        """To READY, every wheel's turns known."""
        self.do(Op.HELLO, arg=VERSION << 16 | self.session)
        beats = self.beats
        self.wait(2 * BOARD_BEAT_S + 0.02, lambda: self.beats > beats)
        if Fault.TURNS_LOST in self.faults:
            self._tell_turns()

    def _tell_turns(self) -> None:
        if not self.straight:
            raise Skipped("the board has lost its wheels' turns; straighten the arm and say so")
        counts = self.counts().astype(int)
        for wheel, angle in enumerate(counts % COUNTS_PER_TURN, start=1):
            turn = -1 if angle >= COUNTS_PER_TURN // 2 else 0
            self.do(Op.TURNS, arg=wheel << 16 | turn & 0xFFFF)
        self.sensors.forget_turns()

    def check_robot(self) -> None:
        """Send the four words of the robot's hash."""
        for k, word in enumerate(fingerprint_words(self.robot.fingerprint), start=1):
            self.do(Op.ROBOT, k, word)

    def arm(self) -> None:
        """To ARMED, with heartbeats from now on."""
        self.greet()
        self.check_robot()
        self.beating = True
        self.beat()
        self.do(Op.ARM, arg=self.session)
        self.wait(2 * BOARD_BEAT_S + 0.5, lambda: self.sensors.complete)

    def go_to(self, position: int) -> None:
        """Turn the axial motor, from 1."""
        self.do(Op.AXIAL, arg=position, within=2 * float(self.robot.switch_time))

    def engage(self, position: int = 1, servo: int = 1) -> int:
        """Armed, with one servo coupled; the tendon it drives, from 0."""
        if self.state is not BoardState.ARMED:
            self.arm()
        self.go_to(position)
        self.do(Op.ENGAGE, *self.clutch(position, servo), within=JOB_S)
        self.listen()
        return int(self.robot.axial_map[position - 1, servo - 1])

    def listen(self) -> None:
        """Until every sensor has reported what it sees now."""
        since = self.link.now
        wheels, servos = range(self.robot.n_tendons), range(self.robot.tendons_per_segment)
        if not self.wait(1.0, lambda: self.sensors.fresh(servos, wheels, since)):
            raise Broken("a servo or wheel does not report")

    def clutch(self, position: int, servo: int) -> tuple[int, int]:
        """ENGAGE's layer and mask for one servo's clutch."""
        tendon = int(self.robot.axial_map[position - 1, servo - 1])
        per_layer = self.robot.tendons_per_segment
        return tendon // per_layer + 1, 1 << tendon % per_layer

    def leave(self) -> None:
        """Disarm and listen on, so that the next check finds the board at rest."""
        if self.state is BoardState.ARMED:
            self.do(Op.DISARM, within=JOB_S)
        self.beating = False
        self.wait(0.3)

    def abandon(self) -> None:
        """Fall silent: the watchdog takes the board to its safe state."""
        self.beating = False
        self.wait(WATCHDOG_S + BRAKE_S + 0.3)

    # What the board says

    @property
    def state(self) -> BoardState | None:
        """Of the last BOARD_HB in this session; heard anew, for one may be under way."""
        beats = self.beats
        self.wait(2 * BOARD_BEAT_S + 0.02, lambda: self.beats > beats)
        return self.sensors.state

    def counts(self) -> np.ndarray:
        """Wheels, whole turns included, heard anew."""
        self.listen()
        self.wait(1.0, lambda: self.sensors.complete)
        return np.rint(self.sensors.displacements() / self.sensors.metres_per_count)

    def servo_bits(self, servo: int) -> int:
        """A servo's angle [0.1 degree], heard anew; servos from 1."""
        self.listen()
        return round(float(self.sensors.servo_rad[servo - 1]) * SERVO_BITS_PER_RAD)

    def target(self, servo: int, tendon: int, displacement: float) -> int:
        """STAGE's argument that brings a coupled tendon to a displacement [m]."""
        way = displacement - float(self.sensors.displacements()[tendon])
        return self.servo_bits(servo) + round(
            way * float(self.robot.servo_per_metre) * SERVO_BITS_PER_RAD
        )

    def way(self, tendon: int) -> float:
        """A small way [m] for this tendon, towards the middle of its range."""
        low, high = displacement_range(self.robot)[tendon]
        return WAY_M if self.sensors.displacements()[tendon] < (low + high) / 2 else -WAY_M

    def expect(self, kept: bool, what: str) -> None:
        """Raise Broken unless a promise is kept."""
        if not kept:
            raise Broken(what)

    def stays(self, before: np.ndarray, what: str) -> None:
        """No wheel has moved since ``before`` [counts]."""
        moved = np.abs(self.counts() - before).max()
        self.expect(moved <= STILL_COUNTS, f"{what}: a wheel moved {moved:.0f} counts")


def _name(op: int) -> str:
    return Op(op).name if op in tuple(Op) else f"opcode {op}"


def _say(status: Status, reason: Reason) -> str:
    return status.name if reason is Reason.NONE else f"{status.name} {reason.name}"


# The checks


def powers_up_silent(bench: Bench) -> None:
    """No frame before the first HELLO."""
    if not bench.just_powered:
        raise Skipped("needs a board that was just switched on")
    bench.wait(1.0)
    bench.expect(not bench.heard and not bench.refused, "it spoke before it was greeted")


def silent_board_refuses_motion(bench: Bench) -> None:
    """Commands before HELLO are answered with NOT_ARMED."""
    if not bench.just_powered:
        raise Skipped("needs a board that was just switched on")
    answer = bench.ask(Op.AXIAL, 0, 1, seq=0)
    bench.expect(
        answer[:2] == (Status.REJECTED, Reason.SEQUENCE),
        f"number 0 after power-up: {_say(*answer[:2])}",
    )
    for number, op in enumerate((Op.AXIAL, Op.ENGAGE, Op.RELEASE, Op.STAGE, Op.START), start=1):
        answer = bench.ask(op, 1, 1, seq=number)
        bench.expect(
            answer[:2] == (Status.REJECTED, Reason.NOT_ARMED),
            f"{op.name} on a silent board: {_say(*answer[:2])}",
        )
    for number, (op, idx, arg) in enumerate(((Op.ROBOT, 1, 0), (Op.ARM, 0, 0)), start=6):
        answer = bench.ask(op, idx, arg, seq=number)
        bench.expect(
            answer[:2] == (Status.REJECTED, Reason.WRONG_SESSION),
            f"{op.name} on a silent board: {_say(*answer[:2])}",
        )


def handshake_in_order(bench: Bench) -> None:
    """HELLO, four ROBOT words, heartbeat, ARM; nothing else and in no other order arms."""
    words = fingerprint_words(bench.robot.fingerprint)
    bench.refuses(Op.HELLO, 0, (VERSION + 1) << 16 | bench.session, Reason.WRONG_VERSION)
    bench.greet()
    bench.refuses(Op.ROBOT, 1, words[0] ^ 1, Reason.WRONG_ROBOT)
    bench.refuses(Op.ROBOT, len(words) + 1, words[0], Reason.WRONG_ROBOT)
    bench.refuses(Op.ARM, 0, bench.session, Reason.ROBOT_UNCHECKED)
    for k, word in enumerate(words, start=1):
        bench.refuses(Op.ARM, 0, bench.session, Reason.ROBOT_UNCHECKED)
        bench.do(Op.ROBOT, k, word)
    bench.refuses(Op.ARM, 0, bench.session ^ FOREIGN, Reason.WRONG_SESSION)
    bench.refuses(Op.ARM, 0, bench.session, Reason.NO_HEARTBEAT, Status.BUSY)
    bench.beat(bench.session ^ FOREIGN)
    bench.refuses(Op.ARM, 0, bench.session, Reason.NO_HEARTBEAT, Status.BUSY)
    bench.beating = True
    bench.beat()
    bench.do(Op.ARM, arg=bench.session)
    bench.expect(bench.state is BoardState.ARMED, "BOARD_HB does not say ARMED after ARM")
    bench.refuses(Op.ARM, 0, bench.session, Reason.ARMED_ALREADY)
    bench.refuses(Op.HELLO, 0, VERSION << 16 | bench.session ^ FOREIGN, Reason.ARMED_ALREADY)
    bench.refuses(Op.ROBOT, 1, words[0], Reason.WRONG_SESSION)


def new_greeting_forgets_the_old(bench: Bench) -> None:
    """HELLO clears the robot check and the heartbeat; DISARM clears the robot check."""
    bench.greet()
    bench.check_robot()
    bench.beat()
    bench.greet()
    bench.refuses(Op.ARM, 0, bench.session, Reason.ROBOT_UNCHECKED)
    bench.check_robot()
    bench.refuses(Op.ARM, 0, bench.session, Reason.NO_HEARTBEAT, Status.BUSY)
    bench.arm()
    bench.do(Op.DISARM, within=JOB_S)
    bench.refuses(Op.ARM, 0, bench.session, Reason.ROBOT_UNCHECKED)


def unarmed_board_refuses_motion(bench: Bench) -> None:
    """READY is not enough to move."""
    bench.greet()
    for op in (Op.AXIAL, Op.ENGAGE, Op.RELEASE, Op.STAGE, Op.START, Op.DISARM):
        bench.refuses(op, 1, 1, Reason.NOT_ARMED)


def nonsense_is_refused(bench: Bench) -> None:
    """Numbers beyond the robot, each with its reason."""
    bench.arm()
    positions, per_layer = len(bench.robot.axial_map), bench.robot.tendons_per_segment
    for arg in (0, -1, positions + 1):
        bench.refuses(Op.AXIAL, 0, arg, Reason.UNKNOWN_AXIAL)
    for idx in (0, per_layer + 1):
        bench.refuses(Op.STAGE, idx, 10, Reason.UNKNOWN_SERVO)
    for arg in (0, -1, 1 << per_layer):
        bench.refuses(Op.START, 0, arg, Reason.UNKNOWN_SERVO)
    bench.refuses(Op.SET_STREAM, 0, 5, Reason.WRONG_SESSION)
    bench.refuses(99, 0, 0, Reason.UNKNOWN_OP)
    bench.refuses(0, 0, 0, Reason.UNKNOWN_OP)


def duplicate_is_answered_not_obeyed(bench: Bench) -> None:
    """A number that was answered gets DUPLICATE, with the status and reason it had."""
    bench.arm()
    bench.refuses(Op.AXIAL, 0, 0, Reason.UNKNOWN_AXIAL)
    answer = bench.ask(Op.DISARM, seq=bench.seq)
    wanted = (Status.DUPLICATE, Reason.UNKNOWN_AXIAL, Status.REJECTED)
    bench.expect(answer == wanted, f"a repeated number: {_say(*answer[:2])}, detail {answer[2]}")
    bench.expect(bench.state is BoardState.ARMED, "a repeated number was obeyed")


def sequence_window(bench: Bench) -> None:
    """A new number is 1 to 16 ahead; anything else is refused."""
    bench.arm()
    for off in (SEQUENCE_WINDOW + 1, -200, 0x8000):
        answer = bench.ask(Op.DISARM, seq=(bench.seq + off) & 0xFFFF)
        bench.expect(
            answer == (Status.REJECTED, Reason.SEQUENCE, bench.seq),
            f"a number {off} ahead: {_say(*answer[:2])}, detail {answer[2]}",
        )
    bench.expect(bench.state is BoardState.ARMED, "a number far off was obeyed")
    bench.seq = (bench.seq + SEQUENCE_WINDOW - 1) & 0xFFFF
    bench.do(Op.DISARM, within=JOB_S)


def broken_frames_are_refused(bench: Bench) -> None:
    """Wrong CRC, repeated counter, short and foreign frames: no answer, a fault bit."""
    bench.greet()
    good = bench.port.pack("CMD", Seq=bench.seq + 1 & 0xFFFF, Op=Op.ROBOT, Idx=1, Arg=-1)
    broken = Frame(good.id, bytes([good.data[0] ^ 1]) + good.data[1:])
    short = Frame(good.id, bytes([frame_crc(good.id, good.data[:7])]) + good.data[1:7])
    bench.wait(1.0, lambda: bench.refused_by_board is not None)
    before = bench.refused_by_board or 0
    bench.acks.clear()
    bench.send(broken, short, Frame(0x7F0, good.data))
    bench.wait(ANSWER_S)
    bench.expect(not bench.acks, "a broken frame was answered")
    bench.expect(bool(bench.faults & Fault.FRAMES_REFUSED), "no fault bit for refused frames")
    counted = (bench.refused_by_board or 0) - before
    bench.expect(counted == 3, f"POWER_FB counts {counted} refused frames of 3")
    bench.send(good)
    bench.wait(ANSWER_S)
    bench.send(good)
    bench.wait(ANSWER_S)
    bench.expect(len(bench.acks) == 1, f"a repeated counter: {len(bench.acks)} answers")
    bench.seq = (bench.seq + 1) & 0xFFFF


def watchdog_expires(bench: Bench) -> None:
    """150 ms after the last heartbeat of the session, not sooner and not later."""
    bench.arm()
    bench.beating = False
    _lose_host(bench, WATCHDOG_S, 150)
    bench.refuses(Op.DISARM, 0, 0, Reason.NOT_ARMED)


def watchdog_takes_the_smaller(bench: Bench) -> None:
    """HOST_HB may shorten the watchdog, not lengthen it."""
    for asked, kept in ((250, WATCHDOG_S), (90, 0.090)):
        bench.arm()
        bench.beating = False
        _lose_host(bench, kept, asked)


def stranger_does_not_keep_the_board_armed(bench: Bench) -> None:
    """Heartbeats of another session do not count."""
    bench.arm()
    bench.beating = False
    bench.beat()
    last = bench.link.now
    while bench.link.now < last + WATCHDOG_S + 2 * BOARD_BEAT_S:
        bench.beat(bench.session ^ FOREIGN)
        bench.wait(HOST_BEAT_S)
    bench.expect(bench.state is BoardState.SAFE, "a stranger's heartbeat kept it armed")


def _lose_host(bench: Bench, watchdog_s: float, asked_ms: int) -> None:
    bench.emergencies.clear()
    bench.beat(watchdog_ms=asked_ms)
    last = bench.link.now
    bench.wait(watchdog_s + BRAKE_S, lambda: bool(bench.emergencies))
    told = bool(bench.emergencies)
    bench.expect(told, f"no EMCY within {1e3 * (watchdog_s + BRAKE_S):g} ms of host loss")
    after, values = bench.emergencies[0]
    after -= last
    code = Reason(values["Code"])
    bench.expect(code is Reason.WATCHDOG, f"EMCY says {code.name}, not WATCHDOG")
    bench.expect(
        after > watchdog_s - 0.005, f"stopped {1e3 * after:.0f} ms after the last heartbeat"
    )
    bench.expect(bench.state is BoardState.SAFE, "BOARD_HB does not say SAFE after host loss")
    bench.expect(bool(bench.faults & Fault.WATCHDOG), "no fault bit for the watchdog")
    bench.wait(0.3)


def streams_at_their_rates(bench: Bench) -> None:
    """Every stream within a tenth of the DBC's cycle time, and the bus load below 15 %."""
    bench.greet()
    _check_rates(bench, 1)
    bench.do(Op.SET_STREAM, arg=10)
    _check_rates(bench, 10)
    for arg in (0, MAX_DIVIDER + 1):
        bench.refuses(Op.SET_STREAM, 0, arg, Reason.STREAM_RANGE)


def _check_rates(bench: Bench, divider: int) -> None:
    bench.wait(0.1)
    bench.heard.clear()
    begin = bench.link.now
    bench.wait(4.0)
    lasted = bench.link.now - begin
    found = Counter(h.name for _, h in bench.heard)
    for name, per_cycle in _messages(bench.robot).items():
        cycle_s = (database().get_message_by_name(name).cycle_time or 0) * 1e-3
        slow = 1 if name == "BOARD_HB" else divider
        wanted = per_cycle * lasted / (cycle_s * slow)
        bench.expect(
            abs(found[name] - wanted) <= 0.1 * wanted + per_cycle,
            f"{name}: {found[name] / lasted:.1f} frames/s, expected {wanted / lasted:.1f}",
        )
    load = sum(found.values()) * FRAME_BITS / BIT_RATE / lasted
    bench.expect(load < MAX_LOAD, f"the board alone takes {100 * load:.1f} % of the bus")


def _messages(robot: Robot) -> dict[str, int]:
    """Frames of each stream per cycle."""
    trios = range(math.ceil(robot.n_tendons / 3))
    return Counter(
        ["BOARD_HB", "AXIAL_FB", "CLUTCH_FB", "POWER_FB"]
        + [f"SERVO_FB_{s % 3 + 1}" for s in range(robot.tendons_per_segment)]
        + [f"WHEEL_FB_{trio % 3 + 1}" for trio in trios]
        + ["WHEEL_TURNS"] * math.ceil(robot.n_tendons / 6)
    )


# Checks that move the arm


def axial_turns_to_a_position(bench: Bench) -> None:
    """There and reported; no clutch switches on the way, no second job begins."""
    bench.arm()
    bench.go_to(1)
    before = bench.counts()
    status, reason, _ = bench.ask(Op.AXIAL, arg=2)
    bench.expect(status is Status.ACCEPTED, f"AXIAL 2: {_say(status, reason)}")
    for op in (Op.ENGAGE, Op.RELEASE):
        bench.refuses(op, *bench.clutch(2, 1), Reason.AXIAL_MOVING)
    bench.refuses(Op.AXIAL, 0, 3, Reason.BUSY, Status.BUSY)
    there = bench.wait(2 * float(bench.robot.switch_time), lambda: bench.sensors.slot == 2)
    bench.expect(there, "AXIAL_FB never reports position 2")
    bench.stays(before, "while the axial motor turned")
    bench.do(Op.AXIAL, arg=2)


def host_loss_stops_the_axial_motor(bench: Bench) -> None:
    """It stops between two positions, and clutches know it."""
    bench.arm()
    bench.go_to(1)
    bench.ask(Op.AXIAL, arg=2)
    bench.wait(min(0.3, float(bench.robot.switch_time) / 4))
    bench.beating = False
    bench.wait(WATCHDOG_S + BRAKE_S + HOST_BEAT_S + BOARD_BEAT_S)
    bench.expect(bench.sensors.slot == 0, "the axial motor went on after host loss")
    bench.wait(float(bench.robot.switch_time))
    bench.expect(bench.sensors.slot == 0, "the axial motor went on after host loss")
    bench.arm()
    for op in (Op.ENGAGE, Op.RELEASE):
        bench.refuses(op, 0, 1, Reason.NOT_IN_SLOT)


def clutch_interlocks(bench: Bench) -> None:
    """No axial motion with a clutch in; only the present layer's clutches, only known ones."""
    bench.arm()
    bench.go_to(1)
    layer, mask = bench.clutch(1, 1)
    for op in (Op.ENGAGE, Op.RELEASE):
        bench.refuses(op, layer % bench.robot.n_segments + 1, mask, Reason.WRONG_LAYER)
        for unknown in (0, 1 << bench.robot.tendons_per_segment, -1):
            bench.refuses(op, layer, unknown, Reason.UNKNOWN_CLUTCH)
    before = bench.counts()
    status, reason, _ = bench.ask(Op.ENGAGE, layer, mask)
    bench.expect(status is Status.ACCEPTED, f"ENGAGE: {_say(status, reason)}")
    bench.refuses(Op.AXIAL, 0, 2, Reason.CLUTCH_IN)
    for op in (Op.ENGAGE, Op.RELEASE):
        bench.refuses(op, layer, mask, Reason.BUSY, Status.BUSY)
    engaged = bench.wait(JOB_S, lambda: bench.sensors.clutches == (layer, mask, mask))
    bench.expect(engaged, "CLUTCH_FB never reports the clutch energised and verified")
    bench.refuses(Op.AXIAL, 0, 2, Reason.CLUTCH_IN)
    status, reason, _ = bench.ask(Op.RELEASE, layer, mask)
    bench.expect(status is Status.ACCEPTED, f"RELEASE: {_say(status, reason)}")
    bench.refuses(Op.AXIAL, 0, 2, Reason.CLUTCH_IN)
    bench.expect(bench.wait(JOB_S, lambda: bench.sensors.clutches_out), "a clutch stays in")
    bench.wait(JOB_S)
    moved = np.abs(bench.counts() - before).max() * bench.sensors.metres_per_count
    bench.expect(moved <= SWITCH_M, f"engaging and releasing moved a wheel by {1e3 * moved:.2f} mm")
    bench.go_to(2)


def servo_moves_its_tendon(bench: Bench) -> None:
    """Only with its clutch verified, only after STAGE, to where it was told, and only once."""
    tendon = bench.engage()
    at = float(bench.sensors.displacements()[tendon])
    before = bench.counts()
    other = 2 if bench.robot.tendons_per_segment > 1 else 0
    if other:
        bench.refuses(Op.STAGE, other, bench.servo_bits(other), Reason.NOT_COUPLED)
        bench.refuses(Op.STAGE, other, SERVO_LIMIT_BITS + 1, Reason.NOT_COUPLED)
    bench.refuses(Op.START, 0, 1, Reason.NOT_STAGED)
    way = bench.way(tendon)
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at + way))
    if other:
        bench.refuses(Op.START, 0, 0b11, Reason.NOT_STAGED)
    bench.stays(before, "staging alone")
    status, reason, _ = bench.ask(Op.START, arg=1)
    bench.expect(status is Status.ACCEPTED, f"START: {_say(status, reason)}")
    started = bench.seq
    bench.refuses(Op.AXIAL, 0, 2, Reason.CLUTCH_IN)
    bench.refuses(Op.STAGE, 1, bench.servo_bits(1), Reason.BUSY, Status.BUSY)
    again = bench.ask(Op.START, arg=1, seq=started)[0]
    bench.expect(again is Status.DUPLICATE, f"START again under its number: {again.name}")
    bench.wait(abs(way) / float(bench.robot.tendon_speed) + JOB_S)
    step = bench.sensors.metres_per_count
    off = abs(bench.sensors.displacements()[tendon] - (at + way)) / step
    bench.expect(off <= 0.0006 / step, f"the wheel stands {off * step * 1e3:.2f} mm off its goal")
    arrived = bench.counts()
    bench.expect(
        bool(np.abs(np.delete(arrived - before, tendon)).max() <= STILL_COUNTS), "another tendon"
    )
    again = bench.ask(Op.START, arg=1, seq=started)[0]
    bench.expect(again is Status.DUPLICATE, f"START again under its number: {again.name}")
    bench.refuses(Op.START, 0, 1, Reason.NOT_STAGED)
    bench.stays(arrived, "a repeated START")
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at))
    bench.do(Op.START, arg=1, within=abs(way) / float(bench.robot.tendon_speed) + JOB_S)
    _start_while_moving(bench, tendon, at)


def _start_while_moving(bench: Bench, tendon: int, at: float) -> None:
    """A second servo's START waits for the first job."""
    if bench.robot.tendons_per_segment < 2:
        return
    layer, mask = bench.clutch(1, 2)
    bench.do(Op.ENGAGE, layer, mask, within=JOB_S)
    other = int(bench.robot.axial_map[0, 1])
    there = float(bench.sensors.displacements()[other])
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at + bench.way(tendon) / 2))
    bench.do(Op.STAGE, 2, bench.target(2, other, there))
    bench.ask(Op.START, arg=1)
    bench.refuses(Op.START, 0, 2, Reason.BUSY, Status.BUSY)
    bench.wait(WAY_M / float(bench.robot.tendon_speed) + JOB_S)
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at))
    bench.do(Op.START, arg=1, within=WAY_M / float(bench.robot.tendon_speed) + JOB_S)


def released_servo_does_not_start(bench: Bench) -> None:
    """A staged target is no leave to move once the clutch is out."""
    tendon = bench.engage()
    at = float(bench.sensors.displacements()[tendon])
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at + bench.way(tendon)))
    bench.do(Op.RELEASE, *bench.clutch(1, 1), within=JOB_S)
    bench.refuses(Op.START, 0, 1, Reason.NOT_COUPLED)
    bench.refuses(Op.STAGE, 1, bench.servo_bits(1), Reason.NOT_COUPLED)


def tendon_range_is_kept(bench: Bench) -> None:
    """Beyond the range STAGE is refused on the board, both ways; at its end it is not."""
    tendon = bench.engage()
    beyond = RANGE_MARGIN_M + 4 * bench.sensors.metres_per_count
    for side, limit in zip((-1, 1), displacement_range(bench.robot)[tendon], strict=True):
        outside = bench.target(1, tendon, float(limit) + side * beyond)
        bench.refuses(Op.STAGE, 1, outside, Reason.TENDON_RANGE)
        bench.do(Op.STAGE, 1, bench.target(1, tendon, float(limit)))
    for arg in (SERVO_LIMIT_BITS + 1, -SERVO_LIMIT_BITS - 1):
        bench.refuses(Op.STAGE, 1, arg, Reason.SERVO_RANGE)


def tendon_range_is_kept_at_the_start(bench: Bench) -> None:
    """A target staged for one tendon is checked anew when it would move another."""
    here, there = _two_positions(bench.robot)
    tendon = bench.engage(here)
    at = float(bench.sensors.displacements()[tendon])
    other = int(bench.robot.axial_map[there - 1, 0])
    way = WAY_M if at >= bench.sensors.displacements()[other] else -WAY_M
    takes = abs(way) / float(bench.robot.tendon_speed) + JOB_S
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at + way))
    bench.do(Op.START, arg=1, within=takes)
    bench.do(Op.RELEASE, *bench.clutch(here, 1), within=JOB_S)
    bench.engage(there)
    low, high = displacement_range(bench.robot)[other]
    bench.do(Op.STAGE, 1, bench.target(1, other, float(high if way > 0 else low)))
    bench.do(Op.RELEASE, *bench.clutch(there, 1), within=JOB_S)
    if bench.robot.tendons_per_segment > 1:
        bench.do(Op.ENGAGE, *bench.clutch(there, 2), within=JOB_S)
        bench.do(Op.STAGE, 2, bench.servo_bits(2))
        bench.do(Op.RELEASE, *bench.clutch(there, 2), within=JOB_S)
    bench.engage(here)
    before = bench.counts()
    if bench.robot.tendons_per_segment > 1:
        bench.refuses(Op.START, 0, 0b11, Reason.NOT_COUPLED)
    bench.refuses(Op.START, 0, 1, Reason.TENDON_RANGE)
    bench.stays(before, "a START beyond the range")
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at))
    bench.do(Op.START, arg=1, within=takes)


def _two_positions(robot: Robot) -> tuple[int, int]:
    """Positions at which servo 1 meets two tendons of one layer, so of the same range."""
    per_layer, met = robot.tendons_per_segment, robot.axial_map[:, 0]
    for other in range(1, len(met)):
        if met[other] // per_layer == met[0] // per_layer and met[other] != met[0]:
            return 1, other + 1
    raise Skipped("servo 1 meets one tendon of its layer only")


def host_loss_stops_the_servo(bench: Bench) -> None:
    """In the middle of a move, within 200 ms; clutches off; and it stays so."""
    tendon = bench.engage()
    status, reason = _start_long_move(bench, tendon)
    bench.expect(status is Status.ACCEPTED, f"START: {_say(status, reason)}")
    bench.wait(0.3)
    bench.beating = False
    bench.beat()
    bench.wait(WATCHDOG_S + BRAKE_S + 0.02)
    _stays_stopped(bench, "host loss", Reason.WATCHDOG)
    bench.expect(bench.state is BoardState.SAFE, "BOARD_HB does not say SAFE")
    bench.refuses(Op.ARM, 0, bench.session, Reason.WRONG_SESSION)


def disarm_stops_the_servo(bench: Bench) -> None:
    """DISARM in the middle of a move aborts it, and takes the clutches off."""
    tendon = bench.engage()
    _start_long_move(bench, tendon)
    bench.wait(0.3)
    status, reason, _ = bench.ask(Op.DISARM)
    bench.expect(status is Status.ACCEPTED, f"DISARM: {_say(status, reason)}")
    bench.wait(BRAKE_S + 0.3)
    _stays_stopped(bench, "DISARM", Reason.DISARMED)
    bench.expect(bench.state is BoardState.READY, "BOARD_HB does not say READY")


def arming_waits_for_rest(bench: Bench) -> None:
    """HELLO and ARM are BUSY while the board brakes and takes its clutches off."""
    tendon = bench.engage()
    _start_long_move(bench, tendon)
    bench.ask(Op.DISARM)
    bench.refuses(Op.HELLO, 0, VERSION << 16 | bench.session, Reason.BUSY, Status.BUSY)
    for k, word in enumerate(fingerprint_words(bench.robot.fingerprint), start=1):
        bench.do(Op.ROBOT, k, word)
    if bench.sensors.clutches_out:
        raise Skipped("the bus is too slow to ask in time")
    bench.refuses(Op.ARM, 0, bench.session, Reason.BUSY, Status.BUSY)


def _start_long_move(bench: Bench, tendon: int) -> tuple[Status, Reason]:
    """A move of a second or more, never beyond a few times WAY_M."""
    at = float(bench.sensors.displacements()[tendon])
    way = 2 * bench.way(tendon)
    bench.do(Op.STAGE, 1, bench.target(1, tendon, at + way))
    return bench.ask(Op.START, arg=1)[:2]


def _stays_stopped(bench: Bench, what: str, reason: Reason) -> None:
    stopped = bench.counts()
    aborted = [ack["Reason"] for ack in bench.acks if ack["Status"] == Status.ABORTED]
    bench.expect(aborted[-1:] == [reason], f"{what}: START was not ABORTED {reason.name}")
    bench.wait(1.0)
    bench.stays(stopped, f"after {what}")
    bench.expect(bench.sensors.clutches_out, f"{what}: a clutch stays in")


def estop_stops_and_is_latched(bench: Bench) -> None:
    """ESTOP with a broken CRC stops, a move too; then all is refused until power-up."""
    if bench.allow_motion:
        _start_long_move(bench, bench.engage())
        bench.wait(0.3)
    else:
        bench.greet()
    _estop(bench)
    if bench.allow_motion:
        bench.wait(BRAKE_S)
        _stays_stopped(bench, "ESTOP", Reason.ESTOPPED)


def _estop(bench: Bench) -> None:
    beats = bench.beats
    bench.send(Frame(ESTOP_ID, b"\x00" * 8))

    def confirmed() -> bool:
        return bench.beats > beats and bench.sensors.state is BoardState.ESTOPPED

    bench.expect(bench.wait(ANSWER_S, confirmed), "ESTOP with a broken CRC was not taken")
    bench.expect(bool(bench.faults & Fault.ESTOP), "no fault bit for the ESTOP")
    for op in (Op.HELLO, Op.ROBOT, Op.TURNS, Op.ARM, Op.DISARM, Op.AXIAL, Op.ENGAGE, Op.RELEASE,
               Op.STAGE, Op.START):  # fmt: skip
        bench.refuses(op, 1, VERSION << 16 | bench.session, Reason.ESTOPPED)
    bench.expect(bench.state is BoardState.ESTOPPED, "the board left ESTOPPED by a command")


STILL: tuple[Callable[[Bench], None], ...] = (
    powers_up_silent,
    silent_board_refuses_motion,
    handshake_in_order,
    new_greeting_forgets_the_old,
    unarmed_board_refuses_motion,
    nonsense_is_refused,
    duplicate_is_answered_not_obeyed,
    sequence_window,
    broken_frames_are_refused,
    watchdog_expires,
    watchdog_takes_the_smaller,
    stranger_does_not_keep_the_board_armed,
    streams_at_their_rates,
)
WITH_MOTION: tuple[Callable[[Bench], None], ...] = (
    axial_turns_to_a_position,
    host_loss_stops_the_axial_motor,
    clutch_interlocks,
    servo_moves_its_tendon,
    released_servo_does_not_start,
    tendon_range_is_kept,
    tendon_range_is_kept_at_the_start,
    host_loss_stops_the_servo,
    disarm_stops_the_servo,
    arming_waits_for_rest,
)
CHECKS: dict[str, Callable[[Bench], None]] = {
    check.__name__: check for check in (*STILL, *WITH_MOTION, estop_stops_and_is_latched)
}
MOVING = frozenset(check.__name__ for check in WITH_MOTION)
