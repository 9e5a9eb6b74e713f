"""What a GPU is good for: `python -m tests.benchmarks.accelerator [part ...] [--repeats 5]`.

Wall times of the batched work on JAX's default device, one table. Beside it, for the CPU of the
same machine, run it again with JAX_PLATFORMS=cpu. Every call ends with its results on the host, or
ready on the device where a row says so; the first call, which compiles, is a column of its own.
The data of the training are random numbers in the shapes of ``configs/training/value.yaml``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import muxjax
from muxjax import batched, workspace
from muxjax.config import load_yaml
from muxjax.planning.batch import plan_batch
from muxjax.precision import by_device
from muxjax.robot import Robot
from tests.benchmarks.common import machine, spread, table
from tests.benchmarks.ik import targets
from tests.benchmarks.kinematics import bending_rows, configurations
from tests.benchmarks.statics import workload

SEED = 20260418
POSES = 1 << 22  # of one call
MATRICES = 1 << 19
SAMPLES = 1_000_000_000
WORLD_SAMPLES = 3_000_000
TARGETS = 100_000
FEW_TARGETS = 4096
PROBLEMS = 4096
DECISIONS = 250_000
STEPS = 100


class Row(NamedTuple):
    """A line of the table."""

    what: str
    count: int  # of what a call does
    unit: str
    first: float  # [s]
    times: list[float]  # [s]
    check: str  # what shows that the numbers are right


def measured(
    what: str,
    count: int,
    unit: str,
    call: Callable[[], Any],
    check: Callable[[Any], str],
    repeats: int,
) -> Row:
    """Call it once more than ``repeats`` times, results ready at the end of each."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        result = jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return Row(what, count, unit, times[0], times[1:], check(result))


def device() -> str:
    """The device, its driver, and the host."""
    first = jax.devices()[0]
    if first.platform == "cpu":
        return f"CPU only; {machine()}"
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        known = subprocess.run(query, check=True, capture_output=True, text=True).stdout
        name, driver = known.splitlines()[0].split(", ")
    except (OSError, subprocess.CalledProcessError):
        name, driver = first.device_kind, "unknown"
    return f"{jax.device_count()} x {name}, driver {driver}; {machine()}"


def largest(found: Any, exact: np.ndarray) -> float:
    """Largest difference."""
    return float(np.max(np.abs(np.asarray(found) - exact)))


def poses(robot: Robot, repeats: int) -> Iterator[Row]:
    """Forward kinematics and Jacobians."""
    q = configurations(robot, POSES)
    few = q[:MATRICES]
    exact = muxjax.forward_kinematics(robot, few.astype(float))
    # A CPU is fastest in its cache.
    columns = by_device(batched.CHUNK, POSES)
    rows = jnp.asarray(bending_rows(q[:columns]))
    arm = batched.chain(robot)
    held: list[Any] = [None]

    def quads() -> Any:
        held[0] = batched.pose_quads(arm, rows, "quaternion", held[0])
        return held[0]

    def position(found: Any) -> str:
        places = batched.numbers(found)[0][:MATRICES, :3]
        return f"position {largest(places, exact[: len(places), :3, 3]):.1e} m"

    name = "position and quaternion, float32, "
    yield measured(name + "on the device", columns, "poses", quads, position, repeats)
    held[0] = None
    b = np.ascontiguousarray(bending_rows(q).T).reshape(-1, robot.n_segments, 2)
    yield measured(
        name + "NumPy in and out",
        POSES,
        "poses",
        lambda: batched.poses(robot, b),
        lambda found: f"position {largest(found[:MATRICES, :3], exact[:, :3, 3]):.1e} m",
        repeats,
    )
    reference = muxjax.jacobian(robot, few.astype(float))
    for kind in (jnp.float32, jnp.float64):
        with jax.enable_x64(kind is jnp.float64):
            given = jnp.asarray(few, kind)
            for what, function, right in (
                ("4 x 4 matrices", muxjax.forward_kinematics, exact),
                ("Jacobians", muxjax.jacobian, reference),
            ):
                compiled = jax.jit(lambda q, function=function: function(robot, q))
                yield measured(
                    f"{what}, {np.dtype(kind).name}, on the device",
                    MATRICES,
                    "poses",
                    lambda compiled=compiled, given=given: compiled(given),
                    lambda found, right=right: f"entry {largest(found, right):.1e}",
                    repeats,
                )


