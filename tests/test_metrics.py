"""Metrics against dense sampling of the same motion."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pytest
from scipy.optimize import linprog
from test_planning import random_targets

import muxjax
from muxjax.metrics import least_time, timeline, tip_deviation
from muxjax.metrics.program import _least_layer_time, distance_to_polyline
from muxjax.planning import Problem, plan
from muxjax.planning.motion import angles_at


@pytest.mark.parametrize("method", ["sequential", "reverse", "greedy", "exact"])
@pytest.mark.parametrize("servos", [(1,), (2, 3), (1, 2, 3)])
def test_metrics_agree_with_dense_sampling(muxarm, rng, method, servos):
    start, target = random_targets(muxarm, rng, 2)
    for begin in (np.zeros(9), start):
        problem = Problem(begin, target, servos=servos, max_step=0.05)
        program = muxjax.schedule(muxarm, plan(muxarm, problem, method))
        metrics = muxjax.evaluate(muxarm, program)
        line = timeline(muxarm, program)
        times = np.linspace(0, metrics.time_s, 100_001)
        theta = np.concatenate(
            [angles_at(muxarm, part) for part in np.array_split(line.at(times), 50)]
        )
        excess = theta - theta[-1]
        share = np.mean(excess > 1e-6, axis=0)
        assert metrics.overshoot_duration == pytest.approx(share, abs=5e-4)
        assert metrics.overshoot_peak_rad == pytest.approx(np.max(excess, axis=0), abs=1e-3)
        assert metrics.overshoot_peak == pytest.approx(
            np.array(metrics.overshoot_peak_rad) / theta[-1], rel=1e-9
        )
        assert np.allclose(line.at(np.array([0.0]))[0], begin)
        assert np.allclose(line.at(np.array([1e9]))[0], target, atol=1e-5)


def test_time_is_eq_14(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    speed = 52 / 60 * 2 * np.pi / 60 * 0.025  # rpm, gear ratio, wheel radius
    for servos in [(1,), (1, 2, 3)]:
        problem = Problem(np.zeros(9), target, servos=servos)
        program = muxjax.schedule(muxarm, plan(muxarm, problem))
        by_hand = sum(
            3.0 + max(abs(m) for m in i.length_moves.values()) / speed for i in program.instructions
        )
        metrics = muxjax.evaluate(muxarm, program)
        assert metrics.time_s == pytest.approx(by_hand, rel=1e-12)
        assert metrics.stages == len(program.instructions)
        assert metrics.travel_m == pytest.approx(np.abs(target).sum(), rel=1e-9)


def test_only_engagement_where_the_drum_stands(muxarm):
    target = np.zeros(9)
    target[0] = -0.01
    position = 1 + int(np.flatnonzero(muxarm.axial_map[:, 0] == 0)[0])
    moving = 0.01 / float(muxarm.tendon_speed)
    for axial, waits in [(position, 0.33), (None, 3.0)]:
        problem = Problem(np.zeros(9), target, servos=(1,), axial=axial)
        metrics = muxjax.evaluate(muxarm, muxjax.schedule(muxarm, plan(muxarm, problem)))
        assert metrics.time_s == pytest.approx(waits + moving)


def test_returning_to_straight_has_no_relative_peak(muxarm, rng):
    start = random_targets(muxarm, rng, 1)[0]
    program = muxjax.schedule(muxarm, plan(muxarm, Problem(start, np.zeros(9), servos=(1,))))
    metrics = muxjax.evaluate(muxarm, program)
    assert np.isnan(metrics.overshoot_peak).all()
    # It starts as bent as it ever is above straight, unless other segments bend it further.
    begin = angles_at(muxarm, start[None])[0]
    assert (np.array(metrics.bending_peak_rad) >= begin - 1e-9).all()
    assert metrics.overshoot_peak_rad == pytest.approx(metrics.bending_peak_rad, abs=1e-6)


@pytest.mark.parametrize("servos", [(1,), (1, 2), (1, 2, 3)])
@pytest.mark.parametrize("axial", [None, 4])
def test_no_plan_is_faster_than_the_least_time(muxarm, rng, servos, axial):
    for target in random_targets(muxarm, rng, 4):
        for max_step in (0.03, None):
            problem = Problem(
                np.zeros(9),
                target,
                servos=servos,
                axial=axial,
                max_step=max_step,
                weights={"time": 1.0},
            )
            program = muxjax.schedule(muxarm, plan(muxarm, problem))
            bound = least_time(muxarm, program)
            time = muxjax.evaluate(muxarm, program).time_s
            assert bound <= time * (1 + 1e-12)
            assert bound > 0.8 * time
            if axial is None and len(servos) != 2:
                assert bound == pytest.approx(time, rel=1e-9)  # it is attained


def test_least_time_of_two_visits_against_every_way_of_sharing(rng):
    """Linear programmes over which tendons move in which of the visits."""
    for _ in range(20):
        net = np.sort(rng.uniform(0.1, 9, 3))[::-1]
        pairs = list(combinations(range(3), 2))
        best = np.inf
        for visits in (2, 3):
            for chosen in product(pairs, repeat=visits):
                met = np.array([[c in pair for pair in chosen] for c in range(3)], dtype=float)
                if met.any(axis=1).all():
                    found = linprog(np.ones(visits), A_ub=-met, b_ub=-net)
                    best = min(best, 3.0 * visits + found.fun)
        assert _least_layer_time(net, 2, 3.0) == pytest.approx(best, rel=1e-7)


def test_tip_deviation_is_what_a_dense_look_finds(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    program = muxjax.schedule(muxarm, plan(muxarm, Problem(np.zeros(9), target, servos=(1, 2))))
    line = timeline(muxarm, program)
    states = line.at(np.linspace(0, line.time_s[-1], 5001))
    poses = muxjax.forward_kinematics(muxarm, muxjax.configuration_from_tendons(muxarm, states))
    tips = poses[:, :3, 3]
    along = (tips[-1] - tips[0]) / np.linalg.norm(tips[-1] - tips[0])
    share = (tips - tips[0]) @ along
    beside = np.linalg.norm(tips - tips[0] - share[:, None] * along, axis=1)
    length = np.linalg.norm(tips[-1] - tips[0])
    past = np.maximum(np.maximum(-share, share - length), 0)
    dense = np.hypot(beside, past).max()
    assert tip_deviation(muxarm, program) == pytest.approx(dense, abs=2e-4)
    assert tip_deviation(muxarm, program, tips) < 1e-4  # along its own path
    with pytest.raises(ValueError, match="path: needs at least two points"):
        tip_deviation(muxarm, program, tips[:1])


def test_distance_to_a_corner_and_a_repeated_point():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 1, 0]])
    points = np.array([[0.5, -0.2, 0], [2.0, 0, 0], [1, 0.5, 0.3], [-3, 4, 0]])
    assert distance_to_polyline(points, corners) == pytest.approx([0.2, 1.0, 0.3, 5.0])
