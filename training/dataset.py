"""Labelled decisions: states, some of their actions, and what each of these costs to the end.

A decision is a state and K of its actions. Of every action the data hold the features of the state
after it, the admissible count there, the cost of the step and the cost to go, costs over the
problem's scale. Shards are made in parallel, each from its own seed; one that lies there already is
kept, so an interrupted run goes on. The manifest tells how they were made, with their hashes.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

import muxjax
from muxjax.config import replacing
from muxjax.planning.beamstep import beamstep
from muxjax.planning.bounds import bound_of
from muxjax.planning.exact import DEFAULT_MEMORY
from muxjax.planning.lattice import Lattice
from muxjax.planning.learned import learned_value
from muxjax.planning.problem import COLLISION, Problem
from muxjax.planning.search import States
from muxjax.planning.table import Choices, solved_table
from muxjax.planning.value import FEATURES, Context, ValueNet, context_of, features
from muxjax.planning.world import Clearance, Collision
from muxjax.robot import Robot
from training.problems import Regime, random_problem

ACTIONS = 8  # of a decision: the best ones, and others at random
_WANDER = 0.3  # share of random steps of the walks on which states are met
_ABREAST = 16  # walks side by side, where many decisions are cheap


class Decisions(NamedTuple):
    """Arrays with a row a decision; missing actions have no ``exists``."""

    features: Float[np.ndarray, "D K F"]  # half precision
    bound: Float[np.ndarray, "D K"]  # admissible, without patterns, after the action
    step: Float[np.ndarray, "D K"]  # cost of the action
    to_go: Float[np.ndarray, "D K"]  # from the state after it
    arrived: Any  # (D, K): that state is the target
    exists: Any  # (D, K)
    labelled: Any  # (D, K): to_go is known; else only that the action is no better than the first


class _Free(eqx.Module):
    """An expensive term that is asked about every step: a table of all states needs it anyway."""

    term: Any
    expensive: ClassVar[bool] = False

    def __call__(self, robot: Robot, t: Any) -> Any:
        return self.term(robot, t)


def _asked(problem: Problem) -> Problem:
    """The problem with its obstacles' terms asked about every step."""
    if problem.world is None:
        return problem
    terms = {COLLISION: _Free(Collision(problem.world))}
    if "clearance" in problem.cost_weights:
        terms["clearance"] = _Free(Clearance(problem.world))
    weights = {k: v for k, v in problem.cost_weights.items() if k != COLLISION}
    return replace(problem, weights=weights, terms={**problem.terms, **terms})


def exact_decisions(
    lattice: Lattice, count: int, rng: np.random.Generator
) -> Iterator[tuple[Choices, np.ndarray]]:
    """Actions of states on walks that mostly follow the optimum; their cost to go is exact."""
    table = solved_table(lattice, DEFAULT_MEMORY, whole=True)
    made = 0
    for _ in range(count):  # walks; one is at least a decision, or there is none to make
        remaining, stop, first = lattice.steps, lattice.start_stop, True
        while remaining.any():
            choices = table.choices(remaining, stop, first=first)
            possible = np.flatnonzero(np.isfinite(choices.cost))
            if made == count or not len(possible):
                break
            if len(possible) > 1:
                made += 1
                yield choices, remaining
            best = int(np.argmin(choices.cost + choices.to_go))
            wanders = rng.random() < _WANDER or not np.isfinite(choices.to_go[best])
            chosen = int(rng.choice(possible)) if wanders else best
            remaining, stop = remaining - choices.moves[chosen], int(choices.stop[chosen])
            first = False


