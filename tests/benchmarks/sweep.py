"""CPU-seconds of a dexterity sweep: `python -m tests.benchmarks.sweep [--samples 1e9]`."""

from __future__ import annotations

import argparse
import resource
import time

import muxjax
from muxjax import workspace
from tests.benchmarks.common import machine, table

SEED = 1


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=float, default=1e9)
    samples = int(parser.parse_args().samples)
    robot = muxjax.load_robot("muxarm")
    rows = []
    for sampler in ("random", "lattice"):
        wall, cpu = time.perf_counter(), time.process_time()
        found = workspace.sweep(robot, samples=samples, seed=SEED, sampler=sampler)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        limit = found.limit()
        rows.append(
            [
                sampler,
                f"{cpu:.1f}",
                f"{wall:.1f}",
                f"{samples / cpu / 1e6:.1f}",
                f"{found.mean_dexterity:.4f}",
                f"{limit.value:.4f} ± {limit.uncertainty:.4f}",
                f"{found.peak_dexterity:.3f}",
            ]
        )
    cells, error = found.cells, found.about["bin_error_deg"]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"MuxArm, {samples:.3g} samples, seed {SEED}, {cells.n_r} x {cells.n_z} cells, 4608 test "
        f"orientations within 10 degrees, bins with a typical error of {error['typical']:.1f} "
        f"degrees; peak memory {memory:.2f} GiB. {machine()}\n"
    )
    header = ["sampler", "CPU-s", "wall [s]", "M samples / CPU-s"]
    print(table([*header, "mean dexterity", "extrapolated", "peak dexterity"], rows))


if __name__ == "__main__":
    main()
