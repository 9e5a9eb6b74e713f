"""Planners against each other, against brute force and against an independent programme."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from itertools import chain, combinations, product
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import muxjax
from muxjax.metrics import program_cost
from muxjax.planning import METHODS, PlanningError, Problem, plan, plan_batch, plan_each
from muxjax.planning.axial import fewest_repositionings
from muxjax.planning.bounds import AdmissibleBound
from muxjax.planning.lattice import Lattice
from muxjax.planning.motion import angles_at, leg_time, relative_excess
from muxjax.planning.table import LatticeTable
from muxjax.planning.terms import step, transition_shapes
from muxjax.robot import Robot
from tests.beam_oracle import beam

GOLDEN = Path(__file__).parent / "golden"
SERVO_SETS = [s for n in (1, 2, 3) for s in combinations((1, 2, 3), n)]
ON_THE_LATTICE = ("beamstep", "sequential", "reverse", "greedy")


def random_targets(robot: Robot, rng: np.random.Generator, n: int) -> np.ndarray:
    """Displacements of the benchmark's targets: theta uniform in 0.2-1.6 rad, any azimuth."""
    theta = rng.uniform(0.2, np.minimum(1.6, robot.theta_max), (n, robot.n_segments))
    phi = rng.uniform(0, 2 * np.pi, theta.shape)
    return muxjax.tendon_displacements(robot, np.stack([theta, phi], -1).reshape(n, -1))


def check_all_methods(robot: Robot, problem: Problem) -> None:
    """The laws that hold between the planners of one problem."""
    plans = {method: plan(robot, problem, method) for method in METHODS}
    for method, found in plans.items():
        assert found.status in ("optimal", "feasible"), (method, found.reason)
        end = found.displacements[-1]
        assert np.max(np.abs(end - problem.target)) <= problem.tolerance
        steps = np.diff(found.displacements, axis=0)
        if problem.max_step is not None:
            assert np.max(np.abs(steps)) <= problem.max_step * (1 + 1e-12)
        reached = robot.reach(problem.servos)[found.axial - 1]
        assert not (np.abs(steps) > 0)[~reached].any()
    best = plans["exact"]
    assert best.status == "optimal"
    for found in plans.values():
        assert best.cost <= found.cost * (1 + 1e-12)
        # The printed algorithm's moves are a subset, and so is what its bound holds for.
        same = found.action_set == problem.action_set
        own = best if same else plan(robot, replace(problem, action_set=found.action_set))
        assert found.lower_bound <= own.cost * (1 + 1e-12)
    assert plans["beamstep"].cost <= min(
        plans[m].cost for m in ("sequential", "reverse", "greedy")
    ) * (1 + 1e-12)


@pytest.mark.parametrize("servos", SERVO_SETS)
@pytest.mark.parametrize("max_step", [None, 0.03])
def test_every_method_reaches_and_exact_is_least(muxarm, rng, servos, max_step):
    for number, target in enumerate(0.5 * random_targets(muxarm, rng, 3)):
        target[number :: max(2, 4 - len(servos))] = (
            0.0  # fewer steps: the printed algorithm is slow
        )
        preset = ("paper", "fastest", "no-overshoot")[number]
        check_all_methods(
            muxarm, Problem(np.zeros(9), target, servos=servos, max_step=max_step, preset=preset)
        )


@pytest.mark.slow
@pytest.mark.parametrize("servos", SERVO_SETS)
@pytest.mark.parametrize("max_step", [None, 0.03])
def test_every_method_on_100_targets(muxarm, rng, servos, max_step):
    presets = ("paper", "fastest", "no-overshoot")
    for number, target in enumerate(random_targets(muxarm, rng, 100)):
        preset = presets[number % 3]
        check_all_methods(
            muxarm, Problem(np.zeros(9), target, servos=servos, max_step=max_step, preset=preset)
        )