def bounded_decisions(
    lattice: Lattice, count: int, rng: np.random.Generator
) -> Iterator[tuple[Choices, np.ndarray]]:
    """Actions of states on walks that follow the full bound, more or less, which is their label."""
    bound, (stops, _) = bound_of(lattice), lattice.actions
    remaining = np.repeat(lattice.steps[None], _ABREAST, axis=0)
    stop, first = np.full(_ABREAST, lattice.start_stop), True
    wander = rng.uniform(0.0, 2 * _WANDER, _ABREAST)
    rows: list[tuple[Choices, np.ndarray]] = []
    while len(remaining):
        possible, moves = lattice.expand(remaining)
        walk, action = np.nonzero(possible)
        made, at = moves[walk, action], stops[action]
        cost = _price(lattice, remaining[walk], made, at == stop[walk], first)
        to_go = bound(remaining[walk] - made, at)
        through = np.full(possible.shape, np.inf)
        through[walk, action] = cost + to_go
        taken = np.argmin(through, axis=1)
        chances = np.where(np.isfinite(through), rng.random(through.shape), np.inf)
        taken = np.where(rng.random(len(taken)) < wander, np.argmin(chances, axis=1), taken)
        for k, here in enumerate(remaining):
            own = walk == k
            if own.sum() > 1:
                rows.append((Choices(at[own], made[own], cost[own], to_go[own]), here))
        remaining = remaining - moves[np.arange(len(taken)), taken]
        goes_on = remaining.any(axis=1)
        remaining, stop, wander = remaining[goes_on], stops[taken][goes_on], wander[goes_on]
        first = False
    return (rows[i] for i in np.sort(rng.permutation(len(rows))[:count]))


def searched_decisions(
    lattice: Lattice, width: int, net: ValueNet | None, rng: np.random.Generator
) -> Iterator[tuple[Choices, np.ndarray]]:
    """Actions along the best plan of a beam: its own with what is left of its cost, and others."""
    if net is None:
        found = beamstep(lattice, width=width)
    else:  # the bound certifies, the network orders
        value = learned_value(lattice, net)
        found = beamstep(lattice, width=width, value_fn=value)
    if found.status == "failed":
        return
    left = lattice.remaining(found.displacements)
    moved = left[:-1] - left[1:]
    stop = lattice.stop_of_axial[found.axial - 1]
    before = np.append(lattice.start_stop, stop[:-1])
    first = np.arange(len(moved)) == 0
    cost = np.concatenate(
        [
            _price(
                lattice, left[k : k + 1], moved[k : k + 1], stop[k : k + 1] == before[k], first[k]
            )
            for k in range(len(moved))
        ]
    )
    to_go = np.append(np.cumsum(cost[::-1])[::-1][1:], 0.0)
    stops, _ = lattice.actions
    for k, here in enumerate(left[:-1]):
        possible, moves = lattice.expand(here[None])
        same = (stops == stop[k]) & (moves[0] == moved[k]).all(axis=-1)
        others = rng.permutation(np.flatnonzero(possible[0] & ~same))[: ACTIONS - 1]
        states = np.repeat(here[None], len(others), axis=0)
        price = _price(lattice, states, moves[0, others], stops[others] == before[k], first[k])
        yield (
            Choices(
                np.append(stop[k], stops[others]),
                np.concatenate([moved[k : k + 1], moves[0, others]]),
                np.append(cost[k], price),
                np.append(to_go[k], np.full(len(others), np.nan)),
            ),
            here,
        )


def _price(
    lattice: Lattice, remaining: np.ndarray, moves: np.ndarray, stays: np.ndarray, first: bool
) -> Float[np.ndarray, " N"]:
    both = lattice.costs(remaining, moves, first=bool(first))
    both = both + lattice.costs(remaining, moves, first=bool(first), expensive=True)
    return np.where(stays, both[:, 0], both[:, 1])


