"""Inverse kinematics judged by the independent transcription."""

from __future__ import annotations

import equinox as eqx
import independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_configurations

import muxjax
from muxjax.config import RobotConfig
from muxjax.ik import IkError, IkStatus, rotation_error, solve_ik
from muxjax.robot import Robot, robot_from_config


def poses_of(robot: Robot, q: np.ndarray) -> np.ndarray:
    rows = q.reshape(-1, q.shape[-1])
    return np.array([independent.pose(robot, row) for row in rows]).reshape(*q.shape[:-1], 4, 4)


def assert_solved(robot: Robot, pose: np.ndarray, result) -> None:
    """q reproduces the poses by the independent transcription, within the limits."""
    assert result.converged.all()
    assert (result.status == IkStatus.CONVERGED).all()
    theta = result.q[..., 0::2]
    assert (theta >= 0).all()
    assert (theta <= robot.theta_max).all()
    found = poses_of(robot, result.q)
    assert np.linalg.norm(found[..., :3, 3] - pose[..., :3, 3], axis=-1).max() < 1.01e-10
    for a, b in zip(found.reshape(-1, 4, 4), pose.reshape(-1, 4, 4), strict=True):
        assert independent.rotation_angle(a[:3, :3], b[:3, :3]) < 1.01e-10


@pytest.mark.parametrize(("name", "count"), [("muxarm", 256), ("penta", 60)])
def test_random_reachable_poses_are_all_solved(rng, name, count):
    robot = muxjax.load_robot(name)
    pose = poses_of(robot, random_configurations(robot, rng, count))
    result = solve_ik(robot, pose)
    assert_solved(robot, pose, result)
    assert result.check() is result
    assert (result.position_error < 1e-10).all()
    assert (result.orientation_error < 1e-10).all()


