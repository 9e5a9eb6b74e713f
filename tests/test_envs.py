"""The environment's core: the planners' own steps and costs, masks, ends of episodes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import muxjax
from envs.config import Difficulty, TdmaConfig, load_env_config
from envs.tdma import OBSERVED, Tdma, servo_bits
from muxjax.config import ConfigError
from muxjax.planning import TERMS
from muxjax.planning.lattice import Lattice

SERVO_SETS = ((1,), (2, 3), (1, 2, 3))


def config(**fields) -> TdmaConfig:
    return TdmaConfig(schema="muxjax/env/1", **fields)


def closeness_to_straight(robot, t):
    """A term of a user's own."""
    return jnp.sum(jnp.cos(t.theta_after), axis=-1) ** 2


def random_target(robot, rng):
    theta = rng.uniform(0.2, 1.6, robot.n_segments)
    phi = rng.uniform(0.0, 2 * np.pi, robot.n_segments)
    return muxjax.tendon_displacements(robot, np.stack([theta, phi], -1).reshape(-1))


def actions_of(robot, plan) -> list[int]:
    """Discrete actions whose steps are the plan's."""
    found = []
    for axial, moved in zip(plan.axial, np.diff(plan.displacements, axis=0) != 0, strict=True):
        servos = np.flatnonzero(moved[robot.axial_map[axial - 1]]) + 1
        subsets = 2**robot.tendons_per_segment - 1
        found.append(int((axial - 1) * subsets + servo_bits(tuple(servos.tolist())) - 1))
    return found


STEP = jax.jit(lambda env, state, action: env.step(state, action), static_argnums=0)


def replayed(env, problem, actions):
    """Return, states and outcomes of actions, in float64."""
    with jax.enable_x64(True):
        state = env.reset(
            jax.random.key(0),
            start=problem.start,
            target=problem.target,
            axial=problem.axial or 0,
            servos=servo_bits(problem.servos),
        )
        total, outcomes, path = 0.0, [], [np.array(state.displacements)]
        for action in actions:
            state, outcome = STEP(env, state, action)
            outcomes.append(outcome)
            path.append(np.array(state.displacements))
            total += float(outcome.reward)
    return total, np.array(path), outcomes


OBJECTIVES = {
    "paper": {},
    "fastest": {},
    "no-overshoot": {},
    "gentle": {},
    "every term": {"weights": {name: 0.1 + 0.2 * k for k, name in enumerate(sorted(TERMS))}},
    "own term": {"weights": {"travel": 1.0, "own": 0.3}},
}


@cache
def core(max_step_mm, objective):
    """One environment for all tests of an objective: it compiles once."""
    fields = dict(OBJECTIVES[objective]) or {"preset": objective}
    terms = {"own": closeness_to_straight} if objective == "own term" else {}
    return Tdma(config(max_step_mm=max_step_mm, **fields), terms)


def _method_cases():
    """Every objective with each planner; those of "gentle" take long."""
    for objective in OBJECTIVES:
        for method in ("greedy", "exact", "beamstep"):
            marks = pytest.mark.slow if objective == "gentle" else ()
            yield pytest.param(objective, method, None, marks=marks)
        yield objective, "greedy", 25.0


@pytest.mark.parametrize(("objective", "method", "max_step_mm"), list(_method_cases()))
def test_return_is_minus_the_cost_of_the_plan(objective, method, max_step_mm, muxarm, rng):
    fields = dict(OBJECTIVES[objective]) or {"preset": objective}
    terms = {"own": closeness_to_straight} if objective == "own term" else {}
    env = core(max_step_mm, objective)
    first = muxjax.Problem(
        np.zeros(9),
        random_target(muxarm, rng),
        max_step=None if max_step_mm is None else 1e-3 * max_step_mm,
        terms=terms,
        preset=fields.get("preset", "paper"),
        weights=fields.get("weights"),
    )
    bent = replace(first, start=random_target(muxarm, rng), axial=5)
    for problem in (replace(p, servos=s) for p in (first, bent) for s in SERVO_SETS):
        plan = muxjax.plan(muxarm, problem, method)
        total, path, outcomes = replayed(env, problem, actions_of(muxarm, plan))
        assert abs(total + plan.cost) < 1e-9
        np.testing.assert_allclose(path, plan.displacements, rtol=0, atol=1e-12)
        ends = [bool(o.terminated) for o in outcomes]
        assert ends == [False] * (plan.n_steps - 1) + [True]
        assert bool(outcomes[-1].solved)


