"""Metrics against dense sampling of the same motion."""

from __future__ import annotations

import numpy as np
import pytest
from test_planning import random_targets

import muxjax
from muxjax.metrics import timeline
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
