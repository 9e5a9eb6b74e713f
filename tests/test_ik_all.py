"""Every solution, judged by a reference file and by the independent transcription."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import equinox as eqx
import independent
import jax
import numpy as np
import pytest
from conftest import random_configurations

import muxjax
from muxjax.config import RobotConfig
from muxjax.ik import all_ik
from muxjax.ik.every import polar
from muxjax.ik.several import APART, solutions_from_table
from muxjax.robot import Robot, robot_from_config

GOLDEN = json.loads((Path(__file__).parent / "golden/ik_three_segments.json").read_text())


def arm(robot: Robot, length, theta_max=(np.pi,) * 3) -> Robot:
    return eqx.tree_at(
        lambda r: (r.length, r.theta_max), robot, (np.array(length), np.array(theta_max))
    )


def bendings(q: np.ndarray) -> np.ndarray:
    return independent.bending(q).reshape(*q.shape)


def poses_of(robot: Robot, q: np.ndarray) -> np.ndarray:
    rows = q.reshape(-1, q.shape[-1])
    return np.array([independent.pose(robot, row) for row in rows]).reshape(*q.shape[:-1], 4, 4)


def assert_none_false(robot: Robot, pose: np.ndarray, result) -> None:
    for target, q, mask in zip(pose, result.q, result.mask, strict=True):
        assert np.isnan(q[~mask]).all()
        for one in q[mask]:
            assert (one[0::2] <= robot.theta_max).all()
            found = independent.pose(robot, one)
            assert np.linalg.norm(found[:3, 3] - target[:3, 3]) < 1.01e-10
            assert independent.rotation_angle(found[:3, :3], target[:3, :3]) < 1.01e-10


def holds(result, row: int, q: np.ndarray, within: float) -> bool:
    mine = bendings(result.q[row][result.mask[row]])
    return bool(len(mine)) and np.abs(mine - bendings(q)).max(axis=-1).min() < within


@pytest.mark.parametrize("name", ["A", "B"])
def test_every_listed_solution_is_found_and_none_is_false(muxarm, name):
    case = GOLDEN["sets"][name]
    robot = arm(muxarm, case["lengths"])
    pose = np.array([c["pose"] for c in case["cases"]])
    result = all_ik(robot, pose)
    assert result.mask.any(axis=-1).all()
    assert_none_false(robot, pose, result)
    for row, c in enumerate(case["cases"]):
        for solution, smallest in zip(c["solutions"], c["sigma_min"], strict=True):
            away = np.abs(bendings(result.q[row]) - bendings(np.array(solution))).max(axis=-1)
            match = int(np.nanargmin(away))
            assert away[match] < 1e-5
            assert result.singular_value[row, match] == pytest.approx(smallest, rel=1e-3)
        assert result.mask[row].sum() == c["n_solutions"]
    assert result.complete.all()


def test_random_targets_hold_the_configuration_they_were_made_from(muxarm, rng):
    q = random_configurations(muxarm, rng, 400)
    pose = poses_of(muxarm, q)
    result = all_ik(muxarm, pose)
    assert_none_false(muxarm, pose, result)
    assert all(holds(result, row, q[row], 1e-5) for row in range(len(q)))


@pytest.mark.slow
def test_a_hundred_thousand_random_targets(muxarm, rng):
    q = random_configurations(muxarm, rng, 100_000)
    pose = muxjax.forward_kinematics(muxarm, q)
    result = all_ik(muxarm, pose)
    assert result.mask.any(axis=-1).all()
    own = np.abs(bendings(result.q) - bendings(q)[:, None]).max(axis=-1)
    assert (np.nanmin(own, axis=-1) < 1e-4).mean() > 0.9995
    again = muxjax.forward_kinematics(muxarm, np.nan_to_num(result.q))
    away = np.abs(again - pose[:, None]).max(axis=(-1, -2))
    assert away[result.mask].max() < 1.1e-10


@pytest.mark.parametrize("straight", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_straight_segments_are_ordinary(muxarm, rng, straight):
    q = random_configurations(muxarm, rng, 3)
    q[:, [2 * i for i in straight]] = 0.0
    pose = poses_of(muxarm, q)
    result = all_ik(muxarm, pose)
    assert_none_false(muxarm, pose, result)
    assert all(holds(result, row, q[row], 1e-4) for row in range(len(q)))


def test_planar_arms(muxarm, rng):
    """d = 0 and s_w = 0: the reduction is singular there, another search takes over."""
    angle = rng.uniform(-1, 1, (20, 3)) * muxarm.theta_max
    azimuth = rng.uniform(0, 2 * np.pi, 20)
    azimuth[:5] = [0, np.pi / 2, np.pi, 3 * np.pi / 2, 0]
    turned = azimuth[:, None] + np.where(angle < 0, np.pi, 0)
    q = np.stack([np.abs(angle), turned % (2 * np.pi)], axis=-1).reshape(20, 6)
    pose = poses_of(muxarm, q)
    result = all_ik(muxarm, pose)
    assert_none_false(muxarm, pose, result)
    assert all(holds(result, row, q[row], 1e-4) for row in range(len(q)))


@pytest.mark.parametrize("off", [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10, 1e-12])
def test_nearly_planar_arms_lose_no_solution(muxarm, rng, off):
    """Judged by the configurations themselves and by damped steps from many starts."""
    q = random_configurations(muxarm, rng, 12)
    q[:, 1::2] = 0.7 + off * rng.uniform(-1, 1, (12, 3)) + np.pi * rng.integers(0, 2, (12, 3))
    pose = poses_of(muxarm, q)
    result = all_ik(muxarm, pose)
    assert_none_false(muxarm, pose, result)
    assert all(holds(result, row, q[row], 1e-4) for row in range(len(q)))
    host = jax.tree.map(lambda x: np.asarray(x, np.float64), muxarm)
    with jax.enable_x64(True):
        found, _ = solutions_from_table(host, pose, np.ones(6), (1e-10, 1e-10))
    lost = [
        (row, b)
        for row, b, singular in zip(found.row, found.b, found.singular, strict=True)
        # Of solutions that nearly coincide either search may report one for several.
        if singular > 1e-3 and not holds(result, row, polar(muxarm, b[None])[0], 1e-5)
    ]
    assert not lost


def test_antipodal_rotations(muxarm):
    """The tip turned by 180 degrees, where both signs of the quaternion are as near."""
    q = np.array(
        [
            [np.pi / 2, 0, np.pi / 2, 0, 0.0, 0],
            [0.8, 1.0, np.pi - 1.3, 1.0, 0.5, 1.0],
            [np.pi, 2.0, 0.6, 0.3, 0.6, 0.3 + np.pi],
        ]
    )
    pose = poses_of(muxarm, q)
    assert np.trace(pose[0, :3, :3]) == pytest.approx(-1)
    result = all_ik(muxarm, pose)
    assert_none_false(muxarm, pose, result)
    assert all(holds(result, row, q[row], 1e-4) for row in range(3))


def test_coinciding_solutions_are_reported_once(muxarm):
    """At a fold of the map two solutions meet: just inside they are two, on it one."""
    case = GOLDEN["sets"]["A"]["cases"]
    rows = [c for c in case if c["n_solutions"] > 1]
    q = np.array([c["solutions"][0] for c in rows[:20]])
    robot = arm(muxarm, GOLDEN["sets"]["A"]["lengths"])
    result = all_ik(robot, poses_of(robot, q))
    for row in range(len(q)):
        mine = bendings(result.q[row][result.mask[row]])
        gap = np.abs(mine[:, None] - mine[None]).max(axis=-1) + np.eye(len(mine))
        assert gap.min() > 1e-6
    straight = all_ik(muxarm, independent.pose(muxarm, np.zeros(6)))
    assert straight.mask.sum() == 1
    assert straight.singular_value[0] < 1e-3


def test_at_the_bending_limits(muxarm, rng):
    q = random_configurations(muxarm, rng, 30)
    for row, segment in enumerate(np.arange(30) % 3):
        q[row, 2 * segment] = muxarm.theta_max[segment]
    pose = poses_of(muxarm, q)
    result = all_ik(muxarm, pose)
    assert_none_false(muxarm, pose, result)
    assert all(holds(result, row, q[row], 1e-5) for row in range(len(q)))


def test_infinitely_many_solutions_are_not_called_complete(muxarm):
    pose = np.eye(4)
    pose[2, 3] = 0.40
    result = all_ik(muxarm, pose)
    assert result.mask.any()
    assert_none_false(muxarm, pose[None], jax.tree.map(lambda x: x[None], result))
    assert not result.complete


def test_unreachable_poses_have_none(muxarm):
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0.0, 0.6]
    result = all_ik(muxarm, pose)
    assert result.q.shape == (0, 6)
    assert not result.mask.any()


def test_batches_are_the_sum_of_their_rows_and_frames_belong_to_the_pose(muxarm, rng):
    moved = eqx.tree_at(
        lambda r: (r.base, r.tool),
        muxarm,
        (independent.segment(0.7, 1.0, 0.5), independent.segment(1.1, 2.0, 0.1)),
    )
    pose = poses_of(moved, random_configurations(moved, rng, 2, 3))
    result = all_ik(moved, pose)
    assert result.q.shape[:2] == result.mask.shape[:2] == result.complete.shape == (2, 3)
    assert_none_false(
        moved, pose.reshape(6, 4, 4), jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), result)
    )
    alone = all_ik(moved, pose[1, 2])
    np.testing.assert_allclose(
        bendings(alone.q), bendings(result.q[1, 2][result.mask[1, 2]]), atol=1e-8
    )
    assert all_ik(moved, pose[:0]).q.shape == (0, 3, 0, 6)


def segments_of(robot: Robot, count: int) -> Robot:
    raw = robot.config.model_dump(by_alias=True)
    parts = [copy.deepcopy(raw["segments"][k % 3]) for k in range(count)]
    for k, part in enumerate(parts):  # no tendon on another one
        part["tendon_offset_deg"]["value"] = 120.0 * k / count
    return robot_from_config(RobotConfig.model_validate(raw | {"segments": parts}))


@pytest.mark.parametrize("count", [1, 2, 4, 5, pytest.param(6, marks=pytest.mark.slow)])
def test_other_numbers_of_segments(muxarm, rng, count):
    robot = segments_of(muxarm, count)
    q = random_configurations(robot, rng, 4)
    pose = poses_of(robot, q)
    result = all_ik(robot, pose)
    assert_none_false(robot, pose, result)
    assert result.mask.any(axis=-1).all()
    assert not result.complete.any()
    assert (result.singular_value[result.mask] > 0).all()
    if count < 3:  # isolated: its own configuration is among them, and none twice
        assert all(holds(result, row, q[row], 1e-5) for row in range(4))
    else:
        assert result.mask.sum(axis=-1).min() > 4
        assert_apart(result)


def assert_apart(result) -> None:
    for mask, q in zip(result.mask, result.q, strict=True):
        mine = independent.bending(q[mask])
        gap = np.linalg.norm(mine[:, None] - mine[None], axis=-1).max(axis=-1)
        assert (gap + np.eye(len(mine)) > APART - 1e-6).all()


@pytest.mark.parametrize("count", [1, 2])
def test_few_segments_reach_no_random_pose(muxarm, rng, count):
    pose = poses_of(muxarm, random_configurations(muxarm, rng, 3))
    pose[:, :3, 3] *= 0.5
    result = all_ik(segments_of(muxarm, count), pose)
    assert not result.mask.any()
    assert not result.complete.any()


@pytest.mark.parametrize("weights", [(1, 1, 1, 0, 0, 0), (1, 1, 1, 1, 1, 0), (0, 0, 1, 0, 0, 0)])
def test_partial_goals_have_representatives(muxarm, rng, weights):
    pose = poses_of(muxarm, random_configurations(muxarm, rng, 4))
    result = all_ik(muxarm, pose, weights=np.array(weights, float))
    assert (result.mask.sum(axis=-1) > 3).all()
    assert not result.complete.any()
    assert_apart(result)
    for target, q, mask in zip(pose, result.q, result.mask, strict=True):
        found = poses_of(muxarm, q[mask])
        off = np.abs(found - target)[:, :3]
        assert off[:, :, 3][:, np.array(weights[:3], bool)].max() < 1.01e-10
        if weights[3]:
            assert off[:, :, 2].max() < 1.01e-10


def test_beyond_the_arm_there_are_certainly_none(muxarm):
    pose = np.eye(4)
    pose[0, 3] = 0.6
    result = all_ik(muxarm, pose, weights=[1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    assert result.complete
    assert not result.mask.any()


def test_a_matrix_that_is_no_rotation_is_projected_on_request(muxarm, rng):
    q = random_configurations(muxarm, rng, 3)
    pose = poses_of(muxarm, q)
    off = pose.copy()
    off[1, :3, :3] *= 1.01
    with pytest.raises(ValueError, match=r"pose\[1\]: not a rotation"):
        all_ik(muxarm, off)
    result = all_ik(muxarm, off, project_rotations=True)
    assert_none_false(muxarm, pose, result)
    off[2, :3, :3] *= -1
    with pytest.raises(ValueError, match=r"pose\[2\]: not a rotation but a reflection"):
        all_ik(muxarm, off, project_rotations=True)


def test_a_trace_is_refused(muxarm):
    with pytest.raises(ValueError, match="all_ik: the number of solutions is data"):
        jax.jit(lambda p: all_ik.__wrapped__(muxarm, p).mask)(np.eye(4))