@pytest.mark.parametrize("action_set", ["subsets", "all"])
def test_from_a_bent_start_at_a_known_axial_position(muxarm, rng, action_set):
    start, target = random_targets(muxarm, rng, 2)
    for axial in (1, 5, 9):
        problem = Problem(
            start, target, servos=(1, 3), max_step=0.05, axial=axial, action_set=action_set
        )
        found = plan(muxarm, problem)
        assert np.allclose(found.displacements[-1], target, atol=problem.tolerance)
        free = plan(muxarm, Problem(start, target, servos=(1, 3), max_step=0.05))
        if action_set == "subsets":
            # Knowing the position saves at most the first repositioning and never costs one.
            assert free.cost - 0.05 - 1e-12 <= found.cost <= free.cost + 1e-12
        else:
            assert found.cost >= plan(muxarm, replace(problem, action_set="subsets")).cost - 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("moving", [6, 20])
def test_penta_has_twenty_tendons(rng, moving):
    penta = muxjax.load_robot("penta")
    target = random_targets(penta, rng, 1)[0]
    target[rng.permutation(20)[moving:]] = 0.0
    problem = Problem(np.zeros(20), target, servos=(1, 2, 3, 4))
    for method in ON_THE_LATTICE:
        found = plan(penta, problem, method)
        assert np.max(np.abs(found.displacements[-1] - target)) <= problem.tolerance


def test_a_lattice_beyond_the_memory_is_refused(rng):
    penta = muxjax.load_robot("penta")
    target = random_targets(penta, rng, 1)[0]
    with pytest.raises(PlanningError, match=r"GiB.*max_step.*beamstep"):
        plan(penta, Problem(np.zeros(20), target, servos=(1, 2, 3, 4), max_step=0.005))


# The cost of cases/planning_full_moves.json: every stage waits t_sw, also at an unchanged position.
def stage_time(robot, t):
    return robot.switch_time + leg_time(robot, t.after - t.before)


def stage_overshoot(robot, t):
    waiting = robot.switch_time * relative_excess(t.theta_before, t.goal)
    along = relative_excess(t.theta_along, t.goal[..., None, :])
    return waiting + leg_time(robot, t.after - t.before) * along.mean(axis=-1)


def golden_cases():
    cases = json.loads((GOLDEN / "planning_full_moves.json").read_text())["cases"]
    return [pytest.param(case, id=str(i)) for i, case in enumerate(cases)]


@pytest.mark.parametrize("case", golden_cases())
def test_exact_reproduces_an_independent_exhaustive_programme(muxarm, case):
    assert np.allclose(muxjax.tendon_displacements(muxarm, case["q"]), case["target"], atol=1e-14)
    for optimum in case["optimum"]:
        problem = Problem(
            np.zeros(9),
            case["target"],
            servos=tuple(optimum["servos"]),
            weights={"stage_time": 1.0, "stage_overshoot": float(optimum["w"])},
            terms={"stage_time": stage_time, "stage_overshoot": stage_overshoot},
        )
        assert plan(muxarm, problem).cost == pytest.approx(optimum["cost"], rel=1e-12)


def cheapest_by_enumeration(
    lattice: Lattice, remaining: np.ndarray, axial: int, first: bool = True
) -> float:
    """Every order of every action at every axial position, by recursion: the simplest exact."""
    if not remaining.any():
        return 0.0
    costs = []
    for position, reach in enumerate(lattice.robot.reach(lattice.problem.servos), start=1):
        usable = np.flatnonzero(reach & (remaining > 0))
        subsets = chain.from_iterable(combinations(usable, n) for n in range(1, len(usable) + 1))
        for chosen in subsets:
            moves = np.zeros_like(remaining)
            moves[list(chosen)] = 1
            both = lattice.costs(remaining[None], moves[None], first=first)[0]
            rest = cheapest_by_enumeration(lattice, remaining - moves, position, first=False)
            costs.append(both[int(position != axial)] + rest)
    return min(costs)


