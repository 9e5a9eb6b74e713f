"""Paths of poses."""

from __future__ import annotations

import independent
import numpy as np
import pytest

import muxjax
from muxjax.ik import solve_path


def bend(q):
    return independent.bending(q)


def line(q_from, q_to, n):
    b = np.linspace(bend(q_from), bend(q_to), n)
    theta, phi = np.linalg.norm(b, axis=-1), np.arctan2(b[..., 1], b[..., 0]) % (2 * np.pi)
    return np.stack([theta, phi], axis=-1).reshape(n, -1)


def test_a_smooth_path_is_followed_without_a_switch(muxarm):
    q = line(np.array([0.3, 0.4, 0.5, 2.0, 0.6, 5.0]), np.array([1.0, 1.4, 0.8, 2.9, 0.9, 4.0]), 60)
    poses = np.array([independent.pose(muxarm, row) for row in q])
    result = solve_path(muxarm, poses, q0=q[0])
    assert result.converged.all()
    assert not result.switched.any()
    np.testing.assert_allclose(bend(result.q), bend(q), atol=1e-6)
    assert result.step.max() < 0.1


def test_a_jump_between_poses_is_reported(muxarm):
    q = np.array([[0.3, 0.4, 0.5, 2.0, 0.6, 5.0], [2.0, 3.4, 1.5, 0.0, 1.6, 1.0]])
    poses = np.array([independent.pose(muxarm, row) for row in q[[0, 0, 1, 1]]])
    result = solve_path(muxarm, poses, q0=q[0])
    assert result.converged.all()
    np.testing.assert_array_equal(result.switched, [False, False, True, False])


def test_a_pose_out_of_reach_is_passed_over(muxarm):
    q = np.array([0.3, 0.4, 0.5, 2.0, 0.6, 5.0])
    poses = np.tile(independent.pose(muxarm, q), (3, 1, 1))
    poses[1, :3, 3] = [0, 0, 0.6]
    result = solve_path(muxarm, poses, q0=q)
    np.testing.assert_array_equal(result.converged, [True, False, True])
    np.testing.assert_allclose(bend(result.q), bend(np.tile(q, (3, 1))), atol=1e-6)


def test_five_segments_go_on_from_the_last_solution():
    penta = muxjax.load_robot("penta")
    q = line(np.tile([0.4, 1.0], 5), np.tile([0.6, 1.5], 5), 6)
    poses = np.array([independent.pose(penta, row) for row in q])
    result = solve_path(penta, poses, q0=q[0])
    assert result.converged.all()
    assert not result.switched.any()
    found = np.array([independent.pose(penta, row) for row in result.q])
    assert np.abs(found - poses).max() < 2e-10


def test_bad_paths(muxarm):
    with pytest.raises(ValueError, match=r"poses: must have shape \(N, 4, 4\)"):
        solve_path.__wrapped__(muxarm, np.eye(4))
    with pytest.raises(ValueError, match="largest_step: must be above 0"):
        solve_path(muxarm, np.eye(4)[None], largest_step=0.0)
