"""Plans among obstacles: checked on dense samples of what is executed."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, permutations

import jax
import numpy as np
import pytest
from test_planning import random_targets

import muxjax
from muxjax.collision import SphereConfig, WorldConfig, attach, world_from_config
from muxjax.metrics import evaluate, program_cost, timeline
from muxjax.planning import METHODS, Problem, plan
from muxjax.planning.world import SWEEP_TOLERANCE, speed_bound


def world_of(*obstacles: dict) -> muxjax.World:
    return world_from_config(
        WorldConfig.model_validate(
            {"schema": "muxjax/world/1", "name": "test", "obstacles": obstacles}
        )
    )


def least_clearance(robot, found, world, samples=1500) -> float:
    line = timeline(robot, muxjax.schedule(robot, found))
    states = line.at(np.linspace(0.0, line.time_s[-1], samples))
    return float(
        np.min(muxjax.clearance(robot, muxjax.configuration_from_tendons(robot, states), world))
    )


# A wall beside the straight arm, from 155 mm up, and an arm that reaches under it.
WALL = {"kind": "box", "centre_m": [0.075, 0.0, 0.555], "size_m": [0.02, 3.0, 0.8]}
UNDER_IT = [1.6, 0.0, 0.3, 0.0, 0.2, 0.0]
# Out of reach: worlds of a ball and a box each share what is compiled.
FAR_WALL = WALL | {"centre_m": [9.0, 0.0, 0.555]}
FAR_BALL = {"kind": "sphere", "centre_m": [9.0, 0.0, 0.0], "radius_m": 0.01}


@pytest.fixture(scope="module")
def blocked(muxarm):
    """A problem whose cheapest plan passes through a ball."""
    target = random_targets(muxarm, np.random.default_rng(3), 1)[0]
    problem = Problem(np.zeros(9), target, servos=(1, 2, 3), preset="no-overshoot")
    free = plan(muxarm, problem)
    line = timeline(muxarm, muxjax.schedule(muxarm, free))
    states = line.at(np.linspace(0.0, line.time_s[-1], 60)[1:-1])
    tips = muxjax.forward_kinematics(muxarm, muxjax.configuration_from_tendons(muxarm, states))
    ends = muxjax.configuration_from_tendons(muxarm, np.stack([problem.start, target]))
    for tip in tips[:, :3, 3]:
        ball = {"kind": "sphere", "centre_m": tip.tolist(), "radius_m": 0.01}
        world = world_of(ball, FAR_WALL)
        if muxjax.clearance(muxarm, ends, world).min() > 0.005:
            return replace(problem, world=world), free
    raise AssertionError("every point of the path is next to its ends")


@pytest.mark.slow
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


@pytest.mark.slow
def test_closeness_has_a_price(muxarm, blocked):
    problem, _ = blocked
    shy = replace(problem, weights={"time": 1.0, "clearance": 1e4})
    bold = replace(problem, weights={"time": 1.0})
    careful, hasty = plan(muxarm, shy), plan(muxarm, bold)
    assert careful.status == hasty.status == "optimal"
    program = muxjax.schedule(muxarm, hasty)
    assert careful.cost <= program_cost(muxarm, shy, program) * (1 + 1e-9)
    assert hasty.cost <= evaluate(muxarm, muxjax.schedule(muxarm, careful)).time_s + 1e-9


@pytest.mark.slow
def test_a_plan_that_does_not_exist_is_not_found(muxarm):
    """Every order leads through the wall: by the planners, and by a walk along every order."""
    target, world = muxjax.tendon_displacements(muxarm, UNDER_IT), world_of(FAR_BALL, WALL)
    problem = Problem(np.zeros(9), target, world=world, action_set="all", preset="no-overshoot")
    ends = muxjax.configuration_from_tendons(muxarm, np.stack([problem.start, target]))
    assert muxjax.clearance(muxarm, ends, world).min() > 0.0
    for method in METHODS:
        found = plan(muxarm, problem, method)
        assert found.status == "failed", method
        assert found.cost == np.inf
        if method in ("exact", "beamstep"):
            assert "passes through a collision" in found.reason
    assert plan(muxarm, replace(problem, world=None)).status == "optimal"
    share = np.linspace(0.0, 1.0, 200)[:, None]
    for order in permutations(range(3)):
        states = [problem.start]
        for layer in order:
            after = states[-1].copy()
            after[3 * layer : 3 * layer + 3] = target[3 * layer : 3 * layer + 3]
            states.append(after)
        path = np.concatenate([a + share * (b - a) for a, b in pairwise(states)])
        clear = muxjax.clearance(muxarm, muxjax.configuration_from_tendons(muxarm, path), world)
        assert clear.min() < -SWEEP_TOLERANCE


def test_start_and_target_in_collision_are_refused(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    tip = muxjax.forward_kinematics(muxarm, np.zeros(6))[:3, 3].tolist()
    world = world_of({"kind": "sphere", "centre_m": tip, "radius_m": 0.01}, FAR_WALL)
    with pytest.raises(ValueError, match=r"Problem.start: the arm is .* mm deep in an obstacle"):
        plan(muxarm, Problem(np.zeros(9), target, world=world))
    with pytest.raises(ValueError, match=r"Problem.target: the arm is .* mm deep in an obstacle"):
        plan(muxarm, Problem(target, np.zeros(9), world=world))
    with pytest.raises(ValueError, match=r"no term 'clearance' .*needs a world"):
        Problem(np.zeros(9), target, weights={"clearance": 1.0})


def test_no_point_of_the_arm_is_faster_than_its_bound(muxarm, rng):
    """Nor is what the tool carries, which here stands half a metre off."""
    plain, far = world_of(WALL), (0.0, 0.3, 0.4)
    laden = attach(plain, [SphereConfig(kind="sphere", centre_m=far, radius_m=0.01)])
    starts, ends = random_targets(muxarm, rng, 40).reshape(2, 20, 9)
    fraction = np.linspace(0, 1, 801)[:, None]
    with jax.enable_x64(True):  # as planners do
        limits = [np.asarray(speed_bound(muxarm, starts, ends, world)) for world in (plain, laden)]
    tried = 0
    for start, end, arm_limit, laden_limit in zip(starts, ends, *limits, strict=True):
        q = muxjax.configuration_from_tendons(muxarm, start + fraction * (end - start))
        if not np.isfinite(q).all():
            continue
        points = muxjax.backbone(muxarm, q, 4)[..., :3, 3]
        assert _fastest(points) <= arm_limit * (1 + 1e-2)
        tool = muxjax.forward_kinematics(muxarm, q)
        carried = tool[:, :3, :3] @ np.array(far) + tool[:, :3, 3]
        assert _fastest(carried) <= laden_limit * (1 + 1e-2)
        tried += 1
    assert tried > 10


def _fastest(points: np.ndarray) -> float:
    """Greatest speed of any point along 801 equal parts of a leg [m a leg]."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).max() * 800)
