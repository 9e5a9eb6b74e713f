"""One instruction as a transaction: all of it, or a failure that says what is to blame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from muxjax.hardware.handshake import Handshake
from muxjax.hardware.journal import LegEntry
from muxjax.hardware.protocol import SERVO_BITS_PER_RAD, SERVO_LIMIT_BITS, Op, Reason
from muxjax.hardware.session import SENSOR_WAIT_S, After, Failed, Script
from muxjax.hardware.visits import Visit, make_visit

Targets = Mapping[int, int]  # {servo: 0.1 degree}

ENGAGE_TRIES = 3
MAX_TRIMS = 6  # each may be lost in the play of the gear
TRIM_COUNTS = 1.5  # wheel error [encoder counts] that is left alone
# A single reading is rounded and noisy. One above this may hide an error of over 2 counts, 0.02 mm
# on MuxArm, so that the mean of several decides.
SURE_COUNTS = 0.6
LOOKS = 8
CLUTCH_S = 0.5  # after this a clutch or its probe should be done
# A wheel further from where its servo has taken it than this has not followed: trims are for what
# gears and clutches lose, and one that followed a stuck encoder would tear the tendon.
FOLLOW_MM = 1.0
FOLLOW_SHARE = 0.05  # of the way


@dataclass(frozen=True)
class InstructionRecord:
    """What one instruction did. Times count from arming, on the board's clock [s].

    ``number`` is the instruction's in its program, from 1.
    """

    number: int
    axial: int
    start_s: float
    end_s: float
    trims: int


class Transaction(Handshake):
    """A session that can do visits."""

    def _transact(self, number: int, visit: Visit, first_leg: int = 1) -> Script[int]:
        """Drum, clutches in, legs, trims, clutches out; how many trims.

        Args:
            number: Of the visit in the journal, from 1.
            visit: What to do.
            first_leg: Leg to begin with, from 1: those before it are done.
        """
        yield from self._go_to(visit)
        yield from self._engage(visit)
        trims = yield from self._move_all(number, visit, first_leg)
        yield from self._release(visit)
        return trims

    def _go_to(self, visit: Visit) -> Script[None]:
        self.phase = f"axial motor to position {visit.axial}"
        yield from self._expect(lambda: self.sensors.clutches_out, "all clutches to be out")
        takes_s = float(self.robot.switch_time)
        reason = yield from self._command(
            Op.AXIAL, arg=visit.axial, takes_s=takes_s, may=(Reason.NOT_RELEASED,)
        )
        if reason is Reason.NOT_RELEASED:
            yield from self._blame_held_clutches("AXIAL")
        yield from self._expect(
            lambda: self.sensors.slot == visit.axial, f"axial position {visit.axial}"
        )

    def _engage(self, visit: Visit) -> Script[None]:
        """The board oscillates the servos and believes both encoders; here its word is checked."""
        self.phase = f"clutches {sorted(visit.tendons.values())} in"
        if (yield from self._try_to_engage(visit)):
            return
        loose = [
            (servo, tendon)
            for servo, tendon in visit.tendons.items()
            if not self.sensors.clutches[2] >> self._bit(tendon) & 1
        ]
        yield from self._release(visit)
        yield from self._diagnose(*loose[0])

    def _try_to_engage(self, visit: Visit) -> Script[bool]:
        """Whether every clutch of the visit is in, seen by both encoders."""
        wanted = visit.layer, visit.clutch_mask, visit.clutch_mask
        for _ in range(ENGAGE_TRIES):
            reason = yield from self._command(
                Op.ENGAGE,
                visit.layer,
                visit.clutch_mask,
                takes_s=CLUTCH_S,
                may=(Reason.NOT_SEATED,),
            )
            if reason is Reason.NONE:
                yield from self._expect(
                    lambda: self.sensors.clutches == wanted, "the clutches to be in"
                )
                return True
        yield from self._expect(
            lambda: (
                self.sensors.clutches[1] == visit.clutch_mask
                and self.sensors.clutches[2] != visit.clutch_mask
            ),
            "CLUTCH_FB to say which clutch is not seated",
        )
        return False

    def _bit(self, tendon: int) -> int:
        """Bit of a tendon (from 1) in its layer's masks."""
        return (tendon - 1) % self.robot.tendons_per_segment

    def _diagnose(self, servo: int, tendon: int) -> Script[None]:
        """Blame the servo or the wheel's side, by another servo's word. Always fails.

        A wheel that stands still while its servo turns may have a clutch that does not couple or
        an encoder that does not count; if it follows another servo, it is neither.
        """
        text = f"clutch {tendon} not seated after {ENGAGE_TRIES} tries with servo {servo}"
        other = self._other_servo(servo, tendon)
        if other is None:
            raise Failed(f"{text}; no other servo to try", After.REPAIR)
        alone, second = other
        self.phase = f"trying tendon {tendon} with servo {second}"
        yield from self._go_to(alone)
        followed = yield from self._try_to_engage(alone)
        yield from self._release(alone)
        if followed:
            raise Failed(
                f"{text}, seated with servo {second}: servo {servo} is at fault",
                After.REPAIR,
                servo=servo,
            )
        raise Failed(
            f"{text}, nor with servo {second}: clutch or encoder of tendon {tendon}", After.REPAIR
        )

    def _other_servo(self, servo: int, tendon: int) -> tuple[Visit, int] | None:
        """A visit of the one clutch with another servo of the program, and that servo."""
        failed = self.journal.standing.failed_servos
        facing = self.robot.axial_map + 1
        for second in self.program.servos:
            if second == servo or second in failed:
                continue
            for axial in range(1, len(facing) + 1):
                if facing[axial - 1, second - 1] == tendon:
                    return make_visit(self.robot, axial, {second: tendon}, ()), second
        return None

    def _release(self, visit: Visit) -> Script[None]:
        self.phase = f"clutches {sorted(visit.tendons.values())} out"
        reason = yield from self._command(
            Op.RELEASE,
            visit.layer,
            visit.clutch_mask,
            takes_s=CLUTCH_S,
            may=(Reason.NOT_RELEASED,),
        )
        if reason is Reason.NOT_RELEASED:
            yield from self._blame_held_clutches("RELEASE")
        yield from self._expect(lambda: self.sensors.clutches_out, "the clutches to be out")

    def _blame_held_clutches(self, op: str) -> Script[None]:
        """Name the clutches whose wheels still follow. Always fails."""
        yield from self._until(lambda: self.sensors.clutches[2] != 0, SENSOR_WAIT_S)
        tendons = self.sensors.tendons_of(self.sensors.clutches[2])
        raise Failed(
            f"{op} aborted by the board: NOT_RELEASED, clutches {tendons} are still in",
            After.REPAIR,
            reason=Reason.NOT_RELEASED,
        )

    def _move_all(self, number: int, visit: Visit, first_leg: int) -> Script[int]:
        """Every leg, then trims until the wheels stand right; how many trims."""
        if not visit.legs:
            return 0
        targets = yield from self._servo_targets(visit)
        for leg, goals in enumerate(visit.legs[first_leg - 1 :], start=first_leg):
            self.phase = f"leg {leg} of {len(visit.legs)}"
            by_tendon = {visit.tendons[s]: m for s, m in goals.items()}
            self._write(
                LegEntry(visit=number, leg=leg, goals=by_tendon, lengths=self._heard_lengths())
            )
            yield from self._move(visit, targets(goals))
        for trims in range(MAX_TRIMS + 1):
            targets = yield from self._servo_targets(visit)
            tendon, off = yield from self._worst_wheel(visit)
            if off <= TRIM_COUNTS:
                return trims
            if trims < MAX_TRIMS:
                self.phase = f"trim {trims + 1}"
                yield from self._move(visit, targets(visit.legs[-1]))
        raise Failed(
            f"tendon {tendon}: its wheel is {off:.1f} counts off after {trims} trims: gear, clutch "
            "or encoder",
            After.REPAIR,
        )

    def _servo_targets(self, visit: Visit) -> Script[Callable[[Mapping[int, float]], Targets]]:
        """Absolute servo angles {servo: 0.1 degree} for tendon goals {servo: m}.

        One reading of servos and wheels fixes how they stand to each other while the clutches
        hold, so that every leg's targets are absolute.
        """
        servos, wheels = [s - 1 for s in visit.tendons], [c - 1 for c in visit.tendons.values()]
        since = self._now
        yield from self._expect(
            lambda: self.sensors.fresh(servos, wheels, since), "servos and wheels to report"
        )
        ratio = float(self.robot.servo_per_metre)
        held = self.sensors.displacements()
        zero = {
            s: self.sensors.servo_rad[s - 1] - held[c - 1] * ratio for s, c in visit.tendons.items()
        }

        def targets(goals: Mapping[int, float]) -> Targets:
            return {s: round((zero[s] + m * ratio) * SERVO_BITS_PER_RAD) for s, m in goals.items()}

        return targets

    def _worst_wheel(self, visit: Visit) -> Script[tuple[int, float]]:
        """The tendon that is furthest from its goal, and how far [encoder counts]."""
        goals = {c: visit.legs[-1][s] for s, c in visit.tendons.items()}

        def furthest(held: Float[np.ndarray, " SJ"]) -> tuple[int, float]:
            off, tendon = max((abs(float(held[c - 1]) - goal), c) for c, goal in goals.items())
            return tendon, off / self.sensors.metres_per_count

        looks = [self.sensors.displacements()]
        tendon, off = furthest(looks[0])
        if not SURE_COUNTS < off <= TRIM_COUNTS:
            return tendon, off
        while len(looks) < LOOKS:
            looks.append((yield from self._next_look([c - 1 for c in goals])))
        return furthest(np.mean(looks, axis=0))

    def _next_look(self, wheels: list[int]) -> Script[Float[np.ndarray, " SJ"]]:
        """Displacements [m] by readings that are not there yet."""
        later = self._now + 1e-6
        yield from self._expect(lambda: self.sensors.fresh([], wheels, later), "wheels to report")
        return self.sensors.displacements()

    def _move(self, visit: Visit, targets: Targets) -> Script[None]:
        """Stage every servo, start them together, see that every wheel followed its servo."""
        longest, before = 0.0, self.sensors.displacements()
        turned = {s: self.sensors.servo_rad[s - 1] for s in targets}
        for servo, target in targets.items():
            if abs(target) > SERVO_LIMIT_BITS:
                raise Failed(f"servo {servo} is at the end of its multi-turn range", After.REPAIR)
            yield from self._command(Op.STAGE, servo, target)
            turn = target / SERVO_BITS_PER_RAD - self.sensors.servo_rad[servo - 1]
            longest = max(longest, abs(float(turn)))
        mask = sum(1 << (servo - 1) for servo in targets)
        yield from self._command(
            Op.START, arg=mask, takes_s=longest / float(self.robot.servo_speed)
        )
        ended = self._now
        servos, wheels = [s - 1 for s in targets], [visit.tendons[s] - 1 for s in targets]
        yield from self._expect(
            lambda: self.sensors.fresh(servos, wheels, ended), "servos and wheels to report"
        )
        after = self.sensors.displacements()
        for servo in targets:
            tendon = visit.tendons[servo]
            way = (self.sensors.servo_rad[servo - 1] - turned[servo]) / float(
                self.robot.servo_per_metre
            )
            missing = abs(after[tendon - 1] - before[tendon - 1] - way)
            if missing > FOLLOW_MM * 1e-3 + FOLLOW_SHARE * abs(way):
                raise Failed(
                    f"tendon {tendon}: its wheel moved {1e3 * (way - missing):.2f} mm while servo "
                    f"{servo} turned for {1e3 * way:.2f} mm",
                    reason=Reason.WHEEL_STILL,
                )