def test_a_term_that_does_not_give_one_value_for_each_transition_is_refused():
    terms = {"foo": lambda robot, t: jnp.sum(t.after**2)}
    with pytest.raises(ConfigError, match=r"Problem.terms\['foo'\]: returned shape \(\)"):
        Tdma(config(weights={"foo": 1.0}), terms)


def test_penta_returns_the_cost_of_its_plans(rng):
    robot = muxjax.load_robot("penta")
    env = Tdma(config(robot="penta"))
    problem = muxjax.Problem(
        np.zeros(robot.n_tendons), random_target(robot, rng), servos=(2, 4), axial=3
    )
    plan = muxjax.plan(robot, problem, "greedy")
    total, _, outcomes = replayed(env, problem, actions_of(robot, plan))
    assert abs(total + plan.cost) < 1e-9
    assert outcomes[-1].solved


def states_underway(env, count=64, steps=4):
    """States after some random possible actions, with random servos and axial positions."""
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(3), count))
    step, masks = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.action_mask))
    rng = np.random.default_rng(0)
    for _ in range(steps):
        allowed = np.array(masks(states))
        actions = np.argmax(np.where(allowed, rng.random(allowed.shape), -1.0), axis=1)
        after, outcome = step(states, actions.astype(np.int32))
        states = jax.vmap(env.autoreset)(after, outcome)
    return states


def test_masks_are_what_the_planners_may_do(muxarm):
    env = Tdma(config(max_step_mm=30.0, axial="random"))
    states = states_underway(env)
    masks = np.array(jax.vmap(env.action_mask)(states))
    for k, mask in enumerate(masks):
        state = jax.tree.map(
            lambda x, k=k: np.asarray(x)[k] if x.dtype != states.key.dtype else 0, states
        )
        servos = tuple(s + 1 for s in range(3) if int(state.servos) >> s & 1)
        start, target = state.displacements.astype(float), state.target.astype(float)
        lattice = Lattice(
            muxarm,
            muxjax.Problem(start, target, servos=servos, axial=int(state.axial), max_step=0.03),
        )
        possible, moves = lattice.expand(lattice.steps[None])
        stops = lattice.actions[0]
        wanted = {
            (int(lattice.axial_of(stops[g : g + 1])[0]), moves[0, g].tobytes())
            for g in np.flatnonzero(possible[0])
        }
        found = set()
        for action in np.flatnonzero(mask):
            place, subset = divmod(int(action), 7)
            tendons = [muxarm.axial_map[place, s] for s in range(3) if subset + 1 >> s & 1]
            row = np.zeros(9, dtype=np.int64)
            row[tendons] = 1
            found.add((place + 1, row.tobytes()))
        assert found == wanted
        assert len(found) == mask.sum()


def test_a_possible_action_always_exists_and_leads_on():
    env = Tdma(config(time_limit=200))
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 128))
    step, masks = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.action_mask))
    rng, running = np.random.default_rng(1), np.ones(128, bool)
    for _ in range(9):  # every step finishes a tendon at least
        allowed = np.array(masks(states))
        assert allowed[running].any(axis=1).all()
        actions = np.argmax(np.where(allowed, rng.random(allowed.shape), -1.0), axis=1)
        states, outcome = step(states, actions.astype(np.int32))
        assert np.array(outcome.useful)[running].all()
        running &= ~np.array(outcome.terminated)
    assert not running.any()
    assert not np.array(masks(states)).any()


def test_targets_are_new_and_within_the_range(muxarm):
    env = Tdma(config(theta_rad=(0.5, 0.9)))
    states = states_underway(env, 256, 20)
    theta = muxjax.configuration_from_tendons(muxarm, np.array(states.target, float))[:, 0::2]
    assert 0.5 - 1e-3 < theta.min() < 0.52
    assert 0.88 < theta.max() < 0.9 + 1e-3
    assert len(np.unique(np.array(states.target)[:, 0])) > 250


