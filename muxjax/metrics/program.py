"""How a Program performs: time, stages, overshoot (M Eq. 14-15) and its planning cost.

Everything here is computed on the Program, because that is what is executed (MODEL.md section 6).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from muxjax.kinematics import forward_kinematics
from muxjax.planning.motion import STRAIGHT, angles_at, bending_angles, overshoot_profile
from muxjax.planning.problem import Problem, Transition, check_own_terms, step
from muxjax.planning.terms import CostTerm
from muxjax.precision import host_array, pad_rows
from muxjax.robot import Robot
from muxjax.scheduler import Program, Trajectory, waypoints
from muxjax.tendons import configuration_from_tendons

Array = jax.Array | np.ndarray

_SAMPLES_A_LEG = 33


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


def timeline(robot: Robot, program: Program) -> Trajectory:
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
    return Trajectory(times, displacements)


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
    duration = float(line.time_s[-1])
    before, after = line.displacements[:-1], line.displacements[1:]
    seconds, peak = _overshoot(robot, before, after, np.diff(line.time_s), line.displacements[-1])
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


def least_time(robot: Robot, program: Program) -> float:
    """T that no program between the same ends with the same servos can fall below [s].

    Whatever the order, the action set and the overshoot: a layer needs a visit for every so many
    of its tendons as there are servos, all with repositioning but one if the drum's position is
    known, and the servos at best share its net displacement as far as that number of visits lets
    them.

    Raises:
        ValueError: The program was made for another robot.
    """
    ends = waypoints(robot, program)
    if not ends:
        return 0.0
    net = np.abs(ends[-1][-1] - np.array(program.start)) / float(robot.tendon_speed)
    switch, servos = float(robot.switch_time), len(program.servos)
    layers = (
        _least_layer_time(np.sort(layer[layer > 0])[::-1], servos, switch)
        for layer in net.reshape(robot.n_segments, -1)
    )
    known = program.axial is not None
    return sum(layers) - known * (switch - float(robot.engage_time))


def _least_layer_time(net: Float[np.ndarray, " n"], servos: int, switch: float) -> float:
    """Visits and motion of one layer, whose tendons need ``net`` [s] each, greatest first.

    With two visits of k servos each for n tendons, 2k - n of them may move in both; the others
    move in one, n - k in either, and each visit lasts as long as the longest of its own.
    """
    n, k = len(net), servos
    if not n:
        return 0.0
    shared = max(float(net[0]), float(net.sum()) / k)
    visits = -(-n // k)
    if visits != 2:
        return visits * switch + shared
    once = net[2 * k - n :]
    two = max(float(net[0]), float(once[0] + once[n - k]))
    return min(2 * switch + two, 3 * switch + shared)


def tip_deviation(
    robot: Robot, program: Program, path: Float[np.ndarray, "points 3"] | None = None
) -> float:
    """Greatest distance of the tool from a path in the world while a program runs [m].

    Every leg is sampled at 33 points. A sample's distance is that to the nearest point of the
    path.

    Args:
        robot: The arm.
        program: What it executes.
        path: Corners of a polyline [m]; by default the straight line from the tool's position at
            the start to that at the end.

    Raises:
        ValueError: The program was made for another robot, or the path has fewer than two points.
    """
    line = timeline(robot, program)
    share = np.linspace(0.0, 1.0, _SAMPLES_A_LEG)[:, None, None]
    before, after = line.displacements[:-1], line.displacements[1:]
    points = np.concatenate(
        [line.displacements, (before + share * (after - before)).reshape(-1, robot.n_tendons)]
    )
    q = configuration_from_tendons(robot, pad_rows(points))
    tips = np.asarray(forward_kinematics(robot, q))[: len(points), :3, 3]
    corners = (
        tips[[0, len(line.displacements) - 1]] if path is None else host_array("path", path, 3)
    )
    if corners.ndim != 2 or len(corners) < 2:
        raise ValueError(f"path: needs at least two points, found shape {corners.shape}")
    return float(np.max(distance_to_polyline(tips, corners)))


def distance_to_polyline(
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, " n"]:
    """Distance [m] of each point to the nearest point of a polyline."""
    begin, along = corners[:-1], np.diff(corners, axis=0)
    squared = np.sum(along**2, axis=-1)
    offset = points[:, None] - begin
    share = np.sum(offset * along, axis=-1) / np.where(squared > 0, squared, 1.0)
    nearest = np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(offset - nearest, axis=-1).min(axis=1)


def program_cost(robot: Robot, problem: Problem, program: Program) -> float:
    """The problem's objective on a program: each leg is one step.

    Raises:
        ValueError: The program was made for another robot, or one of the problem's own terms does
            not give one value for each transition.
    """
    check_own_terms(robot, problem)
    legs = [(v[:-1], v[1:]) for v in waypoints(robot, program)]
    if not legs:
        return 0.0
    before, after = (np.concatenate(side) for side in zip(*legs, strict=True))
    first_leg = np.concatenate([np.arange(len(b)) == 0 for b, _ in legs])
    switched = np.repeat(_repositions(program), [len(b) for b, _ in legs])
    # Expensive terms are data here too: other obstacles need no other compilation.
    split = [problem.compiled_terms(expensive=kind) for kind in (False, True)]
    weights = np.concatenate([w for _, w in split])
    with jax.enable_x64(True):
        terms = _leg_terms(
            robot,
            split[0][0] + split[1][0],
            pad_rows(before),
            pad_rows(after - before),
            pad_rows((first_leg & switched).astype(float)),
            pad_rows((first_leg & ~switched).astype(float)),
            problem.target,
        )
        return float(weights @ np.asarray(terms)[:, : len(before)].sum(axis=1))


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


@jax.jit
def _leg_terms(
    robot: Robot,
    terms: tuple[CostTerm, ...],
    before: Float[Array, "P SJ"],
    move: Float[Array, "P SJ"],
    repositions: Float[Array, " P"],
    engages: Float[Array, " P"],
    target: Float[Array, " SJ"],
) -> Float[Array, "T P"]:
    goal = bending_angles(robot, target)
    transition: Transition = step(robot, before, move, repositions, engages, goal)
    return jnp.stack([term(robot, transition) for term in terms])
