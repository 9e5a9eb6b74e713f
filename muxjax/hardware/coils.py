"""Heat of the clutches' coils."""

from __future__ import annotations

import math

from muxjax.hardware.physics import CoilPhysics

FAULT_RISE_K = 100.0


class Coils:
    """One temperature for all coils, which follows those that have current.

    Attributes:
        temperature: As its sensor says [degree Celsius].
        faulty: Whether they get far hotter than they should.
    """

    def __init__(self, physics: CoilPhysics) -> None:
        self.temperature = physics.ambient_c
        self.faulty = False
        self._physics = physics
        self._time = 0.0

    def pass_time(self, now: float, energised: int) -> None:
        """Until ``now`` [s] that many coils had current."""
        physics = self._physics
        towards = physics.ambient_c + physics.rise_k * energised + FAULT_RISE_K * self.faulty
        # A fault heats fast: it is there to be noticed within a run.
        constant = 1.0 if self.faulty else physics.time_constant_s
        left = math.exp(-(now - self._time) / constant)
        self.temperature = towards + (self.temperature - towards) * left
        self._time = now