def sweep(robot: Robot, repeats: int) -> Iterator[Row]:
    """Reach and dexterity."""
    for sampler in workspace.sampling.SAMPLERS:
        yield measured(
            f"dexterity sweep, {sampler}",
            SAMPLES,
            "samples",
            lambda sampler=sampler: workspace.sweep(
                robot, samples=SAMPLES, seed=1, sampler=sampler, progress=False
            ),
            lambda found: f"mean dexterity {found.mean_dexterity:.4f}",
            min(repeats, 3),
        )
    world = muxjax.load_world("cabinet")
    yield measured(
        "sweep among obstacles (cabinet)",
        WORLD_SAMPLES,
        "samples",
        lambda: workspace.sweep(robot, samples=WORLD_SAMPLES, world=world, progress=False),
        lambda found: f"clear {found.clear_counts.sum() / found.counts.sum():.4f}",
        min(repeats, 3),
    )


def ik(robot: Robot, repeats: int) -> Iterator[Row]:
    """Inverse kinematics of many targets."""
    goals = targets(robot, TARGETS)

    def found(result: Any) -> str:
        solved = np.asarray(result.converged)
        error = np.max(np.asarray(result.position_error)[solved])
        return f"solved {100 * solved.mean():.3f} %, position {error:.1e} m"

    def every(result: Any) -> str:
        mask = np.asarray(result.mask)
        error = np.max(np.asarray(result.position_error)[mask])
        return (
            f"solved {100 * mask.any(-1).mean():.3f} %, {mask.sum() / len(mask):.3f} each, "
            f"position {error:.1e} m"
        )

    yield measured(
        "all solutions",
        TARGETS,
        "targets",
        lambda: muxjax.all_ik(robot, goals),
        every,
        min(repeats, 3),
    )
    for method, count in (
        ("all", TARGETS),
        ("levenberg_marquardt", TARGETS),
        ("pseudo_inverse", FEW_TARGETS),
    ):
        yield measured(
            f"one solution, {method}",
            count,
            "targets",
            lambda method=method, count=count: muxjax.solve_ik(robot, goals[:count], method=method),
            found,
            min(repeats, 3),
        )


def statics(robot: Robot, repeats: int) -> Iterator[Row]:
    """Postures of the paper's elastic arm, 64 joints and eight tendons."""
    del robot
    chain = muxjax.load_chain("hyper_redundant", resolution=32)
    for count in (1024, 8192):
        loads = workload(chain, count)
        yield measured(
            "posture from tension, 64 joints",
            count,
            "solves",
            lambda loads=loads: muxjax.forward_statics(chain, **loads),
            lambda found: (
                f"solved {100 * found.converged.mean():.1f} %, "
                f"residual {found.residual[found.converged].max():.1e}"
            ),
            min(repeats, 3),
        )


def planning(robot: Robot, repeats: int) -> Iterator[Row]:
    """Optima of full moves, and the environment in a scan."""
    lengths = muxjax.tendon_displacements(robot, configurations(robot, PROBLEMS).astype(float))
    straight = np.zeros(robot.n_tendons)
    yield measured(
        "optima of full moves",
        PROBLEMS,
        "problems",
        lambda: plan_batch(robot, straight, lengths),
        lambda found: f"sum of costs {found.cost.sum():.9g}",
        repeats,
    )
    from envs.config import load_env_config
    from envs.tdma import Tdma
    from tests.benchmarks.envs import random_steps

    env = Tdma(load_env_config("muxarm"))

    run = random_steps(env, STEPS)
    for lanes in (4096, 65536):
        states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), lanes))
        start = (states, jax.random.key(1))
        yield measured(
            f"environment, {lanes} lanes in a scan",
            lanes * STEPS,
            "steps",
            lambda start=start: run(start)[1][0],
            lambda found, lanes=lanes: f"mean reward {float(found.sum()) / lanes / STEPS:.5f}",
            repeats,
        )


