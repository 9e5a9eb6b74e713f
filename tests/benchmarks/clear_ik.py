"""Collision-free inverse kinematics in batches, beside a long random search.

Targets are the poses of random configurations that are clear, so that every one of them has a clear
solution; uniform ones, and ones scattered about the configurations of the scene's task. The
random search follows Levenberg-Marquardt from many uniform starts and takes any end that is clear.

    python -m tests.benchmarks.clear_ik
"""

from __future__ import annotations

import argparse
import time

import equinox as eqx
import jax
import numpy as np

import muxjax
from muxjax.collision import World, load_world
from muxjax.config import TaskConfig, load_yaml, resolve
from muxjax.ik import solve_ik
from muxjax.ik.clear import nearest
from muxjax.ik.every import polar
from muxjax.ik.goals import tool_goals
from muxjax.ik.levenberg import levenberg
from muxjax.robot import Robot
from tests.benchmarks.common import machine, table

SEED = 20260418
SCATTER = 0.08  # [rad], of bending and azimuth about a task's configuration
STEPS = 60
TOLERANCE = 1e-10  # [m] and [rad]

Part = tuple[Robot, np.ndarray]  # an arm on its base, and configurations


def random_clear(robot: Robot, world: World, count: int, rng: np.random.Generator) -> np.ndarray:
    """Uniform in theta and phi, among those that are clear."""
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < count:
        theta = rng.uniform(0, robot.theta_max, (4 * count, robot.n_segments))
        phi = rng.uniform(0, 2 * np.pi, theta.shape)
        q = np.stack([theta, phi], axis=-1).reshape(len(theta), -1)
        kept.append(q[nearest(robot, q, world).clearance >= 0])
    return np.concatenate(kept)[:count]


def scattered_clear(
    robot: Robot, about: np.ndarray, world: World, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Near one configuration, among those that are clear."""
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < count:
        q = about + SCATTER * rng.normal(size=(4 * count, len(about)))
        q[:, 0::2] = np.clip(q[:, 0::2], 0, robot.theta_max)
        kept.append(q[nearest(robot, q, world).clearance >= 0])
    return np.concatenate(kept)[:count]


def random_search(
    robot: Robot, poses: np.ndarray, world: World, starts: int, rng: np.random.Generator
) -> np.ndarray:
    """Whether any of many random starts comes to a clear solution, for each pose."""
    success = np.zeros(len(poses), bool)
    host = jax.tree.map(lambda x: np.asarray(x, np.float64), robot)
    for row, pose in enumerate(poses):
        theta = rng.uniform(0, robot.theta_max, (starts, robot.n_segments))
        phi = rng.uniform(0, 2 * np.pi, theta.shape)
        b = np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1).reshape(starts, -1).T
        with jax.enable_x64(True):
            goal = np.repeat(tool_goals(host, pose[None]), starts, axis=1)
            found = levenberg(host, b, b, goal, np.ones(6), STEPS)
        there = (found.position < TOLERANCE) & (found.angle < TOLERANCE)
        clear = nearest(robot, polar(host, found.b.T), world).clearance >= 0
        success[row] = bool((there & clear).any())
    return success


def near_task(name: str, world: World, count: int, rng: np.random.Generator) -> list[Part]:
    """Scattered about the configurations that a task names, each with its own base."""
    muxarm = muxjax.load_robot("muxarm")
    targets = [t for t in load_yaml(TaskConfig, resolve(name, "tasks")).targets if t.near_q_deg]
    parts = []
    for target in targets:
        arm = muxarm
        if target.base is not None:
            frame = np.eye(4)
            frame[:3, 3] = target.base.xyz_m
            arm = eqx.tree_at(lambda r: r.base, muxarm, frame)
        about = np.radians(np.asarray(target.near_q_deg))
        parts.append((arm, scattered_clear(arm, about, world, count // len(targets), rng)))
    return parts


def scenes(count: int, rng: np.random.Generator) -> list[tuple[str, list[Part]]]:
    """Name, and for each base of the arm the configurations that make the targets."""
    muxarm, penta = muxjax.load_robot("muxarm"), muxjax.load_robot("penta")
    cabinet, pipe = load_world("cabinet"), load_world("s_pipe")
    return [
        ("cabinet, muxarm", [(muxarm, random_clear(muxarm, cabinet, count, rng))]),
        ("cabinet, penta", [(penta, random_clear(penta, cabinet, count, rng))]),
        ("cabinet, near its task", near_task("cabinet", cabinet, count, rng)),
        ("s_pipe, near its task", near_task("s_pipe", pipe, count, rng)),
    ]


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--targets", type=int, default=1000, help="of each scene")
    parser.add_argument("--searched", type=int, default=100, help="of them by random search too")
    parser.add_argument("--starts", type=int, default=512, help="of that search a target")
    options = parser.parse_args()
    rng = np.random.default_rng(SEED)
    rows = []
    for name, parts in scenes(options.targets, rng):
        world = load_world(name.split(",")[0])
        cpu, search_cpu, clear, nearest_clear, ours, theirs = 0.0, 0.0, [], [], [], []
        for arm, q in parts:
            poses = muxjax.forward_kinematics(arm, q)
            solve_ik(arm, poses, world=world)  # compiles
            start = time.process_time()
            found = solve_ik(arm, poses, world=world)
            cpu += time.process_time() - start
            clear.append(found.converged)
            near = solve_ik(arm, poses)
            nearest_clear.append(nearest(arm, near.q, world).clearance >= 0)
            few = rng.permutation(len(poses))[: -(-options.searched // len(parts))]
            random_search(arm, poses[few[:1]], world, options.starts, rng)
            start = time.process_time()
            theirs.append(random_search(arm, poses[few], world, options.starts, rng))
            search_cpu += time.process_time() - start
            ours.append(found.converged[few])
        clear_all, mine, reference = (np.concatenate(x) for x in (clear, ours, theirs))
        rows.append(
            [
                name,
                str(len(clear_all)),
                f"{100 * np.concatenate(nearest_clear).mean():.1f}",
                f"{100 * clear_all.mean():.2f}",
                f"{1e6 * cpu / len(clear_all):.0f}",
                f"{100 * mine.mean():.1f}",
                f"{100 * reference.mean():.1f}",
                f"{1e6 * search_cpu / len(reference):.0f}",
            ]
        )
    print(f"{machine()}\nseed {SEED}; random search of {options.starts} starts\n")
    header = ["", "targets", "nearest solution clear [%]", "solve_ik(world=) clear [%]",
              "CPU us a target", "of those searched: solve_ik [%]", "random search [%]",
              "its CPU us a target"]  # fmt: skip
    print(table(header, rows))


if __name__ == "__main__":
    main()
