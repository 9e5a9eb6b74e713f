"""Planners side by side on fixed problems: quality, time and memory.

    python -m training.compare --out out/compare --nets checkpoints/muxarm.value

Every method meets the same problems, those of a file in the repository (``--draw`` made it). A
search starts without a known plan, so its cost is its own. "search" is a warm search; "with tables"
adds what is built for each problem before (bounds, pattern databases, the network's context). Gaps
are over the best bound that any method proved for the problem, and over the least cost that any
method found. Memory is the peak of what NumPy allocates, and the arrays that a compiled search
keeps, without its temporaries. What is measured is kept in a file a problem in the output folder,
and an interrupted comparison goes on.
"""

from __future__ import annotations

import json
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from math import inf, isfinite, nan
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float
from pydantic import Field

import muxjax
from muxjax.config import NotNegative, Positive, Strict, load_yaml
from muxjax.metrics.statistics import dominated_by, median_interval, spread
from muxjax.planning import METHODS, Plan, PlanningError, Problem
from muxjax.planning.beam import WIDEST, Beam
from muxjax.planning.checkpoint import CheckpointError, load_value
from muxjax.planning.exact import exact
from muxjax.planning.lattice import Lattice
from muxjax.planning.learned import learned_value
from muxjax.planning.replay import failed, replay
from muxjax.planning.value import ValueNet
from muxjax.robot import Robot
from training.policy import METHOD, Policy, load_policy
from training.problems import Regime, random_problem, read_problems, write_problems

_REPEATS = 4  # of a search; the fastest counts: what other work delays says nothing
_ENOUGH_MS = 1000.0  # after which no warm search is repeated
_WEIGHED = 2  # problems of a regime on which memory is measured, which takes long


class CompareConfig(Strict):
    """Regimes and budgets.

    Attributes:
        robot: Name of a shipped robot, or path of a YAML file.
        problems: File of the problems, beside this one.
        seed: By which they were drawn.
        regimes: Kinds of problems; their ``problems`` are how many.
        widths: Plans a level, by what orders and bounds the beam.
        widest: Regimes where no wider beam is tried.
        acting: Regimes in which policies act; others they were not trained for.
        baselines: Methods without a search.
        exact_gib: Memory of the exact planner [GiB]; where it needs more, it finds no plan.
        exact_gib_in: Instead, in regimes whose terms are slow, where a table of that size would
            take hours; at 0 it is left out.
        pairs: Methods, with their widths, whose costs are compared on the same problems.
    """

    file_schema: Literal["muxjax/compare/1"] = Field(alias="schema")
    robot: str
    problems: str
    seed: Annotated[int, Field(ge=0)]
    regimes: tuple[Regime, ...]
    widths: dict[str, tuple[Annotated[int, Field(ge=1)], ...]]
    widest: dict[str, Annotated[int, Field(ge=1)]] = Field(default_factory=dict)
    acting: tuple[str, ...] = ()
    baselines: tuple[str, ...]
    exact_gib: Positive
    exact_gib_in: dict[str, NotNegative] = Field(default_factory=dict)
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
        mib: Memory [MiB]; NaN where it was not measured.
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
    mib: float
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
        policies: Folders of trainings of policies, one for each seed.
        only: Regimes to run; all by default.
        guides: What orders the beam; all of the file by default.
        draw: Draw the problems and write their file, and nothing else.
    """

    config: Path = Path("configs/training/compare.yaml")
    out: Path = Path("out/compare")
    nets: tuple[str, ...] = ()
    policies: tuple[Path, ...] = ()
    only: tuple[str, ...] = ()
    guides: tuple[str, ...] = ()
    draw: bool = False


def main(options: Options) -> None:
    """Run what is missing, and write the tables."""
    config = load_yaml(CompareConfig, options.config)
    robot = muxjax.load_robot(config.robot)
    file = options.config.parent / config.problems
    if options.guides:
        widths = {name: config.widths[name] for name in options.guides}
        config = config.model_copy(update={"widths": widths})
    if options.draw:
        write_problems(file, robot, drawn_problems(robot, config))
        return
    problems = read_problems(file, robot)
    options.out.mkdir(parents=True, exist_ok=True)
    loaded = {name: load_value(name, robot) for name in options.nets}
    nets = {name: net for name, (net, _) in loaded.items()}
    policies = {str(folder): load_policy(folder) for folder in options.policies}
    records: list[Record] = []
    for regime in config.regimes:
        if options.only and regime.name not in options.only:
            continue
        acting = policies if regime.name in config.acting else {}
        for number, problem in enumerate(problems[regime.name]):
            kept = options.out / f"{regime.name}_{number:03d}.json"
            if kept.is_file():
                records += [Record(**row) for row in json.loads(kept.read_text())]
                continue
            found = [
                record(robot, problem, regime.name, number, *method)
                for method in methods(config, regime.name, nets, acting)
            ]
            kept.write_text(json.dumps([asdict(r) for r in found]))
            records += found
            print(f"{regime.name} {number + 1}/{regime.problems}", flush=True)
    spent = [header["about"]["cpu_s"] for _, header in loaded.values()]
    training_s = float(np.mean([sum(cpu_s.values()) for cpu_s in spent])) if spent else 0.0
    text = report(config, records, training_s)
    (options.out / "report.md").write_text(text)
    print(text)


def drawn_problems(robot: Robot, config: CompareConfig) -> dict[str, list[Problem]]:
    """Problems of every regime, from seeds that are none of the trainings'."""
    return {
        regime.name: [
            random_problem(robot, regime, np.random.default_rng([config.seed, r, number]))
            for number in range(regime.problems)
        ]
        for r, regime in enumerate(config.regimes)
    }