def decisions_of(
    robot: Robot,
    problem: Problem,
    regime: Regime,
    *,
    width: int,
    net: ValueNet | None,
    rng: np.random.Generator,
) -> Decisions | None:
    """Labelled decisions of one problem; None where it has no plan, or nothing to decide."""
    lattice = Lattice(robot, _asked(problem) if regime.labels == "exact" else problem)
    if regime.labels == "exact":
        rows = list(exact_decisions(lattice, regime.decisions, rng))
    elif regime.labels == "bound":
        rows = list(bounded_decisions(lattice, regime.decisions, rng))
    else:
        rows = list(searched_decisions(lattice, width, net, rng))
        rows = [rows[i] for i in np.sort(rng.permutation(len(rows))[: regime.decisions])]
    if not rows:
        return None
    shape = (len(rows), ACTIONS)
    stop, remaining = np.full(shape, -1), np.zeros((*shape, robot.n_tendons), dtype=int)
    step, to_go = np.full(shape, np.inf), np.full(shape, np.inf)
    for row, (choices, here) in enumerate(rows):
        kept = _kept(choices, rng)
        n = len(kept)
        stop[row, :n], remaining[row, :n] = choices.stop[kept], here - choices.moves[kept]
        step[row, :n], to_go[row, :n] = choices.cost[kept], choices.to_go[kept]
    context = context_of(Lattice(robot, problem))
    inputs, bound = features_of(robot, context, remaining.reshape(-1, robot.n_tendons), stop)
    exists, labelled = np.isfinite(step), np.isfinite(step + to_go)
    scale = float(context.scale)
    return Decisions(
        features=inputs.astype(np.float16).reshape(*shape, -1),
        bound=(bound / scale).astype(np.float32).reshape(shape),
        step=np.where(exists, step / scale, 0.0).astype(np.float32),
        to_go=np.where(labelled, to_go / scale, 0.0).astype(np.float32),
        arrived=~remaining.any(axis=-1),
        exists=exists,
        labelled=labelled,
    )


def _kept(choices: Choices, rng: np.random.Generator) -> np.ndarray:
    """Some of the possible actions, the best one first."""
    through = np.nan_to_num(choices.cost + choices.to_go, nan=np.inf)
    order = np.argsort(through, kind="stable")
    order = order[np.isfinite(choices.cost[order])]
    if len(order) <= ACTIONS:
        return order
    return np.append(order[:3], rng.permutation(order[3:])[: ACTIONS - 3])


def features_of(
    robot: Robot, context: Context, remaining: np.ndarray, stop: np.ndarray
) -> tuple[Float[np.ndarray, "N F"], Float[np.ndarray, " N"]]:
    """Features and admissible counts of states, on the host."""
    n, size = len(remaining), 512
    while size < n:
        size *= 2
    states = np.zeros((size, robot.n_tendons), np.int32)
    states[:n] = remaining
    stops = np.full(size, -1, np.int32)
    stops[:n] = stop.reshape(-1)
    with jax.enable_x64(True):
        inputs, count = _features(robot, context, states, stops)
        return np.asarray(inputs)[:n], np.asarray(count)[:n]


@eqx.filter_jit
def _features(robot: Robot, context: Context, remaining: Any, stop: Any) -> tuple[Any, Any]:
    count = context.bound(context.lattice, remaining, stop)
    at = context.lattice.displacements(remaining)
    states = States(at, remaining, stop, context.lattice.axial[stop], count)
    return features(robot, context, states, count), count


class _Task(NamedTuple):
    """A shard to make, in another process."""

    path: Path
    robot: str
    regime: Regime
    width: int
    seed: tuple[int, ...]
    problems: int
    net: ValueNet | None


