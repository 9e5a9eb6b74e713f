"""Planners side by side: gap to the certified optimum, states expanded, CPU time.

    python -m tests.benchmarks.planning [targets] [methods|lattices|batch ...]

"methods" compares every planner where the exact one fits, "lattices" the layered beam on lattices
from coarse to fine and for two robots, "batch" counts full-move optima a second. "first" is the
first call for a lattice [s], with whatever this process still had to compile.

Targets as MODEL.md section 7 fixes them: bending uniform in 0.2-1.6 rad, azimuth uniform, seed 0,
from the straight arm; weights of the preset "paper" where none is named.
"""

from __future__ import annotations

import sys
import time
from itertools import product

import numpy as np

import muxjax
from muxjax.planning import METHODS
from tests.benchmarks.common import machine, spread, table

SERVO_SETS = ((1,), (1, 2), (1, 2, 3))
STEPS = (None, 0.02)


def targets(robot: muxjax.Robot, n: int) -> np.ndarray:
    """Random target displacements [m]."""
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.2, 1.6, (n, robot.n_segments))
    phi = rng.uniform(0, 2 * np.pi, theta.shape)
    return muxjax.tendon_displacements(robot, np.stack([theta, phi], -1).reshape(n, -1))


def timed_plan(
    robot: muxjax.Robot, problem: muxjax.Problem, method: str
) -> tuple[muxjax.Plan, float, float]:
    """A plan, its CPU and its wall milliseconds."""
    cpu, wall = time.process_time(), time.perf_counter()
    found = muxjax.plan(robot, problem, method)
    return found, 1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - wall)


def main() -> None:
    """Measure and print tables."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    parts = sys.argv[2:] or ["methods", "lattices", "batch"]
    print(f"{machine()}; {n} targets, seed 0; median (quartiles); compilation is left out\n")
    for part in parts:
        print({"methods": methods, "lattices": lattices, "batch": batch}[part](n), "\n")


def lattices(n: int) -> str:
    """The layered beam, B = 64, against lattice size."""
    rows = []
    for name in ("muxarm", "penta"):
        robot = muxjax.load_robot(name)
        goals = targets(robot, n)
        servo_sets = SERVO_SETS if name == "muxarm" else ((1,), (1, 2, 3, 4))
        for max_step, servos, preset in product(
            (0.03, 0.01, 0.005, 0.003, 0.002), servo_sets, ("paper", "no-overshoot")
        ):
            problems = [
                muxjax.Problem(0 * goal, goal, servos=servos, max_step=max_step, preset=preset)
                for goal in goals
            ]
            # Each target has a lattice of its own size, and may have to be compiled for.
            first, *_ = [timed_plan(robot, problem, "beamstep")[-1] for problem in problems]
            runs = [timed_plan(robot, problem, "beamstep") for problem in problems]
            cpu = [milliseconds for _, milliseconds, _ in runs]
            expansions = sum(found.expansions for found, *_ in runs)
            rows.append(
                [
                    name,
                    preset,
                    f"{1e3 * max_step:g} mm",
                    str(len(servos)),
                    quartiles([100 * found.gap for found, *_ in runs]),
                    quartiles(cpu),
                    f"{np.median([wall for *_, wall in runs]):.0f}",
                    f"{first / 1e3:.1f}",
                    f"{1e3 * expansions / sum(cpu):.0f}",
                ]
            )
    header = [
        "robot",
        "preset",
        "step",
        "servos",
        "certified gap [%]",
        "CPU [ms]",
        "wall [ms]",
        "first [s]",
        "expansions/s",
    ]
    return table(header, rows)


def batch(n: int) -> str:
    """Full-move optima a second, for batches of 40 n problems."""
    robot = muxjax.load_robot("muxarm")
    goals, rows = targets(robot, 40 * n), []
    for preset in ("paper", "fastest", "no-overshoot"):
        muxjax.planning.plan_batch(robot, np.zeros(9), goals, preset=preset)
        for servos in SERVO_SETS:
            cpu, wall = time.process_time(), time.perf_counter()
            muxjax.planning.plan_batch(robot, np.zeros(9), goals, preset=preset, servos=servos)
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            rows.append(
                [
                    preset,
                    str(len(servos)),
                    f"{1e3 * cpu / len(goals):.2f}",
                    f"{len(goals) / wall:.0f}",
                ]
            )
    return table(["preset", "servos", "CPU a plan [ms]", "plans/s"], rows)


def methods(n: int) -> str:
    """Every planner where the exact one fits."""
    robot = muxjax.load_robot("muxarm")
    goals = targets(robot, n)
    rows = []
    for max_step in STEPS:
        for servos in SERVO_SETS:
            problems = [
                muxjax.Problem(np.zeros(9), goal, servos=servos, max_step=max_step)
                for goal in goals
            ]
            results = {
                method: [timed_plan(robot, p, method) for p in problems for _ in range(2)][1::2]
                for method in METHODS
            }
            best = np.array([found.cost for found, *_ in results["exact"]])
            for method, runs in results.items():
                gap = 100 * (np.array([found.cost for found, *_ in runs]) / best - 1)
                certified = 100 * np.array([found.gap for found, *_ in runs])
                rows.append(
                    [
                        "full" if max_step is None else f"{1e3 * max_step:g} mm",
                        str(len(servos)),
                        method,
                        quartiles(gap),
                        f"{gap.max():.1f}",
                        quartiles(certified),
                        f"{np.median([found.expansions for found, *_ in runs]):.0f}",
                        quartiles([milliseconds for _, milliseconds, _ in runs]),
                        f"{np.median([wall for *_, wall in runs]):.1f}",
                    ]
                )
    header = [
        "step",
        "servos",
        "method",
        "gap [%]",
        "worst",
        "certified gap [%]",
        "expanded",
        "CPU [ms]",
        "wall [ms]",
    ]
    return table(header, rows)


def quartiles(values: object) -> str:
    """Median and quartiles as text."""
    middle, low, high = spread(list(np.asarray(values, dtype=float)))
    return f"{middle:.1f} ({low:.1f}-{high:.1f})"


if __name__ == "__main__":
    main()
