"""Watches the truth of a virtual board at every instant, whatever controller and host believe."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from muxjax.hardware import VirtualBoard
from muxjax.hardware.protocol import WATCHDOG_S, BoardState, Frame, Op, frame_crc
from muxjax.hardware.virtual_board import RANGE_MARGIN_M
from muxjax.tendons import displacement_range

STOP_S = 0.050  # servo slots and braking, beyond the watchdog
ROUNDING_S = 1e-6
TURNED_RAD = 1e-9
HEARTBEAT_ID = 0x020


class Judge:
    """Stands between a board and its mechanics and notes what must not be.

    Args:
        board: The board; its ``step`` and its mechanics' ``advance`` are watched from here on.
        range_m: How far a wheel may be beyond its tendon's range [m]: errors of its encoder, and
            what slips when a clutch switches.

    Attributes:
        offences: What was seen, in words, each kind once.
        travel: Way of each wheel during commanded moves [m], probes not counted.
        engaged: How often each tendon's plug dropped in.
    """

    def __init__(self, board: VirtualBoard, range_m: float) -> None:
        self.board = board
        self.offences: dict[str, str] = {}
        self.travel = np.zeros(board.robot.n_tendons)
        self.engaged = np.zeros(board.robot.n_tendons, dtype=int)
        low, high = displacement_range(board.robot).T
        self._low, self._high = low - range_m - RANGE_MARGIN_M, high + range_m + RANGE_MARGIN_M
        self._heard_at = self._armed_at = -np.inf
        self._coils: set[int] = set()
        self._coupled: dict[int, int] = {}
        self._advance, self._step = board.mechanics.advance, board.step
        board.mechanics.advance = self._watched_advance  # type: ignore[method-assign]
        board.step = self._watched_step  # type: ignore[method-assign]

    def _watched_step(self, now: float, frames: Iterable[Frame] = ()) -> list[Frame]:
        arrived = list(frames)
        answer = self._step(now, arrived)
        if self.board.running and not self.board.cut_off and any(map(_beats, arrived)):
            self._heard_at = now
        return answer

    def _watched_advance(self, now: float) -> None:
        """Everything that holds from one change of the board's mind to the next."""
        board, mechanics = self.board, self.board.mechanics
        self._switches(now)
        if board.state is BoardState.ARMED and board.running:
            self._armed_at = now
        before = mechanics.time, mechanics.servo.copy(), mechanics.axial, mechanics.wheels.copy()
        self._advance(now)
        if mechanics.time == before[0]:
            return
        turned = np.abs(mechanics.servo - before[1]).max() > TURNED_RAD
        drum = abs(mechanics.axial - before[2]) > TURNED_RAD
        if not turned and not drum:
            return
        self._motion(now, before[0], drum)
        if board._job_command is not None and board._job_command[1] == Op.START:
            self.travel += np.abs(mechanics.wheels - before[3])

    def _switches(self, now: float) -> None:
        """Coils and plugs do not change while the drum turns."""
        mechanics = self.board.mechanics
        if self.board.energised == self._coils and mechanics.coupled == self._coupled:
            return
        for servo, tendon in mechanics.coupled.items():
            if self._coupled.get(servo) != tendon:
                self.engaged[tendon] += 1
        if mechanics.axial_moves:
            self._offend(now, "a clutch switched while the axial motor turned")
        self._coils, self._coupled = set(self.board.energised), dict(mechanics.coupled)

    def _motion(self, now: float, since: float, drum: bool) -> None:
        mechanics = self.board.mechanics
        moved_until = min(now, mechanics.end)
        if drum and mechanics.coupled:
            self._offend(now, f"the axial motor turned with clutches in: {mechanics.coupled}")
        if drum and self.board.energised:
            self._offend(now, "the axial motor turned with coils energised")
        if moved_until > self._armed_at + STOP_S + ROUNDING_S:
            self._offend(now, "motion although not armed")
        if moved_until > self._heard_at + WATCHDOG_S + STOP_S + ROUNDING_S:
            self._offend(
                now, f"motion {1e3 * (moved_until - self._heard_at):.0f} ms after the host"
            )
        beyond = np.maximum(mechanics.wheels - self._high, self._low - mechanics.wheels)
        if beyond.max() > 0:
            tendon = int(beyond.argmax()) + 1
            self._offend(now, f"tendon {tendon} beyond its range by {1e3 * beyond.max():.3f} mm")

    def _offend(self, now: float, what: str) -> None:
        kind = what.split(" by ")[0].split(":")[0]
        self.offences.setdefault(kind, f"{now:.4f} s: {what}")

    @property
    def at_rest(self) -> bool:
        """Whether the truth is the safe state: nothing moves, no plug is in, nobody is armed.

        A plug that is stuck cannot be helped.
        """
        mechanics = self.board.mechanics
        held = set(mechanics.coupled.values()) - mechanics.stuck_plugs
        still = not mechanics.moving and not held and not self.board.energised
        return still and self.board.state is not BoardState.ARMED


def _beats(frame: Frame) -> bool:
    """A heartbeat that a board must take: counting from it can only excuse too much."""
    return frame.id == HEARTBEAT_ID and frame.data[0] == frame_crc(frame.id, frame.data)