@pytest.mark.parametrize("preset", ["paper", "fastest", "no-overshoot"])
@pytest.mark.parametrize("servos", [(2,), (1, 3)])
def test_exact_equals_enumeration(muxarm, rng, preset, servos):
    target = random_targets(muxarm, rng, 1)[0]
    target[[1, 3, 4, 7, 8]] = 0.0
    start = np.where(target == 0, 0.0, 0.3 * target)
    problem = Problem(start, target, servos=servos, preset=preset, axial=2)
    by_hand = cheapest_by_enumeration(Lattice(muxarm, problem), Lattice(muxarm, problem).steps, 2)
    assert plan(muxarm, problem).cost == pytest.approx(by_hand, rel=1e-12)


@pytest.mark.parametrize(
    ("action_set", "max_step"),
    [
        *product(("subsets", "all", "multistep"), (None, 0.03)),
        ("splits", None),
    ],
)
def test_bound_is_admissible_at_every_state(muxarm, rng, max_step, action_set):
    presets = ("paper", "fastest", "no-overshoot")
    for number, servos in enumerate(SERVO_SETS):
        start, target = random_targets(muxarm, rng, 2)
        start[number % 9] = target[number % 9] + 0.9e-5  # one tendon is there but for the tolerance
        problem = Problem(
            start * 0.4,
            target * 0.4,
            servos=servos,
            preset=presets[number % 3],
            max_step=max_step,
            action_set=action_set,
        )
        lattice = Lattice(muxarm, problem)
        table = LatticeTable(lattice, 2**30)
        remaining = table.remaining(np.arange(len(table.value)))
        bound = AdmissibleBound(lattice)
        for stop in range(len(lattice.reach)):
            stops = np.full(len(remaining), stop)
            assert (bound(remaining, stops) <= table.value[:, stop] + 1e-12).all()


def test_bound_of_mostly_bending_is_admissible(muxarm, rng):
    """Where the patterns count most, and where tendons that wind about leave the pairs alone."""
    azimuth = np.array(muxarm.tendon_azimuth)
    azimuth[0, 1] += 0.3  # layer 2's tendons change their azimuth between segments 1 and 2
    twisted = eqx.tree_at(lambda r: r.tendon_azimuth, muxarm, azimuth)
    for robot, servos in product((muxarm, twisted), ((1,), (1, 3), (1, 2, 3))):
        target = random_targets(muxarm, rng, 1)[0]
        problem = Problem(
            np.zeros(9),
            0.7 * target,
            servos=servos,
            max_step=0.02,
            weights={"bending": 1.0, "switches": 0.1, "overshoot": 0.5},
        )
        lattice = Lattice(robot, problem)
        table = LatticeTable(lattice, 2**30)
        remaining = table.remaining(np.arange(len(table.value)))
        bound, last = AdmissibleBound(lattice), np.sum(angles_at(robot, 0.7 * target[None]) ** 2)
        for stop in range(len(lattice.reach)):
            found = bound(remaining, np.full(len(remaining), stop))
            assert (found <= table.value[:, stop] * (1 + 1e-12)).all()
            assert found.max() > 2 * last


@pytest.mark.parametrize(
    ("preset", "action_set"),
    [
        *product(("paper", "fastest", "no-overshoot"), ("subsets",)),
        *product(("paper",), ("all", "multistep", "splits")),
    ],
)
def test_bound_at_the_start_is_below_the_optimum(muxarm, rng, preset, action_set):
    """On finer lattices and larger bends than above, from bent starts too, for every servo set."""
    max_step = {"splits": None, "multistep": 0.02}.get(action_set, 0.008)
    for number, servos in enumerate(SERVO_SETS):
        start, target = random_targets(muxarm, rng, 2)
        start = 0.3 * start * (number % 2)
        target = start + 0.4 * (target - start)
        problem = Problem(
            start, target, servos=servos, max_step=max_step, preset=preset, action_set=action_set
        )
        lattice = Lattice(muxarm, problem)
        bound = float(AdmissibleBound(lattice)(lattice.steps[None], np.array([-1]))[0])
        assert 0.0 < bound <= plan(muxarm, problem).cost * (1 + 1e-12)


