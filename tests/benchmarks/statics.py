"""Forward statics side by side: `python -m tests.benchmarks.statics --out docs/images`.

The paper's arm with 64 joints and eight tendons, random tensions in three mountings, one seed:
one solve and batches, from tension and from length, beside scipy's root finders on the same
compiled residual; the cost from 64 to 512 joints with its slope; the tip error of a discretised
rod against the reference cases by pitch. Wall times are those of all cores that are free.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import equinox as eqx
import jax
import numpy as np
from scipy.optimize import root

import muxjax
from muxjax.statics.chain import ElasticChain
from muxjax.statics.implicit import residual_of, tangent_of
from muxjax.statics.loads import Loads
from muxjax.viz.statics import draw_cost, draw_pitch
from tests.benchmarks.common import machine, rounds, spread, table
from tests.test_statics_cases import cases_of, disc_chain, tip_errors

SEED = 20260418
MOUNTINGS = 9.81 * np.array([[0.0, 0, 1], [1, 0, 0], [0, 0, -1]])
FEW = 10
PEER = "the reference project's C++ models take 7 to 200 ms a solve on such a machine"


def workload(chain: ElasticChain, n: int) -> dict[str, np.ndarray]:
    """Tensions [N] and gravity."""
    rng = np.random.default_rng(SEED)
    return {
        "tension": rng.uniform(0, 15, (n, chain.n_tendons)),
        "gravity": MOUNTINGS[np.arange(n) % 3],
    }


def by_scipy(chain: ElasticChain, loads: dict[str, np.ndarray], method: str) -> Callable[[], float]:
    """Share that a scipy root finder solves from the straight arm, with the exact Jacobian."""
    residual, tangent = eqx.filter_jit(residual_of), eqx.filter_jit(tangent_of)

    def run() -> float:
        solved = 0
        for tension, gravity in zip(loads["tension"][:FEW], loads["gravity"][:FEW], strict=True):
            rest = tension[:, None], Loads(gravity[:, None]), "virtual_work"
            found = root(
                lambda q, rest=rest: np.asarray(residual(chain, q[:, None], *rest)[:, 0]),
                np.zeros(chain.n_joints),
                method=method,
                jac=lambda q, rest=rest: np.asarray(tangent(chain, q[:, None], *rest)[..., 0]),
                options={"maxiter" if method == "lm" else "maxfev": 500},
            )
            solved += np.abs(found.fun).max() < 1e-8
        return solved / FEW

    return run


def wall(call: Callable[[], object], repeats: int = 30) -> tuple[float, float, float]:
    """Wall time of a warm call, median and quartiles [ms]."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return spread(times)


def cell(values: tuple[float, float, float], count: int = 1) -> str:
    """Median and quartiles [ms] of one out of ``count`` solves."""
    middle, low, high = (x / count for x in values)
    return f"{middle:.3f} ({low:.3f}-{high:.3f})"


def speed(n: int, n_rounds: int) -> str:
    """Solves of the 64-joint arm, and scipy beside them."""
    chain = muxjax.load_chain("hyper_redundant", resolution=32)
    loads = workload(chain, n)
    there = muxjax.forward_statics(chain, **loads)
    lengths = {"displacements": there.displacements, "gravity": loads["gravity"]}
    calls: dict[str, tuple[Callable[[], object], int, float]] = {}
    for kind, inputs in (("tension", loads), ("length", lengths)):
        first = {k: v[0] for k, v in inputs.items()}
        for name, given, count in (("one", first, 1), (f"batch of {n}", inputs, n)):
            solved = float(muxjax.forward_statics(chain, **given).converged.mean())
            calls[f"{name} from {kind}"] = (
                lambda given=given: muxjax.forward_statics(chain, **given),
                count,
                solved,
            )
    with jax.enable_x64(True):
        for method in ("hybr", "lm"):
            run = by_scipy(chain, loads, method)
            calls[f"scipy root {method}, {FEW} from tension"] = (run, FEW, run())
        cpu = rounds({name: call for name, (call, _, _) in calls.items()}, n_rounds)
        rows = []
        for name, (call, count, solved) in calls.items():
            took = wall(call, 30 if count == 1 else n_rounds)
            used = tuple(1e3 * x for x in spread(cpu[name]))
            rate = f"{1e3 * count / took[0]:.0f}"
            rows.append([name, cell(took, count), rate, cell(used, count), f"{100 * solved:.1f}"])
    header = ["64 joints, 8 tendons", "wall time a solve [ms]", "solves / s"]
    return table([*header, "CPU time a solve [ms]", "solved [%]"], rows)


def scaling(n_rounds: int, out: Path | None) -> str:
    """CPU time an iteration of a batch of 64, by the number of joints."""
    counts, cost, rows = (64, 128, 256, 512), [], []
    for joints in counts:
        chain = muxjax.load_chain("hyper_redundant", resolution=joints // 2)
        loads = workload(chain, 64)
        found = muxjax.forward_statics(chain, **loads)
        call = {"": lambda chain=chain, loads=loads: muxjax.forward_statics(chain, **loads)}
        took = spread(rounds(call, n_rounds)[""])[0]
        # All lanes of a batch iterate until the last one is done.
        cost.append(took / found.iterations.max())
        rows.append(
            [
                str(joints),
                f"{1e6 * cost[-1] / 64:.1f}",
                f"{found.iterations.max()}",
                f"{1e3 * took / 64:.3f}",
                f"{100 * found.converged.mean():.0f}",
            ]
        )
    if out is not None:
        draw_cost(counts, {"an iteration": np.array(cost) / 64}, out / "statics_cost.png")
    slope = np.polyfit(np.log(counts), np.log(cost), 1)[0]
    header = ["joints", "CPU us an iteration", "iterations", "CPU ms a solve", "solved [%]"]
    return f"{table(header, rows)}\n\nlog-log slope of an iteration {slope:.2f}"


def convergence(out: Path | None) -> str:
    """Tip errors against rods of the reference cases, by beads a segment."""
    rows, lines = [], {}
    with TemporaryDirectory() as folder:
        studies = {
            ("holes in every bead, robot B", "B", "cr"): {
                beads: muxjax.load_chain("tdcr_b", resolution=beads) for beads in (5, 10, 20, 40)
            },
            # The longer segment of robot C has nine discs.
            ("holes at the discs, robot C", "C", "sscr"): {
                9 * each: disc_chain("C", Path(folder), each) for each in (2, 4, 8)
            },
        }
    for (name, robot, model), chains in studies.items():
        errors = [tip_errors(chain, robot, model, cases_of(robot)) for chain in chains.values()]
        middle, worst = [float(np.median(e)) for e in errors], [float(e.max()) for e in errors]
        for beads, m, w in zip(chains, middle, worst, strict=True):
            rows.append([name, str(beads), f"{100 * m:.4f}", f"{100 * w:.4f}"])
        lines[f"{name}, median"] = ([*chains], middle)
        lines[f"{name}, worst"] = ([*chains], worst)
    if out is not None:
        draw_pitch(lines, out / "statics_pitch.png")
    return table(["chain", "beads a segment", "median tip error [% of length]", "worst"], rows)


def main() -> None:
    """Measure and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--solves", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, help="folder for statics_cost.png, statics_pitch.png")
    options = parser.parse_args()
    print(f"{machine()}\n\n{speed(options.solves, options.rounds)}\n\n{PEER}\n")
    print(f"{scaling(options.rounds, options.out)}\n\n{convergence(options.out)}")


if __name__ == "__main__":
    main()
