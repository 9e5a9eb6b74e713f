"""Derivatives through solve_ik against finite differences of the solutions themselves."""

from __future__ import annotations

import equinox as eqx
import independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import muxjax
from muxjax.ik import all_ik, attach_derivatives, solve_ik

Q = np.array([0.7, 0.4, 1.1, 2.0, 0.6, 5.0])
STEP = 1e-5


def moved(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Linear part in the world, angular part in the tool's frame."""
    angle = np.linalg.norm(twist[3:])
    result = pose.copy()
    result[:3, 3] += twist[:3]
    if angle > 0:
        x, y, z = twist[3:] / angle
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
        result[:3, :3] = pose[:3, :3] @ turn
    return result


def near(robot, pose: np.ndarray) -> np.ndarray:
    every = all_ik(robot, pose)
    away = np.abs(independent.bending(every.q) - independent.bending(Q)).max(axis=(-1, -2))
    return every.q[int(np.nanargmin(away))]


@pytest.mark.slow
@pytest.mark.parametrize("axis", range(6))
def test_by_the_pose(muxarm, axis):
    pose = independent.pose(muxarm, Q)
    twist = np.eye(6)[axis]
    numeric = (
        near(muxarm, moved(pose, STEP * twist)) - near(muxarm, moved(pose, -STEP * twist))
    ) / (2 * STEP)
    change = (moved(pose, STEP * twist) - moved(pose, -STEP * twist)) / (2 * STEP)
    with jax.enable_x64(True):
        _, exact = jax.jvp(
            lambda p: solve_ik(muxarm, p, q0=Q, starts=8).q,
            (jnp.asarray(pose),),
            (jnp.asarray(change),),
        )
    np.testing.assert_allclose(exact, numeric, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "segment", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_by_a_length(muxarm, segment):
    pose = independent.pose(muxarm, Q)

    def longer(robot, by):
        return eqx.tree_at(lambda r: r.length, robot, robot.length + by * np.eye(3)[segment])

    numeric = (near(longer(muxarm, STEP), pose) - near(longer(muxarm, -STEP), pose)) / (2 * STEP)
    with jax.enable_x64(True):
        exact = jax.jacfwd(lambda by: solve_ik(longer(muxarm, by), pose, q0=Q, starts=8).q)(0.0)
    np.testing.assert_allclose(exact, numeric, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("frame", [pytest.param("base", marks=pytest.mark.slow), "tool"])
def test_by_a_frame(muxarm, frame):
    pose = independent.pose(muxarm, Q)

    def displaced(robot, by):
        direction = np.zeros((4, 4))
        direction[:3, 3] = [0.3, -0.5, 0.8]
        return eqx.tree_at(
            lambda r: getattr(r, frame), robot, getattr(robot, frame) + by * direction
        )

    numeric = (near(displaced(muxarm, STEP), pose) - near(displaced(muxarm, -STEP), pose)) / (
        2 * STEP
    )
    with jax.enable_x64(True):
        exact = jax.jacfwd(lambda by: solve_ik(displaced(muxarm, by), pose, q0=Q, starts=8).q)(0.0)
    np.testing.assert_allclose(exact, numeric, rtol=1e-5, atol=1e-4)


def test_backwards_equals_forwards(muxarm):
    pose = independent.pose(muxarm, Q)
    with jax.enable_x64(True):

        def solve(p):
            return solve_ik(muxarm, p, q0=Q, starts=8).q

        forwards = jax.jacfwd(solve)(jnp.asarray(pose))
        backwards = jax.jacrev(solve)(jnp.asarray(pose))
    assert np.abs(forwards).max() > 1
    np.testing.assert_allclose(forwards, backwards, rtol=1e-9, atol=1e-9)


def test_more_freedoms_take_the_least_change():
    penta = muxjax.load_robot("penta")
    q = np.tile([0.5, 0.3], 5) + np.arange(10) * 0.1
    pose = independent.pose(penta, q)
    change = np.zeros((4, 4))
    change[0, 3] = 1.0
    with jax.enable_x64(True):
        _, dq = jax.jvp(
            lambda p: attach_derivatives(penta, p, jnp.asarray(q)),
            (jnp.asarray(pose),),
            (jnp.asarray(change),),
        )
    after = independent.pose(penta, q + STEP * np.asarray(dq))
    before = independent.pose(penta, q - STEP * np.asarray(dq))
    np.testing.assert_allclose((after - before) / (2 * STEP), change, atol=1e-6)
