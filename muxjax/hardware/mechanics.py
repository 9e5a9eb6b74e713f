"""The truth behind the virtual board: servos, plugs, axial motor, winding wheels and tendons.

The board's controller knows of it what its sensors say (``sensing``); the true values and their
record are for plots and judges.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Float

from muxjax.hardware.motion import Motion, ramp
from muxjax.hardware.physics import PhysicsConfig
from muxjax.robot import Robot

AT_SLOT_RAD = 1e-6  # how close to a slot the drum must stand for its plugs to face it
ROUNDING_S = 1e-9


class Mechanics:
    """State of the moving parts on a clock that only goes forward.

    Servos, tendons and slots count from 0 in here; slot -1 is between two slots.

    Args:
        robot: The arm.
        physics: How its parts behave.
        displacements: Tendon displacements at first [m].
        slot: Axial position at first.
        rng: Draws phases of slots, play and slip.

    Attributes:
        displacements: True tendon displacements [m], shape (S*J,).
        wheels: What the wheels alone have wound out [m], shape (S*J,): the displacements but for
            what has slipped or stretched beyond the wheel.
        servo: Shaft angles [rad], shape (J,).
        axial: Angle of the drum [rad].
        coupled: {servo: tendon} whose plug is in.
        jammed: Servos whose shaft stands still whatever they are told.
    """

    def __init__(
        self,
        robot: Robot,
        physics: PhysicsConfig,
        displacements: Float[np.ndarray, " S*J"],
        slot: int,
        rng: np.random.Generator,
    ) -> None:
        self.time = 0.0
        self.displacements = np.array(displacements, dtype=np.float64)
        self.wheels = self.displacements.copy()
        self.windings = 0  # how often a wheel has changed
        self.servo = np.zeros(robot.tendons_per_segment)
        self._slot_angle = 2 * math.pi / len(robot.axial_map)
        self._slots = len(robot.axial_map)
        self.axial = self._slot_angle * (slot if slot >= 0 else 0.5)
        self.coupled: dict[int, int] = {}
        self.jammed: set[int] = set()
        self.dead_plugs: set[int] = set()  # tendons whose plug never drops in
        self.stuck_plugs: set[int] = set()  # tendons whose plug does not come out
        self._physics, self._rng = physics, rng
        self._metres_per_rad = 1 / float(robot.servo_per_metre)
        self._top_speed = float(robot.servo_speed)
        self._play = physics.servo.backlash_m
        self._gap: dict[int, float] = {}  # servo: where its gear stands in the play [m]
        self._pressed: dict[int, int] = {}  # servo: tendon whose plug looks for its slot
        pitch = math.radians(physics.clutch.slot_pitch_deg)
        self._plug_angle = rng.uniform(0, pitch, robot.n_tendons)  # against its wheel's shaft
        self._motion = Motion(0.0, 1.0)
        self._by: dict[int, float] = {}  # what each servo turns in the motion [rad]
        self._told: set[int] = set()  # servos that were told to turn
        self._axial_by = 0.0
        self._from_servo, self._from_axial = self.servo.copy(), self.axial
        self._end = 0.0  # of the motion under way [s]
        self._marks: list[float] = []  # times at which the record needs a point, latest first
        self._brake_at = math.inf
        self._brake_s = 0.0
        self._times = [0.0]
        self._points = [self.displacements.copy()]

    @property
    def moving(self) -> bool:
        """Whether any part moves now, or is about to."""
        return self.time < self._end

    @property
    def axial_moves(self) -> bool:
        """Whether the drum turns."""
        return self.moving and self._axial_by != 0

    @property
    def strained(self) -> set[int]:
        """Servos that push and do not turn."""
        return self.jammed & self._told if self.moving else set()

    @property
    def end(self) -> float:
        """When the motion under way is over [s]."""
        return self._end

    @property
    def slot(self) -> int:
        """Where the drum truly stands; -1 between two slots."""
        nearest = round(self.axial / self._slot_angle)
        off = abs(self.axial - nearest * self._slot_angle)
        return nearest % self._slots if off < AT_SLOT_RAD and not self.axial_moves else -1

    # Time

    def advance(self, now: float) -> None:
        """Let time pass until ``now`` [s]."""
        while self._marks and self._marks[-1] <= now:
            self._move_on(self._marks.pop())
            self._note()
            if self.time == self._brake_at:
                self._slow_down()
        self._move_on(now)

    def _move_on(self, now: float) -> None:
        if self.moving and now > self.time:
            done = self._motion.done(now)
            for servo, by in self._by.items():
                at = float(self._from_servo[servo]) + by * done
                self._turn_servo(servo, at - float(self.servo[servo]))
                self.servo[servo] = at
            self.axial = self._from_axial + self._axial_by * done
        self.time = max(self.time, now)

    def _turn_servo(self, servo: int, angle: float) -> None:
        """A shaft turns on by ``angle`` [rad]: its plug may drop in, its wheel may follow."""
        if servo in self._pressed:
            angle = self._drop_on_the_way(servo, angle)
        if servo not in self.coupled:
            return
        way = self._gap.get(servo, 0.0) + angle * self._metres_per_rad
        half = self._play / 2
        held = min(max(way, -half), half)
        self._gap[servo] = held
        self._wind(self.coupled[servo], way - held)

    def _wind(self, tendon: int, by: float) -> None:
        self.windings += 1
        self.wheels[tendon] += by
        self.displacements[tendon] += by

    # Motions

    def turn(self, by: Mapping[int, float], duration: float) -> None:
        """Turn servos {servo: rad} in ``duration`` [s]; they start and end together.

        They begin when the UART next tells them.
        """
        ramps = ramp(duration, self._top_speed, self._physics.servo.acceleration_rad_s2)
        free = {s: angle for s, angle in by.items() if s not in self.jammed}
        self._told = set(by)
        self._begin(Motion(self.next_told(), duration, ramps, ramps), free, 0.0)

    def turn_to(self, targets: Mapping[int, float], duration: float) -> None:
        """Turn servos to absolute targets {servo: rad}, which their own loops reach."""
        self.turn({s: target - float(self.servo[s]) for s, target in targets.items()}, duration)

    def rotate_axial(self, slot: int, duration: float) -> None:
        """Turn the drum to a slot in ``duration`` [s]."""
        ramps = 0.0
        if (axial := self._physics.axial) is not None:
            ramps = ramp(duration, axial.speed_deg_s, axial.acceleration_deg_s2)
        by = self._slot_angle * slot - self.axial
        self._begin(Motion(self.time, duration, ramps, ramps), {}, by)

    def brake(self, duration: float) -> None:
        """Decelerate what moves evenly to a stand within ``duration`` [s], not past its target.

        Servos begin to when the UART next tells them.
        """
        begin = self.next_told() if self._by else self.time
        if not self.moving or begin >= self._end:
            return
        speed, left = self._motion.speed(begin), 1 - self._motion.done(begin)
        lasts = min(duration, 2 * left / speed) if speed > 0 else 0.0
        self._brake_at, self._brake_s, self._end = begin, lasts, begin + lasts
        self._marks = sorted([t for t in self._marks if t < begin] + [begin], reverse=True)
        self.advance(self.time)

    def _slow_down(self) -> None:
        """The brake begins: go on at a falling speed."""
        speed, lasts = self._motion.speed(self.time), self._brake_s
        self._brake_at = math.inf
        part = speed * lasts / 2
        if part == 0:
            self._begin_none()
            return
        by = {s: part * angle for s, angle in self._by.items()}
        self._begin(Motion(self.time, lasts, 0.0, lasts), by, part * self._axial_by)

    def _begin_none(self) -> None:
        self._end, self._by, self._axial_by, self._marks = self.time, {}, 0.0, []

    def _begin(self, motion: Motion, by: Mapping[int, float], axial_by: float) -> None:
        self._note()
        self._motion, self._by, self._axial_by = motion, dict(by), axial_by
        self._from_servo, self._from_axial = self.servo.copy(), self.axial
        self._end = motion.end
        self._brake_at = math.inf
        self._marks = sorted({motion.begin, motion.end, *motion.breaks()}, reverse=True)
        while self._marks and self._marks[-1] <= self.time:
            self._marks.pop()

    def next_told(self) -> float:
        """When the UART next has told and asked every servo [s]."""
        period = self._physics.servo.uart_period_s
        if period == 0:
            return self.time
        return math.ceil((self.time - ROUNDING_S) / period) * period

    def told(self) -> float:
        """When it last had."""
        period = self._physics.servo.uart_period_s
        return math.floor((self.time + ROUNDING_S) / period) * period if period else self.time

    def servo_when_told(self) -> Float[np.ndarray, " J"]:
        """Shaft angles [rad] as the UART last heard them."""
        told = self.told()
        if told >= self.time or not self._by:
            return self.servo
        heard = self.servo.copy()
        for servo, by in self._by.items():
            heard[servo] = self._from_servo[servo] + by * self._motion.done(told)
        return heard

    def jam(self, servo: int) -> None:
        """From now on the shaft stands still."""
        self.jammed.add(servo)
        self._by.pop(servo, None)

    # Plugs

    def press(self, pairs: Mapping[int, int]) -> None:
        """Plugs are pushed out, {servo: tendon}: those that face a slot drop in at once."""
        seated = {}
        for servo, tendon in pairs.items():
            if servo in self.coupled or tendon in self.dead_plugs:
                continue
            if self._to_window(servo, tendon, 1.0) == 0.0:
                seated[servo] = tendon
            else:
                self._pressed[servo] = tendon
        self._seat(seated)

    def unseat(self, tendons: Collection[int]) -> None:
        """Springs pull plugs back."""
        for servo, tendon in list(self.coupled.items()):
            if tendon in tendons and tendon not in self.stuck_plugs:
                del self.coupled[servo]
        for servo, tendon in list(self._pressed.items()):
            if tendon in tendons:
                del self._pressed[servo]

    def throw_out(self, servo: int) -> bool:
        """A plug jumps out of its slot; whether there was one."""
        return self.coupled.pop(servo, None) is not None

    def _seat(self, pairs: Mapping[int, int]) -> None:
        clutch = self._physics.clutch
        self._note()  # the record must jump here, not slope from its last point
        self.coupled.update(pairs)
        for servo, tendon in pairs.items():
            if self.coupled.get(servo) != tendon:
                continue
            self._gap[servo] = self._play * float(self._rng.uniform(-0.5, 0.5))
            if clutch.slip_seen_m:
                self._wind(tendon, self._slip(clutch.slip_seen_m))
            if clutch.slip_unseen_m:
                self.displacements[tendon] += self._slip(clutch.slip_unseen_m)
        self._note()

    def _slip(self, about: float) -> float:
        return about * float(self._rng.uniform(0.8, 1.2) * self._rng.choice([-1, 1]))

    def _to_window(self, servo: int, tendon: int, direction: float) -> float:
        """How far the shaft must turn until the plug faces a slot [rad]."""
        clutch = self._physics.clutch
        pitch, half = math.radians(clutch.slot_pitch_deg), math.radians(clutch.slot_window_deg) / 2
        plug = float(self.wheels[tendon]) / self._metres_per_rad + float(self._plug_angle[tendon])
        phase = (float(self.servo[servo]) - plug) % pitch * math.copysign(1.0, direction) % pitch
        if half >= pitch / 2 or phase <= half or phase >= pitch - half:
            return 0.0
        return pitch - half - phase

    def _drop_on_the_way(self, servo: int, angle: float) -> float:
        """Turn a shaft whose plug looks for a slot; what is left of the turn once it is in."""
        clutch, tendon = self._physics.clutch, self._pressed[servo]
        pitch, start = math.radians(clutch.slot_pitch_deg), float(self.servo[servo])
        way = self._to_window(servo, tendon, angle)
        while way <= abs(angle):
            if self._rng.random() >= clutch.miss_rate:
                del self._pressed[servo]
                self.servo[servo] = start + math.copysign(way, angle)
                self._seat({servo: tendon})
                return math.copysign(abs(angle) - way, angle)
            way += pitch
        return angle

    # The record

    def _note(self) -> None:
        self._times.append(self.time)
        self._points.append(self.displacements.copy())

    def trajectory(
        self, since: float
    ) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K S*J"]]:
        """Points of the true displacements from ``since`` [s] to now: times, values [m].

        Between two points every tendon moves at constant speed; ramps have several points, and
        within the gear's play the record is that much coarse.
        """
        times = np.array([*self._times, self.time])
        points = np.array([*self._points, self.displacements])
        kept = times > since
        first = [np.interp(since, times, column) for column in points.T]
        return np.r_[since, times[kept]], np.vstack([first, points[kept]])
