"""How far a motion has come: speed ramps up, holds, and ramps down again."""

from __future__ import annotations

import math
from dataclasses import dataclass

RAMP_POINTS = 6  # straight lines that stand for a ramp's parabola in the record


@dataclass(frozen=True)
class Motion:
    """A motion from 0 (not begun) to 1 (there) over time.

    Attributes:
        begin: When it begins [s].
        duration: How long it takes [s], ramps included; above 0.
        ramp_in: How long the speed rises evenly from zero [s].
        ramp_out: How long it falls evenly to zero [s]; the two fit into the duration.
    """

    begin: float
    duration: float
    ramp_in: float = 0.0
    ramp_out: float = 0.0

    @property
    def end(self) -> float:
        """When it is over [s]."""
        return self.begin + self.duration

    @property
    def _top(self) -> float:
        """Speed between the ramps [1/s]: the area under the speed is 1."""
        return 1.0 / (self.duration - (self.ramp_in + self.ramp_out) / 2)

    def done(self, now: float) -> float:
        """Which part lies behind at a time [s]."""
        if now >= self.end:
            return 1.0
        gone = now - self.begin
        if gone <= 0.0:
            return 0.0
        if gone < self.ramp_in:
            return self._top * gone * gone / (2 * self.ramp_in)
        left = self.end - now
        if left < self.ramp_out:
            return 1.0 - self._top * left * left / (2 * self.ramp_out)
        return self._top * (gone - self.ramp_in / 2)

    def speed(self, now: float) -> float:
        """Its derivative [1/s]."""
        gone, left = now - self.begin, self.end - now
        if gone < 0.0 or left <= 0.0:
            return 0.0
        rise = gone / self.ramp_in if gone < self.ramp_in else 1.0
        fall = left / self.ramp_out if left < self.ramp_out else 1.0
        return self._top * min(rise, fall)

    def breaks(self) -> list[float]:
        """Times [s] at which its record needs a point beyond begin and end."""
        parts = range(1, RAMP_POINTS + 1)
        rising = [self.begin + self.ramp_in * k / RAMP_POINTS for k in parts if self.ramp_in]
        falling = [self.end - self.ramp_out * k / RAMP_POINTS for k in parts if self.ramp_out]
        return [t for t in rising + falling[::-1] if self.begin < t < self.end]


def fastest(way: float, speed: float, acceleration: float | None) -> float:
    """Shortest time [s] for a way [rad] at a greatest speed [rad/s] and acceleration [rad/s^2].

    Without a limit of the acceleration the speed is there at once.
    """
    if acceleration is None:
        return way / speed
    if way >= speed * speed / acceleration:
        return way / speed + speed / acceleration
    return 2 * math.sqrt(way / acceleration)


def ramp(duration: float, speed: float, acceleration: float | None) -> float:
    """Length [s] of either ramp of the fastest motion of that duration [s]."""
    return 0.0 if acceleration is None else min(speed / acceleration, duration / 2)
