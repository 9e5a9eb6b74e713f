"""Inverse kinematics side by side: `python -m tests.benchmarks.ik [--targets 2000]`.

Random reachable targets of MuxArm, bending uniform within the limits, one seed. Ours in its
methods, beside scipy's least squares from one random start, and optimistix where the environment
that runs this has it. Figures are CPU time over all threads, and wall time for one target.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

import muxjax
from muxjax.ik import all_ik, solve_ik
from muxjax.robot import Robot
from tests.benchmarks.common import machine, rounds, spread, table

SEED = 20260418
BATCH = 1000
FEW = 30  # targets for the slow ones


def targets(robot: Robot, n: int) -> np.ndarray:
    """Tool poses, (n, 4, 4)."""
    rng = np.random.default_rng(SEED)
    theta = rng.uniform(0, robot.theta_max, (n, robot.n_segments))
    phi = rng.uniform(0, 2 * np.pi, theta.shape)
    return muxjax.forward_kinematics(robot, np.stack([theta, phi], axis=-1).reshape(n, -1))


def by_scipy(robot: Robot, poses: np.ndarray) -> float:
    """Share solved at 1e-9 from one random start each."""
    rng = np.random.default_rng(SEED)
    solved = 0
    for pose in poses:

        def error(b: np.ndarray, pose: np.ndarray = pose) -> np.ndarray:
            bx, by = b[0::2], b[1::2]
            q = np.stack([np.hypot(bx, by), np.arctan2(by, bx)], axis=-1).ravel()
            found = muxjax.forward_kinematics(robot, q)
            return ((found - pose)[:3] * [1, 1, 1, 1 / 0.47]).ravel()

        found = least_squares(error, rng.normal(size=6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        solved += np.abs(found.fun).max() < 1e-9
    return solved / len(poses)


def first_call(robot: Robot, pose: np.ndarray) -> float:
    """Seconds of the first call of a process, compilation included."""
    start = time.perf_counter()
    all_ik(robot, pose)
    return time.perf_counter() - start


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--targets", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    robot = muxjax.load_robot("muxarm")
    poses = targets(robot, options.targets)
    compile_time = first_call(robot, poses[0])
    batches = [poses[i : i + BATCH] for i in range(0, len(poses), BATCH)]
    contestants: dict[str, tuple[Callable[[], object], int, Callable[[], float]]] = {
        "all solutions, batches of 1000": (
            lambda: [all_ik(robot, b) for b in batches],
            len(poses),
            lambda: float(
                np.mean([m.any() for b in batches for m in np.asarray(all_ik(robot, b).mask)])
            ),
        ),
        "all solutions, one at a time": (
            lambda: [all_ik(robot, p) for p in poses[:FEW]],
            FEW,
            lambda: float(np.mean([np.any(all_ik(robot, p).mask) for p in poses[:FEW]])),
        ),
    }
    for method in ("all", "levenberg_marquardt", "pseudo_inverse"):
        contestants[f"one solution, {method}"] = (
            lambda method=method: solve_ik(robot, poses[:BATCH], method=method),
            min(BATCH, len(poses)),
            lambda method=method: float(
                np.mean(solve_ik(robot, poses[:BATCH], method=method).converged)
            ),
        )
    contestants["scipy least_squares, one start"] = (
        lambda: by_scipy(robot, poses[:FEW]),
        FEW,
        lambda: by_scipy(robot, poses[:FEW]),
    )
    times = rounds({name: call for name, (call, _, _) in contestants.items()}, options.rounds)
    rows = []
    for name, (_, count, success) in contestants.items():
        middle, low, high = (1e6 * x / count for x in spread(times[name]))
        rows.append(
            [
                name,
                f"{middle:.1f} ({low:.1f}-{high:.1f})",
                f"{1e6 / middle:.0f}",
                f"{100 * success():.2f}",
            ]
        )
    print(f"{machine()}\nfirst call of all_ik for one pose: {compile_time:.1f} s\n")
    print(table(["", "CPU us a target", "targets / core-s", "solved [%]"], rows))
    if importlib.util.find_spec("optimistix") is None:
        print("\noptimistix: not installed here, left out")


if __name__ == "__main__":
    main()