class Outcome(NamedTuple):
    """What a method gave."""

    plan: Plan
    search_ms: float
    arrays: int  # bytes that it keeps outside NumPy


Call = Callable[[Lattice], Outcome]


def methods(
    config: CompareConfig, regime: str, nets: dict[str, ValueNet], policies: dict[str, Policy]
) -> Iterator[tuple[str, str, Call]]:
    """Name, network and call of every method of the comparison."""
    widest = config.widest.get(regime, WIDEST)
    limit = int(config.exact_gib_in.get(regime, config.exact_gib) * 2**30)
    if limit:
        yield "exact", "", partial(_whole, partial(exact, memory_limit=limit))
    for name in config.baselines:
        yield name, "", partial(_whole, METHODS[name])
    for name, widths in config.widths.items():
        guides: dict[str, ValueNet | None] = {"": None}
        if name.startswith("network"):
            guides = dict(nets)
        heuristic = {"network": "count", "network and patterns": "patterns"}.get(name, name)
        for (net_name, net), width in product(guides.items(), widths):
            if width <= widest:
                yield f"{name} {width}", net_name, partial(_beam, heuristic, width, net)
    for name, policy in policies.items():
        yield f"{METHOD} {trained_in(Path(name))}", name, partial(_whole, partial(_acted, policy))


def trained_in(folder: Path) -> str:
    """What a policy's folder is called, without the last part of its name, which tells the seed."""
    return folder.name.rsplit("_", 1)[0]


def _whole(method: Callable[[Lattice], Plan], lattice: Lattice) -> Outcome:
    began = time.perf_counter()
    plan = method(lattice)
    return Outcome(plan, 1e3 * (time.perf_counter() - began), 0)


def _acted(policy: Policy, lattice: Lattice) -> Plan:
    return policy.plan(lattice.robot, lattice.problem)


def _beam(heuristic: str, width: int, net: ValueNet | None, lattice: Lattice) -> Outcome:
    beam = Beam(lattice, heuristic, None if net is None else learned_value(lattice, net))
    began = time.perf_counter()
    found = beam.search(width)
    milliseconds = 1e3 * (time.perf_counter() - began)
    if not found.length:
        plan = failed(lattice, method="beamstep", reason="none found", expansions=0)
        return Outcome(plan, milliseconds, 0)
    plan = replay(
        lattice,
        beam.steps(found),
        method="beamstep",
        lower_bound=min(float(found.cut_off), float(found.cost)),
        expansions=int(found.expansions),
    )
    arrays = jax.tree.leaves((beam.arrays, found, net))
    return Outcome(plan, milliseconds, sum(x.nbytes for x in arrays))


def record(
    robot: Robot, problem: Problem, regime: str, number: int, name: str, net: str, call: Call
) -> Record:
    """Run a method several times, each time anew, and keep its fastest search."""
    nothing = Record(regime, number, name, net, inf, 0.0, 0, nan, nan, nan, nan, 0, nan)
    search, total = list[float](), list[float]()
    while len(total) < _REPEATS and (len(total) < 2 or sum(total[1:]) < _ENOUGH_MS):
        began = time.perf_counter()
        try:
            outcome = call(Lattice(robot, problem))  # the first time it may compile
        except (PlanningError, CheckpointError):
            return nothing
        total.append(1e3 * (time.perf_counter() - began))
        search.append(outcome.search_ms)
    mib = nan
    if number < _WEIGHED:
        tracemalloc.start()
        outcome = call(Lattice(robot, problem))
        mib = (tracemalloc.get_traced_memory()[1] + outcome.arrays) / 2**20
        tracemalloc.stop()
    plan = outcome.plan
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
        mib,
        metrics.time_s,
        metrics.stages,
        float(overshoot),
    )


def report(config: CompareConfig, records: Sequence[Record], training_s: float = 0.0) -> str:
    """Tables of every regime, and paired differences.

    Args:
        config: Regimes and pairs.
        records: Of every regime.
        training_s: CPU time that a network took, labels included [s].
    """
    parts = []
    for regime in config.regimes:
        own = [r for r in records if r.regime == regime.name]
        if own:
            tables = [_table(own), _seeds(own), _pairs(config, own, training_s)]
            parts += [f"## {regime.name}", *filter(None, tables)]
    return "\n\n".join(parts) + "\n"


