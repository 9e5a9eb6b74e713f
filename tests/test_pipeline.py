"""From poses to an arm that is there, and what happens to poses that it cannot reach."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import random_configurations

import muxjax
from muxjax.config import TaskConfig, load_yaml, resolve
from muxjax.pipeline import carry_out, pose_error, problem_for_pose, run_task, target_pose


def shipped_task() -> TaskConfig:
    return load_yaml(TaskConfig, resolve("fig9a", "tasks"))


def test_a_pose_becomes_a_tool_at_that_pose(robot, rng):
    servos = tuple(range(1, robot.tendons_per_segment + 1))
    q = 0.5 * random_configurations(robot, rng)
    pose = muxjax.forward_kinematics(robot, q)
    found, problem = problem_for_pose(robot, pose, servos=servos)
    assert found.converged
    move = carry_out(robot, problem, pose, "beamstep")
    assert move.run.completed
    # One count of a 14-bit encoder on a 25 mm wheel is 0.01 mm of tendon.
    assert move.position_error < 2e-4
    assert move.orientation_error < 2e-3
    assert move.run.duration_s == pytest.approx(move.metrics.time_s, rel=0.01)


def test_from_a_bent_start_back_to_straight(muxarm, rng):
    start = muxjax.tendon_displacements(muxarm, 0.5 * random_configurations(muxarm, rng))
    pose = muxjax.forward_kinematics(muxarm, np.zeros(6))
    _, problem = problem_for_pose(muxarm, pose, start=start, servos=(2,))
    assert np.allclose(problem.start, start)
    move = carry_out(muxarm, problem, pose, "greedy")
    assert move.run.completed
    assert move.position_error < 2e-4


def test_the_board_agrees_with_eq_14_where_the_drum_already_stands(muxarm):
    target = np.zeros(9)
    target[0] = -0.003
    position = 1 + int(np.flatnonzero(muxarm.axial_map[:, 0] == 0)[0])
    for axial in (position, None, 9):
        problem = muxjax.Problem(np.zeros(9), target, servos=(1,), axial=axial)
        move = carry_out(muxarm, problem, muxjax.forward_kinematics(muxarm, np.zeros(6)))
        assert move.run.duration_s == pytest.approx(move.metrics.time_s, rel=0.01)


def test_a_task_goes_on_after_a_pose_out_of_reach(muxarm):
    task = shipped_task()
    outcomes = list(run_task(muxarm, task, servo_sets=[(1, 2, 3), (3,)], methods=["sequential"]))
    assert len(outcomes) == 2 * len(task.targets)
    reached = {o.target.name for o in outcomes if o.moves}
    assert reached == {t.name for t in task.targets} - {"out of reach"}
    for outcome in outcomes:
        assert bool(outcome.ik.converged) == (outcome.target.name != "out of reach")
        for move in outcome.moves.values():
            assert move.run.completed
            assert move.position_error < 1e-4
            assert move.metrics.stages == (3 if len(outcome.servos) == 3 else 9)


def test_an_unreachable_pose_says_how_far_off_it_is(muxarm):
    pose = target_pose(next(t for t in shipped_task().targets if t.name == "out of reach"))
    with pytest.raises(muxjax.IkError, match=r"OUT_OF_REACH.* mm and .* degrees off"):
        problem_for_pose(muxarm, pose)


def test_pose_error_is_distance_and_angle(muxarm):
    straight = np.zeros(9)
    pose = muxjax.forward_kinematics(muxarm, np.zeros(6))
    pose[0, 3] += 0.003
    turn = np.radians(7.0)
    pose[:3, :3] = [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    assert pose_error(muxarm, straight, pose) == pytest.approx((0.003, turn))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("targets: []", r"targets: .*at least 1"),
        ("targets: [{name: a, position_m: [0, 0, .inf], rpy_deg: [0, 0, 0]}]", r"position_m\[3\]"),
        (
            "targets: [{name: a, position_m: [0, 0], rpy_deg: [0, 0, 0]}]",
            r"targets\[1\].position_m",
        ),
        ("targets: [{name: a, position_m: [0, 0, 0]}]", "a: give either quaternion_wxyz or rpy"),
        (
            "targets: [{name: a, position_m: [0, 0, 0], quaternion_wxyz: [1, 1, 0, 0]}]",
            r"a: quaternion_wxyz has norm 1\.41421, must be 1",
        ),
    ],
)
def test_a_wrong_task_file_is_refused_by_field(tmp_path, text, message):
    path = tmp_path / "task.yaml"
    path.write_text(f"schema: muxjax/task/1\nname: mine\n{text}\n")
    with pytest.raises(muxjax.ConfigError, match=message):
        load_yaml(TaskConfig, path)
