"""What every benchmark shares: the clock, the machine's description, first-call latency."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[2]


def rounds(contestants: dict[str, Callable[[], object]], n_rounds: int) -> dict[str, list[float]]:
    """CPU-seconds over all threads of a call, for each contestant in turn, round after round.

    Interleaving lets a disturbance hit everybody; the first round warms up and is left out.
    """
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for number in range(n_rounds + 1):
        for name, call in contestants.items():
            start = time.process_time()
            call()
            if number:
                times[name].append(time.process_time() - start)
    return times


def spread(values: list[float]) -> tuple[float, float, float]:
    """Median and quartiles."""
    if len(values) < 2:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return middle, low, high


def machine() -> str:
    """Processor, cores and versions, one line."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = [
            x for x in information.read_text().splitlines() if x.startswith(("model name", "flags"))
        ]
        model = names[0].split(":")[1].strip() + (" with AVX-512" if "avx512f" in names[1] else "")
    return (
        f"{model}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; Python "
        f"{platform.python_version()}, NumPy {np.__version__}, JAX {jax.__version__}"
    )


def table(header: list[str], rows: list[list[str]]) -> str:
    """Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def fresh_process(code: str, cache: Path | None) -> float:
    """Seconds that ``code`` reports on its last line of output, run in a fresh process.

    Args:
        code: Prints the seconds it took.
        cache: Folder of JAX's persistent compilation cache, or none.
    """
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION")}
    if cache is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env=environment,
    )
    return float(done.stdout.split()[-1])
