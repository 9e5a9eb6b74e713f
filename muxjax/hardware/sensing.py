"""What the board's controller knows of its mechanics: sensors, and nothing else.

The controller counts the wheels' whole turns itself; a reset loses them, and a host has to say
them anew (Op.TURNS). A reading with a bad status is not used, the last good one stands.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from muxjax.hardware.encoders import COUNTS_PER_RAD, Encoders
from muxjax.hardware.mechanics import Mechanics
from muxjax.hardware.protocol import COUNTS_PER_TURN, SERVO_BITS_PER_RAD
from muxjax.robot import Robot

BAD_SAMPLES = 3  # so many in a row are a fault, fewer an accident


class Senses:
    """Sensors of one board. Wheels, tendons and servos count from 0.

    Attributes:
        unknown: Wheels whose whole turns nobody has told since they were lost.
        status: Status bits of each wheel's latest sample.
        offline: Servos that do not answer.
    """

    def __init__(self, robot: Robot, mechanics: Mechanics, encoders: Encoders) -> None:
        self.encoders = encoders
        self.unknown: set[int] = set()
        self.offline: set[int] = set()
        self.status = np.zeros(robot.n_tendons, dtype=np.int64)
        self._lost = np.zeros(robot.n_tendons, dtype=bool)
        self._mechanics = mechanics
        self._radius = float(robot.wheel_radius)
        self._missing = np.zeros(robot.n_tendons, dtype=np.int64)  # turns not counted [counts]
        self._bad = np.zeros(robot.n_tendons, dtype=np.int64)  # bad samples in a row
        self._seen, self._windings = np.zeros(robot.n_tendons), -1
        self._good = self._read()
        self._sampled_at = -math.inf

    def _read(self) -> Int[np.ndarray, " n"]:
        if self._windings != self._mechanics.windings:
            self._seen = self.encoders.seen(self._mechanics.wheels / self._radius)
            self._windings = self._mechanics.windings
        return self.encoders.read(self._seen) - self._missing

    def wheel_counts(self) -> Int[np.ndarray, " n"]:
        """A sample of every wheel, whole turns included [counts of 14 bits]; one at a time."""
        if self._sampled_at == self._mechanics.time:
            return self._good
        self._sampled_at = self._mechanics.time
        counts = self._read()
        if self.encoders.may_fail or self.status.any():
            self.status = self.encoders.status()
            bad = self.status != 0
            self._bad = np.where(bad, self._bad + 1, 0)
            counts = np.where(bad, self._good, counts)
        self._good = counts
        return counts

    @property
    def last_counts(self) -> Int[np.ndarray, " n"]:
        """The latest sample."""
        return self._good

    def displacements(self) -> Float[np.ndarray, " n"]:
        """Tendon displacements [m] by the wheels."""
        radians = self.wheel_counts() / COUNTS_PER_RAD
        return radians * self._radius

    def raw(self, wheel: int) -> int:
        """Reading of a wheel with its true turns [counts], as its encoder would have it."""
        return int(self._read()[wheel] + self._missing[wheel])

    def failed_wheels(self) -> set[int]:
        """Wheels whose samples have been bad for too long; takes a sample."""
        if not self.encoders.may_fail:
            return set()
        self.wheel_counts()
        bad = self._bad >= BAD_SAMPLES
        return set(np.flatnonzero(bad).tolist()) if bad.any() else set()

    def servo_bits(self) -> Int[np.ndarray, " J"]:
        """Shaft angles as the UART last heard them [0.1 degree]."""
        return np.rint(self._mechanics.servo_when_told() * SERVO_BITS_PER_RAD).astype(np.int64)

    def stalled(self) -> set[int]:
        """Servos that say that they cannot turn."""
        return self._mechanics.strained - self.offline

    def axial_deg(self) -> float:
        """Angle of the drum by the axial motor's encoder [degree]."""
        return math.degrees(self._mechanics.axial)

    def lose_turns(self) -> None:
        """The controller starts anew: from here it counts turns from 0."""
        whole = (self._read() + self._missing) // COUNTS_PER_TURN
        self._missing = whole * COUNTS_PER_TURN
        self.unknown = set(range(len(whole)))
        self._lost[:] = True
        self._bad[:] = 0
        self._good = self._read()

    def agrees(self, wheel: int, turns: int) -> bool:
        """Whether a host may say that a wheel stands in this turn.

        It may, once the turns were lost, until somebody arms; after that only the board's own.
        """
        return bool(self._lost[wheel]) or int(self._good[wheel]) // COUNTS_PER_TURN == turns

    def length_with(self, wheel: int, turns: int) -> float:
        """Displacement [m] of a wheel in this turn."""
        counts = turns * COUNTS_PER_TURN + int(self._good[wheel]) % COUNTS_PER_TURN
        return counts / COUNTS_PER_RAD * self._radius

    def tell(self, wheel: int, turns: int) -> None:
        """Take a host's word for a wheel's turn."""
        missed = (turns - int(self._good[wheel]) // COUNTS_PER_TURN) * COUNTS_PER_TURN
        self._missing[wheel] -= missed
        self._good[wheel] += missed
        self.unknown.discard(wheel)

    def turns_are_settled(self) -> None:
        """Whoever armed the board has told them: from here they are the board's own again."""
        self._lost[:] = False
