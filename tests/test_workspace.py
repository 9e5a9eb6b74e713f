"""Sweeps: samples, grids, the estimator against brute force, interruptions, files."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import muxjax
from muxjax import workspace
from muxjax.collision import clearance, load_world
from muxjax.config import FrameConfig
from muxjax.robot import Robot, robot_from_config
from muxjax.workspace import marking, orientation, sampling
from muxjax.workspace.about import about_sweep, identity_of
from muxjax.workspace.cells import Cells, cells_for, inverse_root
from muxjax.workspace.checkpoint import State, save_checkpoint
from muxjax.workspace.convergence import extrapolate
from muxjax.workspace.files import write_file
from muxjax.workspace.marking import Layout

SMALL: dict = {"cells": (6, 12), "bins_per_axis": 16, "progress": False}
TABLES = ("counts", "met", "met_bounds", "met_tests", "ladder_samples", "ladder_met")


def same(a: workspace.Sweep, b: workspace.Sweep) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in TABLES)


def with_tool(robot: Robot, **tool: tuple[float, float, float]) -> Robot:
    return robot_from_config(robot.config.model_copy(update={"tool_frame": FrameConfig(**tool)}))


def random_quaternions(rng: np.random.Generator, n: int) -> np.ndarray:
    q = rng.normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def angles(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Angle between rotations, all pairs."""
    return 2 * np.arccos(np.minimum(np.abs(p @ q.T), 1.0))


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """From the eigenvector of eigenvalue 1 and the angle; enough for random rotations."""
    values, vectors = np.linalg.eig(rotation)
    axis = np.real(np.take_along_axis(vectors, np.argmin(abs(values - 1), -1)[:, None, None], 2))[
        ..., 0
    ]
    once = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=-1,
    )
    angle = np.arctan2(np.sum(once * axis, -1), np.trace(rotation, axis1=1, axis2=2) - 1)
    return np.concatenate([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis], axis=-1)