def test_a_wide_beam_is_exact_and_certifies_itself(muxarm, rng):
    for target in random_targets(muxarm, rng, 3):
        problem = Problem(np.zeros(9), target, servos=(1, 2))
        wide = plan(muxarm, problem, "beamstep", width=10_000)
        assert wide.status == "optimal"
        assert wide.gap == 0.0
        assert wide.cost == pytest.approx(plan(muxarm, problem).cost, rel=1e-12)


@pytest.mark.parametrize(
    "action_set",
    ["subsets", "all", *(pytest.param(s, marks=pytest.mark.slow) for s in ("multistep", "splits"))],
)
def test_the_compiled_beam_is_the_one_on_the_host(muxarm, rng, action_set):
    """Whatever the width, the servos and the weights, as long as these leave no two plans equal."""
    weights = {"travel": 1.0, "bending": 0.005, "switches": 0.05, "overshoot": 0.0137}
    for number, target in enumerate(random_targets(muxarm, rng, 7)):
        problem = Problem(
            0.2 * (number % 2) * target,
            target,
            servos=SERVO_SETS[number % len(SERVO_SETS)],
            max_step=None if action_set == "splits" else (0.03, 0.015)[number % 2],
            weights=weights,
            action_set=action_set,
            axial=(None, 4)[number // 2 % 2],
        )
        lattice, width = Lattice(muxarm, problem), (7, 50)[number % 2]
        known = min(plan(muxarm, problem, m).cost for m in ("sequential", "reverse", "greedy"))
        cost, cut_off, _ = beam(lattice, width, known)
        found = plan(muxarm, problem, "beamstep", width=width)
        assert found.cost == pytest.approx(cost, rel=1e-12)
        assert found.lower_bound == pytest.approx(min(cost, cut_off), rel=1e-12)


@pytest.mark.parametrize("heuristic", ["none", "count", "patterns"])
def test_every_heuristic_certifies(muxarm, rng, heuristic):
    target = random_targets(muxarm, rng, 1)[0]
    problem = Problem(np.zeros(9), target, servos=(1, 2), max_step=0.03)
    best = plan(muxarm, problem).cost
    found = plan(muxarm, problem, "beamstep", width=16, heuristic=heuristic)
    assert found.lower_bound <= best * (1 + 1e-12)
    assert best <= found.cost * (1 + 1e-12)


def test_plans_side_by_side_are_those_one_by_one(muxarm, rng):
    problems = [
        Problem(np.zeros(9), target, servos=SERVO_SETS[number], max_step=0.03)
        for number, target in enumerate(random_targets(muxarm, rng, 6))
    ]
    together = plan_each(muxarm, problems, width=7)
    for problem, found in zip(problems, together, strict=True):
        alone = plan(muxarm, problem, "beamstep", width=7)
        assert found.problem is problem
        assert (found.cost, found.lower_bound) == (alone.cost, alone.lower_bound)
        np.testing.assert_array_equal(found.displacements, alone.displacements)


def test_a_value_function_guides_but_cannot_break_the_certificate(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    problem = Problem(np.zeros(9), target, servos=(1, 2))
    best = plan(muxarm, problem).cost
    perverse = plan(
        muxarm,
        problem,
        "beamstep",
        width=4,
        value_fn=lambda states: -1e3 * abs(states.displacements).sum(axis=1),
    )
    assert perverse.lower_bound <= best <= perverse.cost


def test_axial_mapping_is_a_shortest_path(muxarm, rng):
    for _ in range(20):
        servos = SERVO_SETS[rng.integers(len(SERVO_SETS))]
        reach = muxarm.reach(servos)
        preferred = rng.integers(1, 10, size=5)
        moving = reach[preferred - 1] & (rng.random((5, 9)) < 0.7)
        start = [None, 4][rng.integers(2)]
        path = fewest_repositionings(muxarm, moving, servos, start, preferred)
        feasible = [[a for a in range(1, 10) if not (row & ~reach[a - 1]).any()] for row in moving]
        assert all(a in options for a, options in zip(path, feasible, strict=True))
        least = min(
            np.count_nonzero(np.diff(choice, prepend=start or 0)) for choice in product(*feasible)
        )
        assert np.count_nonzero(np.diff(path, prepend=start or 0)) == least


def test_steps_are_counted_with_a_rounding_guard(muxarm):
    target = np.zeros(9)
    target[0] = -0.03
    for max_step, steps in [(0.01, 3), (0.01 - 1e-9, 3), (0.0149, 3), (0.015, 2), (0.03, 1)]:
        problem = Problem(np.zeros(9), target, max_step=max_step)
        assert Lattice(muxarm, problem).steps[0] == steps


def test_a_residual_within_tolerance_is_left_alone(muxarm):
    target = np.zeros(9)
    target[3] = 0.9e-5
    found = plan(muxarm, Problem(np.zeros(9), target))
    assert found.n_steps == 0
    assert found.cost == 0.0


def tendon_one_is_dear(robot, t):
    return 100.0 * abs(t.after - t.before)[..., 0] + 1e-3 * t.repositions


def test_a_users_term_works_in_every_planner(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    for method in METHODS:
        found = plan(
            muxarm,
            Problem(
                np.zeros(9),
                target,
                servos=(1,),
                weights={"dear": 2.0},
                terms={"dear": tendon_one_is_dear},
            ),
            method,
        )
        assert found.cost == pytest.approx(2 * (100 * abs(target[0]) + 9e-3), rel=1e-9)


def test_plans_do_not_depend_on_the_callers_precision(muxarm, rng):
    problem = Problem(np.zeros(9), random_targets(muxarm, rng, 1)[0], servos=(1, 2))
    plain = plan(muxarm, problem)
    with jax.enable_x64(True):
        assert plan(muxarm, problem).cost == plain.cost


def nowhere(robot, t):
    return t.repositions * np.nan


def bonus(robot, t):
    return -t.repositions


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"target": [np.nan] * 9}, r"Problem.target: entry \(0,\) is nan"),
        ({"target": np.zeros(8)}, r"Problem.target: last axis must have 9"),
        ({"start": np.zeros((2, 9))}, r"Problem.start: must be a vector"),
        ({"start": "straight"}, r"Problem.start: expected numbers"),
        ({"target": np.full(9, 0.2)}, r"Problem.target: tendon 1 is at 200 mm, its range is"),
        ({"target": [-0.09, 0.09, 0.09, 0, 0, 0, 0, 0, 0]}, r"segment 1 is .* limit 180"),
        ({"servos": ()}, r"Problem.servos: must be a non-empty set"),
        ({"servos": (1, 1)}, r"Problem.servos: servo 1 is named twice, found \(1, 1\)"),
        ({"servos": (4,)}, r"Problem.servos: the robot has servos 1 to 3, found 4"),
        ({"servos": (0,)}, r"Problem.servos: the robot has servos 1 to 3, found 0"),
        ({"tolerance": 0.0}, r"Problem.tolerance: must be above 0"),
        ({"max_step": 1e-6}, r"Problem.max_step: must be finite and above the tolerance"),
        ({"max_step": np.nan}, r"Problem.max_step"),
        ({"max_step": np.inf}, r"Problem.max_step: must be finite"),
        ({"weights": {}}, r"Problem.weights: needs at least one term"),
        ({"terms": {"mine": bonus}}, r"Problem.terms: \['mine'\] have no entry"),
        ({"axial": 10}, r"Problem.axial: the robot has positions 1 to 9, found 10"),
        ({"preset": "cheapest"}, r"planners: no 'cheapest' among the shipped"),
        ({"weights": {"travel": np.nan}}, r"Problem.weights\['travel'\]"),
        ({"weights": {"travl": 1.0}}, r"Problem.weights: no term 'travl' among"),
        ({"action_set": "some"}, r"Problem.action_set"),
    ],
)
def test_bad_problems_are_refused_by_name(muxarm, fields, message):
    with pytest.raises(ValueError, match=message):
        plan(muxarm, Problem(**{"start": np.zeros(9), "target": np.full(9, -0.001), **fields}))


