"""Inverse kinematics side by side: `python -m tests.benchmarks.ik [--targets 10000]`.

Random reachable targets of MuxArm, bending uniform within the limits, one seed. Ours in its
methods, beside scipy and optimistix from one random start in an environment of their own
(``ik_peers_runner``). Figures are CPU time over all threads; the seconds of first calls are wall.
Started on one core (``taskset -c 0 python -m ...``) it counts core-seconds; on several, what the
threads lose between two cores' caches comes on top.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import scipy

import muxjax
from muxjax.ik import all_ik, solve_ik
from muxjax.robot import Robot
from tests.benchmarks.common import fresh_process, machine, rounds, spread, table

SEED = 20260418
BATCH = 1000
FEW = 30  # targets for the slow ones


def targets(robot: Robot, n: int) -> np.ndarray:
    """Tool poses, (n, 4, 4)."""
    rng = np.random.default_rng(SEED)
    theta = rng.uniform(0, robot.theta_max, (n, robot.n_segments))
    phi = rng.uniform(0, 2 * np.pi, theta.shape)
    return muxjax.forward_kinematics(robot, np.stack([theta, phi], axis=-1).reshape(n, -1))


def peers(robot: Robot, poses: np.ndarray, n_rounds: int) -> dict | str:
    """Figures of scipy and optimistix from an environment of their own, or why there are none."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        starts = np.random.default_rng(SEED).normal(size=(len(poses), 2 * robot.n_segments))
        np.savez(folder / "given.npz", lengths=robot.length, poses=poses, starts=starts)
        python = folder / "peers" / "bin" / "python"
        packages = ["optimistix==0.1.0", f"scipy=={scipy.__version__}", f"jax=={jax.__version__}"]
        try:
            subprocess.run([sys.executable, "-m", "venv", folder / "peers"], check=True)
            subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
            script = Path(__file__).with_name("ik_peers_runner.py")
            command = [python, script, folder / "given.npz", str(n_rounds)]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
        except (OSError, subprocess.CalledProcessError) as error:
            return f"not measured: {str(getattr(error, 'stderr', None) or error).strip()[-200:]}"
        return json.loads(done.stdout.splitlines()[-1])


def first_calls() -> list[list[str]]:
    """Seconds of the first call in a fresh process: without and with a filled persistent cache."""
    rows = []
    for label, robot, call in (
        ("all_ik, muxarm, one pose", "muxarm", "all_ik(robot, pose[0])"),
        ("all_ik, muxarm, 1000 poses", "muxarm", "all_ik(robot, pose)"),
        ("one solution, muxarm", "muxarm", "solve_ik(robot, pose, method='levenberg_marquardt')"),
        ("one solution, penta", "penta", "solve_ik(robot, pose)"),
    ):
        code = (
            "import time, numpy as np, muxjax\nfrom muxjax.ik import all_ik, solve_ik\n"
            f"robot = muxjax.load_robot('{robot}')\n"
            "rng = np.random.default_rng(0)\n"
            "q = rng.uniform(0, robot.theta_max.min(), (1000, 2 * robot.n_segments))\n"
            "pose = muxjax.forward_kinematics(robot, q)\nstart = time.perf_counter()\n"
            f"{call}\nprint(time.perf_counter() - start)"
        )
        with tempfile.TemporaryDirectory() as cache:
            bare, _, cached = (
                fresh_process(code, folder) for folder in (None, Path(cache), Path(cache))
            )
        rows.append([label, f"{bare:.1f}", f"{cached:.1f}"])
    return rows


def row(name: str, times: list[float], count: int, solved: float) -> list[str]:
    """A line of the table from the CPU-seconds of each round."""
    middle, low, high = (1e6 * x / count for x in spread(times))
    shown = f"{middle:.1f} ({low:.1f}-{high:.1f})"
    return [name, shown, f"{1e6 / middle:.0f}", f"{100 * solved:.2f}"]


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--targets", type=int, default=10_000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    robot = muxjax.load_robot("muxarm")
    poses = targets(robot, options.targets)
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
    for method, most in (
        ("all", len(poses)),
        ("levenberg_marquardt", len(poses)),
        ("pseudo_inverse", BATCH),
    ):
        few = poses[:most]
        contestants[f"one solution, {method}, {len(few)} in a call"] = (
            lambda method=method, few=few: solve_ik(robot, few, method=method),
            len(few),
            lambda method=method, few=few: float(
                np.mean(solve_ik(robot, few, method=method).converged)
            ),
        )
    times = rounds({name: call for name, (call, _, _) in contestants.items()}, options.rounds)
    found = peers(robot, poses[:FEW], max(3, options.rounds // 2))
    rows = [
        row(name, times[name], count, success())
        for name, (_, count, success) in contestants.items()
    ]
    missing = f"\n\nscipy, optimistix: {found}" if isinstance(found, str) else ""
    for name, peer in {} if isinstance(found, str) else found.items():
        rows.append(row(f"{name} {peer['version']}, one start", peer["times"], 1, peer["solved"]))
    print(f"{machine()}; seed {SEED}\n")
    header = ["", "CPU us a target, median (quartiles)", "targets / core-s", "solved [%]"]
    print(table(header, rows) + missing)
    header = ["first call in a fresh process", "wall s", "with the persistent cache"]
    print("\n" + table(header, first_calls()))


if __name__ == "__main__":
    main()
