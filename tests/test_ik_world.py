"""Inverse kinematics clear of obstacles, and the best by a cost."""

from __future__ import annotations

import independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_configurations

from muxjax.collision import (
    SphereConfig,
    WorldConfig,
    attach,
    clearance,
    load_world,
    world_from_config,
)
from muxjax.ik import IkStatus, all_ik, solve_ik
from muxjax.robot import load_robot

COMPILED = jax.jit(clearance)


def clearances(robot, q: np.ndarray, world) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(COMPILED(robot, jnp.asarray(np.nan_to_num(q)), world))


def world_of(*balls: tuple[np.ndarray, float]):
    items = [{"kind": "sphere", "centre_m": c.tolist(), "radius_m": r} for c, r in balls]
    raw = {"schema": "muxjax/world/1", "name": "balls", "obstacles": items}
    return world_from_config(WorldConfig.model_validate(raw))


def bending(q: np.ndarray) -> np.ndarray:
    theta, phi = q[..., 0::2], q[..., 1::2]
    return np.concatenate([theta * np.cos(phi), theta * np.sin(phi)], axis=-1)


def test_a_clear_solution_is_returned_if_there_is_one(muxarm, rng):
    world = load_world("cabinet")
    q = random_configurations(muxarm, rng, 60)
    q[:, 0::2] *= 0.6
    pose = np.array([independent.pose(muxarm, row) for row in q])
    result, every = solve_ik(muxarm, pose, world=world), all_ik(muxarm, pose)
    own = clearances(muxarm, every.q, world)
    best = np.where(every.mask, own, -np.inf).max(axis=1)
    np.testing.assert_array_equal(result.converged, best >= 0)
    assert (result.status[best < 0] == IkStatus.BLOCKED).all()
    np.testing.assert_allclose(result.clearance[best < 0], best[best < 0], atol=1e-9)
    assert (result.clearance[best >= 0] >= 0).all()
    assert (result.converged).any()
    assert (~result.converged).any()
    assert ((result.nearest_segment >= 1) & (result.nearest_segment <= 3)).all()
    found = np.array([independent.pose(muxarm, row) for row in result.q])
    assert np.abs(found - pose).max() < 2e-10


def test_the_place_of_the_collision_is_on_the_arm(muxarm):
    """A ball on the second segment's backbone, of a pose with nowhere to go."""
    q = np.radians([30.0, 0.0, 40.0, 90.0, 20.0, 0.0])
    middle = independent.backbone(muxarm, q, 16)[16 + 8][:3, 3]
    result = solve_ik(muxarm, independent.pose(muxarm, q), world=world_of((middle, 0.2)), q0=q)
    assert result.status == IkStatus.BLOCKED
    assert not result.converged
    frames = np.array(independent.backbone(muxarm, result.q, 16))[:, :3, 3]
    assert np.linalg.norm(frames - result.nearest_point, axis=-1).min() < 1e-9
    depth = np.linalg.norm(result.nearest_point - middle) - 0.2 - float(muxarm.body_radius)
    assert result.clearance == pytest.approx(depth, abs=6e-3)


@pytest.mark.parametrize(
    ("name", "weights"),
    [
        ("muxarm", (1.0, 1.0, 1.0, 1.0, 1.0, 0.0)),
        pytest.param("penta", (1.0, 1.0, 1.0, 1.0, 1.0, 0.0), marks=pytest.mark.slow),
        pytest.param("penta", None, marks=pytest.mark.slow),
    ],
)
def test_freedom_is_used_to_go_around(name, rng, weights):
    """A ball is put where the nearest solution has its second segment; goals leave freedom."""
    robot = load_robot(name)
    q = random_configurations(robot, rng, 6)
    q[:, 0::2] *= 0.5
    pose = np.array([independent.pose(robot, row) for row in q])
    solved = 0
    for target in pose:
        first = solve_ik(robot, target, weights=weights)
        centre = independent.backbone(robot, first.q, 16)[16 + 8][:3, 3]
        world = world_of((np.array(centre), 0.01))
        assert clearances(robot, first.q, world) < 0
        found = solve_ik(robot, target, weights=weights, world=world)
        assert found.position_error < 1e-10
        assert found.orientation_error < 1e-10
        assert found.clearance == pytest.approx(float(clearances(robot, found.q, world)), abs=1e-9)
        assert found.converged == (found.clearance >= 0)
        solved += bool(found.converged)
    assert solved >= 4