def by_method(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Records of each method that found plans, all networks together, in the order of the first."""
    found: dict[str, list[Record]] = defaultdict(list)
    for r in records:
        found[r.method].append(r)
    return found


def gaps(records: Sequence[Record]) -> dict[str, Float[np.ndarray, " n"]]:
    """Cost of each method over the least known one of the same problem, where it has a plan [%]."""
    best = _least_costs(records)
    return {
        name: np.array([100 * (r.cost / best[r.number] - 1) for r in rows if isfinite(r.cost)])
        for name, rows in by_method(records).items()
    }


def _least_costs(records: Sequence[Record]) -> dict[int, float]:
    """By number of the problem."""
    best: dict[int, float] = defaultdict(lambda: inf)
    for r in records:
        best[r.number] = min(best[r.number], r.cost)
    return best


def medians(records: Sequence[Record]) -> dict[str, tuple[float, float]]:
    """Time with tables [ms] and gap [%] of each method that solves all problems."""
    over = gaps(records)
    return {
        name: (float(np.median([r.total_ms for r in rows])), float(np.median(over[name])))
        for name, rows in by_method(records).items()
        if len(over[name]) == len(rows)
    }


def front(records: Sequence[Record]) -> list[str]:
    """Methods that solve all problems, with none of them both quicker and better in the median."""
    points = medians(records)
    return [name for name in points if not dominated_by(name, points)]


def _table(records: Sequence[Record]) -> str:
    bound: dict[int, float] = defaultdict(float)
    for r in records:
        bound[r.number] = max(bound[r.number], r.bound)
    ahead, over = front(records), gaps(records)
    header = "method | solved [%] | over the best known [%] | over the best bound [%] | expanded | "
    header += "search [ms] | with tables [ms] | memory [MiB] | T [s] | stages | overshoot [% of T]"
    lines = [f"| {header} |", "| " + " | ".join(["---"] * 11) + " |"]
    for name, rows in by_method(records).items():
        found = [r for r in rows if isfinite(r.cost)]
        if not found:
            lines.append(f"| {name} | 0 |" + " - |" * 9)
            continue
        columns: list[Sequence[float] | np.ndarray] = [
            over[name],
            [100 * (r.cost / bound[r.number] - 1) for r in found],
            [r.expansions for r in found],
            [r.search_ms for r in found],
            [r.total_ms for r in found],
            [r.mib for r in found if isfinite(r.mib)] or [nan],
            [r.time_s for r in found],
            [r.stages for r in found],
            [r.overshoot for r in found],
        ]
        digits = (2, 1, 0, 2, 1, 1, 1, 0, 1)
        cells = [
            "{:.{d}f} ({:.{d}f})".format(*spread(np.array(column, float)), d=d)
            if np.isfinite(column).all()
            else "-"
            for column, d in zip(columns, digits, strict=True)
        ]
        shown = f"**{name}**" if name in ahead else name
        solved = f"{100 * len(found) / len(rows):.0f}"
        lines.append(f"| {shown} | {solved} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _seeds(records: Sequence[Record]) -> str:
    """Median gap of each network, or policy, at each width."""
    over = {(r.method, r.net): list[float]() for r in records if r.net}
    names = sorted({net for _, net in over})
    if len(names) < 2:
        return ""
    best = _least_costs(records)
    for r in records:
        if r.net and isfinite(r.cost):
            over[r.method, r.net].append(100 * (r.cost / best[r.number] - 1))
    lines = ["| method | over the best known [%], one training each |", "| --- | --- |"]
    for method in dict.fromkeys(method for method, _ in over):
        found = [np.median(over[key]) for key in over if key[0] == method and over[key]]
        lines.append(f"| {method} | " + ", ".join(f"{m:.2f}" for m in found) + " |")
    return "\n".join(lines)


def _pairs(config: CompareConfig, records: Sequence[Record], training_s: float) -> str:
    """One method against another on the same problems, a network's seeds averaged."""
    costs: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    times: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for r in records:
        if isfinite(r.cost):
            costs[r.method][r.number].append(r.cost)
            times[r.method][r.number].append(r.total_ms)
    lines = [
        "| ours | theirs | problems | cost, ours over theirs [%] | time, theirs over ours "
        "| plans until trained for |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for ours, theirs in config.pairs:
        both = sorted(set(costs[ours]) & set(costs[theirs]))
        if not both:
            continue
        ratio = [100 * (np.mean(costs[ours][n]) / np.mean(costs[theirs][n]) - 1) for n in both]
        quicker = [np.mean(times[theirs][n]) / np.mean(times[ours][n]) for n in both]
        saved = 1e-3 * np.mean([np.mean(times[theirs][n]) - np.mean(times[ours][n]) for n in both])
        learned = ours.startswith("network") and training_s > 0 and saved > 0
        cells = [
            "{:.2f} [{:.2f}, {:.2f}]".format(*median_interval(np.array(ratio))),
            "{:.1f} [{:.1f}, {:.1f}]".format(*median_interval(np.array(quicker))),
            f"{training_s / saved:.0f}" if learned else "-",
        ]
        lines.append(f"| {ours} | {theirs} | {len(both)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main(tyro.cli(Options))
