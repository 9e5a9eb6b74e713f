"""The compiled table, batches, action sets, the beam's options and fronts against the lattice."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from test_planning import SERVO_SETS, random_targets

import muxjax
from muxjax.metrics import program_cost
from muxjax.planning import METHODS, Problem, front, plan, plan_batch
from muxjax.planning.bounds import AdmissibleBound
from muxjax.planning.grid import layered_angles
from muxjax.planning.lattice import Lattice
from muxjax.planning.motion import angles_at
from muxjax.planning.table import FullMoveTable, LatticeTable

PRESETS = ("paper", "no-overshoot")


def test_angles_on_a_grid_are_those_of_its_points(robot, rng):
    sizes = [3, 4, 2, 2, 2][: robot.n_segments]
    j = robot.tendons_per_segment
    points = [rng.normal(size=(n, j)) * 0.01 for n in sizes]
    by_layer = layered_angles(robot, points, np)
    for index in np.ndindex(*sizes):
        displacements = np.concatenate([p[i] for p, i in zip(points, index, strict=True)])
        expected = angles_at(robot, displacements[None])[0]
        found = [angles[index[: k + 1]] for k, angles in enumerate(by_layer)]
        assert found == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("action_set", ["subsets", "all"])
def test_the_compiled_table_is_that_of_the_lattice(muxarm, rng, preset, action_set):
    for number, servos in enumerate(SERVO_SETS):
        start, target = 0.5 * random_targets(muxarm, rng, 2)
        start[number] = target[number]  # already there
        axial = (None, 4)[number % 2]
        problem = Problem(
            start, target, servos=servos, preset=preset, axial=axial, action_set=action_set
        )
        lattice = Lattice(muxarm, problem)
        compiled, plain = FullMoveTable(lattice), LatticeTable(lattice, 2**30)
        for stop in {lattice.start_stop, 0}:
            for remaining in (lattice.steps, lattice.steps * (rng.random(9) < 0.6)):
                if not remaining.any():
                    continue
                ours, theirs = (
                    sorted(
                        (int(s), tuple(m), round(float(c + v), 9))
                        for s, m, c, v in zip(
                            *table.choices(remaining, stop, first=True), strict=True
                        )
                        if np.isfinite(c + v)
                    )
                    for table in (compiled, plain)
                )
                assert [x[:2] for x in ours] == [x[:2] for x in theirs]
                assert [x[2] for x in ours] == pytest.approx([x[2] for x in theirs], rel=1e-8)


def everything(robot, t):
    """A term that looks at every field of a transition."""
    angles = t.theta_before.sum(-1) + t.theta_after.max(-1) + t.theta_along.max(-2).sum(-1)
    excess = t.excess_before + 2 * t.excess_mean + 3 * t.excess_peak + t.goal.sum(-1)
    return angles + excess + t.wait + 5 * t.duration + (t.after**2 + t.before).sum(-1) ** 2


@pytest.mark.slow
def test_the_compiled_table_shows_terms_the_same_transitions(muxarm, rng):
    start, target = 0.5 * random_targets(muxarm, rng, 2)
    problem = Problem(start, target, weights={"all": 1.0}, terms={"all": everything}, servos=(2, 3))
    lattice = Lattice(muxarm, problem)
    first, second = (
        np.sort(c.cost + c.to_go)
        for c in (
            table.choices(lattice.steps, -1, first=True)
            for table in (FullMoveTable(lattice), LatticeTable(lattice, 2**30))
        )
    )
    assert first == pytest.approx(second, abs=1e-10)


@pytest.mark.parametrize(
    ("action_set", "max_step", "axial"),
    [("subsets", 0.03, None), ("all", 0.02, 4), ("multistep", 0.03, None), ("splits", None, 7)],
)
def test_a_table_of_promising_states_has_the_same_optima(
    muxarm, rng, monkeypatch, action_set, max_step, axial
):
    monkeypatch.setattr("muxjax.planning.table._SOON_SOLVED", 0)
    for servos, preset in [((1, 3), "paper"), ((1, 2, 3), "no-overshoot")]:
        start, target = random_targets(muxarm, rng, 2)
        problem = Problem(
            0.2 * start,
            target,
            servos=servos,
            preset=preset,
            max_step=max_step,
            axial=axial,
            action_set=action_set,
        )
        lattice = Lattice(muxarm, problem)
        whole, some = (LatticeTable(lattice, 2**30, whole=kind) for kind in (True, False))
        assert some.expansions < whole.expansions
        assert (some.value >= whole.value * (1 - 1e-12)).all()
        remaining, stop, first = lattice.steps, lattice.start_stop, True
        while remaining.any():
            choices, ours = (t.choices(remaining, stop, first=first) for t in (whole, some))
            through = choices.cost + choices.to_go
            optimal = through <= through.min() + 1e-10
            assert ours.to_go[optimal] == pytest.approx(choices.to_go[optimal], rel=1e-12)
            best, first = int(np.argmax(optimal)), False
            remaining, stop = remaining - choices.moves[best], int(choices.stop[best])


def test_a_batch_is_its_plans(muxarm, rng):
    targets = random_targets(muxarm, rng, 19)
    for servos, axial in [((1, 3), None), ((1, 2, 3), 5)]:
        batch = plan_batch(muxarm, np.zeros(9), targets, servos=servos, axial=axial)
        assert batch.cost.shape == (19,)
        for i in (0, 7, 18):
            assert batch.plan(i).cost == pytest.approx(batch.cost[i], rel=1e-12)
    with pytest.raises(ValueError, match="plan_batch: is for full moves"):
        plan_batch(muxarm, np.zeros(9), targets, max_step=0.01)
    with pytest.raises(ValueError, match="targets: must be a matrix"):
        plan_batch(muxarm, np.zeros(9), targets[0])
    with pytest.raises(ValueError, match=r"targets\[1\]: tendon"):
        plan_batch(muxarm, np.zeros(9), np.stack([targets[0], np.full(9, 0.3)]))


@pytest.mark.parametrize("action_set", ["all", "subsets", "multistep"])
@pytest.mark.parametrize("servos", [(2,), (1, 2, 3)])
def test_what_is_certified_is_what_is_executed(muxarm, rng, action_set, servos):
    start, target = 0.4 * random_targets(muxarm, rng, 2)
    problem = Problem(
        start, target, servos=servos, max_step=0.02, action_set=action_set, preset="no-overshoot"
    )
    for method in METHODS:
        found = plan(muxarm, problem, method)
        assert found.status != "failed"
        program = muxjax.schedule(muxarm, found)
        assert program_cost(muxarm, problem, program) == pytest.approx(found.cost, rel=1e-9)
        assert found.action_set == ("all" if method == "beamstep_printed" else action_set)


def test_more_actions_never_cost_more(muxarm, rng):
    start, target = 0.4 * random_targets(muxarm, rng, 2)
    for servos in ((1,), (1, 2, 3)):
        problem = Problem(start, target, servos=servos, max_step=0.02, preset="paper")
        cost = {
            name: plan(muxarm, replace(problem, action_set=name)).cost
            for name in ("all", "subsets", "multistep")
        }
        assert cost["multistep"] <= cost["subsets"] * (1 + 1e-12)
        assert cost["subsets"] <= cost["all"] * (1 + 1e-12)


def test_the_pattern_is_worth_its_name(muxarm, rng):
    """Above what the last step alone proves, and admissible (test_planning.py)."""
    target = random_targets(muxarm, rng, 1)[0]
    for servos in ((1,), (1, 2), (1, 2, 3)):
        problem = Problem(
            np.zeros(9), target, servos=servos, max_step=0.01, weights={"bending": 1.0}
        )
        lattice = Lattice(muxarm, problem)
        bound = float(AdmissibleBound(lattice)(lattice.steps[None], np.array([-1]))[0])
        assert bound > 2 * np.sum(angles_at(muxarm, target[None]) ** 2)
    # Three servos need three switches; to bend less by going to and fro between layers is not free.
    both = Lattice(muxarm, replace(problem, weights={"bending": 1.0, "switches": 10.0}))
    joint = float(AdmissibleBound(both)(both.steps[None], np.array([-1]))[0])
    assert joint > bound + 3 * 10.0


class Heavy(eqx.Module):
    """A user's term with data of its own."""

    factor: np.ndarray
    expensive = False

    def __call__(self, robot, t):
        return jnp.abs(t.after - t.before) @ self.factor


