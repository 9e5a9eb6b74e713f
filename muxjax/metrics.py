"""How a Program performs: time, stages, overshoot (M Eq. 14-15) and its planning cost.

Everything here is computed on the Program, because that is what is executed (MODEL.md section 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from muxjax.planning.motion import STRAIGHT, angles_at, bending_angles, overshoot_profile
from muxjax.planning.problem import Problem, Term, Transition, step
from muxjax.precision import pad_rows
from muxjax.robot import Robot
from muxjax.scheduler import Program, waypoints

Array = jax.Array | np.ndarray


@dataclass(frozen=True)
class Metrics:
    """Execution figures of a program.

    Attributes:
        time_s: T of M Eq. 14 [s]; at the axial position where the drum already stands, t_sw is
            the time of engagement alone.
        stages: Instructions. The paper's Table II counts one more (MODEL.md section 7).
        overshoot_duration: Share of T that each segment spends above its final bending
            (M Eq. 15a), with a margin of 1e-6 rad.
        overshoot_peak: Greatest excess over the final bending, relative to it (M Eq. 15b); NaN
            for a segment that ends straight (below 0.02 rad).
        overshoot_peak_rad: Greatest excess [rad].
        bending_peak_rad: Greatest bending on the way [rad]; nothing else keeps a plan's
            intermediate shapes within the limits of its segments.
        travel_m: Sum of |dl| [m].
    """

    time_s: float
    stages: int
    overshoot_duration: tuple[float, ...]
    overshoot_peak: tuple[float, ...]
    overshoot_peak_rad: tuple[float, ...]
    bending_peak_rad: tuple[float, ...]
    travel_m: float


@dataclass(frozen=True)
class Timeline:
    """A program as a piecewise linear motion: stretches between consecutive points.

    Attributes:
        times: When each point is reached [s], non-decreasing, the first is 0.
        displacements: Tendon displacements at the points [m].
    """

    times: Float[np.ndarray, " P"]
    displacements: Float[np.ndarray, "P SJ"]

    def at(self, times: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T SJ"]:
        """Displacements [m] at any times [s]; constant before the first and after the last."""
        columns = [np.interp(times, self.times, column) for column in self.displacements.T]
        return np.stack(columns, axis=-1)


def timeline(robot: Robot, program: Program) -> Timeline:
    """When the tendons are where: waiting for the axial motor, then the legs of each instruction.

    Raises:
        ValueError: The program was made for another robot.
    """
    points, waits = [np.array(program.start)[None]], [np.zeros(1)]
    for visit, repositions in zip(waypoints(robot, program), _repositions(program), strict=True):
        points.append(visit)
        wait = float(robot.switch_time if repositions else robot.engage_time)
        waits.append(np.concatenate([[wait], np.zeros(len(visit) - 1)]))
    displacements = np.concatenate(points)
    moving = np.max(np.abs(np.diff(displacements, axis=0)), axis=-1) / float(robot.tendon_speed)
    times = np.cumsum(np.concatenate(waits) + np.concatenate([[0.0], moving]))
    return Timeline(times, displacements)


def _repositions(program: Program) -> Bool[np.ndarray, " I"]:
    """Whether the axial motor moves before each instruction."""
    axial = [program.axial or 0, *(i.axial for i in program.instructions)]
    return np.diff(axial) != 0


def evaluate(robot: Robot, program: Program) -> Metrics:
    """Time, stages and overshoot of a program.

    Raises:
        ValueError: The program was made for another robot.
    """
    line = timeline(robot, program)
    duration = float(line.times[-1])
    before, after = line.displacements[:-1], line.displacements[1:]
    seconds, peak = _overshoot(robot, before, after, np.diff(line.times), line.displacements[-1])
    goal = angles_at(robot, line.displacements[-1:])[0]
    relative = np.where(
        goal >= STRAIGHT, np.maximum(peak, 0.0) / np.maximum(goal, STRAIGHT), np.nan
    )
    return Metrics(
        time_s=duration,
        stages=len(program.instructions),
        overshoot_duration=tuple((seconds / duration if duration else seconds).tolist()),
        overshoot_peak=tuple(relative.tolist()),
        overshoot_peak_rad=tuple(np.maximum(peak, 0.0).tolist()),
        bending_peak_rad=tuple((goal + peak).tolist()),
        travel_m=float(np.abs(after - before).sum()),
    )


def program_cost(robot: Robot, problem: Problem, program: Program) -> float:
    """The problem's objective on a program: each leg is one step.

    Raises:
        ValueError: The program was made for another robot.
    """
    legs = [(v[:-1], v[1:]) for v in waypoints(robot, program)]
    if not legs:
        return 0.0
    before, after = (np.concatenate(side) for side in zip(*legs, strict=True))
    first_leg = np.concatenate([np.arange(len(b)) == 0 for b, _ in legs])
    switched = np.repeat(_repositions(program), [len(b) for b, _ in legs])
    with jax.enable_x64(True):
        terms = _leg_terms(
            robot,
            problem.weighted_terms,
            pad_rows(before),
            pad_rows(after - before),
            pad_rows((first_leg & switched).astype(float)),
            pad_rows((first_leg & ~switched).astype(float)),
            problem.target,
        )
        return float(problem.weight_vector @ np.asarray(terms)[:, : len(before)].sum(axis=1))


def _overshoot(
    robot: Robot,
    before: Float[np.ndarray, "P SJ"],
    after: Float[np.ndarray, "P SJ"],
    duration: Float[np.ndarray, " P"],
    end: Float[np.ndarray, " SJ"],
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    fill = pad_rows(duration).shape[0] - len(duration)
    rest = np.tile(end, (fill, 1))  # padding rests at the end, where nothing is in excess
    with jax.enable_x64(True):
        seconds, peak = _profile(
            robot,
            np.concatenate([before, rest]),
            np.concatenate([after, rest]),
            pad_rows(duration),
            end,
        )
        return np.asarray(seconds), np.asarray(peak)


@jax.jit
def _profile(
    robot: Robot,
    before: Float[Array, "P SJ"],
    after: Float[Array, "P SJ"],
    duration: Float[Array, " P"],
    end: Float[Array, " SJ"],
) -> tuple[Float[Array, " S"], Float[Array, " S"]]:
    return overshoot_profile(robot, before, after, duration, bending_angles(robot, end))


@partial(jax.jit, static_argnums=1)
def _leg_terms(
    robot: Robot,
    terms: tuple[tuple[str, Term], ...],
    before: Float[Array, "P SJ"],
    move: Float[Array, "P SJ"],
    repositions: Float[Array, " P"],
    engages: Float[Array, " P"],
    target: Float[Array, " SJ"],
) -> Float[Array, "T P"]:
    goal = bending_angles(robot, target)
    transition: Transition = step(robot, before, move, repositions, engages, goal)
    return jnp.stack([term(robot, transition) for _, term in terms])
