"""Forward statics side by side: `python -m tests.benchmarks.statics [--solves 256]`.

The paper's arm with 64 joints and eight tendons, random tensions in three mountings, one seed:
one solve and batches, from tension and from length, beside scipy's root finders on the same
compiled residual; the cost from 64 to 512 joints with its slope; the tip error of a discretised
rod against the reference cases by pitch. Wall time for one solve, CPU time for batches.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from scipy.optimize import root

import muxjax
from muxjax.statics.chain import ElasticChain
from muxjax.statics.implicit import residual_of, tangent_of
from muxjax.statics.loads import Loads
from tests.benchmarks.common import machine, rounds, spread, table
from tests.test_statics_cases import cases_of, tip_errors

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


def one(call: Callable[[], object], repeats: int = 30) -> float:
    """Median wall time of a warm call [ms]."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return float(np.median(times))


def speed(n: int, n_rounds: int) -> str:
    """Solves of the 64-joint arm, and scipy beside them."""
    chain = muxjax.load_chain("hyper_redundant", resolution=32)
    loads = workload(chain, n)
    gravity = loads["gravity"]
    there = muxjax.forward_statics(chain, **loads)
    lengths = {"displacements": there.displacements, "gravity": gravity}
    first = {k: v[0] for k, v in loads.items()}
    first_length = {k: v[0] for k, v in lengths.items()}
    rows = [
        [
            "one solve from tension, wall",
            f"{one(lambda: muxjax.forward_statics(chain, **first)):.2f} ms",
            "",
            "",
        ],
        [
            "one solve from length, wall",
            f"{one(lambda: muxjax.forward_statics(chain, **first_length)):.2f} ms",
            "",
            "",
        ],
    ]
    contestants: dict[str, tuple[Callable[[], object], int, Callable[[], float]]] = {
        f"batch of {n} from tension": (
            lambda: muxjax.forward_statics(chain, **loads),
            n,
            lambda: float(there.converged.mean()),
        ),
        f"batch of {n} from length": (
            lambda: muxjax.forward_statics(chain, **lengths),
            n,
            lambda: float(muxjax.forward_statics(chain, **lengths).converged.mean()),
        ),
    }
    with jax.enable_x64(True):
        for method in ("hybr", "lm"):
            run = by_scipy(chain, loads, method)
            contestants[f"scipy root {method}, from tension"] = (run, FEW, run)
        times = rounds({name: call for name, (call, _, _) in contestants.items()}, n_rounds)
        for name, (_, count, success) in contestants.items():
            middle, low, high = (1e3 * x / count for x in spread(times[name]))
            rows.append(
                [
                    name,
                    f"{middle:.3f} ({low:.3f}-{high:.3f}) ms",
                    f"{1e3 / middle:.0f}",
                    f"{100 * success():.1f}",
                ]
            )
    return table(
        ["64 joints, 8 tendons", "CPU time a solve", "solves / core-s", "solved [%]"], rows
    )


def scaling(n_rounds: int) -> str:
    """CPU time an iteration of a batch of 64, by the number of joints."""
    counts, cost, rows = (64, 128, 256, 512), [], []
    for joints in counts:
        chain = muxjax.load_chain("hyper_redundant", resolution=joints // 2)
        loads = workload(chain, 64)
        found = muxjax.forward_statics(chain, **loads)
        call = {"": lambda chain=chain, loads=loads: muxjax.forward_statics(chain, **loads)}
        # All lanes of a batch iterate until the last one is done.
        cost.append(spread(rounds(call, n_rounds)[""])[0] / found.iterations.max())
        rows.append([str(joints), f"{1e6 * cost[-1] / 64:.1f}", f"{found.iterations.max()}"])
    slope = np.polyfit(np.log(counts), np.log(cost), 1)[0]
    text = table(["joints", "CPU us an iteration and solve", "iterations"], rows)
    return f"{text}\n\nlog-log slope {slope:.2f}"


def convergence() -> str:
    """Tip error of robot B against the Cosserat rod, by beads a segment."""
    rows = []
    for beads in (5, 10, 20, 40):
        errors = tip_errors(muxjax.load_chain("tdcr_b", resolution=beads), "B", "cr", cases_of("B"))
        rows.append([str(beads), f"{100 * np.median(errors):.4f}", f"{100 * errors.max():.4f}"])
    return table(["beads a segment", "median tip error [% of length]", "worst"], rows)


def main() -> None:
    """Measure and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--solves", type=int, default=256)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    print(f"{machine()}\n\n{speed(options.solves, options.rounds)}\n\n{PEER}\n")
    print(f"{scaling(options.rounds)}\n\n{convergence()}")


if __name__ == "__main__":
    main()
