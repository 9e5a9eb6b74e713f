"""Planners side by side on fixed problems: quality, time and memory.

    python -m training.compare --out out/compare --nets checkpoints/muxarm.value

Every method meets the same problems. A search starts without a known plan, so its cost is its own.
"ms" is a warm search; "with tables" adds what is built for each problem before (bounds, pattern
databases, the network's context). Gaps are over the best bound that any method proved for the
problem, and over the least cost that any method found. What is measured is kept in a file a problem
in the output folder, and an interrupted comparison goes on.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from math import inf, isfinite, nan
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from pydantic import Field

import muxjax
from muxjax.config import Strict, load_yaml
from muxjax.metrics.statistics import median_interval, spread
from muxjax.planning import METHODS, Plan, PlanningError, Problem
from muxjax.planning.beam import Beam
from muxjax.planning.checkpoint import load_value
from muxjax.planning.exact import exact
from muxjax.planning.lattice import Lattice
from muxjax.planning.learned import learned_value
from muxjax.planning.replay import failed, replay
from muxjax.planning.value import ValueNet
from muxjax.robot import Robot
from training.problems import Regime, random_problem

_REPEATS = 3  # of a warm search; the fastest counts, what other work delays says nothing


class CompareConfig(Strict):
    """Regimes and budgets.

    Attributes:
        robot: Name of a shipped robot, or path of a YAML file.
        seed: Of the problems.
        regimes: Kinds of problems; their ``problems`` are how many.
        widths: Plans a level, by what orders and bounds the beam.
        baselines: Methods without a search.
        exact_gib: Memory of the exact planner [GiB]; where it needs more, it is left out.
        pairs: Methods, with their widths, whose costs are compared on the same problems.
    """

    file_schema: Literal["muxjax/compare/1"] = Field(alias="schema")
    robot: str
    seed: Annotated[int, Field(ge=0)]
    regimes: tuple[Regime, ...]
    widths: dict[str, tuple[Annotated[int, Field(ge=1)], ...]]
    baselines: tuple[str, ...]
    exact_gib: Annotated[float, Field(gt=0)]
    pairs: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Record:
    """One method on one problem.

    Attributes:
        regime: Of the problem.
        number: Of the problem, within its regime.
        method: And its width.
        net: Which network, or "".
        cost: Of the plan; infinite where none was found.
        bound: Certified lower bound.
        expansions: States whose steps were evaluated.
        search_ms: Of the warm search, wall time.
        total_ms: With what is built for the problem before.
        time_s: T of the program (M Eq. 14).
        stages: Instructions.
        overshoot: Greatest share of T above the final bending of any segment [%].
    """

    regime: str
    number: int
    method: str
    net: str
    cost: float
    bound: float
    expansions: int
    search_ms: float
    total_ms: float
    time_s: float
    stages: int
    overshoot: float


@dataclass
class Options:
    """Command line.

    Attributes:
        config: Regimes and budgets.
        out: Folder of the records, the tables and the picture.
        nets: Checkpoints, one for each seed of the training.
        only: Regimes to run; all by default.
    """

    config: Path = Path("configs/training/compare.yaml")
    out: Path = Path("out/compare")
    nets: tuple[str, ...] = ()
    only: tuple[str, ...] = ()


def main(options: Options) -> None:
    """Run what is missing, and write the tables."""
    config = load_yaml(CompareConfig, options.config)
    robot = muxjax.load_robot(config.robot)
    options.out.mkdir(parents=True, exist_ok=True)
    nets = {name: load_value(name, robot)[0] for name in options.nets}
    records: list[Record] = []
    for regime in config.regimes:
        if options.only and regime.name not in options.only:
            continue
        for number in range(regime.problems):
            kept = options.out / f"{regime.name}_{number:03d}.json"
            if kept.is_file():
                records += [Record(**row) for row in json.loads(kept.read_text())]
                continue
            problem = fixed_problem(robot, config, regime, number)
            found = [
                record(robot, problem, regime.name, number, *method)
                for method in methods(config, nets)
            ]
            kept.write_text(json.dumps([asdict(r) for r in found]))
            records += found
            print(f"{regime.name} {number + 1}/{regime.problems}", flush=True)
    text = report(config, records)
    (options.out / "report.md").write_text(text)
    print(text)


def fixed_problem(robot: Robot, config: CompareConfig, regime: Regime, number: int) -> Problem:
    """A problem of the comparison; its seed is none of the training's."""
    names = [r.name for r in config.regimes]
    return random_problem(
        robot, regime, np.random.default_rng([config.seed, names.index(regime.name), number])
    )


Call = Callable[[Lattice], tuple[Plan, float]]  # the plan, and the milliseconds of its search


def methods(config: CompareConfig, nets: dict[str, ValueNet]) -> Iterator[tuple[str, str, Call]]:
    """Name, network and call of every method of the comparison."""
    limit = int(config.exact_gib * 2**30)
    yield "exact", "", partial(_whole, partial(exact, memory_limit=limit))
    for name in config.baselines:
        yield name, "", partial(_whole, METHODS[name])
    for name, widths in config.widths.items():
        guides: dict[str, ValueNet | None] = {"": None}
        if name.startswith("network"):
            guides = dict(nets)
        heuristic = {"network": "count", "network and patterns": "patterns"}.get(name, name)
        for (net_name, net), width in product(guides.items(), widths):
            yield f"{name} {width}", net_name, partial(_beam, heuristic, width, net)


