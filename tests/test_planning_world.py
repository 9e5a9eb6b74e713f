"""Plans among obstacles: checked on dense samples of what is executed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_planning import random_targets

import muxjax
from muxjax.collision import WorldConfig, world_from_config
from muxjax.metrics import program_cost, timeline
from muxjax.planning import Problem, plan
from muxjax.planning.world import SWEEP_TOLERANCE, speed_bound


def world_of(*obstacles: dict) -> muxjax.World:
    return world_from_config(
        WorldConfig.model_validate(
            {"schema": "muxjax/world/1", "name": "test", "obstacles": obstacles}
        )
    )


def least_clearance(robot, found, world, samples=1500) -> float:
    line = timeline(robot, muxjax.schedule(robot, found))
    states = line.at(np.linspace(0.0, line.times[-1], samples))
    return float(
        np.min(muxjax.clearance(robot, muxjax.configuration_from_tendons(robot, states), world))
    )


@pytest.fixture(scope="module")
def blocked(muxarm):
    """A problem whose cheapest plan passes through a ball."""
    target = random_targets(muxarm, np.random.default_rng(3), 1)[0]
    problem = Problem(np.zeros(9), target, servos=(1, 2, 3), preset="no-overshoot")
    free = plan(muxarm, problem)
    line = timeline(muxarm, muxjax.schedule(muxarm, free))
    states = line.at(np.linspace(0.0, line.times[-1], 60)[1:-1])
    tips = muxjax.forward_kinematics(muxarm, muxjax.configuration_from_tendons(muxarm, states))
    ends = muxjax.configuration_from_tendons(muxarm, np.stack([problem.start, target]))
    for tip in tips[:, :3, 3]:
        ball = {"kind": "sphere", "centre_m": tip.tolist(), "radius_m": 0.01}
        world = world_of(ball)
        if muxjax.clearance(muxarm, ends, world).min() > 0.005:
            return replace(problem, world=world), free
    raise AssertionError("every point of the path is next to its ends")


def test_a_plan_goes_around(muxarm, blocked):
    problem, free = blocked
    assert least_clearance(muxarm, free, problem.world) < -SWEEP_TOLERANCE
    found = plan(muxarm, problem)
    assert found.status == "optimal", found.reason
    assert found.cost > free.cost
    assert least_clearance(muxarm, found, problem.world) >= -SWEEP_TOLERANCE
    beam = plan(muxarm, problem, "beamstep", width=512)
    assert beam.cost >= found.cost - 1e-9
    assert beam.lower_bound <= found.cost + 1e-9
    assert least_clearance(muxarm, beam, problem.world) >= -SWEEP_TOLERANCE
    assert program_cost(muxarm, problem, muxjax.schedule(muxarm, found)) == pytest.approx(
        found.cost, rel=1e-9
    )


def test_closeness_has_a_price(muxarm, blocked):
    problem, _ = blocked
    shy = replace(problem, weights={"time": 1.0, "clearance": 1e4})
    bold = replace(problem, weights={"time": 1.0})
    careful, hasty = plan(muxarm, shy), plan(muxarm, bold)
    assert careful.status == hasty.status == "optimal"
    program = muxjax.schedule(muxarm, hasty)
    assert careful.cost <= program_cost(muxarm, shy, program) * (1 + 1e-9)
    assert hasty.cost <= program_cost(muxarm, bold, muxjax.schedule(muxarm, careful)) + 1e-9


def test_a_plan_that_does_not_exist_is_not_found(muxarm, rng):
    """A shell of balls closes the straight arm's tip in, and the target is outside."""
    target = random_targets(muxarm, rng, 1)[0]
    tip = muxjax.forward_kinematics(muxarm, np.zeros(6))[:3, 3]
    shell = [
        {"kind": "sphere", "centre_m": (tip + np.array(side)).tolist(), "radius_m": 0.03}
        for side in ([0.07, 0, 0], [-0.07, 0, 0], [0, 0.07, 0], [0, -0.07, 0])
    ]
    world = world_of(*shell, {"kind": "sphere", "centre_m": [0.3, 0.3, 0.0], "radius_m": 0.01})
    end = muxjax.clearance(muxarm, muxjax.configuration_from_tendons(muxarm, target), world)
    problem = Problem(np.zeros(9), target, world=world)
    if end < 0:
        with pytest.raises(ValueError, match=r"Problem.target: the arm is .* mm deep"):
            plan(muxarm, problem)
        return
    for method in ("exact", "beamstep", "sequential"):
        found = plan(muxarm, problem, method)
        if found.status != "failed":
            assert least_clearance(muxarm, found, world) >= -SWEEP_TOLERANCE
        else:
            assert found.reason


def test_start_and_target_in_collision_are_refused(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    tip = muxjax.forward_kinematics(muxarm, np.zeros(6))[:3, 3].tolist()
    world = world_of({"kind": "sphere", "centre_m": tip, "radius_m": 0.01})
    with pytest.raises(ValueError, match=r"Problem.start: the arm is .* mm deep in an obstacle"):
        plan(muxarm, Problem(np.zeros(9), target, world=world))
    with pytest.raises(ValueError, match=r"Problem.target: the arm is .* mm deep in an obstacle"):
        plan(muxarm, Problem(target, np.zeros(9), world=world))
    with pytest.raises(ValueError, match=r"no term 'clearance' .*needs a world"):
        Problem(np.zeros(9), target, weights={"clearance": 1.0})


def test_no_point_of_the_arm_is_faster_than_its_bound(muxarm, rng):
    starts, ends = random_targets(muxarm, rng, 40).reshape(2, 20, 9)
    fraction = np.linspace(0, 1, 801)[:, None]
    bound = np.asarray(speed_bound(muxarm, starts, ends))
    for start, end, limit in zip(starts, ends, bound, strict=True):
        q = muxjax.configuration_from_tendons(muxarm, start + fraction * (end - start))
        if not np.isfinite(q).all():
            continue
        points = muxjax.backbone(muxarm, q, 4)[..., :3, 3]
        speed = np.linalg.norm(np.diff(points, axis=0), axis=-1).max() * 800
        assert speed <= limit * (1 + 1e-2)