# -- samples -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "counter", "words"),
    [  # the known answers that Random123 ships (kat_vectors, threefry2x32 20)
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF,) * 2, (0xFFFFFFFF,) * 2, (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_threefry_known_answers(key: tuple, counter: tuple, words: tuple) -> None:
    as_words = [tuple(jnp.asarray(np.uint32(w)) for w in pair) for pair in (key, counter)]
    assert tuple(int(w) for w in sampling.threefry(*as_words)) == words


def draw(seed: int, block: int, n: int = 5) -> np.ndarray:
    key = np.array([seed, 0], np.uint32)
    lane = jnp.arange(sampling.BLOCK, dtype=jnp.uint32)
    return np.stack(sampling.random_fractions(key, jnp.uint32(block), lane, n))


def test_random_fractions_are_uniform_and_independent() -> None:
    u = draw(3, 7)
    assert u.min() >= 0
    assert u.max() < 1
    assert np.array_equal(u * 2.0**24, np.round(u * 2.0**24))
    scale = 1 / np.sqrt(u.shape[1])
    for row in u:  # chi-square over 256 cells: 255 +- 5 sigma
        counts = np.histogram(row, bins=256, range=(0, 1))[0]
        assert abs(np.sum((counts - 512.0) ** 2 / 512.0) - 255) < 5 * np.sqrt(2 * 255)
    low_bits = (u * 2.0**24).astype(np.int64) & 0xFF
    assert np.all(np.abs(low_bits.mean(axis=1) - 127.5) < 5 * 74 * scale)
    correlation = np.corrcoef(np.concatenate([u, draw(3, 8), draw(4, 7)]))
    assert np.max(np.abs(correlation - np.eye(15))) < 5 * scale


def test_blocks_do_not_wrap_below_1e13_draws() -> None:
    assert sampling.MAX_SAMPLES * 2 > 1e13
    last = int(1e13) // sampling.BLOCK
    assert not np.array_equal(draw(1, last), draw(1, last % 2**16))
    assert not np.array_equal(draw(1, last), draw(1, 0))


def test_lattice_is_exact_far_out() -> None:
    n, block = 5, int(1e13) // sampling.BLOCK
    steps = [Fraction(int(a), 2**64) for a in sampling.lattice_steps(n)]
    # g solves g^(n+1) = g + 1, so a_n (g^-n) and a_1 (g^-1) obey a_n (1 + a_1) = 1 - ... in g:
    g = 1 / float(steps[0])
    assert g ** (n + 1) == pytest.approx(g + 1, rel=1e-14)
    assert [float(s) for s in steps] == pytest.approx([g ** -(d + 1) for d in range(n)], rel=1e-14)
    rows, columns = sampling.lattice_parts(n, 9, block)
    origin, _ = sampling.lattice_parts(n, 9, 0)
    u = np.stack(sampling.lattice_fractions(rows, columns)).reshape(n, -1)
    for lane in (0, 1, 1023, 1024, sampling.BLOCK - 1):
        for d in range(n):
            exact = (
                Fraction(int(origin[d, 0]), 2**32) + (block * sampling.BLOCK + lane) * steps[d]
            ) % 1
            gap = abs(float(exact) - u[d, lane])
            assert min(gap, 1 - gap) < 2.0**-23


def test_lattice_is_more_even_than_chance() -> None:
    rows, columns = sampling.lattice_parts(2, 0, 3)
    u = np.stack(sampling.lattice_fractions(rows, columns)).reshape(2, -1)
    counts = np.histogram2d(*u, bins=64, range=[[0, 1], [0, 1]])[0]
    assert counts.std() < 0.2 * np.sqrt(counts.mean())


def test_turn_is_the_unit_circle() -> None:
    f = np.linspace(0, 1, 1001, endpoint=False, dtype=np.float32)
    c, s = (np.asarray(v) for v in sampling.turn(jnp.asarray(f)))
    np.testing.assert_allclose(c, np.cos(2 * np.pi * (f - 0.5)), atol=5e-7)
    np.testing.assert_allclose(s, np.sin(2 * np.pi * (f - 0.5)), atol=5e-7)


# -- grids -------------------------------------------------------------------------------------


def test_test_orientations_are_evenly_spread(rng: np.random.Generator) -> None:
    tests = orientation.test_orientations()
    assert tests.shape == (4608, 4)
    np.testing.assert_allclose(np.linalg.norm(tests, axis=-1), 1.0, atol=1e-12)
    away = angles(random_quaternions(rng, 4000), tests)
    assert np.degrees(away.min(axis=1).max()) < 13
    # A ball of 10 degrees holds (a - sin a) / pi of the group.
    expected = 4608 * (np.radians(10) - np.sin(np.radians(10))) / np.pi
    assert (away <= np.radians(10)).sum(axis=1).mean() == pytest.approx(expected, rel=0.05)


def test_healpix_rings() -> None:
    z, azimuth = orientation.healpix_directions(4)
    assert len(z) == 192
    points = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z])
    # Equal areas: the first two moments are those of the sphere.
    np.testing.assert_allclose(points.mean(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(points @ points.T / 192, np.eye(3) / 3, atol=2e-3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_bins(mirrored: bool, rng: np.random.Generator) -> None:
    centres = orientation.bin_centres(12, mirrored)
    assert len(centres) == orientation.n_bins(12, mirrored) == 4 * 12**3 // (1 + mirrored)
    assert np.array_equal(
        orientation.bin_index(list(centres.T.astype(np.float32)), 12, mirrored),
        np.arange(len(centres)),
    )
    q = random_quaternions(rng, 5000).astype(np.float32)
    index = np.asarray(orientation.bin_index([jnp.asarray(c) for c in q.T], 12, mirrored))
    images = [q, -q, orientation.mirror(q).astype(np.float32)] if mirrored else [q, -q]
    for image in images:
        assert np.array_equal(orientation.bin_index(list(image.T), 12, mirrored), index)
    near = 2 * np.arccos(
        np.minimum(1, np.max([np.abs(np.sum(i * centres[index], -1)) for i in images], 0))
    )
    error = orientation.bin_error(12, mirrored)
    assert near.max() <= error.largest + 1e-3
    assert np.sqrt(np.mean(near**2)) == pytest.approx(error.typical, rel=0.03)


@pytest.mark.parametrize("mirrored", [False, True])
def test_bins_near_tests_against_all_pairs(mirrored: bool) -> None:
    near, _ = orientation.bins_near_tests(10, mirrored, np.radians(14))
    centres, tests = orientation.bin_centres(10, mirrored), orientation.test_orientations()
    for t in range(0, 4608, 97):
        away = angles(centres, tests[t : t + 1])[:, 0]
        if mirrored:
            away = np.minimum(away, angles(centres, orientation.mirror(tests[t : t + 1]))[:, 0])
        assert set(near[t]) == set(np.flatnonzero(away <= np.radians(14)))


def test_symmetry_is_found_not_assumed(robot: Robot) -> None:
    assert workspace.axially_symmetric(robot)
    assert workspace.axially_symmetric(with_tool(robot, xyz_m=(0, 0, 0.1), rpy_deg=(30, 40, 50)))
    assert not workspace.axially_symmetric(with_tool(robot, xyz_m=(0.01, 0, 0.1)))
    moved = robot.config.model_copy(
        update={"base_frame": FrameConfig(xyz_m=(1, 2, 3), rpy_deg=(9, 8, 7))}
    )
    assert workspace.axially_symmetric(robot_from_config(moved))


def test_cells_hold_the_volume_of_their_cylinder() -> None:
    cells = Cells(5, 8, 3, 0.4)
    assert cells.volume.shape == (3, 5, 8)
    assert cells.volume.sum() == pytest.approx(np.pi * 0.4**2 * 0.8)


def test_inverse_root() -> None:
    x = np.logspace(-14, 2, 3000).astype(np.float32)
    np.testing.assert_allclose(inverse_root(jnp.asarray(x)) * np.sqrt(x), 1.0, rtol=5e-7)
    assert np.isfinite(inverse_root(jnp.zeros(1))).all()


# -- the estimator against brute force ----------------------------------------------------------


def samples_of(robot: Robot, seed: int, n: int) -> np.ndarray:
    """The configurations of a random sweep, (n, 2S), by the readable route."""
    in_plane = workspace.axially_symmetric(robot)
    fractions = draw(seed, 0, 2 * robot.n_segments - in_plane)[:, :n].astype(np.float64)
    if in_plane:
        fractions = np.insert(fractions, 1, 0.5, axis=0)
    q = np.empty((n, 2 * robot.n_segments))
    q[:, 0::2] = fractions[0::2].T * robot.theta_max
    q[:, 1::2] = (fractions[1::2].T - 0.5) * 2 * np.pi
    return q


def brute_force(robot: Robot, q: np.ndarray, cells: Cells, tolerance: float) -> np.ndarray:
    """Test orientations met in each cell, sample by sample, in float64."""
    poses = np.linalg.inv(robot.base) @ muxjax.forward_kinematics(robot, q)
    x, y, z = poses[:, :3, 3].T
    azimuth = np.arctan2(y, x)
    r_cell = np.digitize(np.hypot(x, y), cells.r_edges) - 1
    z_cell = np.digitize(z, cells.z_edges) - 1
    tests = orientation.test_orientations()
    rotation = poses[:, :3, :3]
    sector = np.zeros(len(q), int)
    if cells.n_sectors == 1:
        c, s, o = np.cos(azimuth), np.sin(azimuth), np.zeros(len(q))
        back = np.stack(
            [np.stack([c, s, o], -1), np.stack([-s, c, o], -1), np.stack([o, o, o + 1], -1)], -2
        )
        rotation = back @ rotation @ np.swapaxes(back, -1, -2)
    else:
        sector = np.floor(azimuth / (2 * np.pi) * cells.n_sectors).astype(int) % cells.n_sectors
    quaternion = quaternion_of(rotation)
    near = angles(quaternion, tests) <= tolerance
    if cells.n_sectors == 1:
        near |= angles(orientation.mirror(quaternion), tests) <= tolerance
    met = np.zeros((*cells.shape, 4608), bool)
    for k in range(len(q)):
        met[sector[k], r_cell[k], z_cell[k]] |= near[k]
    return met.sum(axis=-1)


@pytest.mark.parametrize("lateral", [0.0, 0.02])
def test_dexterity_lies_between_brute_force_bounds(muxarm: Robot, lateral: float) -> None:
    arm = with_tool(muxarm, xyz_m=(lateral, 0, 0.03))
    n = 6000
    grid: dict = {"cells": (3, 5), "bins_per_axis": 16, "progress": False}
    if lateral:
        grid["sectors"] = 4
    found = workspace.sweep(arm, samples=n, seed=5, **grid)
    assert found.counts.sum() == n
    q = samples_of(arm, 5, n)
    cells = cells_for(arm, (3, 5), 4 if lateral else None)
    error = orientation.bin_error(16, not lateral).largest
    low, exact, high = (
        brute_force(arm, q, cells, np.radians(10) + margin) for margin in (-error, 0, error)
    )
    # A sample on the border of two cells may be rounded into the other one.
    assert np.all(found.met >= low - 3)
    assert np.all(found.met <= high + 3)
    assert np.all(found.met_bounds[0] <= found.met)
    assert np.all(found.met <= found.met_bounds[1])
    dense = found.counts > 200
    assert dense.sum() >= 4
    np.testing.assert_allclose(found.met[dense].sum(), exact[dense].sum(), rtol=0.12)


def test_half_plane_equals_the_whole_arm(muxarm: Robot, rng: np.random.Generator) -> None:
    """Leaving out phi_1 gives the cell counts of a sample of all six numbers."""
    n = 40_000
    found = workspace.sweep(muxarm, samples=n, **SMALL).counts[0]
    theta = rng.uniform(0, muxarm.theta_max, (n, 3))
    q = np.stack([theta, rng.uniform(0, 2 * np.pi, (n, 3))], axis=-1).reshape(n, 6)
    x, y, z = muxjax.forward_kinematics(muxarm, q)[:, :3, 3].T
    cells = cells_for(muxarm, (6, 12), None)
    other = np.histogram2d(np.hypot(x, y), z, bins=(cells.r_edges, cells.z_edges))[0]
    used = found + other > 20
    chi2 = np.sum((found - other)[used] ** 2 / (found + other)[used])
    assert chi2 < used.sum() + 5 * np.sqrt(2 * used.sum())


@pytest.mark.parametrize("sampler", ["random", "lattice"])
def test_every_sample_is_counted_once(robot: Robot, sampler: str) -> None:
    n = 3 * sampling.BLOCK + 17
    found = workspace.sweep(robot, samples=n, sampler=sampler, **SMALL)
    assert found.counts.dtype == np.int64
    assert found.counts.sum() == n
    assert np.array_equal(found.reached, found.counts > 0)
    assert 0 < found.mean_dexterity < found.peak_dexterity <= 1


def test_more_samples_only_add(muxarm: Robot) -> None:
    few, many = (workspace.sweep(muxarm, samples=n, **SMALL) for n in (50_000, 400_000))
    assert np.all(few.counts <= many.counts)
    assert np.all(few.met <= many.met)
    assert np.array_equal(few.met_tests & many.met_tests, few.met_tests)


@pytest.mark.parametrize(
    ("sampler", "world"), [("random", None), ("lattice", None), ("random", "cabinet")]
)
def test_blocks_of_a_round_change_nothing(
    muxarm: Robot, sampler: str, world: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    arena = None if world is None else muxjax.load_world(world)
    options = {"samples": (1 if arena else 21) * sampling.BLOCK + 5, "world": arena, **SMALL}
    one = workspace.sweep(muxarm, sampler=sampler, **options)
    monkeypatch.setattr(marking, "_on_cpu", lambda: False)
    monkeypatch.setattr(marking, "BLOCKS_ELSEWHERE", 5)
    monkeypatch.setattr(marking, "BLOCKS_PER_FLUSH", 7)
    assert same(one, workspace.sweep(muxarm, sampler=sampler, **options))


def test_seeds_differ_and_repeat(muxarm: Robot) -> None:
    a, b, c = (workspace.sweep(muxarm, samples=20_000, seed=s, **SMALL) for s in (1, 1, 2**40 + 1))
    assert same(a, b)
    assert not np.array_equal(a.counts, c.counts)


# -- convergence -------------------------------------------------------------------------------


def test_limit_of_a_power_law() -> None:
    n = 2 ** np.arange(20, 31)
    limit = extrapolate(n, 0.6 - 30.0 * n**-0.4)
    assert limit.value == pytest.approx(0.6, abs=2e-3)
    assert limit.exponent == pytest.approx(0.4, abs=0.02)
    assert abs(limit.value - 0.6) <= limit.uncertainty


def test_limit_needs_a_ladder() -> None:
    assert np.isnan(extrapolate(np.array([1, 2, 4]), np.array([0.1, 0.2, 0.3])).value)


def test_limit_holds_what_more_samples_find(muxarm: Robot) -> None:
    sweep = workspace.sweep(
        muxarm, samples=256 * sampling.BLOCK, cells=(3, 6), bins_per_axis=12, progress=False
    )
    assert list(sweep.ladder_samples // sampling.BLOCK) == [8, 16, 32, 64, 128, 256]
    earlier = extrapolate(sweep.ladder_samples[:5], sweep.mean_ladder[:5])
    assert earlier.value + earlier.uncertainty >= sweep.mean_ladder[5]
    assert sweep.limit().value >= sweep.mean_ladder[5]


# -- interruptions and several processes --------------------------------------------------------

RUN = """
import sys, muxjax
from muxjax import workspace
workspace.sweep(muxjax.load_robot("muxarm"), samples=int(sys.argv[1]), seed=11, sampler=sys.argv[2],
    cells=(6, 12), bins_per_axis=16, progress=False, checkpoint=sys.argv[3], resume=True,
    checkpoint_every_s=0.05, out=sys.argv[4])
"""
PLENTY = 1 << 30  # far more than a run gets to before it is stopped


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """Of random samples; who goes on from its checkpoint takes a copy."""
    return stopped_run(tmp_path_factory.mktemp("killed"), "random", signal.SIGKILL)


def stopped_run(tmp_path: Path, sampler: str, number: int) -> tuple[Path, int]:
    """Checkpoint of a real process that got the signal in the middle of its work."""
    checkpoint = tmp_path / "sweep.ckpt"
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            RUN,
            str(PLENTY),
            sampler,
            str(checkpoint),
            str(tmp_path / "no.npz"),
        ],
        stderr=subprocess.PIPE,
    )
    deadline = time.monotonic() + 60
    while not checkpoint.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.3)
    process.send_signal(number)
    process.communicate(timeout=60)
    assert checkpoint.exists()
    assert not (tmp_path / "no.npz").exists()
    return checkpoint, process.returncode


def test_killed_and_resumed_is_bit_identical(
    muxarm: Robot, tmp_path: Path, killed: tuple[Path, int]
) -> None:
    stopped, code = killed
    goes_on_bit_identically(muxarm, shutil.copy(stopped, tmp_path / "sweep.ckpt"), code, "random")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.parametrize("sampler", ["random", "lattice"])
def test_stopped_and_resumed_is_bit_identical(
    muxarm: Robot, tmp_path: Path, number: signal.Signals, sampler: str
) -> None:
    goes_on_bit_identically(muxarm, *stopped_run(tmp_path, sampler, number), sampler)


def goes_on_bit_identically(muxarm: Robot, checkpoint: Path, code: int, sampler: str) -> None:
    """A sweep that goes on from the checkpoint of a stopped one, against one in a piece."""
    assert code != 0
    with np.load(checkpoint) as stored:
        done = int(stored["counts"].sum())
    assert 0 < done < PLENTY
    n = done + 5 * sampling.BLOCK + 99
    options: dict = {"samples": n, "seed": 11, "sampler": sampler, **SMALL}
    resumed = workspace.sweep(muxarm, checkpoint=checkpoint, resume=True, **options)
    assert same(resumed, workspace.sweep(muxarm, **options))


def test_checkpoint_of_another_sweep_is_refused(
    muxarm: Robot, tmp_path: Path, killed: tuple[Path, int]
) -> None:
    checkpoint = shutil.copy(killed[0], tmp_path / "sweep.ckpt")
    options: dict = {"checkpoint": checkpoint, "resume": True, "samples": PLENTY, **SMALL}
    with pytest.raises(workspace.SweepFileError, match=r"sweep\.ckpt: is of another sweep"):
        workspace.sweep(muxarm, seed=12, **options)
    with pytest.raises(workspace.SweepFileError, match="is of another sweep"):
        workspace.sweep(muxjax.load_robot("penta"), seed=11, **options)
    with pytest.raises(workspace.SweepFileError, match="already holds"):
        workspace.sweep(muxarm, seed=11, **{**options, "samples": 10})


WORKER = """
import sys, jax
jax.config.update("jax_platforms", "cpu")
jax.distributed.initialize(sys.argv[1], num_processes=2, process_id=int(sys.argv[2]))
import muxjax
from muxjax import workspace
found = workspace.sweep(muxjax.load_robot("muxarm"), samples=2300000, seed=3, sampler=sys.argv[3],
    cells=(6, 12), bins_per_axis=16, progress=False, out=sys.argv[4])
assert jax.process_count() == 2 and found.counts.sum() == 2300000
"""


@pytest.mark.parametrize("sampler", [pytest.param("random", marks=pytest.mark.slow), "lattice"])
def test_two_processes_give_the_table_of_one(muxarm: Robot, tmp_path: Path, sampler: str) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    out = tmp_path / "two.npz"
    workers = [
        subprocess.Popen(
            [sys.executable, "-c", WORKER, address, str(rank), sampler, str(out)],
            stderr=subprocess.PIPE,
            env={**os.environ},
        )
        for rank in range(2)
    ]
    for worker in workers:
        _, errors = worker.communicate(timeout=120)
        assert worker.returncode == 0, errors.decode()[-2000:]
    alone = workspace.sweep(muxarm, samples=2_300_000, seed=3, sampler=sampler, **SMALL)
    assert same(workspace.load_sweep(out), alone)


# -- files, designs, pictures -------------------------------------------------------------------


def test_file_says_everything_and_reads_back(muxarm: Robot, tmp_path: Path) -> None:
    path = tmp_path / "found.npz"
    found = workspace.sweep(muxarm, samples=30_000, seed=4, out=path, **SMALL)
    again = workspace.load_sweep(path)
    assert same(found, again)
    assert again.about == found.about
    assert again.cells == found.cells
    assert again.samples == 30_000
    about = again.about
    assert about["robot"]["config"]["name"] == "muxarm"
    assert about["robot"]["length_m"] == list(muxarm.length)
    assert (about["seed"], about["sampler"]) == (4, "random")
    assert set(about["versions"]) == {"muxjax", "jax", "numpy", "python"}
    assert about["bin_error_deg"]["typical"] < about["bin_error_deg"]["largest"] < 10


def test_damaged_and_foreign_files_are_refused_by_name(muxarm: Robot, tmp_path: Path) -> None:
    path = tmp_path / "found.npz"
    workspace.sweep(muxarm, samples=30_000, out=path, **SMALL)
    whole = path.read_bytes()
    for cut in (0, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(workspace.SweepFileError, match=r"found\.npz"):
            workspace.load_sweep(path)
    rng = np.random.default_rng(0)
    for place in rng.integers(200, len(whole) - 1200, 20):
        flipped = bytearray(whole)
        flipped[place] ^= 0x10
        path.write_bytes(flipped)
        try:
            read = workspace.load_sweep(path)
        except workspace.SweepFileError as error:
            assert "found.npz" in str(error)  # noqa: PT017
        else:  # a bit that zip itself does not use
            path.write_bytes(whole)
            assert same(read, workspace.load_sweep(path))
    foreign = tmp_path / "foreign.npz"
    np.savez(foreign, a=np.zeros(3))
    with pytest.raises(workspace.SweepFileError, match=r"foreign\.npz: not a sweep file"):
        workspace.load_sweep(foreign)
    write_file(foreign, {"schema": "muxjax/other/1"}, {}, compress=False)
    with pytest.raises(workspace.SweepFileError, match="schema is 'muxjax/other/1'"):
        workspace.load_sweep(foreign)
    with pytest.raises(workspace.SweepFileError, match="no such file"):
        workspace.load_sweep(tmp_path / "missing.npz")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 0}, "samples: must be a whole number, 1 to"),
        ({"seed": -1}, "seed: must be 0 to"),
        ({"sampler": "sobol"}, "sampler: must be one of"),
        ({"tolerance_deg": 0.5}, "tolerance_deg: must be 1 to 60"),
        ({"bins_per_axis": 7}, "bins_per_axis: must be even"),
        ({"bins_per_axis": 128, "cells": (100, 100)}, "must be below 2 GiB"),
        ({"cells": (0, 4)}, "counts must be at least 1"),
        ({"sectors": 4}, "sectors: must be 1 for an axially symmetric arm"),
        ({"resume": True}, "resume: needs a checkpoint"),
        ({"out": "found.npy"}, r"out: must end in \.npz"),
    ],
)
def test_bad_arguments_are_named(muxarm: Robot, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        workspace.sweep(muxarm, **{"samples": 1000, **SMALL, **options})


def test_design_study(muxarm: Robot, tmp_path: Path) -> None:
    grid = {"segments[1].length_m": [0.12, 0.2], "tendons.radius_m": [0.02, 0.03]}
    study = workspace.design_study(muxarm, grid, samples=40_000, **SMALL)
    rows = study.table()
    assert [row["segments[1].length_m"] for row in rows] == [0.12, 0.12, 0.2, 0.2]
    assert rows[2]["reach_volume_m3"] > 1.2 * rows[0]["reach_volume_m3"]
    assert rows[0]["mean_dexterity"] == rows[1]["mean_dexterity"]
    assert rows[1]["tendon_stroke_m"] == pytest.approx(1.5 * rows[0]["tendon_stroke_m"], rel=0.01)
    alone = workspace.sweep(
        workspace.with_values(muxarm, {"segments[1].length_m": 0.2}), samples=40_000, **SMALL
    )
    assert same(study.designs[2].sweep, alone)
    lines = study.save_csv(tmp_path / "study.csv").read_text().splitlines()
    assert len(lines) == 5
    assert lines[0].startswith("segments[1].length_m,tendons.radius_m,reach_radius_m")


def test_with_values_changes_one_thing(muxarm: Robot) -> None:
    changed = workspace.with_values(muxarm, {"segments[2].theta_max_deg": 90})
    np.testing.assert_allclose(np.degrees(changed.theta_max), [180, 90, 140])
    assert changed.config.segments[1].theta_max_deg.source == "assumed"
    np.testing.assert_array_equal(changed.length, muxarm.length)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("segments[4].length_m", 0.1, "segments has entries 1 to 3, found 4"),
        ("segments[1].lenght_m", 0.1, "no such parameter at 'lenght_m'"),
        ("segments[1]", 0.1, "is not one value"),
        ("segments[1].length_m", -0.1, "greater than 0"),
    ],
)
def test_bad_design_parameters_are_named(
    muxarm: Robot, path: str, value: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        workspace.with_values(muxarm, {path: value})


def test_pictures(muxarm: Robot, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from muxjax.workspace import plots

    found = workspace.sweep(muxarm, samples=5_000_000, **SMALL)
    study = workspace.design_study(
        muxarm, {"segments[1].length_m": [0.15, 0.17]}, samples=20_000, **SMALL
    )
    for draw_it, what in (
        (plots.dexterity_map, found),
        (plots.convergence_curve, found),
        (plots.workspace_cut, found),
        (plots.design_plot, study),
    ):
        path = draw_it(what, tmp_path / f"{draw_it.__name__}.png")
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 10_000


@pytest.mark.slow
def test_a_sweep_in_a_world_counts_what_is_clear(muxarm: Robot, tmp_path: Path) -> None:
    """Against clearances of the same samples in float64; resumed, saved and drawn."""
    pytest.importorskip("matplotlib")
    from muxjax.workspace import plots

    world, other = load_world("cabinet"), load_world("s_pipe")
    options: dict = {**SMALL, "bins_per_axis": 8, "sectors": 4, "sampler": "lattice"}
    checkpoint = tmp_path / "part.npz"
    part = workspace.sweep(
        muxarm, samples=sampling.BLOCK, world=world, checkpoint=checkpoint, **options
    )
    assert part.clear_counts is not None
    assert part.counts.sum() == sampling.BLOCK
    assert (part.clear_counts <= part.counts).all()
    assert (part.met[part.clear_counts == 0] == 0).all()
    rows, columns = sampling.lattice_parts(6, 0, 0)
    u = np.stack(sampling.lattice_fractions(rows, columns)).reshape(6, -1).T[:2048].astype(float)
    q = u * np.stack([muxarm.theta_max, np.full(3, 2 * np.pi)], axis=-1).reshape(-1)
    q[:, 1::2] += np.pi  # turn() is half a turn away from the fraction's own azimuth
    with jax.enable_x64(True):
        share = float((np.asarray(clearance(muxarm, jnp.asarray(q), world)) >= 0).mean())
    assert part.clear_counts.sum() / part.counts.sum() == pytest.approx(share, abs=0.03)
    assert 0 < part.clear_volume < part.reach_volume
    copy = workspace.load_sweep(part.save(tmp_path / "sweep.npz"))
    assert np.array_equal(copy.clear_counts, part.clear_counts)
    np.testing.assert_array_equal(copy.clear_share, part.clear_share)
    drawn = plots.clear_map(part, world, tmp_path / "clear.png")
    assert drawn.stat().st_size > 10_000

    layout = Layout((4, 6, 12), 8, orientation.n_bins(8, False), "lattice", True)
    grid = cells_for(muxarm, (6, 12), 4, True)
    identity = identity_of(about_sweep(muxarm, layout, 0, 10.0, world), grid)
    state = State(marking.new_tables(layout), counts=np.zeros(layout.n_counts, np.int64))
    save_checkpoint(checkpoint, layout, identity, state)
    again = workspace.sweep(
        muxarm, samples=sampling.BLOCK, world=world, checkpoint=checkpoint, resume=True, **options
    )
    assert same(again, part)
    assert np.array_equal(again.clear_counts, part.clear_counts)
    for wrong in (other, None):
        more = options if wrong is not None else {**options, "sectors": 1}
        with pytest.raises(workspace.SweepFileError, match="of another sweep"):
            workspace.sweep(
                muxarm,
                samples=sampling.BLOCK,
                world=wrong,
                checkpoint=checkpoint,
                resume=True,
                **more,
            )


def test_a_sweep_without_a_world_has_no_clear_share(muxarm: Robot) -> None:
    found = workspace.sweep(muxarm, samples=1000, **SMALL)
    with pytest.raises(ValueError, match="the sweep had no world"):
        _ = found.clear_share
    with pytest.raises(ValueError, match="sectors: must be 1"):
        workspace.sweep(muxarm, samples=1000, world=load_world("cabinet"), sectors=1, **SMALL)