def _whole(method: Callable[[Lattice], Plan], lattice: Lattice) -> tuple[Plan, float]:
    began = time.perf_counter()
    plan = method(lattice)
    return plan, 1e3 * (time.perf_counter() - began)


def _beam(heuristic: str, width: int, net: ValueNet | None, lattice: Lattice) -> tuple[Plan, float]:
    beam = Beam(lattice, heuristic, None if net is None else learned_value(lattice, net))
    began = time.perf_counter()
    found = beam.search(width)
    milliseconds = 1e3 * (time.perf_counter() - began)
    if not found.length:
        return failed(lattice, method="beamstep", reason="none found", expansions=0), milliseconds
    plan = replay(
        lattice,
        beam.steps(found),
        method="beamstep",
        lower_bound=min(float(found.cut_off), float(found.cost)),
        expansions=int(found.expansions),
    )
    return plan, milliseconds


def record(
    robot: Robot, problem: Problem, regime: str, number: int, name: str, net: str, call: Call
) -> Record:
    """Run a method several times, each time anew, and keep its fastest search."""
    nothing = Record(regime, number, name, net, inf, 0.0, 0, nan, nan, nan, 0, nan)
    try:
        call(Lattice(robot, problem))  # compiles
    except PlanningError:
        return nothing
    search, total = [], []
    for _ in range(_REPEATS):
        began = time.perf_counter()
        plan, milliseconds = call(Lattice(robot, problem))
        total.append(1e3 * (time.perf_counter() - began))
        search.append(milliseconds)
    if plan.status == "failed":
        return nothing
    metrics = muxjax.evaluate(robot, muxjax.schedule(robot, plan))
    overshoot = 100 * max(metrics.overshoot_duration)
    return Record(
        regime,
        number,
        name,
        net,
        plan.cost,
        plan.lower_bound,
        plan.expansions,
        min(search),
        min(total),
        metrics.time_s,
        metrics.stages,
        float(overshoot),
    )


def report(config: CompareConfig, records: Sequence[Record]) -> str:
    """Tables of every regime, and paired differences."""
    parts = []
    for regime in config.regimes:
        own = [r for r in records if r.regime == regime.name]
        if own:
            parts += [f"## {regime.name}", _table(own), _pairs(config, own)]
    return "\n\n".join(parts) + "\n"


def _table(records: list[Record]) -> str:
    bound: dict[int, float] = defaultdict(float)
    best: dict[int, float] = defaultdict(lambda: inf)
    for r in records:
        bound[r.number] = max(bound[r.number], r.bound)
        best[r.number] = min(best[r.number], r.cost)
    by_method: dict[str, list[Record]] = defaultdict(list)
    for r in records:
        by_method[r.method].append(r)
    header = "method | solved [%] | over the best known [%] | over the best bound [%] | expanded | "
    header += "search [ms] | with tables [ms] | T [s] | stages | overshoot [% of T]"
    lines = [f"| {header} |", "| " + " | ".join(["---"] * 10) + " |"]
    for name, rows in by_method.items():
        found = [r for r in rows if isfinite(r.cost)]
        if not found:
            lines.append(f"| {name} | 0 |" + " - |" * 8)
            continue
        columns: list[list[float]] = [
            [100 * (r.cost / best[r.number] - 1) for r in found],
            [100 * (r.cost / bound[r.number] - 1) for r in found],
            [r.expansions for r in found],
            [r.search_ms for r in found],
            [r.total_ms for r in found],
            [r.time_s for r in found],
            [r.stages for r in found],
            [r.overshoot for r in found],
        ]
        digits = (2, 1, 0, 2, 1, 1, 0, 1)
        cells = [
            "{:.{d}f} ({:.{d}f})".format(*spread(np.array(column, float)), d=d)
            for column, d in zip(columns, digits, strict=True)
        ]
        lines.append(f"| {name} | {100 * len(found) / len(rows):.0f} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _pairs(config: CompareConfig, records: list[Record]) -> str:
    """Cost of one method over that of another on the same problem, a network's seeds averaged."""
    costs: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for r in records:
        if isfinite(r.cost):
            costs[r.method][r.number].append(r.cost)
    lines = [
        "| ours | theirs | problems | cost, ours over theirs [%] |",
        "| --- | --- | --- | --- |",
    ]
    for ours, theirs in config.pairs:
        both = sorted(set(costs[ours]) & set(costs[theirs]))
        if not both:
            continue
        ratio = [100 * (np.mean(costs[ours][n]) / np.mean(costs[theirs][n]) - 1) for n in both]
        middle, low, high = median_interval(np.array(ratio))
        lines.append(f"| {ours} | {theirs} | {len(both)} | {middle:.2f} [{low:.2f}, {high:.2f}] |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Options))
