"""The host's conversation with a board: heartbeats, commands, answers, waiting.

Written as scripts: generators that wait by yielding the time at which to go on at the latest.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Mapping
from enum import Enum
from itertools import count
from typing import Any, TypeVar

from muxjax.hardware.protocol import (
    HOST_BEAT_S,
    WATCHDOG_S,
    Frame,
    Op,
    Port,
    Reason,
    Refusal,
    Status,
)
from muxjax.hardware.sensors import Sensors
from muxjax.robot import Robot

T = TypeVar("T")
Script = Generator[float, None, T]  # yields when to wake up at the latest [s]

RETRY_S = 0.030  # an unanswered command is sent again after this
TRIES = 5
SENSOR_WAIT_S = 1.0  # longest wait for feedback: SERVO_FB's 25 Hz, divided by 20
BUSY_S = 1.0  # a board that comes to rest or waits for a heartbeat is asked again for so long
PATIENCE_S = 1.0  # beyond what a job should take, while the board says that it is at it

ANOTHER_BOARD = {
    Reason.WRONG_ROBOT: "the board drives another robot than the program is for",
    Reason.WRONG_VERSION: "the board speaks another version of the protocol",
}


class After(Enum):
    """What can be done after a failure."""

    AGAIN = 1  # a new session may go on at once
    RESUME = 2  # a person looks first; then ``resume`` goes on
    REPAIR = 3  # a part is to be repaired, or left out of a new plan, first


class Failed(Exception):  # noqa: N818 - a way out of the script, never seen outside
    """The session cannot go on; the board is to be left in the safe state.

    Args:
        text: What happened.
        after: What can be done now.
        reason: The board's reason, if it gave one.
        servo: The servo that failed, from 1; 0 if none is to blame.
    """

    def __init__(
        self,
        text: str,
        after: After = After.AGAIN,
        *,
        reason: Reason = Reason.NONE,
        servo: int = 0,
    ) -> None:
        super().__init__(text)
        self.after, self.reason, self.servo = after, reason, servo


class Wrong(Failed):
    """The run must not begin: the caller asked for something the board is not there for."""

    def __init__(self, text: str) -> None:
        super().__init__(text, After.REPAIR)


# What a reason of the board leaves open; the others may be gone in a new session.
AFTER = {
    Reason.UNKNOWN_OP: After.REPAIR,
    Reason.ESTOPPED: After.RESUME,
    Reason.SERVO_RANGE: After.REPAIR,
    Reason.TENDON_RANGE: After.REPAIR,
    Reason.NOT_RELEASED: After.REPAIR,
    Reason.SERVO_STALLED: After.REPAIR,
    Reason.SERVO_OFFLINE: After.REPAIR,
    Reason.ENCODER_FAULT: After.REPAIR,
}


class Session:
    """One session with a board, and what its sensors said.

    Args:
        robot: The arm on the board.
        session: 16-bit number of this session, another one each time.
    """

    def __init__(self, robot: Robot, session: int) -> None:
        self.session = session
        self.sensors = Sensors(robot)
        self._now = 0.0
        self._port = Port("HOST")
        self._out: list[Frame] = []
        self._seq = (session * 257) & 0xFFFF
        self._ack: tuple[Status, Reason] | None = None  # newest one to _seq
        self._armed_at: float | None = None  # on the host's clock
        self._heartbeat_due = 0.0

    # Sending and receiving

    def _send(self, name: str, **values: float) -> None:
        self._out.append(self._port.pack(name, **values))

    def _beat(self) -> None:
        armed = self._armed_at is not None
        self._send("HOST_HB", Armed=armed, Session=self.session, Watchdog=WATCHDOG_S * 1e3)
        self._heartbeat_due = self._now + HOST_BEAT_S

    def _receive(self, frame: Frame) -> None:
        received = self._port.unpack(frame)
        if isinstance(received, Refusal):
            return  # as if lost: commands are repeated, streams come again
        name, values = received
        if name == "ACK":
            self._receive_ack(values)
        else:
            self.sensors.update(self._now, name, values)

    def _receive_ack(self, values: Mapping[str, Any]) -> None:
        if values["Seq"] != self._seq:
            return
        status, reason = Status(values["Status"]), Reason(values["Reason"])
        if status is Status.DUPLICATE:
            if values["Detail"] not in tuple(Status):
                return
            status = Status(values["Detail"])
        elif status in (Status.ACCEPTED, Status.DONE, Status.ABORTED):
            self.sensors.hear_clock(values["Detail"])
        self._ack = status, reason

    # Waiting

    def _until(self, condition: Callable[[], bool], timeout_s: float) -> Script[bool]:
        """Wait for a condition; whether it came true in time."""
        deadline = self._now + timeout_s
        while not condition():
            if self._now >= deadline:
                return False
            yield deadline
        return True

    def _expect(self, condition: Callable[[], bool], what: str | Callable[[], str]) -> Script[None]:
        """Wait for the sensors to say something; what it is may be known only afterwards."""
        if not (yield from self._until(condition, SENSOR_WAIT_S)):
            raise Failed(
                f"waited {SENSOR_WAIT_S:g} s for {what if isinstance(what, str) else what()}"
            )

    def _pause(self, seconds: float) -> Script[None]:
        """Let time pass."""
        yield from self._until(lambda: False, seconds)

    def _command(
        self,
        op: Op,
        idx: int = 0,
        arg: int = 0,
        *,
        takes_s: float = 0.0,
        may: Collection[Reason] = (),
    ) -> Script[Reason]:
        """Send a command until it is answered, and wait until it is done.

        Args:
            op: Opcode.
            idx: As the opcode defines it.
            arg: Likewise.
            takes_s: How long its job should take [s]; after that the board is asked again.
            may: Reasons not to do it that the caller can mend.

        Returns:
            NONE, or one of ``may``.
        """
        self._seq, self._ack = (self._seq + 1) & 0xFFFF, None
        yield from self._ask(op, idx, arg)
        yield from self._until(lambda: self._ended, takes_s + RETRY_S)
        deadline = self._now + takes_s + PATIENCE_S
        while not self._ended:
            if self._now >= deadline:
                raise Failed(f"{op.name}: accepted, but never done")
            self._send("CMD", Seq=self._seq, Op=op, Idx=idx, Arg=arg)
            yield from self._until(lambda: self._ended, RETRY_S)
        return self._verdict(op, may)

    def _ask(self, op: Op, idx: int, arg: int) -> Script[None]:
        """Send a command until it is taken or refused."""
        deadline = self._now + BUSY_S
        for sent in count():
            if sent >= TRIES and self._ack is None:
                raise Failed(f"{op.name}: no answer after {TRIES} tries")
            if self._now >= deadline:
                raise Failed(f"{op.name}: the board was busy for {BUSY_S:g} s")
            self._send("CMD", Seq=self._seq, Op=op, Idx=idx, Arg=arg)
            if (yield from self._until(lambda: self._answered, RETRY_S)):
                return

    @property
    def _answered(self) -> bool:
        return self._ack is not None and self._ack[0] is not Status.BUSY

    @property
    def _ended(self) -> bool:
        return self._ack is not None and self._ack[0] not in (Status.BUSY, Status.ACCEPTED)

    def _verdict(self, op: Op, may: Collection[Reason]) -> Reason:
        assert self._ack is not None  # callers wait for _ended
        status, reason = self._ack
        if status is Status.DONE or reason in may:
            return reason
        text = f"{op.name} {status.name.lower()} by the board: {reason.name}"
        if reason in ANOTHER_BOARD:
            raise Wrong(f"{text}; {ANOTHER_BOARD[reason]}")
        raise Failed(text, AFTER.get(reason, After.AGAIN), reason=reason)
