"""The wheels' encoders: what they read of the true wheels, and what a lab can put right."""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field, model_validator

from muxjax.config import Strict, load_yaml
from muxjax.hardware.protocol import COUNTS_PER_TURN, PARITY, WHEEL_BITS

COUNTS_PER_RAD = COUNTS_PER_TURN / (2 * math.pi)
NOISE_BLOCK = 1024


class EncoderCalibration(Strict):
    """Errors of wheel encoders over a turn, as a lab measured them against a reference.

    A reading minus the error at its angle is the true angle; between the angles the error is a
    straight line.
    """

    file_schema: Literal["muxjax/encoders/1"] = Field(alias="schema")
    error_deg: Annotated[
        tuple[tuple[float, ...], ...],
        Field(min_length=1, description="of each wheel at equal angles of its reading, from 0"),
    ]

    @model_validator(mode="after")
    def _equally_long(self) -> EncoderCalibration:
        lengths = {len(row) for row in self.error_deg}
        if len(lengths) != 1 or min(lengths) < 4:
            raise ValueError(
                f"error_deg: every wheel needs the same number of angles, at least 4, found "
                f"{sorted(lengths)}"
            )
        return self

    def correct(self, counts: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Readings [counts, whole turns included] without the error, not rounded."""
        table, rise, first = self._table
        at = (counts % COUNTS_PER_TURN) * (len(self.error_deg[0]) / COUNTS_PER_TURN)
        low = at.astype(np.int64)
        entry = first + low
        return counts - (table[entry] + rise[entry] * (at - low))

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Errors and their rise to the next angle [counts], and where each wheel's begin."""
        table = np.array(self.error_deg) * (COUNTS_PER_TURN / 360)
        rise = np.roll(table, -1, axis=1) - table
        return table.ravel(), rise.ravel(), np.arange(len(table)) * table.shape[1]


def load_calibration(path: str | Path) -> EncoderCalibration:
    """Read a lab's table of encoder errors.

    Raises:
        ConfigError: No such file, or a wrong value.
    """
    return load_yaml(EncoderCalibration, Path(path))


class Encoders:
    """Encoders of all wheels.

    Args:
        n_wheels: How many.
        bits: Bits of an encoder; of a finer one than the bus carries its 14 bits are used.
        inl_deg: Largest smooth error over a turn.
        noise_counts: Standard deviation of a reading.
        parity_rate: Share of readings with a parity error.
        rng: Draws errors and noise.

    Attributes:
        calibration: The lab's table, if it was entered.
        stuck: {wheel: reading [counts] that it stays at}.
        broken: {wheel: status bits that every reading has}.
    """

    def __init__(
        self,
        n_wheels: int,
        bits: int,
        inl_deg: float,
        noise_counts: float,
        parity_rate: float,
        rng: np.random.Generator,
    ) -> None:
        self.calibration: EncoderCalibration | None = None
        self.stuck: dict[int, int] = {}
        self.broken: dict[int, int] = {}
        self._lost_bits = max(0, WHEEL_BITS - bits)
        self._noise, self._parity, self._rng = noise_counts, parity_rate, rng
        # A first and a second harmonic, as an off-centre magnet gives; together at most inl_deg.
        shares = rng.uniform(0.3, 0.7, n_wheels)
        scale = inl_deg * COUNTS_PER_TURN / 360
        self._amplitude = scale * np.stack([shares, 1 - shares])
        self._phase = rng.uniform(0, 2 * math.pi, (2, n_wheels))
        self._exact = inl_deg == 0
        self._drawn = np.zeros((0, n_wheels))
        self._used = 0

    @property
    def may_fail(self) -> bool:
        """Whether any reading can have a status bit."""
        return bool(self.broken) or self._parity > 0

    def error(self, radians: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Smooth error [counts] at true wheel angles [rad]."""
        first, second = self._phase
        one, two = self._amplitude
        error: Float[np.ndarray, " n"]
        error = one * np.sin(radians + first) + two * np.sin(2 * radians + second)
        return error

    def seen(self, radians: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """True wheel angles [rad] with the smooth error [counts, whole turns included]."""
        counts = radians * COUNTS_PER_RAD
        return counts if self._exact else counts + self.error(radians)

    def read(self, counts: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """A reading of wheels that are ``seen`` so [counts of 14 bits, whole turns included]."""
        if self._noise:
            counts = counts + self._next_noise()
        read = np.rint(counts / (1 << self._lost_bits)).astype(np.int64) << self._lost_bits
        if self.calibration is not None:
            read = np.rint(self.calibration.correct(read.astype(float))).astype(np.int64)
        for wheel, held in self.stuck.items():
            read[wheel] = held
        return read

    def status(self) -> Int[np.ndarray, " n"]:
        """Status bits that come with a reading."""
        bits = np.zeros(self._amplitude.shape[1], dtype=np.int64)
        if self._parity:
            bits |= np.where(self._rng.random(len(bits)) < self._parity, PARITY, 0)
        for wheel, broken in self.broken.items():
            bits[wheel] |= broken
        return bits

    def _next_noise(self) -> Float[np.ndarray, " n"]:
        if self._used == len(self._drawn):
            shape = NOISE_BLOCK, self._amplitude.shape[1]
            self._drawn, self._used = self._rng.normal(0, self._noise, shape), 0
        self._used += 1
        drawn: Float[np.ndarray, " n"] = self._drawn[self._used - 1]
        return drawn

    def measure(self, points: int) -> EncoderCalibration:
        """What a lab gets that turns every wheel to ``points`` equal readings of a turn.

        The reference is exact; the readings have their noise and quantisation.
        """
        angles = 2 * math.pi * np.arange(points) / points
        table = []
        for angle in angles:
            # The true angle at which the wheel reads ``angle``: two steps of a fixed point.
            true = np.full(self._amplitude.shape[1], angle)
            for _ in range(3):
                true = angle - self.error(true) / COUNTS_PER_RAD
            table.append((self.read(self.seen(true)) / COUNTS_PER_RAD - true) * (180 / math.pi))
        wheels = np.array(table).T
        rows = ((wheels + 180) % 360 - 180).tolist()
        return EncoderCalibration.model_validate({"schema": "muxjax/encoders/1", "error_deg": rows})
