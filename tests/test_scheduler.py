"""Programs: what they add up to, and that the hardware map allows them."""

from __future__ import annotations

from itertools import combinations, pairwise

import equinox as eqx
import numpy as np
import pytest
from test_planning import random_targets

import muxjax
from muxjax.metrics import program_cost
from muxjax.planning import METHODS, Problem, plan
from muxjax.scheduler import waypoints


@pytest.mark.parametrize("servos", [s for n in (1, 2, 3) for s in combinations((1, 2, 3), n)])
@pytest.mark.parametrize("method", METHODS)
def test_a_program_is_feasible_and_adds_up(muxarm, rng, servos, method):
    start, target = random_targets(muxarm, rng, 2)
    for max_step in (None, 0.02):
        problem = Problem(start, target, servos=servos, max_step=max_step)
        # A lattice of 0.02 m steps between two bent poses is large for the exact planner alone.
        if method == "exact" and max_step is not None:
            problem = Problem(0 * start, target, servos=servos, max_step=0.06)
        found = plan(muxarm, problem, method)
        program = muxjax.schedule(muxarm, found)
        total = np.zeros(9)
        for instruction in program.instructions:
            tendons = []
            for servo, moved in instruction.length_moves.items():
                assert servo in servos
                tendon = muxarm.axial_map[instruction.axial - 1, servo - 1]
                tendons.append(int(tendon) + 1)
                total[tendon] += moved
                assert instruction.servo_angles[servo] == pytest.approx(60 / 0.025 * moved)
                assert instruction.via[-1][servo] == pytest.approx(moved, abs=1e-15)
            assert instruction.clutches == tuple(sorted(tendons))
        assert np.allclose(total, target - problem.start, atol=problem.tolerance)
        assert np.allclose(waypoints(muxarm, program)[-1][-1], target, atol=problem.tolerance)
        assert program_cost(muxarm, problem, program) == pytest.approx(found.cost, rel=1e-9)
        axial = [i.axial for i in program.instructions]
        assert all(a != b for a, b in pairwise(axial)), "fusion left a pair"


def test_three_servos_need_three_instructions_and_one_needs_nine(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    for servos, stages in [((1, 2, 3), 3), ((1, 2), 6), ((2,), 9)]:
        problem = Problem(np.zeros(9), target, servos=servos, preset="fastest")
        assert len(muxjax.schedule(muxarm, plan(muxarm, problem)).instructions) == stages


def test_a_program_or_plan_for_another_robot_is_refused(muxarm, rng):
    penta = muxjax.load_robot("penta")
    found = plan(muxarm, Problem(np.zeros(9), random_targets(muxarm, rng, 1)[0]))
    with pytest.raises(ValueError, match=r"plan: made for robot .*, this is 'penta'"):
        muxjax.schedule(penta, found)
    with pytest.raises(ValueError, match="program: made for robot 'muxarm'"):
        muxjax.evaluate(penta, muxjax.schedule(muxarm, found))


def test_a_changed_robot_is_another_robot(muxarm, rng):
    """Equal counts and configuration are not enough: the leaves count too."""
    changed = eqx.tree_at(lambda r: r.tendon_radius, muxarm, np.array(0.02))
    found = plan(muxarm, Problem(np.zeros(9), random_targets(muxarm, rng, 1)[0]))
    with pytest.raises(ValueError, match="plan: made for robot"):
        muxjax.schedule(changed, found)
    with pytest.raises(ValueError, match="program: made for robot"):
        muxjax.evaluate(changed, muxjax.schedule(muxarm, found))
