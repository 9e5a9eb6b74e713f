"""The CAN bus between host and virtual board: frame times, arbitration and trouble on the way.

One wire carries one frame at a time. Whenever it falls free, the waiting frame of the lowest id
goes first, whoever sends it. Feedback frames that follow one another reach the host together, at
the end of the last one; urgent frames (heartbeats, commands, answers) at their own end.

Not modelled: error frames and automatic repetition. A frame is lost, doubled, late or changed
beyond what CAN's own CRC notices, at stated rates.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from muxjax.config import NotNegative, Positive, Strict
from muxjax.hardware.protocol import Frame

FRAME_BITS = 135  # eight bytes, 11-bit id, interframe space and every stuff bit there can be
URGENT_BELOW = 0x040
Share = Annotated[float, Field(ge=0, le=1)]


class BusConfig(Strict):
    """A bus; without a bit rate every frame takes the physics' ``frame_latency_s`` alone."""

    bit_rate: Positive | None = Field(None, description="bit/s; None: no frame waits for another")
    loss: Share = 0.0
    doubling: Share = 0.0
    corruption: Share = Field(0.0, description="a bit of the payload flips unnoticed")
    delay: Share = Field(0.0, description="of frames that arrive late")
    delay_s: NotNegative = Field(0.0, description="largest such delay")


class _Waiting(NamedTuple):
    """A frame that waits for the wire. They sort by who goes first."""

    id: int
    order: int
    to_board: bool
    frame: Frame


class _Arriving(NamedTuple):
    """Frames that are past arbitration."""

    when: float
    to_board: bool
    frames: list[Frame]
    grouped: bool  # whether they may wait for others that follow them on the wire


class Bus:
    """Frames under way, both ways.

    Args:
        config: The bus.
        latency: What a frame takes beyond the wire [s].
        rng: Draws the troubles.

    Attributes:
        frames: Frames that were sent so far.
        busy_s: How long the wire was taken [s], every frame at its longest.
    """

    def __init__(self, config: BusConfig, latency: float, rng: np.random.Generator) -> None:
        self.config = config
        self.frames = 0
        self.busy_s = 0.0
        self._latency, self._rng = latency, rng
        self._frame_s = FRAME_BITS / config.bit_rate if config.bit_rate else 0.0
        self._troubled = any((config.loss, config.doubling, config.corruption, config.delay))
        self._free_at = 0.0
        self._order = 0
        self._waiting: list[_Waiting] = []  # a heap
        self._arriving: list[_Arriving] = []

    @property
    def next_time(self) -> float:
        """When frames next arrive if no others are sent [s]."""
        due = min((a.when for a in self._arriving if not a.grouped), default=math.inf)
        last = max((a.when for a in self._arriving if a.grouped), default=math.inf)
        if self._waiting:
            if self._waiting[0].id < URGENT_BELOW:
                due = min(due, self._free_at + self._frame_s + self._latency)
            last = self._free_at + len(self._waiting) * self._frame_s + self._latency
        return min(due, last)

    def send(self, now: float, to_board: bool, frames: Iterable[Frame]) -> None:
        """A node wants to send frames, in this order among those of one id."""
        sent = list(frames)
        if not sent:
            return
        self.frames += len(sent)
        if not self._frame_s:
            self._arrive(now + self._latency, to_board, sent)
            return
        self._arbitrate(now)
        self._free_at = max(self._free_at, now)  # else the wire has been free until now
        for frame in sent:
            self._order += 1
            heapq.heappush(self._waiting, _Waiting(frame.id, self._order, to_board, frame))

    def take(self, now: float) -> tuple[list[Frame], list[Frame]]:
        """Frames that have arrived by ``now`` [s]: at the board, at the host."""
        self._arbitrate(now)
        if not self._arriving:
            return [], []
        here = sorted((a for a in self._arriving if a.when <= now), key=lambda a: a.when)
        self._arriving = [a for a in self._arriving if a.when > now]
        board = [f for a in here if a.to_board for f in a.frames]
        return board, [f for a in here if not a.to_board for f in a.frames]

    def _arbitrate(self, now: float) -> None:
        """Give the wire to the lowest id again and again until ``now``."""
        while self._waiting and self._free_at < now:
            first = heapq.heappop(self._waiting)
            self._free_at += self._frame_s
            self.busy_s += self._frame_s
            self._arrive(self._free_at + self._latency, first.to_board, [first.frame])

    def _arrive(self, when: float, to_board: bool, frames: list[Frame]) -> None:
        grouped = self._frame_s > 0 and frames[0].id >= URGENT_BELOW
        if not self._troubled:
            self._arriving.append(_Arriving(when, to_board, frames, grouped))
            return
        for frame in frames:
            for late, spoiled in self._trouble(frame):
                arriving = _Arriving(when + late, to_board, [spoiled], grouped and not late)
                self._arriving.append(arriving)

    def _trouble(self, frame: Frame) -> list[tuple[float, Frame]]:
        """What becomes of one frame: (how late [s], what arrives), for each copy."""
        loss, double, flip, delay = self._rng.random(4)
        if loss < self.config.loss:
            return []
        if flip < self.config.corruption:
            bit = int(self._rng.integers(8 * len(frame.data)))
            data = bytearray(frame.data)
            data[bit // 8] ^= 1 << bit % 8
            frame = Frame(frame.id, bytes(data))
        late = self._rng.uniform(0, self.config.delay_s) if delay < self.config.delay else 0.0
        return [(late, frame)] * (2 if double < self.config.doubling else 1)
