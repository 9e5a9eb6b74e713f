"""Links from the executor to a board.

``LockstepLink`` runs a virtual board in this process on a virtual clock: no set-up, far faster
than real time, and the same run every time. ``BusLink`` speaks over any python-can bus, in real
time.
"""

from __future__ import annotations

import json
import logging
import secrets
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from muxjax.hardware.bus import Bus
from muxjax.hardware.faults import FaultConfig
from muxjax.hardware.physics import PhysicsConfig
from muxjax.hardware.protocol import MAX_DIVIDER, Frame
from muxjax.hardware.virtual_board import VirtualBoard
from muxjax.robot import Robot
from muxjax.scheduler import Trajectory

if TYPE_CHECKING:
    import can

AT_ONCE = 64  # frames taken from a bus before the executor looks at them
ERROR_PAUSE_S = 0.001
SEND_S = 0.01  # a bus that takes a frame later than this has lost it


@runtime_checkable
class Link(Protocol):
    """What ``execute`` needs of a way to a board."""

    robot: Robot  # the arm the caller believes to be at the other end; the handshake checks it
    stream_divider: int  # the board's feedback comes at 1 / this of its full rates

    @property
    def now(self) -> float:
        """Clock of this link [s]."""

    def new_session(self) -> int:
        """A 16-bit session number that was not used just before."""

    def send(self, frames: Iterable[Frame]) -> None:
        """Put frames on the bus."""

    def wait(self, until: float) -> list[Frame]:
        """Frames as soon as some arrive; none if the clock reaches ``until`` [s] first."""

    def trajectory(self, since: float) -> Trajectory | None:
        """True displacements since a time of this link's clock, if anything knows them."""


class LockstepLink:
    """A virtual board in this process, on a virtual clock.

    Args:
        robot: The arm.
        physics: Physics of the board, or the name or path of a file of them.
        displacements: Tendon displacements at power-up [m]; straight if None. A program that
            starts elsewhere needs its ``start`` here.
        axial: Axial position at power-up, from 1; between two if None.
        stream_divider: The board's feedback comes at 1 / this of its full rates (1 to 20); fewer
            frames to code make the same run faster.
        faults: Faults beyond those of the physics.
        seed: Of everything that is drawn on the board and on the bus.

    Attributes:
        board: The board; ``board.mechanics`` is the truth.
        bus: The wire in between.
    """

    def __init__(
        self,
        robot: Robot,
        physics: PhysicsConfig | str = "ideal",
        displacements: Collection[float] | Float[np.ndarray, " S*J"] | None = None,
        axial: int | None = None,
        stream_divider: int = 1,
        faults: Iterable[FaultConfig] = (),
        seed: int = 0,
    ) -> None:
        self.robot = robot
        self.stream_divider = check_divider(stream_divider)
        self.board = VirtualBoard(robot, physics, displacements, axial, faults, seed)
        physics = self.board.physics
        on_the_wire = np.random.default_rng([seed, 1])
        self.bus = Bus(physics.bus, physics.frame_latency_s, on_the_wire)
        self._now = 0.0
        self._sessions = 0

    @property
    def now(self) -> float:
        """Virtual clock [s]."""
        return self._now

    def new_session(self) -> int:
        """1, 2, 3, ..."""
        self._sessions = self._sessions % 0xFFFF + 1
        return self._sessions

    def send(self, frames: Iterable[Frame]) -> None:
        """Frames reach the board as the bus carries them."""
        self.bus.send(self._now, True, frames)

    def wait(self, until: float) -> list[Frame]:
        """Let virtual time pass, from event to event."""
        while True:
            due = min(self.bus.next_time, self.board.next_time)
            if until < due:
                self._now = max(self._now, until)
                return []
            self._now = max(self._now, due)
            arrived, received = self.bus.take(self._now)
            self.bus.send(self._now, False, self.board.step(self._now, arrived))
            if received:
                return received

    @property
    def frames(self) -> int:
        """Frames sent so far, both ways."""
        return self.bus.frames

    def trajectory(self, since: float) -> Trajectory:
        """The board's own record."""
        times, displacements = self.board.mechanics.trajectory(since)
        return Trajectory(times - since, displacements)


def check_divider(stream_divider: int) -> int:
    """``stream_divider``, or ValueError if SET_STREAM would refuse it."""
    if not 1 <= stream_divider <= MAX_DIVIDER:
        raise ValueError(f"stream_divider: is 1 to {MAX_DIVIDER}, found {stream_divider}")
    return stream_divider


