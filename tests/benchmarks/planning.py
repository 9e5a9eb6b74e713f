"""Planners side by side: gap to the certified optimum, states expanded, CPU time.

    python -m tests.benchmarks.planning [targets]

Targets as MODEL.md section 7 fixes them: bending uniform in 0.2-1.6 rad, azimuth uniform, seed 0,
from the straight arm; weights of the preset "paper".
"""

from __future__ import annotations

import sys
import time

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
) -> tuple[muxjax.Plan, float]:
    """A plan and its CPU milliseconds."""
    began = time.process_time()
    found = muxjax.plan(robot, problem, method)
    return found, 1e3 * (time.process_time() - began)


def main() -> None:
    """Measure and print a table."""
    robot, n = muxjax.load_robot("muxarm"), int(sys.argv[1]) if len(sys.argv) > 1 else 50
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
            best = np.array([found.cost for found, _ in results["exact"]])
            for method, runs in results.items():
                gap = 100 * (np.array([found.cost for found, _ in runs]) / best - 1)
                certified = 100 * np.array([found.gap for found, _ in runs])
                rows.append(
                    [
                        "full" if max_step is None else f"{1e3 * max_step:g} mm",
                        str(len(servos)),
                        method,
                        quartiles(gap),
                        f"{gap.max():.1f}",
                        quartiles(certified),
                        f"{np.median([found.expansions for found, _ in runs]):.0f}",
                        quartiles([milliseconds for _, milliseconds in runs]),
                    ]
                )
    print(
        f"{machine()}; {n} targets, seed 0; median (quartiles); the second of two calls is timed\n"
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
    ]
    print(table(header, rows))


def quartiles(values: object) -> str:
    """Median and quartiles as text."""
    middle, low, high = spread(list(np.asarray(values, dtype=float)))
    return f"{middle:.1f} ({low:.1f}-{high:.1f})"


if __name__ == "__main__":
    main()
