"""Partial goals, methods by name and other arms, judged by the independent transcription."""

from __future__ import annotations

import independent
import numpy as np
import pytest
from conftest import random_configurations

import muxjax
from muxjax.ik import IkStatus, solve_ik
from muxjax.ik.goals import check_weights

POSITION = np.array([1.0, 1, 1, 0, 0, 0])
POINTING = np.array([1.0, 1, 1, 1, 1, 0])


def poses_of(robot, q):
    return np.array([independent.pose(robot, row) for row in q])


@pytest.mark.parametrize("name", ["muxarm", "penta"])
def test_a_position_alone(rng, name):
    robot = muxjax.load_robot(name)
    pose = poses_of(robot, random_configurations(robot, rng, 40))
    result = solve_ik(robot, pose, weights=POSITION)
    assert result.converged.all()
    found = poses_of(robot, result.q)
    assert np.linalg.norm(found[:, :3, 3] - pose[:, :3, 3], axis=1).max() < 1.01e-10
    assert (result.q[:, 0::2] <= robot.theta_max).all()


def test_a_position_and_a_pointing_direction(muxarm, rng):
    pose = poses_of(muxarm, random_configurations(muxarm, rng, 40))
    result = solve_ik(muxarm, pose, weights=POINTING)
    assert result.converged.all()
    found = poses_of(muxarm, result.q)
    assert np.linalg.norm(found[:, :3, 3] - pose[:, :3, 3], axis=1).max() < 1.01e-10
    assert np.linalg.norm(found[:, :3, 2] - pose[:, :3, 2], axis=1).max() < 1.01e-10
    # what is free was used: not the whole poses
    assert np.abs(found - pose).max() > 0.1


def test_freedom_goes_to_the_reference(muxarm, rng):
    q = random_configurations(muxarm, rng, 30)
    q[:, 0::2] *= 0.5
    pose = poses_of(muxarm, q)
    free = solve_ik(muxarm, pose, weights=POSITION, q0=q)
    assert np.abs(independent.bending(free.q) - independent.bending(q)).max() < 1e-6
    straight = np.linalg.norm(
        independent.bending(solve_ik(muxarm, pose, weights=POSITION).q), axis=(1, 2)
    )
    assert (straight <= np.linalg.norm(independent.bending(q), axis=(1, 2)) + 1e-6).mean() > 0.9


def test_equal_weights_on_one_axis_only(muxarm, rng):
    pose = poses_of(muxarm, random_configurations(muxarm, rng, 10))
    result = solve_ik(muxarm, pose, weights=(0.0, 0.0, 2.0, 0.0, 0.0, 0.0))
    found = poses_of(muxarm, result.q)
    assert result.converged.all()
    assert np.abs(found[:, 2, 3] - pose[:, 2, 3]).max() < 1.01e-10


@pytest.mark.parametrize("method", ["all", "levenberg_marquardt", "pseudo_inverse"])
def test_every_method_by_name(muxarm, rng, method):
    pose = poses_of(muxarm, random_configurations(muxarm, rng, 30))
    result = solve_ik(muxarm, pose, method=method)
    assert result.converged.all()
    assert np.abs(poses_of(muxarm, result.q) - pose).max() < 2e-10


def test_an_unreachable_position_is_met_as_closely_as_possible(muxarm):
    pose = np.eye(4)
    pose[:3, 3] = [0.3, 0.4, 0.6]
    result = solve_ik(muxarm, pose, weights=POSITION)
    assert not result.converged
    assert result.status == IkStatus.OUT_OF_REACH
    # the straight arm, but for its root's direction, comes no nearer than the reach allows
    distance = np.linalg.norm(pose[:3, 3])
    assert distance - 0.47 <= result.position_error
    rng = np.random.default_rng(0)
    q = random_configurations(muxarm, rng, 4000)
    sampled = muxjax.forward_kinematics(muxarm, q)[:, :3, 3]
    assert result.position_error <= np.linalg.norm(sampled - pose[:3, 3], axis=1).min()


def test_bad_weights_and_methods(muxarm):
    for weights, message in (
        (np.ones(5), "weights: last axis must have 6 entries"),
        (np.ones((2, 6)), r"weights: must be 6 numbers for all poses"),
        ([1, 1, 1, 0, 0, -1], "weights: must be >= 0"),
        (np.zeros(6), "not all 0"),
    ):
        with pytest.raises(ValueError, match=message):
            check_weights(weights)
    pose = independent.pose(muxarm, np.array([0.3, 0, 0.4, 1, 0.5, 2]))
    with pytest.raises(ValueError, match="weights: method 'all' is for whole poses"):
        solve_ik(muxarm, pose, weights=POSITION, method="all")
    with pytest.raises(ValueError, match="method: must be one of auto, all, "):
        solve_ik.__wrapped__(muxarm, pose, method="newton")
    with pytest.raises(ValueError, match="method: 'all' needs three segments"):
        solve_ik(muxjax.load_robot("penta"), pose, method="all")
