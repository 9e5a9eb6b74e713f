"""The action set "splits": servos that wind side by side lose no time."""

from __future__ import annotations

import numpy as np
import pytest
from test_planning import random_targets

from muxjax.metrics import evaluate, least_time
from muxjax.planning import Problem, plan, plan_batch
from muxjax.scheduler import schedule

FASTEST = {"time": 1.0, "overshoot": 1e-3}


@pytest.mark.parametrize(
    "servos", [(1, 2), pytest.param((1, 3), marks=pytest.mark.slow), (1, 2, 3)]
)
def test_it_comes_close_to_what_no_program_can_fall_below(muxarm, rng, servos):
    start = np.zeros(muxarm.n_tendons)
    for target in random_targets(muxarm, rng, 3):
        problem = Problem(start, target, servos=servos, weights=FASTEST, action_set="splits")
        found = plan(muxarm, problem)
        assert found.status == "optimal"
        np.testing.assert_allclose(found.displacements[-1], target, atol=problem.tolerance)
        program = schedule(muxarm, found)
        bound = least_time(muxarm, program)
        assert bound * (1 - 1e-9) <= evaluate(muxarm, program).time_s < 1.03 * bound
        whole = Problem(start, target, servos=servos, weights=FASTEST)
        assert found.cost <= plan(muxarm, whole).cost + 1e-9


def test_only_the_longest_tendon_of_a_layer_stops_halfway(muxarm, rng):
    start = np.zeros(muxarm.n_tendons)
    target = random_targets(muxarm, rng, 1)[0]
    problem = Problem(start, target, servos=(1, 2), weights=FASTEST, action_set="splits")
    found = plan(muxarm, problem)
    way = np.abs(target).reshape(3, 3)
    for column in range(muxarm.n_tendons):
        layer, own = divmod(column, 3)
        others = np.delete(way[layer], own)
        stops = [0.0, way[layer, own]]
        if way[layer, own] == way[layer].max():
            stops += [*others, *(way[layer, own] - others)]
        made = np.abs(found.displacements[:, column])
        assert np.abs(made[:, None] - np.array(stops)).min(axis=1).max() < 2 * problem.tolerance


def test_it_has_no_greatest_step_and_no_batch(muxarm, rng):
    start, target = random_targets(muxarm, rng, 2)
    with pytest.raises(ValueError, match=r"Problem\.max_step: must be None"):
        Problem(start, target, max_step=0.01, action_set="splits")
    with pytest.raises(ValueError, match=r"plan_batch: is for full moves"):
        plan_batch(muxarm, start, target[None], action_set="splits")