class BusLink:
    """A board on a python-can bus, in real time.

    What the bus raises counts as frames that were lost: whether the board is still there, its
    heartbeat says, and nothing else. (A corrupt slcan line raises in ``recv``; a socketcand
    server that died makes ``recv`` return None for ever.)

    Args:
        bus: An open python-can bus; the caller closes it. The executor owns its receive loop, so
            no Notifier may read from it.
        robot: The arm at the other end; the board refuses another one.
        stream_divider: As for ``LockstepLink``; for slow serial links.

    Attributes:
        errors: What the bus has raised so far, counted by kind.
    """

    def __init__(self, bus: can.BusABC, robot: Robot, stream_divider: int = 1) -> None:
        self.robot = robot
        self.stream_divider = check_divider(stream_divider)
        self.errors: Counter[str] = Counter()
        self._bus = bus

    @property
    def now(self) -> float:
        """The host's monotonic clock [s]."""
        return time.monotonic()

    def new_session(self) -> int:
        """A random number: two hosts started at once must not agree."""
        return secrets.randbelow(0xFFFF) + 1

    def send(self, frames: Iterable[Frame]) -> None:
        """Put frames on the bus."""
        try:
            send_frames(self._bus, frames)
        except _bus_errors() as error:
            self.errors[type(error).__name__] += 1

    def wait(self, until: float) -> list[Frame]:
        """The frames that are there, or the first one to come by ``until`` [s]."""
        try:
            return receive_frames(self._bus, until - self.now)
        except _bus_errors() as error:
            self.errors[type(error).__name__] += 1
            if isinstance(error.__cause__, UnicodeDecodeError):
                self._forget_line()
            time.sleep(ERROR_PAUSE_S)  # a bus that is gone raises at once
            return []

    def _forget_line(self) -> None:
        """Slcan keeps a line that it cannot read, and raises for ever; its flush drops it."""
        flush = getattr(self._bus, "flush", None)
        if flush is not None:
            with suppress(*_bus_errors()):
                flush()

    def trajectory(self, since: float) -> None:
        """Nobody sees the truth of a real arm."""
        return


@contextmanager
def open_bus(spec: str) -> Iterator[can.BusABC]:
    """A python-can bus, from the arguments of ``can.Bus`` or from python-can's configuration.

    Args:
        spec: A JSON object of arguments, such as ``{"interface": "socketcand", "host":
            "127.0.0.1", "port": 29536, "channel": "can0"}``; or the name of a section of
            python-can's configuration file.

    Raises:
        ValueError: Not JSON, no such section, or an interface that cannot be opened.
    """
    import can

    # socketcand warns of every message that TCP has cut in two, though it mends that itself.
    logging.getLogger("can").setLevel(logging.ERROR)
    try:
        if spec.lstrip().startswith("{"):
            bus = can.Bus(**json.loads(spec))
        elif can.util.load_file_config(section=spec):
            bus = can.Bus(config_context=spec)
        else:
            raise ValueError("no JSON object, and no such section in python-can's configuration")
    except (can.CanError, OSError, TypeError, ValueError) as error:
        raise ValueError(f"bus: {spec} cannot be opened: {error}") from error
    try:
        yield bus
    finally:
        with suppress(*_bus_errors()):  # slcan writes to an adapter that may be gone
            bus.shutdown()


def _bus_errors() -> tuple[type[Exception], ...]:
    """What python-can raises for a bad line, an adapter that is gone, a full queue."""
    import can

    return can.CanError, OSError, ValueError, IndexError


def send_frames(bus: can.BusABC, frames: Iterable[Frame]) -> None:
    """Put frames on a python-can bus."""
    import can

    for frame in frames:
        message = can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
        bus.send(message, timeout=SEND_S)


def receive_frames(bus: can.BusABC, timeout: float) -> list[Frame]:
    """Data frames of the kind the protocol uses: those there, or the first one in time [s]."""
    frames: list[Frame] = []
    message = bus.recv(max(0.0, timeout))
    while message is not None:
        other = message.is_extended_id or message.is_fd
        if not (other or message.is_error_frame or message.is_remote_frame):
            frames.append(Frame(message.arbitration_id, bytes(message.data)))
        message = bus.recv(0.0) if len(frames) < AT_ONCE else None
    return frames
