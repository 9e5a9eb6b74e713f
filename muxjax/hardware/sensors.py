"""What the host knows of a board from its feedback streams."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from muxjax.hardware.protocol import COUNTS_PER_TURN, BoardState, Fault, Reason
from muxjax.robot import Robot

MOTION_STOPPED = 2  # severity of an EMCY


class Emergency(NamedTuple):
    """What an EMCY said."""

    reason: Reason
    op: int  # that ran; 0 if none
    part: int  # servo or tendon that it is about, from 1; 0 if none


class Sensors:
    """Latest readings, with the host's time at which each arrived [s]. Indices count from 0.

    Attributes:
        state: Board state of the last BOARD_HB; None before the first.
        faults: Its faults.
        boot_count: Its count of power-ups.
        emergency: The last EMCY that stopped the motion, if any.
        warnings: EMCYs that did not.
        slot: Axial position that the board is at, from 1; 0 between two.
        clutches: Layer (from 1), energised and verified masks.
        servo_rad: Shaft angles [rad], shape (J,).
        servo_status: Status bits of SERVO_FB.
        unreadable: Wheels whose last sample was flagged; such samples are not used.
        voltage: Supply [V]; NaN before POWER_FB.
        coil_temperature: [degC]; NaN before CLUTCH_FB.
        metres_per_count: Tendon displacement of one wheel encoder count [m].
    """

    def __init__(self, robot: Robot) -> None:
        n, j = robot.n_tendons, robot.tendons_per_segment
        self.state: BoardState | None = None
        self.faults = Fault(0)
        self.boot_count = 0
        self.emergency: Emergency | None = None
        self.warnings: list[Emergency] = []
        self.heartbeat_at = -math.inf
        self.slot = 0
        self.clutches = (0, 0, 0)
        self.servo_rad = np.full(j, np.nan)
        self.servo_status = [0] * j
        self.unreadable: set[int] = set()
        self.voltage = self.coil_temperature = math.nan
        self._clock_ms: int | None = None
        self._servo_at = np.full(j, -math.inf)
        # Lists, because single entries of an array are slow to reach.
        self._wheel_at = [-math.inf] * n
        self._angle = [0] * n  # within the turn [counts]
        self._counts = [0] * n  # whole turns included
        self._anchored = [False] * n  # whether the turn is known
        self.metres_per_count = 2 * math.pi * float(robot.wheel_radius) / COUNTS_PER_TURN

    @property
    def complete(self) -> bool:
        """Whether every servo and every wheel has reported."""
        return all(self._anchored) and bool(np.isfinite(self.servo_rad).all())

    @property
    def angles_known(self) -> bool:
        """Whether every wheel has reported its angle within the turn."""
        return all(math.isfinite(at) for at in self._wheel_at)

    @property
    def clutches_out(self) -> bool:
        """Whether no clutch is energised or still coupled."""
        return self.clutches[1:] == (0, 0)

    def tendons_of(self, mask: int) -> list[int]:
        """Tendons, from 1, of a mask of the layer's clutches: those energised or those verified."""
        layer, per_layer = self.clutches[0], len(self.servo_rad)
        held = [k for k in range(per_layer) if layer and mask >> k & 1]
        return [(layer - 1) * per_layer + k + 1 for k in held]

    def displacements(self) -> Float[np.ndarray, " S*J"]:
        """Displacements [m] by the wheel encoders; NaN where a wheel's turn is not known."""
        return np.where(self._anchored, np.array(self._counts) * self.metres_per_count, np.nan)

    def fresh(self, servos: Iterable[int], wheels: Iterable[int], since: float) -> bool:
        """Whether these servos and wheels reported at ``since`` [s] or later."""
        return bool(
            all(self._servo_at[s] >= since for s in servos)
            and all(self._wheel_at[c] >= since for c in wheels)
        )

    def angles(self) -> list[int]:
        """Wheel angles within their turn [counts]."""
        return list(self._angle)

    def forget_turns(self) -> None:
        """Take the turns of every wheel anew from what the board reports next."""
        self._anchored = [False] * len(self._anchored)
        self._wheel_at = [-math.inf] * len(self._wheel_at)

    @property
    def board_s(self) -> float:
        """Board clock [s], unwrapped; its zero means nothing. NaN before it was heard."""
        return math.nan if self._clock_ms is None else self._clock_ms * 1e-3

    def hear_clock(self, milliseconds: int) -> None:
        """Follow the board's 16-bit clock; it is heard far more often than it wraps (65 s)."""
        if self._clock_ms is None:
            self._clock_ms = milliseconds
        ahead = (milliseconds - self._clock_ms) & 0xFFFF
        if ahead < 0x8000:  # else a frame that a newer one overtook
            self._clock_ms += ahead

    def update(self, now: float, name: str, values: Mapping[str, Any]) -> None:
        """Take one feedback message; others are ignored."""
        if name.startswith("WHEEL_FB_"):
            first = 9 * values["Group"] + 3 * (int(name[-1]) - 1)
            angles = [values[f"Angle{k}"] for k in (1, 2, 3)]
            self._update_wheels(now, first, angles, [values[f"Status{k}"] for k in (1, 2, 3)])
        elif name.startswith("SERVO_FB_"):
            servo = 3 * values["Group"] + int(name[-1]) - 1
            if servo < len(self.servo_rad):
                self.servo_rad[servo] = math.radians(values["Position"])
                self.servo_status[servo] = values["Status"]
                self._servo_at[servo] = now
        elif name == "WHEEL_TURNS":
            self._update_turns(6 * values["Group"], [values[f"Turns{k}"] for k in range(1, 7)])
        elif name == "AXIAL_FB":
            self.slot = values["Slot"] if values["InPosition"] else 0
        elif name == "CLUTCH_FB":
            self.clutches = values["Layer"], values["Energised"], values["Verified"]
            self.coil_temperature = values["Temperature"]
        elif name == "BOARD_HB":
            self.state, self.heartbeat_at = BoardState(values["State"]), now
            self.faults, self.boot_count = Fault(values["Faults"]), values["BootCount"]
            self.hear_clock(values["Time"])
        elif name == "POWER_FB":
            self.voltage = values["Voltage"]
        elif name == "EMCY":
            said = Emergency(Reason(values["Code"]), values["Subsystem"], values["Index"])
            if values["Severity"] >= MOTION_STOPPED:
                self.emergency = said
            else:
                self.warnings.append(said)

    def _update_wheels(self, now: float, first: int, angles: list[int], flags: list[int]) -> None:
        """The shortest way from the last angle: a wheel needs seconds for half a turn."""
        half = COUNTS_PER_TURN // 2
        for wheel, angle in enumerate(angles[: max(0, len(self._counts) - first)], start=first):
            if flags[wheel - first]:  # parity error or magnet lost: not a sample
                self.unreadable.add(wheel)
                continue
            self.unreadable.discard(wheel)
            self._wheel_at[wheel] = now
            if angle != self._angle[wheel]:
                moved = (angle - self._angle[wheel] + half) % COUNTS_PER_TURN - half
                self._angle[wheel] = angle
                self._counts[wheel] += moved

    def _update_turns(self, first: int, turns: list[int]) -> None:
        """Anchor each wheel at its first report; the board samples turns along with angles.

        What a wheel at the end of a turn reports is off by one turn if the angle was lost on the
        way: the caller, who knows about where the wheel is, forgets it then and asks again.
        """
        for wheel, turn in enumerate(turns[: max(0, len(self._counts) - first)], start=first):
            if not self._anchored[wheel] and math.isfinite(self._wheel_at[wheel]):
                self._counts[wheel] = turn * COUNTS_PER_TURN + self._angle[wheel]
                self._anchored[wheel] = True