def make_shards(
    folder: Path,
    robot: str,
    regimes: tuple[Regime, ...],
    *,
    seed: int,
    width: int,
    net: ValueNet | None = None,
    workers: int | None = None,
    shard: int = 50,
) -> None:
    """Label the problems of the regimes into a folder; shards that lie there are kept.

    Args:
        folder: Of the shards and their manifest.
        robot: Name of a shipped robot, or path of a YAML file.
        regimes: Kinds of problems.
        seed: Of everything that is drawn.
        width: Of the beam that labels by search.
        net: Its order, if not that of the bound.
        workers: Processes; one for each core by default.
        shard: Problems in a shard.

    Raises:
        ValueError: The folder holds data of another robot, configuration or seed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    about = {
        "schema": "muxjax/data/1",
        "features": FEATURES,
        "robot": robot,
        "fingerprint": muxjax.load_robot(robot).fingerprint,
        "regimes": [regime.model_dump() for regime in regimes],
        "seed": seed,
        "width": width,
        "net": None if net is None else digest_of(net),
    }
    manifest = folder / "manifest.json"
    if manifest.is_file():
        known = json.loads(manifest.read_text())
        differs = [k for k, v in json.loads(json.dumps(about)).items() if known.get(k) != v]
        if differs:
            raise ValueError(
                f"{folder}: holds data with another {', '.join(differs)}; take another folder"
            )
    else:
        manifest.write_text(
            json.dumps({**about, "commit": commit(), "cpu_s": 0.0, "shards": {}}, indent=1)
        )
    tasks = [
        _Task(folder / f"{regime.name}_{k:04d}.npz", robot, regime, width, (seed, r, k), n, net)
        for r, regime in enumerate(regimes)
        for k, n in enumerate(_sizes(regime.problems, shard))
    ]
    open_tasks = [task for task in tasks if not task.path.is_file()]
    began, done = time.monotonic(), len(tasks) - len(open_tasks)
    # Spawned: a fork would inherit the threads of the compiler.
    with ProcessPoolExecutor(workers or os.cpu_count(), get_context("spawn")) as pool:
        for future in as_completed([pool.submit(_make, task) for task in open_tasks]):
            name, decisions, cpu_s = future.result()
            done += 1
            seconds = time.monotonic() - began
            print(f"{done}/{len(tasks)} {name}: {decisions} decisions, {seconds:.0f} s", flush=True)
            known = json.loads(manifest.read_text())
            known["cpu_s"] = round(known["cpu_s"] + cpu_s, 1)
            manifest.write_text(json.dumps(known, indent=1))
    shards = {task.path.name: _digest(task.path) for task in tasks}
    manifest.write_text(
        json.dumps({**json.loads(manifest.read_text()), "shards": shards}, indent=1)
    )


def _sizes(problems: int, shard: int) -> list[int]:
    return [min(shard, problems - i) for i in range(0, problems, shard)]


def _make(task: _Task) -> tuple[str, int, float]:
    began = time.process_time()
    # Every process would compile the same searches anew, for minutes.
    jax.config.update("jax_compilation_cache_dir", str(task.path.parent / "compiled"))
    robot = muxjax.load_robot(task.robot)
    parts = []
    for number in range(task.problems):
        rng = np.random.default_rng([*task.seed, number])
        problem = random_problem(robot, task.regime, rng)
        part = decisions_of(robot, problem, task.regime, width=task.width, net=task.net, rng=rng)
        if part is not None:
            parts.append(part)
    whole = Decisions(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    with replacing(task.path) as beside:
        np.savez(beside, **whole._asdict())
    return task.path.name, len(whole.bound), time.process_time() - began


def load_decisions(folder: Path, names: list[str] | None = None) -> Decisions:
    """Shards of a folder, all by default.

    Raises:
        ValueError: No manifest, or a shard is missing or altered.
    """
    digests = shards_of(folder)
    parts = []
    for name in sorted(digests) if names is None else names:
        path = folder / name
        if not path.is_file() or _digest(path) != digests[name]:
            raise ValueError(f"{path}: missing or altered; delete it and make the data again")
        with np.load(path) as arrays:
            parts.append(Decisions(**arrays))
    return Decisions(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def shards_of(folder: Path) -> dict[str, str]:
    """Digests of a folder's shards by name.

    Raises:
        ValueError: No manifest, or one of data that are not complete.
    """
    manifest = folder / "manifest.json"
    shards = json.loads(manifest.read_text())["shards"] if manifest.is_file() else {}
    if not shards:
        raise ValueError(f"{folder}: holds no complete data")
    return dict(shards)


def label_seconds(folder: Path) -> float:
    """CPU time that the labels of a folder took [s]."""
    return float(json.loads((folder / "manifest.json").read_text())["cpu_s"])


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def digest_of(net: ValueNet) -> str:
    """Short hash of a network's arrays."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(net):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]


def commit() -> str:
    """Commit of the checkout, or "unknown" outside one."""
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return found.stdout.strip()
