"""``python -m tests.campaigns --runs 10000 --seed 0 [--workers 2] [--replay SEED]``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

import muxjax
from tests.campaigns.campaign import Verdict, play, run
from tests.campaigns.scenario import draw

CHUNK = 25


def played(first: int, runs: int, workers: int) -> Iterator[tuple[list[Verdict], float]]:
    """The same for many seeds, in several processes."""
    chunks = [range(k, min(k + CHUNK, first + runs)) for k in range(first, first + runs, CHUNK)]
    if workers == 1:
        yield from map(play, chunks)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(play, chunks)


def report(verdicts: list[Verdict], cpu: float) -> str:
    """The campaign in a few lines."""
    endings = Counter(v.ending for v in verdicts)
    bad = [v for v in verdicts if v.offences]
    done = [v for v in verdicts if v.ending == "completed"]
    lines = [
        f"{len(verdicts) - len(bad)} of {len(verdicts)} runs without an offence: "
        + ", ".join(f"{n} {ending}" for ending, n in sorted(endings.items())),
        f"{sum(v.simulated_s for v in verdicts):.0f} s simulated in {cpu:.0f} s of CPU time, "
        f"{cpu / len(verdicts):.2f} s a run",
    ]
    if done:
        measured, true = (
            np.array([getattr(v, name) for v in done]) for name in ("measured_mm", "true_mm")
        )
        lines.append(
            f"completed: wheels within {measured.max():.4f} mm of their goals as measured, true "
            f"lengths within {true.max():.4f} mm (median {np.median(true):.4f} mm)"
        )
    return "\n".join(lines)


def tell(verdict: Verdict) -> None:
    """A line for a run with an offence."""
    if verdict.offences:
        print(f"seed {verdict.seed}: {'; '.join(verdict.offences)} [{verdict.reason}]", flush=True)


def replay(seed: int) -> int:
    """One run alone, with all that is known of it."""
    robot = muxjax.load_robot("muxarm")
    scenario = draw(robot, seed)
    print(f"kills {scenario.kills}, axial {scenario.axial}, divider {scenario.stream_divider}")
    print(scenario.physics.bus)
    for fault in scenario.faults:
        print(fault)
    verdict = run(robot, scenario)
    print("\n".join(verdict.steps))
    tell(verdict)
    print(report([verdict], 0.0))
    return len(verdict.offences)


def main() -> int:
    """Run a campaign; the exit status is 0 if every run was safe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first run; the next has 1 more")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--replay", type=int, help="play one seed alone and tell all about it")
    options = parser.parse_args()
    if options.replay is not None:
        return min(replay(options.replay), 1)
    verdicts: list[Verdict] = []
    cpu = 0.0
    for some, took in played(options.seed, options.runs, options.workers):
        verdicts += some
        cpu += took
        for verdict in some:
            tell(verdict)
        print(f"\r{len(verdicts)} of {options.runs} runs", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    print(report(verdicts, cpu))
    return int(any(v.offences for v in verdicts))


if __name__ == "__main__":
    sys.exit(main())