FOLDED = np.radians([170, 0, 170, 0, 135, 0]), np.radians([170, 180, 170, 180, 135, 180])


@pytest.mark.parametrize("servos", [(1, 2, 3), (1,)])
def test_orders_through_undefined_states_are_never_chosen(muxarm, servos):
    """Between these two shapes, some orders wind a segment in by more than its length."""
    start, target = (muxjax.tendon_displacements(muxarm, q) for q in FOLDED)
    problem = Problem(start, target, servos=servos)
    found = {method: plan(muxarm, problem, method) for method in METHODS}
    assert found["exact"].status == "optimal"
    for candidate in found.values():
        if candidate.status == "failed":
            assert "not defined" in candidate.reason
            assert candidate.gap == 1.0
        else:
            assert np.isfinite(candidate.cost)
            optimum = plan(muxarm, replace(problem, action_set=candidate.action_set), "exact").cost
            assert candidate.lower_bound <= optimum <= candidate.cost * (1 + 1e-12)
            assert found["exact"].cost <= optimum * (1 + 1e-12)
            metrics = muxjax.evaluate(muxarm, muxjax.schedule(muxarm, candidate))
            assert np.isfinite(metrics.bending_peak_rad).all()
    if servos == (1,):
        assert found["greedy"].status == "failed"