def test_preferences_rank_the_solutions(muxarm, rng):
    q = random_configurations(muxarm, rng, 40)
    q[:, 0::2] *= 0.6
    pose = np.array([independent.pose(muxarm, row) for row in q])
    every, world = all_ik(muxarm, pose), load_world("cabinet")
    mask = np.asarray(every.mask)
    assert (mask.sum(axis=1) > 1).sum() > 10
    away = np.sum((bending(every.q) - bending(q)[:, None]) ** 2, axis=-1)
    bent = np.sum(bending(every.q) ** 2, axis=-1)
    clear = clearances(muxarm, every.q, world)

    def best(cost: np.ndarray) -> np.ndarray:
        return every.q[np.arange(len(q)), np.argmin(np.where(mask, cost, np.inf), axis=1)]

    for prefer, cost in (
        ("distance", away),
        ("bending", bent),
        ({"distance": 1.0, "bending": 0.5}, away + 0.5 * bent),
    ):
        found = solve_ik(muxarm, pose, q0=q, prefer=prefer)
        np.testing.assert_allclose(bending(found.q), bending(best(cost)), atol=1e-7)
    found = solve_ik(muxarm, pose, q0=q, prefer="clearance", world=world)
    np.testing.assert_allclose(
        found.clearance, np.where(mask, clear, -np.inf).max(axis=1), atol=1e-8
    )


def test_a_grasped_object_is_kept_clear_too(muxarm, rng):
    """With a long stick in the gripper some poses that were clear are not any more."""
    bare = load_world("cabinet")
    stick = [SphereConfig(centre_m=(0.0, 0.0, z), radius_m=0.02) for z in (0.05, 0.1, 0.15)]
    q = random_configurations(muxarm, rng, 60)
    q[:, 0::2] *= 0.6
    pose = np.array([independent.pose(muxarm, row) for row in q])
    without = solve_ik(muxarm, pose, world=bare)
    with_stick = solve_ik(muxarm, pose, world=attach(bare, stick))
    assert (without.converged | ~with_stick.converged).all()
    assert (without.converged & ~with_stick.converged).any()
    assert (with_stick.nearest_segment[~with_stick.converged] == 4).any()


def test_a_pose_out_of_reach_has_no_clearance(muxarm):
    pose = np.eye(4)
    pose[2, 3] = 0.6
    result = solve_ik(muxarm, pose, world=load_world("cabinet"))
    assert not result.converged
    assert result.status == IkStatus.OUT_OF_REACH
    assert np.isnan(result.clearance)
    assert result.nearest_segment == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prefer": "speed"}, "prefer: must be of distance, bending, clearance, found 'speed'"),
        ({"prefer": {"bending": -1.0}}, r"prefer\['bending'\]: must be a number >= 0"),
        ({"prefer": {"bending": 0.0}}, "needs a weight above 0"),
        ({"prefer": "clearance"}, "'clearance' needs a world"),
    ],
)
def test_bad_preferences_are_refused(muxarm, options, message):
    with pytest.raises(ValueError, match=message):
        solve_ik(muxarm, np.eye(4), **options)


def test_a_rotation_is_projected_only_on_request(muxarm):
    pose = independent.pose(muxarm, np.radians([40.0, 10.0, 30.0, 80.0, 20.0, 200.0]))
    rough = pose.copy()
    rough[:3, :3] = np.round(pose[:3, :3], 2)
    with pytest.raises(ValueError, match="not a rotation"):
        solve_ik(muxarm, rough)
    found = solve_ik(muxarm, rough, project_rotations=True)
    assert found.converged
    assert np.abs(independent.pose(muxarm, found.q) - pose).max() < 0.02
