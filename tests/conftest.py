"""Shared fixtures. Shape annotations are checked at run time here, and only here."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

# The workers, and later runs, share what has been compiled: most of the tests' time.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

# Two cores are shared by the test workers; XLA's own thread pools would only fight over them.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

from jaxtyping import install_import_hook

# The rooms with annotated array shapes; pydantic checks config.py itself.
SHAPED = [
    "robot",
    "kinematics",
    "tendons",
    "collision",
    "ik",
    "planning",
    "scheduler",
    "metrics",
    "pipeline",
    "statics",
    "urdf",
    "trajectory_file",
    *(f"viz.{part}" for part in ("scene", "drum", "obstacles", "playback", "recorded", "desk")),
]
install_import_hook([f"muxjax.{room}" for room in SHAPED], "beartype.beartype")

import jax
import numpy as np
import pytest

import muxjax
from muxjax.robot import Robot

MOST_MAPS = 20_000


@pytest.fixture(scope="module", autouse=True)
def few_compiled_functions() -> Iterator[None]:
    """Linux gives a process 65 530 memory maps; compiled functions take some each, and at the last
    one XLA aborts the worker with all its tests."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session", params=["muxarm", "penta"])
def robot(request: pytest.FixtureRequest) -> Robot:
    """Both shipped robots in turn."""
    return muxjax.load_robot(request.param)


@pytest.fixture(scope="session")
def muxarm() -> Robot:
    return muxjax.load_robot("muxarm")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260418)


def random_configurations(robot: Robot, rng: np.random.Generator, *batch: int) -> np.ndarray:
    """Uniform over the allowed bending angles and all azimuths, shape (*batch, 2S)."""
    theta = rng.uniform(0.0, robot.theta_max, (*batch, robot.n_segments))
    phi = rng.uniform(0.0, 2 * np.pi, (*batch, robot.n_segments))
    return np.stack([theta, phi], axis=-1).reshape(*batch, -1)
