"""Poses a second, side by side: `python -m tests.benchmarks.kinematics [--rounds 30]`.

Position and quaternion of MuxArm's tool for the same random configurations in float32: ours,
straightforward jit(vmap), structure-of-arrays NumPy, SoRoMoX (which this installs into an
environment of its own), and a fused C loop compiled on the spot as the limit. Every contestant
gets the batch size that suits it. Figures are CPU-seconds over all threads.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import muxjax
from muxjax import batched
from muxjax.robot import Robot
from tests.benchmarks.common import fresh_process, machine, rounds, spread, table

SEED = 20260418
N = batched.CHUNK
NUMPY_N = 1 << 14  # in cache; larger batches are slower
NAIVE_N = 1 << 14
SOROMOX_N = 1 << 13


def configurations(robot: Robot, n: int) -> np.ndarray:
    """Polar q, (n, 2S), float32."""
    rng = np.random.default_rng(SEED)
    theta = rng.uniform(0, robot.theta_max, (n, robot.n_segments))
    phi = rng.uniform(0, 2 * np.pi, theta.shape)
    return np.stack([theta, phi], axis=-1).reshape(n, -1).astype(np.float32)


def bending_rows(q: np.ndarray) -> np.ndarray:
    """Structure of arrays, (2S, n)."""
    theta, phi = q[:, 0::2], q[:, 1::2]
    b = np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1)
    return np.ascontiguousarray(b.reshape(len(q), -1).T)


def naive_pose(q: jax.Array, length: jax.Array) -> tuple[jax.Array, jax.Array]:
    """M Eq. 1-2 as printed, for one configuration: 4 x 4 matrices, then a quaternion."""
    pose = jnp.eye(4)
    for i in range(len(length)):
        theta, phi = q[2 * i], q[2 * i + 1]
        theta = jnp.where(jnp.abs(theta) < 1e-6, 1e-6, theta)
        c, s = jnp.cos(phi), jnp.sin(phi)
        ct, st = jnp.cos(theta), jnp.sin(theta)
        reach = length[i] / theta
        pose = pose @ jnp.array(
            [
                [c * c * (ct - 1) + 1, c * s * (ct - 1), c * st, reach * c * (1 - ct)],
                [c * s * (ct - 1), s * s * (ct - 1) + 1, s * st, reach * s * (1 - ct)],
                [-c * st, -s * st, ct, reach * st],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    r = pose[:3, :3]
    w = 0.5 * jnp.sqrt(jnp.maximum(1 + r[0, 0] + r[1, 1] + r[2, 2], 1e-12))
    v = jnp.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w)
    return pose[:3, 3], jnp.concatenate([w[None], v])


def numpy_pose(u: np.ndarray, length: np.ndarray, series: batched.Series) -> list[np.ndarray]:
    """The same arithmetic as ours, in vectorised NumPy over rows."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    place: list[np.ndarray] = []
    turn: list[np.ndarray] = []
    for i in reversed(range(len(length))):
        ux, uy = u[2 * i], u[2 * i + 1]
        x = (ux * ux + uy * uy) * quarter
        s, c = (_horner(p, x) for p in (series.sinc, series.cosine))
        ex, ey, chord = half * s * ux, half * s * uy, length[i] * s
        if not place:
            place, turn = [chord * ex, chord * ey, chord * c], [c, -ey, ex, np.zeros_like(c)]
            continue
        px, py, pz = place
        along = ex * px + ey * py
        side = 2 * (c * pz - along) + chord
        place = [
            px + side * ex,
            py + side * ey,
            pz * (2 * c * c - 1) + c * (chord - 2 * along),
        ]
        w, a, b, d = turn
        turn = [
            c * w + ey * a - ex * b,
            c * a - ey * w + ex * d,
            c * b + ey * d + ex * w,
            c * d - ey * b - ex * a,
        ]
    return place + turn