def training(robot: Robot, repeats: int) -> Iterator[Row]:
    """An epoch of the value network."""
    from muxjax.planning.value import n_features
    from training.config import TrainingConfig
    from training.dataset import Decisions
    from training.fit_value import _optimiser, _Trainer

    rng = np.random.default_rng(SEED)
    config = load_yaml(TrainingConfig, Path("configs/training/value.yaml"))
    shape = (DECISIONS, 8)
    costs = [rng.uniform(0, 1, shape).astype(np.float32) for _ in range(3)]
    flags = [rng.uniform(size=shape) < share for share in (0.05, 0.9, 0.8)]
    flags[1][:, 0] = flags[2][:, 0] = True  # every decision has a best action
    flags[2] &= flags[1]
    features = rng.standard_normal((*shape, n_features(robot)), np.float32).astype(np.float16)
    decisions = Decisions(features, costs[0], costs[1], costs[0] + costs[2], *flags)
    held = Decisions(*(x[:8192] for x in decisions))
    batches = DECISIONS // config.batch
    with tempfile.TemporaryDirectory() as folder:
        trainer = _Trainer(config, robot, Path(folder))
        optimiser = _optimiser(config, batches * config.epochs)
        state = [trainer.fresh()]

        def epoch() -> float:
            state[0] = trainer._epoch(state[0], decisions, held, optimiser, batches)
            return trainer.curve[-1]["train"]

        yield measured(
            f"training, an epoch of {batches} batches of {config.batch}",
            DECISIONS,
            "decisions",
            epoch,
            lambda loss: f"loss {loss:.4f}",
            min(repeats, 3),
        )


def single(robot: Robot, repeats: int) -> Iterator[Row]:
    """One call at a time: on the default device, and on the CPU beside it."""
    pose = targets(robot, 1)[0]
    length = muxjax.tendon_displacements(robot, configurations(robot, 1)[0].astype(float))
    problem = muxjax.Problem(np.zeros(robot.n_tendons), length, servos=(1, 2))
    fine = replace(problem, max_step=5e-3)
    chain = muxjax.load_chain("hyper_redundant", resolution=32)
    load = {k: v[0] for k, v in workload(chain, 1).items()}
    calls: dict[str, tuple[Callable[[], Any], Callable[[Any], str]]] = {
        "forward kinematics": (
            lambda: muxjax.forward_kinematics(robot, np.ones(6)),
            lambda found: f"x {found[0, 3]:.9f} m",
        ),
        "all solutions": (
            lambda: muxjax.all_ik(robot, pose),
            lambda found: f"{found.mask.sum()} solutions",
        ),
        "one solution": (
            lambda: muxjax.solve_ik(robot, pose),
            lambda found: f"position {float(found.position_error):.1e} m",
        ),
        "exact plan": (
            lambda: muxjax.plan(robot, problem, method="exact"),
            lambda found: f"cost {found.cost:.9g}",
        ),
        "learned plan, 5 mm steps": (
            lambda: muxjax.plan(robot, fine, method="learned"),
            lambda found: f"cost {found.cost:.9g}",
        ),
        "posture from tension": (
            lambda: muxjax.forward_statics(chain, **load),
            lambda found: f"residual {float(found.residual):.1e}",
        ),
    }
    places = {"": None}
    if jax.default_backend() != "cpu":
        places[", default_device='cpu'"] = "cpu"
    for name, (call, check) in calls.items():
        for label, place in places.items():
            with jax.default_device(place):
                yield measured(f"single: {name}{label}", 1, "calls", call, check, 3 * repeats)


PARTS: dict[str, Callable[[Robot, int], Iterator[Row]]] = {
    "poses": poses,
    "sweep": sweep,
    "ik": ik,
    "statics": statics,
    "planning": planning,
    "training": training,
    "single": single,
}


def cells(row: Row) -> list[str]:
    """A row as text."""
    middle, low, high = spread(row.times)
    rate = row.count / middle
    return [
        row.what,
        f"{row.count:.3g} {row.unit}",
        f"{row.first:.2f}",
        f"{middle:.4g} ({low:.4g}-{high:.4g})",
        f"{rate:.3g}",
        row.check,
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="all of them by default")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="file for all times")
    options = parser.parse_args()
    robot = muxjax.load_robot("muxarm")
    rows = []
    for part in options.parts or PARTS:
        for row in PARTS[part](robot, options.repeats):
            rows.append(row)
            print(*cells(row), sep=", ", file=sys.stderr, flush=True)
    if options.json:
        options.json.write_text(json.dumps([row._asdict() for row in rows], indent=1))
    print(f"\n{device()}; seed {SEED}, MuxArm, {options.repeats} repeats or fewer\n")
    header = ["", "a call", "first call [s]", "then [s], median (quartiles)", "a second", "check"]
    print(table(header, [cells(row) for row in rows]))


if __name__ == "__main__":
    main()