class HeavyAndSlow(Heavy):
    expensive = True


@pytest.mark.parametrize("kind", [Heavy, pytest.param(HeavyAndSlow, marks=pytest.mark.slow)])
def test_a_term_with_data_works_in_every_planner(muxarm, rng, kind):
    target = random_targets(muxarm, rng, 1)[0] * (np.arange(9) % 2)  # four tendons move
    for factor in (np.ones(9), np.arange(9.0)):
        term = kind(factor)
        problem = Problem(
            np.zeros(9),
            target,
            servos=(2,),
            weights={"heavy": 3.0, "switches": 0.1},
            terms={"heavy": term},
        )
        for method in METHODS:
            cost = plan(muxarm, problem, method).cost
            assert cost == pytest.approx(3 * np.abs(target) @ factor + 0.4, rel=1e-9)


def test_a_beam_doubles_until_it_is_good_enough(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    problem = Problem(np.zeros(9), target, servos=(1, 2), max_step=0.03)
    narrow = plan(muxarm, problem, "beamstep", width=2)
    better = plan(muxarm, problem, "beamstep", width=2, gap=narrow.gap / 2)
    assert better.gap <= narrow.gap / 2
    assert better.cost <= narrow.cost
    assert plan(muxarm, problem, "beamstep", width=2, deadline_s=0.0).cost == narrow.cost
    for option in ({"gap": -1.0}, {"deadline_s": np.nan}):
        with pytest.raises(ValueError, match="must be at least 0"):
            plan(muxarm, problem, "beamstep", **option)


def test_exact_falls_back_on_request_and_says_so(rng):
    penta = muxjax.load_robot("penta")
    problem = Problem(np.zeros(20), random_targets(penta, rng, 1)[0], servos=(1, 2, 3, 4))
    found = plan(penta, problem, memory_limit=2**20, fallback=True)
    assert found.method == "beamstep"
    assert "GiB" in found.reason
    assert np.isfinite(found.cost)


def test_a_front_trades_time_for_overshoot(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    problem = Problem(np.zeros(9), target, servos=(1, 2, 3))
    points = front(muxarm, problem, [0.0, 0.1, 1.0, 10.0])
    times, excesses = [p.time_s for p in points], [p.overshoot_s for p in points]
    assert times == sorted(times)
    assert excesses == sorted(excesses, reverse=True)
    for point in points:
        assert point.plan.cost == pytest.approx(
            point.time_s + point.weight * point.overshoot_s, rel=1e-9
        )
        metrics = muxjax.evaluate(muxarm, muxjax.schedule(muxarm, point.plan))
        assert metrics.time_s == pytest.approx(point.time_s, rel=1e-9)
        assert metrics.stages == point.stages
