"""Kinematics against an independent transcription, finite differences and autodiff."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from math import factorial

import equinox as eqx
import independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_configurations
from scipy.spatial.transform import Rotation

import muxjax
from muxjax.kinematics import (
    bending_from_configuration,
    bending_jacobian,
    check_configuration,
    configuration_from_bending,
    pose_from_bending,
    roll_pitch_yaw,
    stumpff,
)
from muxjax.robot import Robot

SMALL = [0.0, 1e-12, 1e-9, 1e-6, 1e-3]
FRAMES = ["base", "body", "mixed"]


def with_small_angles(robot: Robot, rng: np.random.Generator, n: int) -> np.ndarray:
    """Random configurations; in half of them some segments are at or next to straight."""
    q = random_configurations(robot, rng, n)
    some = rng.random((n // 2, robot.n_segments)) < 0.5
    small = rng.choice(SMALL, (n // 2, robot.n_segments))
    q[: n // 2, 0::2] = np.where(some, small, q[: n // 2, 0::2])
    q[: len(SMALL), 0::2] = np.array(SMALL)[:, None]
    return q


def test_forward_kinematics_agrees_with_the_transcription(robot, rng):
    q = with_small_angles(robot, rng, 1000)
    expected = np.array([independent.pose(robot, row) for row in q])
    np.testing.assert_allclose(muxjax.forward_kinematics(robot, q), expected, rtol=0, atol=1e-12)


def test_backbone_agrees_with_the_transcription(robot, rng):
    q = with_small_angles(robot, rng, 100)
    expected = np.array([independent.backbone(robot, row, 4) for row in q])
    np.testing.assert_allclose(muxjax.backbone(robot, q, 4), expected, rtol=0, atol=1e-12)


def test_backbone_runs_from_base_to_tip_at_equal_arc_length(robot, rng):
    q = random_configurations(robot, rng)
    frames = muxjax.backbone(robot, q, 200)
    assert frames.shape == (200 * robot.n_segments + 1, 4, 4)
    np.testing.assert_allclose(frames[0], robot.base)
    np.testing.assert_allclose(frames[-1] @ robot.tool, muxjax.forward_kinematics(robot, q))
    steps = np.linalg.norm(np.diff(frames[:, :3, 3], axis=0), axis=-1)
    np.testing.assert_allclose(steps, np.repeat(robot.length / 200, 200), rtol=1e-4)


@pytest.mark.parametrize("frame", FRAMES)
def test_jacobian_agrees_with_the_transcription(robot, rng, frame):
    q = with_small_angles(robot, rng, 1000)
    expected = np.array([independent.jacobian(robot, row, frame) for row in q])
    np.testing.assert_allclose(muxjax.jacobian(robot, q, frame), expected, rtol=0, atol=1e-12)


def numeric_twist(robot: Robot, q: np.ndarray, direction: np.ndarray, frame: str) -> np.ndarray:
    """Twist along ``direction`` from central differences of the independent pose."""
    h = 1e-5
    ahead, behind = (independent.pose(robot, q + s * h * direction) for s in (1, -1))
    tip = independent.pose(robot, q)
    velocity = (ahead - behind) / (2 * h)
    spin = velocity[:3, :3] @ tip[:3, :3].T
    linear, angular = velocity[:3, 3], np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
    if frame == "body":
        linear = tip[:3, :3].T @ linear
    if frame != "base":
        angular = tip[:3, :3].T @ angular
    return np.concatenate([linear, angular])


@pytest.mark.parametrize("frame", FRAMES)
def test_jacobian_agrees_with_finite_differences(robot, rng, frame):
    for q in random_configurations(robot, rng, 10):
        columns = [numeric_twist(robot, q, e, frame) for e in np.eye(len(q))]
        np.testing.assert_allclose(
            muxjax.jacobian(robot, q, frame), np.array(columns).T, rtol=0, atol=1e-9
        )


@pytest.mark.parametrize("theta", [*SMALL, 1.0])
def test_bending_jacobian_agrees_with_autodiff(robot, rng, theta):
    q = random_configurations(robot, rng)
    q[0::2] = theta
    with jax.enable_x64(True):
        b = bending_from_configuration(jnp.asarray(q))
        tip = pose_from_bending(robot, b)[:3, :3]
        slope = jax.jacfwd(lambda b: pose_from_bending(robot, b))(b).reshape(4, 4, -1)
        spin = jnp.einsum("ijk,lj->ilk", slope[:3, :3], tip)
        expected = jnp.concatenate([slope[:3, 3], jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]])])
        found = bending_jacobian(robot, b, "base")
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_jacobian_refuses_an_unknown_frame(muxarm):
    # The import hook's own check of the annotation would come first here.
    unchecked = inspect.unwrap(muxjax.jacobian)
    with pytest.raises(ValueError, match=r"frame: must be 'base', 'body' or 'mixed', found 'tool'"):
        unchecked(muxarm, np.zeros(6), "tool")


def series(u: float, k: int, order: int) -> float:
    """d^order/du^order of sum (-u)^n / (2n + k)!, term by term."""
    return sum(
        (-1) ** n * u ** (n - order) * factorial(n) / factorial(n - order) / factorial(2 * n + k)
        for n in range(order, 40)
    )


@pytest.mark.parametrize("k", range(5))
@pytest.mark.parametrize("u", [0.0, 1e-24, 1e-18, 1e-12, 1e-6, 0.5, 3.999999, 4.0, 4.1, 9.9])
def test_stumpff_and_its_derivatives_match_the_series(k, u):
    with jax.enable_x64(True):
        derivative = lambda x: stumpff(x, k)  # noqa: E731
        for order in range(4):
            found = float(derivative(jnp.asarray(u)))
            assert found == pytest.approx(series(u, k, order), rel=1e-11, abs=1e-14)
            derivative = jax.grad(derivative)


def check_three_derivatives(robot: Robot, curve_of: Callable, exact_of: Callable) -> None:
    """t-derivatives along b = (theta + t) a match the transcription, at and beside theta = 0.

    ``curve_of`` maps a bending and ``exact_of`` a configuration to the same quantity. The curve
    is analytic through theta = 0, so a polynomial through points at |t| > 0.02 gives its
    derivatives at the awkward point without going near it.
    """
    directions = np.linspace(0.3, 2.4, robot.n_segments)
    along = np.stack([np.cos(directions), np.sin(directions)], axis=-1)
    points = np.cos(np.pi * (np.arange(16) + 0.5) / 16)
    assert np.min(np.abs(0.4 * points)) > 0.02

    def derivatives(theta: jax.Array) -> list[jax.Array]:
        curve = lambda x: curve_of(robot, x * jnp.asarray(along))  # noqa: E731
        orders = []
        for _ in range(3):
            curve = jax.jacfwd(curve)
            orders.append(curve(theta))
        return orders

    compiled = jax.jit(derivatives)
    for theta in SMALL:
        with jax.enable_x64(True):
            found = compiled(theta)
        values = [
            exact_of(robot, np.stack([np.full(len(along), theta + 0.4 * x), directions], 1).ravel())
            for x in points
        ]
        fit = np.polynomial.polynomial.polyfit(points, np.array(values).reshape(16, -1), 15)
        for order in (1, 2, 3):
            expected = factorial(order) * fit[order] / 0.4**order
            np.testing.assert_allclose(found[order - 1].ravel(), expected, rtol=0, atol=1e-9)


def test_forward_kinematics_has_three_derivatives_at_and_near_straight(robot):
    check_three_derivatives(robot, pose_from_bending, independent.pose)


def test_all_third_partial_derivatives_are_finite(muxarm):
    f = lambda b: pose_from_bending(muxarm, b)  # noqa: E731
    third = jax.jit(jax.jacfwd(jax.jacfwd(jax.jacfwd(f))))
    for theta in SMALL:
        with jax.enable_x64(True):
            assert np.isfinite(third(jnp.full((3, 2), theta))).all()


def test_any_batch_axes(robot, rng):
    q = random_configurations(robot, rng, 2, 3)
    poses = muxjax.forward_kinematics(robot, q)
    assert poses.shape == (2, 3, 4, 4)
    assert muxjax.backbone(robot, q, 2).shape == (2, 3, 2 * robot.n_segments + 1, 4, 4)
    jac = muxjax.jacobian(robot, q)
    assert jac.shape == (2, 3, 6, 2 * robot.n_segments)
    np.testing.assert_allclose(poses[1, 2], muxjax.forward_kinematics(robot, q[1, 2]), atol=1e-15)
    np.testing.assert_allclose(jac[1, 2], muxjax.jacobian(robot, q[1, 2]), atol=1e-15)
    assert muxjax.forward_kinematics(robot, q[:0]).shape == (0, 3, 4, 4)


def test_polar_and_cartesian_bending_are_inverse(robot, rng):
    q = random_configurations(robot, rng, 100)
    with jax.enable_x64(True):
        again = configuration_from_bending(bending_from_configuration(jnp.asarray(q)))
        straight = configuration_from_bending(jnp.zeros((robot.n_segments, 2)))
        below = configuration_from_bending(jnp.array([[1.0, -1e-17]]))
    np.testing.assert_allclose(again, q, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(straight, np.zeros(2 * robot.n_segments))
    assert 0 <= below[1] < 2 * np.pi


def test_numpy_in_gives_float64_and_jax_float32_stays(robot, rng):
    q = random_configurations(robot, rng, 5)
    exact = muxjax.forward_kinematics(robot, q)
    assert isinstance(exact, np.ndarray)
    assert exact.dtype == np.float64
    assert isinstance(muxjax.forward_kinematics(robot, q.tolist()), np.ndarray)
    rough = muxjax.forward_kinematics(robot, jnp.asarray(q, jnp.float32))
    assert isinstance(rough, jax.Array)
    assert rough.dtype == jnp.float32
    np.testing.assert_allclose(rough, exact, atol=2e-6)


def test_transforms_compose(robot, rng):
    q = jnp.asarray(random_configurations(robot, rng, 4), jnp.float32)
    one_by_one = muxjax.forward_kinematics(robot, np.asarray(q))
    mapped = jax.jit(jax.vmap(lambda row: muxjax.forward_kinematics(robot, row)))(q)
    np.testing.assert_allclose(mapped, one_by_one, atol=1e-6)
    grad = jax.jit(jax.grad(lambda row: muxjax.forward_kinematics(robot, row)[2, 3]))(q[0])
    np.testing.assert_allclose(grad, muxjax.jacobian(robot, np.asarray(q[0]))[2], atol=1e-6)


@pytest.mark.parametrize("field", ["length", "tool"])
def test_gradients_by_robot_parameters(robot, rng, field):
    q = random_configurations(robot, rng)
    value = np.asarray(getattr(robot, field))
    change = rng.normal(size=value.shape)

    def tip(t):
        varied = eqx.tree_at(lambda r: getattr(r, field), robot, value + t * change)
        return pose_from_bending(varied, bending_from_configuration(jnp.asarray(q)))[:3, 3]

    with jax.enable_x64(True):
        found = jax.jacfwd(tip)(0.0)
        numeric = (tip(1e-6) - tip(-1e-6)) / 2e-6
    assert np.linalg.norm(found) > 0.01
    np.testing.assert_allclose(found, numeric, atol=1e-8)


@pytest.mark.parametrize(
    "call",
    [
        muxjax.forward_kinematics,
        muxjax.jacobian,
        lambda r, q: muxjax.backbone(r, q, 2),
        check_configuration,
    ],
)
def test_bad_configurations_are_refused(muxarm, call):
    with pytest.raises(ValueError, match=r"q: last axis must have 6 entries, found shape \(5,\)"):
        call(muxarm, np.zeros(5))
    with pytest.raises(ValueError, match=r"q: entry \(1, 2\) is nan, must be finite"):
        call(muxarm, np.where(np.arange(12) == 8, np.nan, 0).reshape(2, 6))
    with pytest.raises(ValueError, match=r"q: expected numbers"):
        call(muxarm, "straight")


def test_backbone_refuses_no_intervals(muxarm):
    with pytest.raises(ValueError, match="n: must be a whole number of intervals"):
        muxjax.backbone(muxarm, np.zeros(6), 0)


def test_a_bending_beyond_the_limit_is_refused_by_name(muxarm):
    q = np.zeros((2, 6))
    q[1, 4] = np.radians(141)
    with pytest.raises(ValueError, match=r"q\[1\]: bending of segment 3 is 141 degrees, limit 140"):
        check_configuration(muxarm, q)
    q[1, 4] = np.radians(-141)
    with pytest.raises(ValueError, match=r"segment 3 is 141 degrees"):
        check_configuration(muxarm, q)


@pytest.mark.filterwarnings("error")
def test_roll_pitch_and_yaw_compose_to_the_rotation(rng):
    turns = [*Rotation.random(50, rng=rng), Rotation.identity()]
    turns += [
        Rotation.from_euler("xyz", [r, p, 0.7]) for r in (0, -2) for p in (-np.pi / 2, np.pi / 2)
    ]
    for turn in turns:
        rpy = roll_pitch_yaw(turn.as_matrix())
        assert abs(rpy[1]) <= np.pi / 2
        again = Rotation.from_euler("xyz", rpy)
        np.testing.assert_allclose(again.as_matrix(), turn.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(
        roll_pitch_yaw(Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()), [0.1, 0.2, 0.3]
    )