@pytest.mark.parametrize("straight", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_straight_segments_are_ordinary(muxarm, rng, straight):
    q = random_configurations(muxarm, rng)
    q[[2 * i for i in straight]] = 0.0
    pose = poses_of(muxarm, q)
    assert_solved(muxarm, pose, solve_ik(muxarm, pose))


def test_the_straight_pose_from_straight_and_from_bent(robot):
    straight = np.zeros(2 * robot.n_segments)
    pose = independent.pose(robot, straight)
    np.testing.assert_array_equal(solve_ik(robot, pose).q[0::2], 0)
    bent = np.tile([0.5, 0.3], robot.n_segments)
    assert_solved(robot, pose, solve_ik(robot, pose, q0=bent))


def test_segments_at_their_limit_are_reached_and_named(muxarm):
    q = np.array([np.pi, 0.4, 1.0, 2.0, np.radians(140), 5.0])
    pose = independent.pose(muxarm, q)
    result = solve_ik(muxarm, pose, q0=q)
    assert_solved(muxarm, pose, result)
    np.testing.assert_array_equal(result.binding_limit, [True, False, True])


def test_the_solution_nearest_to_q0_is_taken(muxarm, rng):
    q = random_configurations(muxarm, rng, 20)
    q[:, 0::2] = np.minimum(q[:, 0::2], 2.0)
    near = q + 0.01 * rng.normal(size=q.shape)
    near[:, 0::2] = np.abs(near[:, 0::2])
    result = solve_ik(muxarm, poses_of(muxarm, q), q0=near)
    assert result.converged.all()
    own = np.linalg.norm(independent.bending(q) - independent.bending(near), axis=(-1, -2))
    found = np.linalg.norm(independent.bending(result.q) - independent.bending(near), axis=(-1, -2))
    assert (found <= own + 1e-6).all()


def test_a_redundant_arm_stays_near_q0(rng):
    penta = muxjax.load_robot("penta")
    q = random_configurations(penta, rng, 10)
    q[:, 0::2] *= 0.6
    pose = poses_of(penta, q)

    def away(result, reference):
        change = independent.bending(result.q) - independent.bending(reference)
        return np.linalg.norm(change, axis=(-1, -2))

    towards_q, towards_straight = solve_ik(penta, pose, q0=q), solve_ik(penta, pose)
    assert_solved(penta, pose, towards_q)
    assert (away(towards_q, q) < 1e-6).all()
    assert (
        away(towards_straight, np.zeros_like(q)) <= away(towards_q, np.zeros_like(q))
    ).mean() > 0.8


def test_an_unreachable_pose_is_reported_with_the_closest_found(muxarm):
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[0, 2, 3] = 0.57  # 0.1 m beyond the straight arm's tip
    pose[1] = independent.pose(muxarm, np.array([0.3, 0, 0.4, 1, 0.5, 2]))
    result = solve_ik(muxarm, pose)
    np.testing.assert_array_equal(result.converged, [False, True])
    np.testing.assert_array_equal(result.status, [IkStatus.OUT_OF_REACH, IkStatus.CONVERGED])
    assert result.position_error[0] == pytest.approx(0.1, abs=0.002)
    found = independent.pose(muxarm, result.q[0])
    assert np.linalg.norm(found[:3, 3] - pose[0, :3, 3]) == pytest.approx(result.position_error[0])
    with pytest.raises(
        IkError, match=r"pose\[0\]: not reached \(OUT_OF_REACH\).* mm and .* degrees"
    ):
        result.check()


def test_a_bending_beyond_the_limit_is_reported_with_the_limit_that_binds(muxarm):
    """Within reach of a longer bend, out of that of the arm: only limits stand between."""
    q = np.array([0.2, 0.0, 0.2, 0.0, np.radians(150), 0.0])
    result = solve_ik(muxarm, independent.pose(muxarm, q), q0=np.zeros(6), starts=16)
    assert not result.converged
    assert result.status == IkStatus.LIMITED
    np.testing.assert_array_equal(result.binding_limit, [False, False, True])
    with pytest.raises(IkError, match=r"pose: not reached \(LIMITED\).*segments \[3\] at their"):
        result.check()


def test_the_same_key_gives_the_same_answer_and_rows_are_independent(muxarm, rng):
    pose = poses_of(muxarm, random_configurations(muxarm, rng, 40))
    batch = solve_ik(muxarm, pose)
    np.testing.assert_array_equal(batch.q, solve_ik(muxarm, pose, key=jax.random.key(0)).q)
    alone = solve_ik(muxarm, pose[17])
    np.testing.assert_allclose(
        independent.bending(alone.q), independent.bending(batch.q[17]), atol=1e-6
    )
    assert solve_ik(muxarm, pose, key=jax.random.key(1)).converged.all()


def test_batch_axes(muxarm, rng):
    pose = poses_of(muxarm, random_configurations(muxarm, rng, 2, 3))
    result = solve_ik(muxarm, pose, q0=np.zeros(6))
    assert result.q.shape == (2, 3, 6)
    assert result.binding_limit.shape == (2, 3, 3)
    assert result.converged.shape == result.status.shape == (2, 3)
    assert solve_ik(muxarm, pose[:0]).q.shape == (0, 3, 6)
    assert solve_ik(muxarm, pose[0, 0]).q.dtype == np.float64


def test_a_float32_pose_is_orthonormalised(muxarm, rng):
    q = random_configurations(muxarm, rng, 10)
    rounded = jnp.asarray(poses_of(muxarm, q), jnp.float32)
    result = solve_ik(muxarm, rounded)
    assert result.converged.all()
    np.testing.assert_allclose(poses_of(muxarm, result.q), rounded, atol=1e-6)


@pytest.mark.parametrize("segments", [1, 2])
def test_an_arm_of_fewer_than_six_freedoms(muxarm, rng, segments):
    raw = muxarm.config.model_dump(by_alias=True)
    short = robot_from_config(
        RobotConfig.model_validate(raw | {"segments": raw["segments"][:segments]})
    )
    pose = poses_of(short, random_configurations(short, rng, 10))
    assert_solved(short, pose, solve_ik(short, pose))


def test_base_and_tool_frames_belong_to_the_pose(rng):
    robot = muxjax.load_robot("muxarm")
    base = independent.segment(0.7, 1.0, 0.5)
    tool = independent.segment(1.1, 2.0, 0.1)
    moved = eqx.tree_at(lambda r: (r.base, r.tool), robot, (base, tool))
    pose = poses_of(moved, random_configurations(moved, rng, 5))
    assert_solved(moved, pose, solve_ik(moved, pose))


def test_rotation_error_tells_half_a_turn_from_none():
    with jax.enable_x64(True):
        for angle in (0.0, 1e-12, 1e-9, 0.5, np.pi - 1e-9, np.pi):
            vee, found = rotation_error(jnp.eye(3), jnp.asarray(independent.rot_y(angle)))
            assert float(found) == pytest.approx(angle, rel=1e-12, abs=1e-15)
            np.testing.assert_allclose(vee, [0, np.sin(angle), 0], rtol=0, atol=1e-15)


def test_tracing_needs_float64(muxarm, rng):
    pose = poses_of(muxarm, random_configurations(muxarm, rng))
    solve = jax.jit(lambda p: solve_ik(muxarm, p, starts=24))
    with pytest.raises(ValueError, match=r"traced in float32.*jax_enable_x64"):
        solve(jnp.asarray(pose, jnp.float32))
    with jax.enable_x64(True):
        traced = solve(jnp.asarray(pose))
        broken = solve(jnp.full((4, 4), jnp.nan))
    assert_solved(muxarm, pose, jax.tree.map(np.asarray, traced))
    assert not broken.converged


def shifted(pose: np.ndarray, index: tuple[int, ...], by: float) -> np.ndarray:
    pose = pose.copy()
    pose[index] += by
    return pose


def test_bad_poses_are_refused_by_row(muxarm):
    good = np.tile(independent.pose(muxarm, np.array([0.3, 0, 0.4, 1, 0.5, 2])), (3, 1, 1))
    mirror = good @ np.diag([1.0, 1, -1, 1])
    for pose, message in (
        (np.zeros(4), r"pose: must have shape \(\.\.\., 4, 4\), found \(4,\)"),
        (np.eye(3), r"pose: last axis must have 4 entries"),
        (shifted(good, (1, 0, 3), np.nan), r"pose: entry \(1, 0, 3\) is nan"),
        (shifted(good, (2, 0, 0), 1e-3), r"pose\[2\]: not a rotation: .* below 1e-05, found 0\.00"),
        (mirror[0], r"pose: not a rotation but a reflection: .*found -1"),
        (shifted(good, (1, 3, 3), 1.0), r"pose\[1\]: last row must be \(0, 0, 0, 1\)"),
        (shifted(good, (1, 0, 3), 200), r"pose\[1\]: position must be within 4\.7 m.*millimetres"),
    ):
        with pytest.raises(ValueError, match=message):
            solve_unhooked(muxarm, pose)


def test_bad_references_are_refused(muxarm):
    pose = np.tile(np.eye(4), (3, 1, 1))
    pose[:, 2, 3] = 0.47
    with pytest.raises(ValueError, match=r"q0: last axis must have 6 entries"):
        solve_unhooked(muxarm, pose, q0=np.zeros(5))
    with pytest.raises(ValueError, match=r"q0: bending of segment 3 is 160.*limit 140"):
        solve_unhooked(muxarm, pose, q0=np.array([0, 0, 0, 0, np.radians(160), 0]))
    with pytest.raises(ValueError, match=r"q0: batch axes \(2,\) must broadcast to .* \(3,\)"):
        solve_unhooked(muxarm, pose, q0=np.zeros((2, 6)))
    with pytest.raises(ValueError, match=r"q0: entry \(1,\) is nan"):
        solve_unhooked(muxarm, pose, q0=np.array([0, np.nan, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match=r"starts: must be at least 1, found 0"):
        solve_ik(muxarm, pose, starts=0)


def solve_unhooked(robot: Robot, pose: np.ndarray, **options):
    """Without the import hook's check of shapes, which would come before ours."""
    return solve_ik.__wrapped__(robot, pose, **options)