def _horner(coefficients: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    value = np.full_like(x, coefficients[-1])
    for k in coefficients[-2::-1]:
        value *= x
        value += np.float32(k)
    return value


def c_kernel(folder: Path) -> Callable[[np.ndarray, np.ndarray, np.ndarray], None] | None:
    """limit.c, or None without a compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    library = folder / "limit.so"
    flags = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
    source = Path(__file__).with_name("limit.c")
    subprocess.run([compiler, *flags, "-o", library, source], check=True)
    poses = ctypes.CDLL(str(library)).poses
    poses.argtypes = [ctypes.c_size_t] + [ctypes.c_void_p] * 3
    poses.restype = None
    return lambda u, length, out: poses(
        u.shape[1], u.ctypes.data, length.ctypes.data, out.ctypes.data
    )


def soromox(folder: Path, robot: Robot, n_rounds: int) -> dict | str:
    """SoRoMoX's figures from its own environment, or why there are none."""
    q = configurations(robot, SOROMOX_N)
    np.savez(
        folder / "given.npz",
        bending=bending_rows(q).T.reshape(-1, robot.n_segments, 2),
        length=robot.length,
        position=muxjax.forward_kinematics(robot, q)[:, :3, 3],
    )
    python = folder / "soromox" / "bin" / "python"
    try:
        subprocess.run([sys.executable, "-m", "venv", folder / "soromox"], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", "soromox==0.5.0"], check=True)
        script = Path(__file__).with_name("soromox_runner.py")
        command = [python, script, folder / "given.npz", str(n_rounds)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        return f"not measured: {str(getattr(error, 'stderr', None) or error).strip()[-200:]}"
    return json.loads(done.stdout.splitlines()[-1])


def largest_difference(robot: Robot, values: np.ndarray, n: int) -> float:
    """Of positions (n, 3) from the readable float64 form [m]."""
    exact = muxjax.forward_kinematics(robot, configurations(robot, n))[:, :3, 3]
    return float(np.max(np.abs(values - exact)))


FIRST_CALLS = {
    "batched.poses": "muxjax.batched.poses(robot, numpy.zeros((1000, 3, 2)))",
    "batched.tendon_lengths": "muxjax.batched.tendon_lengths(robot, numpy.zeros((1000, 3, 2)))",
    "workspace.sweep": "muxjax.workspace.sweep(robot, samples=100_000, progress=False)",
}


def first_calls(folder: Path) -> str:
    """Seconds of the first call in a fresh process, after the imports."""
    rows = []
    for name, call in FIRST_CALLS.items():
        code = (
            "import time, numpy, muxjax, muxjax.batched, muxjax.workspace\n"
            "robot = muxjax.load_robot('muxarm')\n"
            "start = time.perf_counter()\n"
            f"{call}\nprint(time.perf_counter() - start)"
        )
        cold = [fresh_process(code, None) for _ in range(3)]
        fresh_process(code, folder / "cache")
        warm = [fresh_process(code, folder / "cache") for _ in range(3)]
        rows.append([name, f"{spread(cold)[0]:.2f}", f"{spread(warm)[0]:.2f}"])
    return table(["first call", "no cache [s]", "persistent cache [s]"], rows)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=30)
    n_rounds = parser.parse_args().rounds
    robot = muxjax.load_robot("muxarm")
    length = robot.length.astype(np.float32)
    arm = batched.chain(robot)
    series = batched.series(0.25 * arm.angle_limit**2)
    rows = jnp.asarray(bending_rows(configurations(robot, N)))
    numpy_rows = bending_rows(configurations(robot, NUMPY_N))
    naive_q = jnp.asarray(configurations(robot, NAIVE_N))
    compile_s: dict[str, float] = {}

    start = time.perf_counter()
    ours = [jax.block_until_ready(batched.pose_quads(arm, rows))]
    compile_s["muxjax, batched"] = time.perf_counter() - start
    naive = jax.jit(jax.vmap(naive_pose, in_axes=(0, None)))
    start = time.perf_counter()
    naive_places = np.asarray(jax.block_until_ready(naive(naive_q, length))[0])
    compile_s["jit(vmap(4 x 4)), as printed"] = time.perf_counter() - start

    def run_ours() -> None:
        ours[0] = jax.block_until_ready(batched.pose_quads(arm, rows, "quaternion", ours[0]))

    contestants: dict[str, Callable[[], object]] = {
        "muxjax, batched": run_ours,
        "jit(vmap(4 x 4)), as printed": lambda: jax.block_until_ready(naive(naive_q, length)),
        "NumPy, structure of arrays": lambda: numpy_pose(numpy_rows, length, series),
    }
    sizes = dict(zip(contestants, (N, NAIVE_N, NUMPY_N), strict=True))
    errors = dict(
        zip(
            contestants,
            (
                largest_difference(robot, batched.numbers(ours[0])[0][:, :3], N),
                largest_difference(robot, naive_places, NAIVE_N),
                largest_difference(
                    robot, np.stack(numpy_pose(numpy_rows, length, series)[:3], -1), NUMPY_N
                ),
            ),
            strict=True,
        )
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        kernel = c_kernel(folder)
        if kernel is not None:
            name = "C, fused, -O3 -march=native -ffast-math"
            out = np.empty((7, NUMPY_N), np.float32)
            contestants[name] = lambda: kernel(numpy_rows, length, out)
            sizes[name] = NUMPY_N
            kernel(numpy_rows, length, out)
            errors[name] = largest_difference(robot, out[:3].T, NUMPY_N)
        measured = {
            name: spread([t / sizes[name] for t in times])
            for name, times in rounds(contestants, n_rounds).items()
        }
        peer = soromox(folder, robot, max(3, n_rounds // 5))
        latency = first_calls(folder)
    if isinstance(peer, dict):
        measured["SoRoMoX 0.5.0, PCS"] = tuple(peer["times"])
        sizes["SoRoMoX 0.5.0, PCS"] = SOROMOX_N
        compile_s["SoRoMoX 0.5.0, PCS"] = peer["compiled"]
        errors["SoRoMoX 0.5.0, PCS"] = peer["difference"]
    reference = measured["muxjax, batched"][0]
    lines = [
        [
            name,
            f"{1e-6 / middle:.1f} ({1e-6 / high:.1f} to {1e-6 / low:.1f})",
            f"{middle / reference:.2f}",
            f"{compile_s[name]:.2f}" if name in compile_s else "-",
            f"{errors[name]:.1e}",
            str(sizes[name]),
        ]
        for name, (middle, low, high) in sorted(measured.items(), key=lambda item: item[1][0])
    ]
    print(f"MuxArm, position + quaternion, float32, seed {SEED}, {n_rounds} rounds. {machine()}\n")
    header = ["", "M poses / core-second (quartiles)", "time / ours", "first call [s]"]
    print(table([*header, "largest position error [m]", "batch"], lines))
    if isinstance(peer, str):
        print(f"\nSoRoMoX: {peer}")
    else:
        print(f"\nSoRoMoX took {peer['constructed']:.1f} s to construct the arm.")
    print(f"\n{latency}")


if __name__ == "__main__":
    main()