@pytest.mark.slow
def test_difficulty_opens_the_range(muxarm):
    env = Tdma(config(theta_rad=(0.2, 1.6), difficulty={"begin": 0.25, "steps": 1000}))
    schedule = env.config.difficulty
    assert [schedule.level(n) for n in (0, 500, 1000, 5000)] == [0.25, 0.625, 1.0, 1.0]
    keys = jax.random.split(jax.random.key(0), 200)
    for level, most in ((0.25, 0.55), (1.0, 1.6)):
        states = jax.vmap(env.reset, (0, None))(keys, level)
        theta = muxjax.configuration_from_tendons(muxarm, np.array(states.target, float))[:, 0::2]
        assert most - 0.05 < theta.max() < most + 1e-3


@pytest.mark.slow
def test_starts_bent_and_axial_positions_are_drawn():
    env = Tdma(config(bent=0.5, axial="random"))
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 400))
    bent = np.array(states.displacements).any(axis=1)
    assert 0.4 < bent.mean() < 0.6
    assert set(np.array(states.axial).tolist()) == set(range(1, 10))
    assert set(np.array(states.servos).tolist()) == set(range(1, 8))
    assert not np.allclose(states.displacements[bent], np.array(states.target)[bent])


@pytest.mark.slow
def test_out_of_time_is_truncated_and_costs_the_penalty():
    env = Tdma(config(time_limit=2, unsolved_penalty=7.0, servo_sets=[(1,)]))
    state = env.reset(jax.random.key(0))
    for number in (1, 2):
        action = int(np.argmax(env.action_mask(state)))
        state, outcome = env.step(state, action)
        assert bool(outcome.truncated) == (number == 2)
        assert not outcome.terminated
        penalty = 7.0 if number == 2 else 0.0
        assert float(outcome.reward) == pytest.approx(-float(outcome.cost) - penalty)


def test_solved_in_the_last_step_is_terminated_alone(muxarm):
    env = Tdma(config(time_limit=1))
    target = np.zeros(9)
    target[2] = 0.004
    state = env.reset(jax.random.key(0), target=target, servos=7)
    place, servo = (int(i) for i in np.argwhere(muxarm.axial_map == 2)[0])
    _, outcome = env.step(state, 7 * place + (1 << servo) - 1)
    assert outcome.terminated
    assert outcome.solved
    assert not outcome.truncated
    assert float(outcome.reward) == pytest.approx(-float(outcome.cost))


def test_an_action_that_moves_nothing_still_turns_the_drum(muxarm):
    env = Tdma(config(servo_sets=[(1,)]))
    state = env.reset(jax.random.key(0))
    after, outcome = env.step(state, 1)  # servo 2 at position 1, which is not available
    assert not outcome.useful
    assert int(after.axial) == 1
    assert float(outcome.cost) == pytest.approx(0.05)
    np.testing.assert_array_equal(after.displacements, state.displacements)
    again, outcome = env.step(after, 1)
    assert float(outcome.cost) == 0.0
    nowhere, outcome = env.step(again, env.n_actions)
    assert not outcome.useful
    assert int(nowhere.axial) == 1


@pytest.mark.slow
def test_servos_are_lost_one_by_one_but_never_the_last():
    env = Tdma(config(servo_failure=1.0, servo_sets=[(1, 2, 3)], max_step_mm=2.0))
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 60))
    lost_first = set()
    for left in (2, 1, 1):
        before = np.array(states.servos)
        masks = np.array(jax.vmap(env.action_mask)(states))
        subsets = np.arange(masks.shape[1]) % 7 + 1
        assert not (masks & ((subsets & ~before[:, None]) != 0)).any()
        states, _ = jax.vmap(env.step)(states, np.argmax(masks, axis=1).astype(np.int32))
        after = np.array(states.servos)
        assert [bin(s).count("1") for s in after] == [left] * 60
        assert ((after & ~before) == 0).all()
        lost_first |= set((before & ~after).tolist()) if left == 2 else set()
    assert lost_first == {1, 2, 4}


def among_obstacles(env):
    """Steps in the cabinet: states before, actions, states after, outcomes; a row an episode."""
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 32))
    step, rng = jax.jit(jax.vmap(env.step)), np.random.default_rng(0)
    for _ in range(3):
        masks = np.array(jax.vmap(env.action_mask)(states))
        actions = np.argmax(np.where(masks, rng.random(masks.shape), -1.0), axis=1)
        after, outcome = step(states, actions.astype(np.int32))
        yield states, actions, after, outcome
        states = jax.vmap(env.autoreset)(after, outcome)


