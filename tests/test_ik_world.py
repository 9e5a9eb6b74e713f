"""Inverse kinematics clear of obstacles."""

from __future__ import annotations

import independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_configurations

from muxjax.collision import clearance, load_world
from muxjax.ik import IkStatus, all_ik, solve_ik


@pytest.mark.parametrize("name", ["cabinet", "s_pipe"])
def test_a_clear_solution_is_returned_if_there_is_one(muxarm, rng, name):
    world = load_world(name)
    q = random_configurations(muxarm, rng, 60)
    q[:, 0::2] *= 0.6
    # along the pipe's own bends
    q[30:] = np.array([0.48, 0.0, 0.04, np.pi, 0.4, np.pi]) + rng.uniform(0, 0.02, (30, 6))
    pose = np.array([independent.pose(muxarm, row) for row in q])
    result, every = solve_ik(muxarm, pose, world=world), all_ik(muxarm, pose)
    with jax.enable_x64(True):
        own = np.asarray(clearance(muxarm, jnp.asarray(np.nan_to_num(every.q)), world))
    best = np.where(every.mask, own, -np.inf).max(axis=1)
    np.testing.assert_array_equal(result.converged, best >= 0)
    assert (result.status[best < 0] == IkStatus.BLOCKED).all()
    np.testing.assert_allclose(result.clearance[best < 0], best[best < 0], atol=1e-9)
    assert (result.clearance[best >= 0] >= 0).all()
    assert (result.converged).any()
    assert (~result.converged).any()
    assert ((result.nearest_segment >= 1) & (result.nearest_segment <= 4)).all()
    found = np.array([independent.pose(muxarm, row) for row in result.q])
    assert np.abs(found - pose).max() < 2e-10


def test_a_pose_out_of_reach_has_no_clearance(muxarm):
    pose = np.eye(4)
    pose[2, 3] = 0.6
    result = solve_ik(muxarm, pose, world=load_world("cabinet"))
    assert not result.converged
    assert result.status == IkStatus.OUT_OF_REACH
    assert np.isnan(result.clearance)
    assert result.nearest_segment == 0


def test_other_methods_have_no_world(muxarm):
    with pytest.raises(ValueError, match="world: needs method 'all'"):
        solve_ik(muxarm, np.eye(4), world=load_world("cabinet"), method="pseudo_inverse")
