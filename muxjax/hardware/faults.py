"""When a virtual board's parts fail: faults from YAML, at a time, at a command, or at random."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from enum import StrEnum
from itertools import count
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from muxjax.config import NotNegative, Positive, Strict
from muxjax.hardware.protocol import Op


class FaultKind(StrEnum):
    """What can break. The value is its name in YAML."""

    SERVO_STALL = "servo_stall"  # index: servo; its shaft stands still, whatever it is told
    SERVO_OFFLINE = "servo_offline"  # index: servo; it neither answers nor obeys
    CLUTCH_SLIP = "clutch_slip"  # index: servo; its plug jumps out of the slot, its coil stays on
    CLUTCH_DEAD = "clutch_dead"  # index: tendon; its plug never drops in
    CLUTCH_STUCK = "clutch_stuck"  # index: tendon; its plug does not come out
    ENCODER_STUCK = "encoder_stuck"  # index: tendon; its wheel's reading does not change
    ENCODER_PARITY = "encoder_parity"  # index: tendon; every reading has a parity error
    ENCODER_MAGNET = "encoder_magnet"  # index: tendon; the magnet is lost
    COIL_HEAT = "coil_heat"  # the coils get 100 K hotter than they should
    UNDERVOLTAGE = "undervoltage"  # the supply sags, the controller just lives
    BROWN_OUT = "brown_out"  # the controller loses its supply, then boots
    HANG = "hang"  # the controller stops; its hardware watchdog resets it
    BUS_OFF = "bus_off"  # the board neither hears nor sends until its power-up
    CABLE = "cable"  # the same while the cable is out


OF_SERVOS = (FaultKind.SERVO_STALL, FaultKind.SERVO_OFFLINE, FaultKind.CLUTCH_SLIP)
OF_TENDONS = (
    FaultKind.CLUTCH_DEAD,
    FaultKind.CLUTCH_STUCK,
    FaultKind.ENCODER_STUCK,
    FaultKind.ENCODER_PARITY,
    FaultKind.ENCODER_MAGNET,
)
BROWN_OUT_S = 0.2  # how long the supply is away where for_s does not say


class FaultConfig(Strict):
    """One fault: what, where, when, how long.

    Exactly one of ``at_s``, ``at_op`` and ``rate_hz`` says when.
    """

    kind: FaultKind
    index: Annotated[int, Field(ge=1)] | None = Field(
        None, description="servo or tendon, from 1; None: drawn each time"
    )
    at_s: NotNegative | None = Field(None, description="on the clock of the board's mechanics")
    at_op: str | None = Field(None, description="name of an opcode, such as START")
    nth: Annotated[int, Field(ge=1)] = Field(1, description="at which of those that are executed")
    delay_s: NotNegative = Field(0.0, description="after at_op")
    rate_hz: Positive | None = Field(None, description="how often on average, at random")
    for_s: Positive | None = Field(None, description="how long; None: for good")

    @model_validator(mode="after")
    def _one_trigger(self) -> Self:
        triggers = {"at_s": self.at_s, "at_op": self.at_op, "rate_hz": self.rate_hz}
        given = [name for name, value in triggers.items() if value is not None]
        if len(given) != 1:
            raise ValueError(f"exactly one of {', '.join(triggers)} says when, found {given}")
        if self.at_op is not None and self.at_op not in Op.__members__:
            raise ValueError(f"at_op: is one of {', '.join(Op.__members__)}, found {self.at_op!r}")
        if self.index is not None and self.kind not in OF_SERVOS + OF_TENDONS:
            raise ValueError(f"index: {self.kind} has no servo or tendon")
        return self


class FaultClock:
    """What breaks next.

    Args:
        faults: The faults.
        n_servos: J.
        n_tendons: S * J.
        rng: Draws times of faults with a rate and indices that are not given.

    Raises:
        ValueError: An index beyond the robot's servos or tendons.
    """

    def __init__(
        self,
        faults: Iterable[FaultConfig],
        n_servos: int,
        n_tendons: int,
        rng: np.random.Generator,
    ) -> None:
        self._sizes = {**dict.fromkeys(OF_SERVOS, n_servos), **dict.fromkeys(OF_TENDONS, n_tendons)}
        self._rng = rng
        self._number = count()  # among faults of one instant the first one in the list is first
        self._due: list[tuple[float, int, FaultConfig]] = []
        self._waiting: list[FaultConfig] = []
        self._executed: dict[str, int] = {}
        for fault in faults:
            if fault.index is not None and fault.index > self._sizes[fault.kind]:
                raise ValueError(
                    f"{fault.kind}: index is 1 to {self._sizes[fault.kind]}, found {fault.index}"
                )
            if fault.at_op is not None:
                self._waiting.append(fault)
            else:
                self._push(fault, fault.at_s if fault.at_s is not None else self._draw(fault))

    @property
    def next_time(self) -> float:
        """When the next fault is due [s]; inf if none is known of."""
        return self._due[0][0] if self._due else math.inf

    def executed(self, op: Op, now: float) -> None:
        """A command is being executed at ``now`` [s]: arm the faults that wait for it."""
        if not self._waiting:
            return
        nth = self._executed[op.name] = self._executed.get(op.name, 0) + 1
        met = [f for f in self._waiting if (f.at_op, f.nth) == (op.name, nth)]
        for fault in met:
            self._waiting.remove(fault)
            self._push(fault, now + fault.delay_s)

    def take(self) -> tuple[FaultConfig, int]:
        """The fault that is due, and the servo or tendon it meets, from 0."""
        due, _, fault = heapq.heappop(self._due)
        if fault.rate_hz is not None:
            self._push(fault, due + self._draw(fault))
        size = self._sizes.get(fault.kind, 1)
        at = int(self._rng.integers(size)) if fault.index is None else fault.index - 1
        return fault, at

    def _push(self, fault: FaultConfig, due: float) -> None:
        heapq.heappush(self._due, (due, next(self._number), fault))

    def _draw(self, fault: FaultConfig) -> float:
        assert fault.rate_hz is not None  # else at_s or at_op says when
        return float(self._rng.exponential(1 / fault.rate_hz))