@pytest.mark.slow
def test_a_step_through_a_collision_ends_the_episode():
    env, seen = Tdma(load_env_config("cabinet")), []
    for states, _, after, outcome in among_obstacles(env):
        forbidden = np.array(outcome.forbidden)
        assert (forbidden <= np.array(outcome.terminated)).all()
        assert (np.array(outcome.reward)[forbidden] == -env.config.unsolved_penalty).all()
        assert (np.array(outcome.cost)[~forbidden] > 0).all()
        np.testing.assert_array_equal(
            np.array(after.displacements)[forbidden], np.array(states.displacements)[forbidden]
        )
        seen.extend(forbidden.tolist())
    assert 0 < sum(seen) < len(seen)


@pytest.mark.slow
def test_forbidden_are_the_steps_that_the_planners_forbid():
    env = Tdma(load_env_config("cabinet"))
    for states, actions, _, outcome in among_obstacles(env):
        for k, forbidden in enumerate(np.array(outcome.forbidden)):
            price = planners_price(env, states, k, actions[k], env.problem)
            assert (price == np.inf) == forbidden


def planners_price(env, states, k, action, problem) -> float:
    """What the planners' lattice says about one step, obstacles included."""
    start = np.array(states.displacements[k], float)
    target = np.array(states.target[k], float)
    lattice = Lattice(env.robot, replace(problem, start=start, target=target))
    place, subset = divmod(int(action), 7)
    moves = np.zeros((1, 9), dtype=np.int64)
    moves[0, [env.robot.axial_map[place, s] for s in range(3) if subset + 1 >> s & 1]] = 1
    moves = np.minimum(moves, lattice.steps)
    both = [lattice.costs(lattice.steps[None], moves, expensive=e) for e in (False, True)]
    return float((both[0] + both[1])[0, 1])


@pytest.mark.slow
def test_targets_among_obstacles_are_clear():
    env = Tdma(load_env_config("cabinet"))
    from muxjax.planning.world import clearance_of

    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 32))
    for ends in (states.target, states.displacements):
        assert all(clearance_of(env.robot, np.array(at), env.problem.world) > -1e-5 for at in ends)


def test_continuous_actions_reach_the_target_where_they_aim_near(muxarm):
    env = Tdma(config(actions="continuous", servo_sets=[(1, 2, 3)], snap_mm=5.0))
    state, solved = env.reset(jax.random.key(0)), False
    scale = np.abs(muxjax.tendons.displacement_range(muxarm)).max(axis=1)
    step = jax.jit(env.step)
    for place in (0, 1, 2):  # the three layers
        residual = np.array(state.target - state.displacements)
        aim = (residual + 0.003) / scale
        action = np.full(12, -1.0, np.float32)
        action[place], action[9:] = 0.5, aim[muxarm.axial_map[place]]
        state, outcome = step(state, action)
        solved = bool(outcome.solved)
    assert solved
    np.testing.assert_allclose(state.displacements, state.target, atol=1e-7)


def test_continuous_actions_keep_to_limits(muxarm):
    env = Tdma(config(actions="continuous", servo_sets=[(2,)], snap_mm=0.0))
    state = env.reset(jax.random.key(0))
    action = np.zeros(12, np.float32)
    action[3], action[9:] = 1.0, 1.0
    for _ in range(2):
        state, outcome = env.step(state, action)
    _, high = muxjax.tendons.displacement_range(muxarm).T
    moved = np.flatnonzero(np.array(state.displacements))
    assert moved.tolist() == [muxarm.axial_map[3, 1]]
    np.testing.assert_allclose(state.displacements[moved], high[moved], rtol=1e-5)
    still, outcome = env.step(state, action * np.nan)
    assert not outcome.useful
    np.testing.assert_array_equal(still.displacements, state.displacements)


