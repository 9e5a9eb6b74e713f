"""The value network: its features, its files, and the planner that it guides."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import muxjax
from muxjax.planning import Problem, plan
from muxjax.planning.checkpoint import CheckpointError, load_value, save_value
from muxjax.planning.lattice import Lattice
from muxjax.planning.learned import learned_value
from muxjax.planning.search import States
from muxjax.planning.value import context_of, n_features, turn_by_a_tendon, value_net
from training.dataset import features_of

SERVO_SETS = ((1,), (2, 3), (1, 2, 3))


def random_lattice(robot, rng, **fields) -> Lattice:
    theta, phi = rng.uniform(0.2, 1.2, 3), rng.uniform(0, 2 * np.pi, 3)
    target = muxjax.tendon_displacements(robot, np.stack([theta, phi], -1).ravel())
    return Lattice(robot, Problem(0.3 * rng.random() * target[::-1], target, **fields))


def random_states(lattice: Lattice, rng, count: int = 40):
    remaining = rng.integers(0, lattice.steps + 1, (count, len(lattice.steps)))
    return remaining, rng.integers(-1, len(lattice.reach), count)


@pytest.fixture(scope="module")
def net(muxarm):
    return value_net((n_features(muxarm), 16, 1), jax.random.key(3))


def turned(robot, problem: Problem) -> Problem:
    """The same problem a third of a turn on: every tendon's task is its neighbour's."""
    start, target = (
        np.roll(x.reshape(robot.n_segments, -1), 1, axis=1).ravel()
        for x in (problem.start, problem.target)
    )
    servos = tuple(s % robot.tendons_per_segment + 1 for s in problem.servos)
    return replace(problem, start=start, target=target, servos=servos)


@pytest.mark.parametrize("servos", SERVO_SETS)
def test_turning_a_problem_turns_its_features_and_keeps_its_cost(muxarm, rng, servos):
    lattice = random_lattice(muxarm, rng, servos=servos, max_step=0.02)
    other = Lattice(muxarm, turned(muxarm, lattice.problem))
    assert plan(muxarm, other.problem).cost == pytest.approx(plan(muxarm, lattice.problem).cost)
    remaining, _ = random_states(lattice, rng)
    around = np.roll(remaining.reshape(-1, 3, 3), 1, axis=2).reshape(len(remaining), -1)
    axial = rng.integers(1, 10, len(remaining))  # turned servos meet the turned tendons there
    here, there = (
        features_of(muxarm, context_of(x), states, x.stop_of_axial[axial - 1])[0]
        for x, states in ((lattice, remaining), (other, around))
    )
    assert here.shape[1] == n_features(muxarm)
    np.testing.assert_allclose(here @ turn_by_a_tendon(muxarm).T, there, atol=1e-9)
    assert not np.allclose(here, there)


def test_features_are_finite_and_bounded(muxarm, rng):
    for preset in ("paper", "fastest", "no-overshoot", "gentle"):
        for action_set in ("subsets", "splits"):
            lattice = random_lattice(muxarm, rng, preset=preset, action_set=action_set)
            inputs, count = features_of(muxarm, context_of(lattice), *random_states(lattice, rng))
            assert np.isfinite(inputs).all()
            assert np.abs(inputs).max() <= 3.0
            assert (count >= 0).all()


@pytest.mark.slow
def test_obstacles_and_unknown_terms_are_felt(muxarm, rng):
    lattice = random_lattice(muxarm, rng, weights={"travel": 1.0})
    world = muxjax.load_world("cabinet")
    weights = {"travel": 1.0, "clearance": 5.0}
    among = Lattice(muxarm, replace(lattice.problem, weights=weights, world=world))
    own = Lattice(
        muxarm,
        replace(
            lattice.problem,
            weights={"travel": 1.0, "mine": 2.0},
            terms={"mine": lambda robot, t: t.wait * t.theta_before[..., 0]},
        ),
    )
    assert not context_of(lattice).rates.any()
    assert context_of(among).rates.any()
    assert context_of(own).rates[0] < context_of(own).rates[-1]  # bends more at the target


def test_the_value_is_no_less_than_the_bound_and_zero_at_the_target(muxarm, rng, net):
    lattice = random_lattice(muxarm, rng, servos=(1, 2), max_step=0.03)
    value = learned_value(lattice, net)
    remaining, stop = (x.astype(np.int32) for x in random_states(lattice, rng))
    remaining[0] = 0
    bound = np.where(np.arange(len(stop)) == 5, 1e6, 0.0)
    with jax.enable_x64(True):
        states = States(lattice.displacements(remaining), remaining, stop, stop + 1, bound)
        found = np.asarray(value(states))
    assert found[0] == 0.0
    assert found[5] == 1e6
    _, count = features_of(muxarm, context_of(lattice), remaining, stop)
    assert (found[1:] > count[1:]).all()


def test_a_learned_plan_is_certified_by_the_admissible_bound(muxarm, rng, net, tmp_path):
    path = tmp_path / "own.value"
    save_value(path, net, muxarm, {"seed": 3})
    for servos in SERVO_SETS:
        problem = random_lattice(muxarm, rng, servos=servos, max_step=0.03).problem
        found = plan(muxarm, problem, "learned", checkpoint=str(path), width=4)
        best = plan(muxarm, problem).cost
        assert found.method == "learned"
        assert found.lower_bound <= best * (1 + 1e-12)
        assert best <= found.cost * (1 + 1e-12)
        np.testing.assert_allclose(found.displacements[-1], problem.target, atol=1e-5)


def test_checkpoints_come_back_as_they_were(muxarm, net, tmp_path):
    path = tmp_path / "own.value"
    save_value(path, net, muxarm, {"seed": 3})
    again, header = load_value(path, muxarm)
    jax.tree.map(np.testing.assert_array_equal, net, again)
    assert header["about"] == {"seed": 3}
    assert header["robot"] == "muxarm"


def test_wrong_checkpoints_are_refused_with_the_reason(muxarm, net, tmp_path):
    path = tmp_path / "own.value"
    save_value(path, net, muxarm, {})
    content = path.read_bytes()
    with pytest.raises(CheckpointError, match=r"fingerprint of the robot is .* trained for the"):
        load_value(path, muxjax.load_robot("penta"))
    header, _, arrays = content.partition(b"\n")
    broken = {
        "truncated": (content[:-100], "truncated or altered"),
        "empty": (b"", "is no checkpoint"),
        "other": (b"\x00\x01garbage\n" + arrays, "is no checkpoint"),
        "version": (header.replace(b'"features": 1', b'"features": 0') + b"\n" + arrays, "version"),
        "schema": (header.replace(b"value/1", b"value/9") + b"\n" + arrays, "schema"),
    }
    for name, (damaged, reason) in broken.items():
        other = tmp_path / f"{name}.value"
        other.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=reason):
            load_value(other, muxarm)
    with pytest.raises(CheckpointError, match="no such file"):
        load_value(tmp_path / "missing.value", muxarm)
    with pytest.raises(CheckpointError, match="no 'nobody' among the shipped ones"):
        load_value("nobody", muxarm)


@pytest.mark.parametrize("name", ["muxarm", "penta"])
def test_shipped_networks_fit_their_robots(name):
    net, header = load_value(name, muxjax.load_robot(name))
    assert header["about"]["config"]["robot"] == name
    assert all(np.isfinite(w).all() for w in net.weights)