def test_a_users_term_that_is_not_a_cost_is_refused(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    for method in METHODS:
        bad = Problem(np.zeros(9), target, weights={"mine": 1.0}, terms={"mine": nowhere})
        assert plan(muxarm, bad, method).status == "failed"
        bad = Problem(np.zeros(9), target, weights={"mine": 1.0}, terms={"mine": bonus})
        with pytest.raises(PlanningError, match="a cost term is negative"):
            plan(muxarm, bad, method)


WRONG_TERMS = [
    (
        lambda robot, t: jnp.sum(t.after**2),
        r"returned shape \(\), .*, shape \(3,\); sum over axis=-1",
    ),
    (
        lambda robot, t: t.after**2,
        r"returned shape \(3, 9\), must be one value for each transition",
    ),
    (lambda robot, t: jnp.sum(t.theta_after, axis=0), r"returned shape \(5, 3\), .*shape \(2, 5\)"),
    (lambda robot, t: 1.0, r"returned shape \(\)"),
    (lambda robot, t: (t.wait, t.wait), "must return one array, found tuple"),
    (
        lambda robot, t: np.linalg.norm(t.after, axis=-1),
        "needs the numbers .*; write it with jax.numpy",
    ),
    (
        lambda robot, t: t.wait if (t.wait > 0).any() else t.duration,
        "needs .*jax.numpy.where for an if",
    ),
]


@pytest.mark.parametrize(("term", "message"), WRONG_TERMS)
def test_a_term_gives_one_value_for_each_transition(muxarm, term, message):
    target = np.full(9, -0.001)
    fields = {"weights": {"foo": 1.0}, "terms": {"foo": term}}
    found = r"Problem.terms\['foo'\]: " + message
    for method in METHODS:
        with pytest.raises(ValueError, match=found):
            plan(muxarm, Problem(np.zeros(9), target, **fields), method)
    with pytest.raises(ValueError, match=found):
        plan_batch(muxarm, np.zeros(9), [target], **fields)
    with pytest.raises(ValueError, match=found):
        plan_each(muxarm, [Problem(np.zeros(9), target, **fields)])
    program = muxjax.schedule(muxarm, plan(muxarm, Problem(np.zeros(9), target)))
    with pytest.raises(ValueError, match=found):
        program_cost(muxarm, Problem(np.zeros(9), target, **fields), program)


def test_a_fault_in_a_term_names_the_term(muxarm):
    fields = {"weights": {"foo": 1.0}, "terms": {"foo": lambda robot, t: t.waiting}}
    with pytest.raises(AttributeError) as caught:
        plan(muxarm, Problem(np.zeros(9), np.full(9, -0.001), **fields))
    notes = "".join(caught.value.__notes__)
    assert "in Problem.terms['foo'], asked about transitions of shape (3,)" in notes


@pytest.mark.parametrize("batch", [(3,), (2, 5)])
def test_terms_are_checked_on_transitions_as_steps_make_them(robot, batch):
    moves, flags = np.zeros((*batch, robot.n_tendons)), np.zeros(batch)
    with jax.enable_x64(True):
        goal = np.zeros(robot.n_segments)
        made = jax.eval_shape(step, robot, moves, moves, flags, flags, goal)
        shapes = jax.tree.map(lambda x: (x.shape, x.dtype), made._asdict())
    expected = transition_shapes(robot, batch)._asdict()
    assert shapes == jax.tree.map(lambda x: (x.shape, x.dtype), expected)


def test_a_problem_keeps_its_own_copy(muxarm, rng):
    target = random_targets(muxarm, rng, 1)[0]
    problem = Problem(np.zeros(9), target)
    wanted = target.copy()
    target *= 0.5
    assert np.array_equal(problem.target, wanted)
    with pytest.raises(ValueError, match="read-only"):
        problem.target[0] = 0.0
    with pytest.raises(TypeError):
        problem.cost_weights["travel"] = 7.0


def test_exact_counts_its_temporaries(rng):
    penta = muxjax.load_robot("penta")
    problem = Problem(np.zeros(20), random_targets(penta, rng, 1)[0], servos=(1, 2, 3, 4))
    with pytest.raises(PlanningError, match=r"the limit is 0\.0977 GiB"):
        plan(penta, problem, memory_limit=100 * 2**20)


WRONG_TYPES = """
import muxjax
for field, value in [
    ("max_step", "2"), ("tolerance", None), ("servos", 2), ("servos", (1.7,)), ("servos", "12"),
    ("axial", 2.5), ("axial", "2"), ("preset", None),
]:
    try:
        muxjax.Problem([0.0], [0.0], **{field: value})
    except ValueError as error:
        assert str(error).startswith(f"Problem.{field}: "), error
    else:
        raise SystemExit(f"{field}={value!r} was taken")
"""


def test_wrong_types_are_refused_by_name():
    """In a process of its own: here the shape checker would be first."""
    subprocess.run([sys.executable, "-c", WRONG_TYPES], check=True)


def test_unknown_methods_and_options_are_refused(muxarm):
    problem = Problem(np.zeros(9), np.zeros(9))
    with pytest.raises(ValueError, match="method: must be one of exact"):
        plan(muxarm, problem, "best")
    with pytest.raises(ValueError, match="exact: has no option gap"):
        plan(muxarm, problem, "exact", gap=0.1)
    for method, limit in (("beamstep", " from 1 to 65536"), ("beamstep_printed", ", at least 1")):
        with pytest.raises(ValueError, match=f"width: must be a whole number{limit}, found 0"):
            plan(muxarm, problem, method, width=0)


def test_the_printed_algorithm_says_when_it_gives_up(muxarm, rng):
    problem = Problem(np.zeros(9), random_targets(muxarm, rng, 1)[0], servos=(1,))
    found = plan(muxarm, problem, "beamstep_printed", max_expansions=5)
    assert found.status == "failed"
    assert found.cost == np.inf
    assert "5 expansions" in found.reason
    with pytest.raises(ValueError, match="found none"):
        muxjax.schedule(muxarm, found)