@pytest.mark.slow
def test_observations_keep_to_their_parts():
    env = Tdma(config(lookahead=True, axial="random", bent=0.5))
    states = states_underway(env)
    seen = np.array(jax.vmap(env.observe)(states))
    assert seen.dtype == np.float32
    assert seen.shape == (64, env.n_observed)
    at = 0
    named = {}
    for part in env.parts:
        named[part.name] = seen[:, at : at + part.size]
        assert (named[part.name] >= part.low).all()
        assert (named[part.name] <= part.high).all()
        at += part.size
    assert at == env.n_observed
    radius = float(env.robot.tendon_radius)
    residual = np.array(states.target - states.displacements)
    np.testing.assert_allclose(
        named["residual"], np.clip(residual / radius, -OBSERVED, OBSERVED), rtol=1e-5, atol=1e-6
    )
    assert (named["axial"].sum(axis=1) == (np.array(states.axial) > 0)).all()
    theta = muxjax.configuration_from_tendons(env.robot, np.array(states.displacements, float))
    beyond = theta[:, 0::2] - np.linalg.norm(states.goal, axis=-1)
    np.testing.assert_allclose(named["bent_beyond_goal"], beyond, atol=2e-4)
    assert (named["prices"] > 0).any(axis=1).all()


@pytest.mark.slow
def test_lookahead_is_the_price_of_each_tendon_alone(muxarm):
    env = Tdma(config(lookahead=True))
    state = env.reset(jax.random.key(5), axial=1, servos=7)
    prices = np.array(env.observe(state))[-9:]
    for action, tendon in ((0, muxarm.axial_map[0, 0]), (3, muxarm.axial_map[0, 2])):
        _, outcome = env.step(state, action)
        assert float(outcome.cost) == pytest.approx(float(prices[tendon]), rel=1e-5)


def test_the_start_may_be_given():
    env = Tdma(config(start_mm=[1.0] * 9))
    np.testing.assert_allclose(env.reset(jax.random.key(0)).displacements, 1e-3, rtol=1e-6)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"servo_sets": [(4,)]}, "servos 1 to 3"),
        ({"axial": 10}, "positions 1 to 9"),
        ({"weights": {"clearance": 1.0}}, "needs a world"),
        ({"weights": {"comfort": 1.0}}, "no term 'comfort'"),
        ({"preset": "cheap"}, "no 'cheap'"),
        ({"robot": "sexarm"}, "no 'sexarm'"),
        ({"start_mm": [0.0] * 8}, "9 entries"),
        ({"start_mm": [500.0] + [0.0] * 8}, "tendon 1 is at 500 mm"),
        ({"world": "attic"}, "no 'attic'"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(fields, message):
    with pytest.raises(ConfigError, match=message):
        Tdma(config(**fields))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robots: muxarm", "robots: Extra inputs are not permitted"),
        ("time_limit: 0", "time_limit"),
        ("servo_failure: 1.5", "servo_failure"),
        ("actions: both", "actions"),
        ("theta_rad: [1.0, 0.5]", "theta_rad: must not fall"),
        ("max_step_mm: 0.005", "max_step_mm: must be above tolerance_mm"),
        ("servo_sets: [[1, 1]]", "servo_sets: must be non-empty sets"),
        ("difficulty: {begin: 2.0, steps: 10}", "difficulty.begin"),
    ],
)
def test_a_file_with_a_wrong_field_names_it(text, message, tmp_path):
    path = tmp_path / "env.yaml"
    path.write_text(f"schema: muxjax/env/1\n{text}\n")
    with pytest.raises(ConfigError, match=message):
        load_env_config(str(path))


@pytest.mark.parametrize("action", [1.0, np.array([1, 2]), True])
def test_a_discrete_action_of_another_kind_is_refused(action):
    env = Tdma(config())
    with pytest.raises(ValueError, match="action: must be a whole number, found"):
        env.step(env.reset(jax.random.key(0)), action)


def test_a_continuous_action_of_another_kind_is_refused():
    env = Tdma(config(actions="continuous"))
    for action in (np.zeros(11), np.zeros(12, int), 3):
        with pytest.raises(ValueError, match=r"action: must be a float array of shape \(12,\)"):
            env.step(env.reset(jax.random.key(0)), action)


def test_every_shipped_environment_is_valid():
    folder = muxjax.config.data_folder("configs") / "envs"
    names = [path.stem for path in folder.glob("*.yaml")]
    assert {"muxarm", "muxarm_one_servo", "muxarm_continuous"} <= set(names)
    for name in names:
        loaded = load_env_config(name)
        assert isinstance(loaded.difficulty, Difficulty | None)
