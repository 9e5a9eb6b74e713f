"""What a program does over time, moment by moment, for a viewer's timeline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from muxjax.metrics.program import timeline
from muxjax.robot import Robot
from muxjax.scheduler import Program, Trajectory

_WINDOW_S = 0.1  # over which a speed is taken
_STILL = 0.05  # share of the tendons' top speed below which one counts as held


@dataclass(frozen=True, eq=False)
class Marks:
    """What the drive does from a time on, until the next.

    Attributes:
        since_s: [s].
        engaged: Tendons whose clutches are in.
        lost: Servos that are out of use.
        phase: In words.
        left_out: Those of them, from 1, that have not failed: the program does without them.
    """

    since_s: float
    engaged: Bool[np.ndarray, " SJ"]
    lost: Bool[np.ndarray, " J"]
    phase: str
    left_out: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Moment:
    """The arm and its drive at one time.

    Attributes:
        displacements: Of the tendons [m].
        moving: Tendons that move.
        axial: Axial position from 0, fractions between two; None if not known.
        marks: What the drive does.
    """

    displacements: Float[np.ndarray, " SJ"]
    moving: Bool[np.ndarray, " SJ"]
    axial: float | None
    marks: Marks

    @property
    def slot(self) -> int:
        """Axial position from 1; 0 between two or if not known."""
        near = self.axial is not None and abs(self.axial - round(self.axial)) < 1e-2
        return round(self.axial) + 1 if near and self.axial is not None else 0


@dataclass(frozen=True, eq=False)
class Track:
    """One recording or prediction that a timeline plays.

    Attributes:
        name: For a person.
        kind: Where it comes from, in words, with what its times mean.
        line: Tendons over time, from 0 s.
        marks: In time order, the first at 0 s.
        axial_s: Times at which the drum's position is known [s].
        axial: The position then, from 0; straight lines in between.
        top_speed: Of a tendon [m/s].
        target: Displacements wanted at the end [m], if known.
    """

    name: str
    kind: str
    line: Trajectory
    marks: tuple[Marks, ...]
    axial_s: Float[np.ndarray, " Q"]
    axial: Float[np.ndarray, " Q"]
    top_speed: float
    target: Float[np.ndarray, " SJ"] | None = None

    @property
    def duration_s(self) -> float:
        """Of the whole [s]."""
        return float(self.line.time_s[-1])

    def at(self, time_s: float) -> Moment:
        """The moment at a time [s]; before the start and after the end, those."""
        time_s = float(np.clip(time_s, 0.0, self.duration_s))
        around = time_s + np.array([-0.5, 0.0, 0.5]) * _WINDOW_S
        before, now, after = self.line.at(around)
        fast = np.abs(after - before) > _STILL * self.top_speed * _WINDOW_S
        marks = self.marks[max(0, self._index(time_s))]
        axial = None
        if len(self.axial_s):
            axial = float(np.interp(time_s, self.axial_s, self.axial))
        return Moment(now, fast & marks.engaged, axial, marks)

    def _index(self, time_s: float) -> int:
        times = [mark.since_s for mark in self.marks]
        return int(np.searchsorted(times, time_s, side="right")) - 1


def still(robot: Robot, displacements: Float[np.ndarray, " SJ"], axial: int | None) -> Moment:
    """An arm at rest; ``axial`` counts from 1."""
    n, j = robot.n_tendons, robot.tendons_per_segment
    none = np.zeros(n, bool)
    at = None if axial is None else float(axial - 1)
    return Moment(displacements, none, at, Marks(0.0, none, np.zeros(j, bool), "at rest"))


def track_of_program(robot: Robot, program: Program, name: str) -> Track:
    """What a program does, with the times of M Eq. 14.

    Raises:
        ValueError: The program was made for another robot.
    """
    line = timeline(robot, program)
    lost = lost_servos(robot, program.servos)
    left_out = numbers_of(lost)
    none = np.zeros(robot.n_tendons, bool)
    marks = [Marks(0.0, none, lost, "at rest", left_out)]
    axial_s, axial = [0.0], [axial_before(program)]
    point, count = 1, len(program.instructions)
    for number, item in enumerate(program.instructions, start=1):
        # timeline: one point where the visit's motion begins, then one a leg.
        waits = float(line.time_s[point - 1])
        begin, end = float(line.time_s[point]), float(line.time_s[point + len(item.via)])
        engage = max(waits, begin - float(robot.engage_time))
        engaged = none.copy()
        engaged[np.array(item.clutches) - 1] = True
        turned = item.axial - 1.0
        stage = f"stage {number} of {count}"
        if turned != axial[-1]:
            marks.append(Marks(waits, none, lost, f"{stage}: drum turns to {item.axial}", left_out))
        marks.append(Marks(engage, engaged, lost, f"{stage}: clutches engage", left_out))
        moves = f"{stage}: {move_words(item.clutches)}"
        marks.append(Marks(begin, engaged, lost, moves, left_out))
        axial_s += [waits, engage]
        axial += [axial[-1], turned]
        point += len(item.via) + 1
        over = "done" if number == count else f"{stage}: over"
        marks.append(Marks(end, none, lost, over, left_out))
    return Track(
        name,
        "predicted, times of M Eq. 14",
        line,
        tuple(marks),
        np.array(axial_s),
        np.array(axial),
        float(robot.tendon_speed),
        np.array(program.target),
    )


def axial_before(program: Program) -> float:
    """Where the drum stands before a program, from 0.

    If that is not known, beside where it goes first: it counts as turning there (M Eq. 14).
    """
    if program.axial is not None:
        return program.axial - 1.0
    first = program.instructions[0].axial if program.instructions else 2
    return first - 2.0 if first > 1 else 1.0


def move_words(tendons: Sequence[int]) -> str:
    """That these tendons move, from 1."""
    names = ", ".join(map(str, tendons))
    return f"tendon {names} moves" if len(tendons) == 1 else f"tendons {names} move"


def lost_servos(robot: Robot, servos: tuple[int, ...]) -> Bool[np.ndarray, " J"]:
    """Servos that are not among these, from 1."""
    return ~np.isin(np.arange(1, robot.tendons_per_segment + 1), servos)


def numbers_of(servos: Bool[np.ndarray, " J"]) -> tuple[int, ...]:
    """Numbers, from 1, of the servos that are marked."""
    return tuple(int(s) + 1 for s in np.flatnonzero(servos))
