"""A motion at equal times, with the drive that makes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.metrics.program import timeline
from muxjax.robot import Robot
from muxjax.scheduler import Program, Trajectory, waypoints
from muxjax.trajectory_file import Samples, sample


@dataclass(frozen=True, eq=False)
class Recording:
    """A motion at equal times.

    Attributes:
        samples: Times, tendons, bending and tool.
        begin_s: Time of the first sample [s]: since 1970 of a run on a bus, else 0.
        servo_rad: Shaft angles of the servos [rad]; of a program from 0 at its start, of a run as
            the board reported them. NaN where not known.
        axial: Axial position, from 1; 0 while the drum turns or where it is not known.
        engaged: Tendons whose clutches are energised.
        source: "program", or "run".
    """

    samples: Samples
    begin_s: float
    servo_rad: Float[np.ndarray, "T J"]
    axial: Int[np.ndarray, " T"]
    engaged: Bool[np.ndarray, "T SJ"]
    source: str


def take(
    values: Float[np.ndarray, "P *shape"] | Int[np.ndarray, "P *shape"],
    at_s: Float[np.ndarray, " P"],
    times: Float[np.ndarray, " T"],
) -> np.ndarray:
    """What was last said at or before some times; before the first word, the first.

    Args:
        values: What was said.
        at_s: When [s], never falling.
        times: When it is asked for [s].
    """
    # The last of several at one time: a step is at its later value.
    return np.asarray(values)[np.maximum(np.searchsorted(at_s, times, side="right") - 1, 0)]


def program_recording(robot: Robot, program: Program, rate_hz: float = 50.0) -> Recording:
    """What a program does, by the times of M Eq. 14.

    A clutch counts as energised, and the drum as in position, from the end of an instruction's wait
    to the end of its last leg.

    Args:
        robot: The arm.
        program: What is executed.
        rate_hz: Samples a second.

    Raises:
        ValueError: The program was made for another robot, or a rate that cannot serve.
    """
    line = timeline(robot, program)
    samples = sample(robot, line, rate_hz)
    axial, engaged = _states(robot, program)
    return Recording(
        samples=samples,
        begin_s=0.0,
        servo_rad=Trajectory(line.time_s, _servo_angles(robot, program)).at(samples.time_s),
        axial=take(axial, line.time_s, samples.time_s),
        engaged=take(engaged, line.time_s, samples.time_s).astype(bool),
        source="program",
    )


def _servo_angles(robot: Robot, program: Program) -> Float[np.ndarray, "P J"]:
    """At the knots of the timeline: after each wait, and after each leg."""
    now = np.zeros(robot.tendons_per_segment)
    knots = [now]
    for item in program.instructions:
        start, angle = now, now
        knots.append(start)
        for leg in item.via:  # relative to the start of the visit
            angle = start.copy()
            for servo, moved in leg.items():
                angle[servo - 1] += float(robot.servo_per_metre) * moved
            knots.append(angle)
        now = angle
    return np.stack(knots)


def _states(
    robot: Robot, program: Program
) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, "P SJ"]]:
    """Axial position and energised clutches from each knot of the timeline to the next."""
    axial, engaged, before = [], [], program.axial or 0
    for item, points in zip(program.instructions, waypoints(robot, program), strict=True):
        coils = np.zeros(robot.n_tendons, dtype=int)
        coils[[c - 1 for c in item.clutches]] = 1
        axial += [item.axial if item.axial == before else 0] + [item.axial] * (len(points) - 1)
        engaged += [0 * coils] + [coils] * (len(points) - 1)
        before = item.axial
    return np.array([*axial, before]), np.array([*engaged, np.zeros(robot.n_tendons, dtype=int)])
