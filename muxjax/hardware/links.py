"""Links from the executor to a board.

``LockstepLink`` runs a virtual board in this process on a virtual clock: no set-up, far faster
than real time, and the same run every time. ``BusLink`` speaks over any python-can bus, in real
time; ``serve`` is the virtual board at the other end of such a bus.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Collection, Iterable
from typing import TYPE_CHECKING, Protocol

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

    Args:
        bus: An open python-can bus; the caller closes it. The executor owns its receive loop, so
            no Notifier may read from it.
        robot: The arm at the other end; the board refuses another one.
        stream_divider: As for ``LockstepLink``; for slow serial links.
    """

    def __init__(self, bus: can.BusABC, robot: Robot, stream_divider: int = 1) -> None:
        self.robot = robot
        self.stream_divider = check_divider(stream_divider)
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
        _send(self._bus, frames)

    def wait(self, until: float) -> list[Frame]:
        """One frame, or none by ``until`` [s]."""
        return _receive(self._bus, until - self.now)

    def trajectory(self, since: float) -> None:
        """Nobody sees the truth of a real arm."""
        return


def serve(board: VirtualBoard, bus: can.BusABC, until: Callable[[], bool]) -> None:
    """Be the board on a python-can bus, in real time, until ``until()`` says so."""
    begin = time.monotonic()
    while not until():
        now = time.monotonic() - begin
        frames = _receive(bus, min(board.next_time - now, 0.01))
        _send(bus, board.step(time.monotonic() - begin, frames))


def _send(bus: can.BusABC, frames: Iterable[Frame]) -> None:
    import can

    for frame in frames:
        bus.send(can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False))


def _receive(bus: can.BusABC, timeout: float) -> list[Frame]:
    """One data frame of the kind the protocol uses, if one arrives in time [s]."""
    message = bus.recv(max(0.0, timeout))
    if message is None or message.is_extended_id or message.is_fd:
        return []
    if message.is_error_frame or message.is_remote_frame:
        return []
    return [Frame(message.arbitration_id, bytes(message.data))]
