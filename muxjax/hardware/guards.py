"""What stops an armed board: faults of its parts that its sensors show.

Looked at every 10 ms while the board is armed. Parts count only while they are in use: a dead
servo must not stop an arm that has learned to do without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int

from muxjax.hardware.protocol import Fault, Reason

if TYPE_CHECKING:
    from muxjax.hardware.virtual_board import VirtualBoard

PATIENCE = 3  # looks in a row at which a servo is silent or strained
COMPARE_EVERY = 4  # looks: a window takes a wheel 0.11 s at full speed
FOLLOW = 0.5  # a wheel that goes less of its way than this stands still
WINDOW_COUNTS = 26  # way over which that is judged, 0.25 mm; slower ones wait for it

FAULTS: Mapping[Reason, Fault] = {
    Reason.SERVO_STALLED: Fault.SERVO,
    Reason.SERVO_OFFLINE: Fault.SERVO,
    Reason.ENCODER_FAULT: Fault.ENCODER,
    Reason.COIL_HOT: Fault.COIL_HOT,
    Reason.UNDERVOLTAGE: Fault.VOLTAGE,
    Reason.WHEEL_STILL: Fault.ENCODER | Fault.SERVO,  # either may be at fault
}


class Trip(Exception):  # noqa: N818 - a way out of a job, never seen outside
    """A part failed: the board goes to the safe state.

    Attributes:
        reason: What the EMCY says.
        index: Servo or tendon, from 1; 0 if none.
    """

    def __init__(self, reason: Reason, index: int = 0) -> None:
        super().__init__(reason.name)
        self.reason = reason
        self.index = index


class Guards:
    """Looks at the sensors of a board; remembers what lasts."""

    def __init__(self) -> None:
        self._silent: dict[int, int] = {}  # servo: looks in a row
        self._strained: dict[int, int] = {}
        self._looks = 0
        self._mark: tuple[Int[np.ndarray, " J"], Int[np.ndarray, " n"]] | None = None

    def begin_move(self, board: VirtualBoard) -> None:
        """From here wheels are compared with their servos."""
        self._mark = board.senses.servo_bits(), board.senses.wheel_counts().copy()

    def end_move(self) -> None:
        """Wheels are compared no longer."""
        self._mark = None

    def look(self, board: VirtualBoard) -> None:
        """Raise Trip for what must stop the board."""
        limits = board.physics
        if board.volts < limits.controller.lowest_v:
            raise Trip(Reason.UNDERVOLTAGE)
        if board.coils.temperature > limits.coil.limit_c:
            raise Trip(Reason.COIL_HOT)
        used = board.in_use()
        self._last(self._silent, board.senses.offline & used.keys(), Reason.SERVO_OFFLINE)
        self._last(self._strained, board.senses.stalled() & used.keys(), Reason.SERVO_STALLED)
        failed = board.senses.failed_wheels() & set(used.values())
        if failed:
            raise Trip(Reason.ENCODER_FAULT, min(failed) + 1)
        self._looks += 1
        if self._mark is not None and self._looks % COMPARE_EVERY == 0:
            self._compare(board, used)

    def _last(self, seen: dict[int, int], now: set[int], reason: Reason) -> None:
        for servo in list(seen):
            if servo not in now:
                del seen[servo]
        for servo in sorted(now):
            seen[servo] = seen.get(servo, 0) + 1
            if seen[servo] >= PATIENCE:
                raise Trip(reason, servo + 1)

    def _compare(self, board: VirtualBoard, used: Mapping[int, int]) -> None:
        """Whether wheels follow their servos; each window begins where the last one ended."""
        assert self._mark is not None  # the caller looks
        servos, wheels = board.senses.servo_bits(), board.senses.wheel_counts()
        for servo, tendon in used.items():
            way = float(servos[servo] - self._mark[0][servo]) * board.counts_per_bit
            if abs(way) < board.window_counts:
                continue
            followed = float(wheels[tendon] - self._mark[1][tendon]) / way
            if followed < FOLLOW:
                raise Trip(Reason.WHEEL_STILL, tendon + 1)
            self._mark[0][servo] = servos[servo]
            self._mark[1][tendon] = wheels[tendon]
