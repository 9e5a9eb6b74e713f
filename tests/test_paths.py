"""Through several poses as one program, and the choice among configurations by cost."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from conftest import random_configurations

import muxjax
from muxjax.config import TaskConfig, load_yaml, resolve
from muxjax.hardware import LockstepLink
from muxjax.pipeline import plan_path, plan_task, plan_to_pose, pose_error
from muxjax.planning import Problem, plan


def random_poses(robot, rng, n):
    q = 0.5 * random_configurations(robot, rng, n)
    return [muxjax.forward_kinematics(robot, x) for x in q]


def poses_of_several(robot, rng, n):
    """Poses that more than one configuration reaches."""
    found = []
    while len(found) < n:
        pose = random_poses(robot, rng, 1)[0]
        if muxjax.all_ik(robot, pose).mask.sum() > 1:
            found.append(pose)
    return found


@pytest.mark.parametrize("preset", ["paper", "no-overshoot"])
def test_the_chosen_configuration_is_the_cheapest_of_all(muxarm, rng, preset):
    for pose in poses_of_several(muxarm, rng, 3):
        found = plan_to_pose(muxarm, pose, servos=(1, 3), preset=preset)
        every = muxjax.all_ik(muxarm, pose)
        costs = [
            plan(muxarm, Problem(np.zeros(9), goal, servos=(1, 3), preset=preset)).cost
            for goal in muxjax.tendon_displacements(muxarm, every.q[every.mask])
        ]
        assert found.complete
        assert len(found.alternatives) == len(costs) - 1
        assert found.plan.cost == pytest.approx(min(costs), rel=1e-12)
        for option in found.alternatives:
            assert option.cost >= found.plan.cost
            assert option.plan is not None or option.lower_bound >= found.plan.cost
        assert pose_error(muxarm, found.plan.displacements[-1], pose) == pytest.approx(
            (0, 0), abs=1e-8
        )


def test_fewer_candidates_say_that_not_all_were_considered(muxarm, rng):
    pose = poses_of_several(muxarm, rng, 1)[0]
    found = plan_to_pose(muxarm, pose, candidates=1)
    assert not found.complete
    assert found.alternatives == ()
    with pytest.raises(ValueError, match="candidates: must be at least 1, found 0"):
        plan_to_pose(muxarm, pose, candidates=0)


@pytest.mark.slow
def test_an_arm_without_every_solution_takes_the_nearest(rng):
    penta = muxjax.load_robot("penta")
    pose = random_poses(penta, rng, 1)[0]
    found = plan_to_pose(penta, pose, method="beamstep", servos=(1, 2, 3))
    assert not found.complete
    assert pose_error(penta, found.plan.displacements[-1], pose)[0] < 1e-6


def test_a_pose_out_of_reach_is_an_ik_error(muxarm):
    pose = np.eye(4)
    pose[2, 3] = 0.6
    with pytest.raises(muxjax.IkError, match="OUT_OF_REACH"):
        plan_to_pose(muxarm, pose)
    reached = muxjax.forward_kinematics(muxarm, np.full(6, 0.4))
    with pytest.raises(muxjax.IkError, match=r"pose 2: .*OUT_OF_REACH"):
        plan_path(muxarm, [reached, pose])


def test_a_path_is_no_dearer_than_any_choice_of_configurations(muxarm, rng):
    poses = poses_of_several(muxarm, rng, 2)
    found = plan_path(muxarm, poses, servos=(1, 2))
    goals = [muxjax.tendon_displacements(muxarm, e.q[e.mask]) for e in map(every(muxarm), poses)]
    assert found.cost == pytest.approx(sum(p.cost for p in found.plans))
    for first, second in product(*goals):
        one = plan(muxarm, Problem(np.zeros(9), first, servos=(1, 2)))
        two = plan(
            muxarm,
            Problem(one.displacements[-1], second, servos=(1, 2), axial=int(one.axial[-1])),
        )
        assert found.cost <= (one.cost + two.cost) * (1 + 1e-12)


def every(robot):
    return lambda pose: muxjax.all_ik(robot, pose)


def test_a_path_is_one_program_that_runs(muxarm, rng):
    poses = random_poses(muxarm, rng, 3)
    found = plan_path(muxarm, poses, servos=(1, 2, 3), axial=4)
    assert [p.problem.axial for p in found.plans] == [
        4,
        *(int(p.axial[-1]) for p in found.plans[:-1]),
    ]
    link = LockstepLink(muxarm, axial=4, stream_divider=10)
    run = muxjax.execute(found.program, link)
    assert run.completed
    assert pose_error(muxarm, run.measured, poses[-1])[0] < 2e-4
    times = [muxjax.evaluate(muxarm, p).time_s for p in found.programs]
    assert muxjax.evaluate(muxarm, found.program).time_s == pytest.approx(sum(times))
    assert run.duration_s == pytest.approx(sum(times), rel=0.01)
    # The tool is at every pose when its program ends.
    line = run.trajectory
    for pose, end in zip(
        poses, np.cumsum([len(p.instructions) for p in found.programs]), strict=True
    ):
        at = run.records[end - 1].end_s
        held = [np.interp(at, line.time_s, column) for column in line.displacements.T]
        assert pose_error(muxarm, np.array(held), pose)[0] < 2e-4
    assert len(found.deviations) == 3
    assert all(0 < d < 0.5 for d in found.deviations)


def test_a_task_may_name_the_configuration_of_a_pose(muxarm):
    task = load_yaml(TaskConfig, resolve("fig9a", "tasks"))
    task = task.model_copy(update={"targets": task.targets[:2]})
    found = plan_task(muxarm, task)
    wanted = np.radians([t.near_q_deg for t in task.targets])
    assert muxjax.tendon_displacements(muxarm, found.q) == pytest.approx(
        muxjax.tendon_displacements(muxarm, wanted), abs=1e-5
    )


def test_wrong_paths(muxarm, rng):
    pose = random_poses(muxarm, rng, 1)[0]
    with pytest.raises(ValueError, match="found 0 poses"):
        plan_path(muxarm, [])
    with pytest.raises(ValueError, match="1 poses and 2 entries in near"):
        plan_path(muxarm, [pose], near=[None, None])
    with pytest.raises(ValueError, match="candidates: must be at least 1"):
        plan_path(muxarm, [pose], candidates=0)
    with pytest.raises(ValueError, match="start: tendon 1 is at 500 mm"):
        plan_path(muxarm, [pose], start=np.full(9, 0.5))
    forbidden = {"travel": lambda robot, t: np.inf * t.wait}
    with pytest.raises(muxjax.PlanningError, match="pose 1: no plan to any of"):
        plan_path(muxarm, [pose], terms=forbidden, weights={"travel": 1.0})
    with pytest.raises(muxjax.PlanningError, match="configurations reach it; exact: "):
        plan_to_pose(muxarm, pose, terms=forbidden, weights={"travel": 1.0})
