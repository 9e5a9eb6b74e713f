"""Pattern databases against the exact table, with narrow cells and wide ones."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

import muxjax
from muxjax.planning import Problem, stop_patterns
from muxjax.planning.bounds import AdmissibleBound
from muxjax.planning.extents import extents, least_angles
from muxjax.planning.grid import layered_angles
from muxjax.planning.lattice import Lattice
from muxjax.planning.motion import angles_at
from muxjax.planning.patterns import Prices
from muxjax.planning.table import LatticeTable
from tests.test_planning import random_targets

WEIGHTS = {"bending": 0.05, "switches": 0.05, "overshoot": 0.1}


def pattern_of(lattice: Lattice) -> stop_patterns.StopPattern | None:
    """The pattern of a lattice with the weights above."""
    problem, robot = lattice.problem, lattice.robot
    weights = problem.cost_weights
    prices = Prices(
        weights["bending"], weights["switches"], float(robot.switch_time) * weights["overshoot"]
    )
    return stop_patterns.stop_pattern(lattice, prices, angles_at(robot, problem.target[None])[0])


@pytest.mark.parametrize("action_set", ["subsets", "all", "multistep", "splits"])
@pytest.mark.parametrize("size", [1, 3])
def test_the_pattern_is_admissible_at_every_state(muxarm, rng, monkeypatch, action_set, size):
    monkeypatch.setattr(stop_patterns, "_SIZES", (size,))
    for servos in ((2,), (1, 3), (1, 2, 3)):
        start, target = random_targets(muxarm, rng, 2)
        problem = Problem(
            start * 0.3,
            start * 0.3 + 0.7 * (target - start) * np.array([1, 1, 1, 0, 1, 1, 0, 1, 0]),
            servos=servos,
            weights=WEIGHTS,
            max_step={"splits": None, "multistep": 0.03}.get(action_set, 0.012),
            action_set=action_set,
        )
        lattice = Lattice(muxarm, problem)
        table = LatticeTable(lattice, 2**30)
        remaining = table.remaining(np.arange(len(table.value)))
        if len(servos) == 1 and action_set in ("subsets", "all"):
            assert pattern_of(lattice).wide == (size > 1)
        bound = AdmissibleBound(lattice)
        for stop in range(len(lattice.reach)):
            found = bound(remaining, np.full(len(remaining), stop))
            assert (found <= table.value[:, stop] + 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("servos", [(2,), (1, 2, 3, 4)])
def test_it_is_admissible_where_the_arm_has_more_layers_than_it_knows(rng, servos):
    penta = muxjax.load_robot("penta")
    start, target = random_targets(penta, rng, 2) * 0.4
    still = rng.permutation(penta.n_tendons)[6:]
    target[still] = start[still]
    problem = Problem(start, target, servos=servos, weights=WEIGHTS, max_step=0.02)
    lattice = Lattice(penta, problem)
    table = LatticeTable(lattice, 2**30)
    remaining = table.remaining(np.arange(len(table.value)))
    bound = AdmissibleBound(lattice)
    assert pattern_of(lattice) is not None
    for stop in range(len(lattice.reach)):
        stops = np.full(len(remaining), stop)
        assert (bound(remaining, stops) <= table.value[:, stop] + 1e-12).all()


def test_with_one_servo_it_nearly_is_the_cost(muxarm, rng):
    """What it gives away is the bending of classes of several states."""
    for target in random_targets(muxarm, rng, 3):
        problem = Problem(np.zeros(9), 0.5 * target, servos=(1,), max_step=0.02)
        lattice = Lattice(muxarm, problem)
        best = muxjax.plan(muxarm, problem).cost
        bound = float(AdmissibleBound(lattice)(lattice.steps[None], np.array([-1]))[0])
        assert 0.98 * best < bound <= best * (1 + 1e-12)


def test_least_bending_is_least(muxarm, rng):
    """Of any states, however they are told apart, on the image of M Eq. 6 or far from it."""
    for spread in (0.005, 0.02):
        lengths = [rng.normal(size=(40, 3)) * spread for _ in range(3)]
        labels = [np.sort(np.append(np.arange(5), rng.integers(0, 5, 35))) for _ in range(3)]
        for layers in (1, 2, 3):
            chosen = list(zip(lengths[:layers], labels[:layers], strict=True))
            least = least_angles(
                muxarm, [extents(muxarm, i, *layer) for i, layer in enumerate(chosen)]
            )
            angles = layered_angles(muxarm, lengths[:layers], np)
            for index in product(*(range(0, 40, 3) for _ in range(layers))):
                bending = sum(a[index[: i + 1]] ** 2 for i, a in enumerate(angles))
                classes = tuple(labels[i][k] for i, k in enumerate(index))
                assert not bending < least.bending[classes] * (1 - 1e-12)
