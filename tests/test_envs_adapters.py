"""Gymnasium's and Stable-Baselines3's environments, training, and policies as plans."""

from __future__ import annotations

import json
import pickle

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.env_checker import check_env as check_sb3

import muxjax
from envs.config import TdmaConfig, load_env_config
from envs.gymnasium_adapter import CONTINUOUS, DISCRETE, TdmaEnv, TdmaVectorEnv
from envs.sb3_adapter import TdmaVecEnv
from envs.tdma import Tdma
from muxjax.config import ConfigError
from muxjax.hardware.links import LockstepLink
from muxjax.planning.checkpoint import CheckpointError
from tests.test_envs import actions_of, random_target
from training.config import RlConfig
from training.policy import Policy, evaluation_problems, load_policy
from training.train_rl import fit

ONE_SERVO = TdmaConfig(schema="muxjax/env/1", servo_sets=((1,),), time_limit=3)


def possible(masks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.argmax(np.where(masks, rng.random(masks.shape), -1.0), axis=-1)


@pytest.mark.parametrize("name", [DISCRETE, CONTINUOUS])
def test_both_environments_pass_the_checkers(name):
    env = gymnasium.make(name, render_mode="rgb_array").unwrapped
    check_env(env)
    check_sb3(env)


def test_return_is_minus_the_cost_in_gymnasium_too(muxarm, rng):
    problem = muxjax.Problem(np.zeros(9), random_target(muxarm, rng), servos=(1, 3), axial=2)
    plan = muxjax.plan(muxarm, problem)
    env = gymnasium.make(DISCRETE)
    options = {"target": problem.target, "start": problem.start, "servos": (1, 3), "axial": 2}
    _, info = env.reset(seed=0, options=options)
    np.testing.assert_array_equal(info["target"], problem.target)
    assert (info["axial"], info["servos"]) == (2, (1, 3))
    steps = [env.step(action) for action in actions_of(muxarm, plan)]
    assert abs(sum(reward for _, reward, *_ in steps) + plan.cost) < 1e-9
    assert [terminated for _, _, terminated, *_ in steps][-2:] == [False, True]
    assert steps[-1][-1]["is_success"]
    assert isinstance(steps[-1][-1]["is_success"], bool)
    with pytest.raises(ResetNeeded, match="has ended"):
        env.step(0)


def test_seeds_repeat_episodes():
    env, other = TdmaEnv(), TdmaEnv()
    first, _ = env.reset(seed=4)
    second, _ = env.reset()
    np.testing.assert_array_equal(other.reset(seed=4)[0], first)
    np.testing.assert_array_equal(other.reset()[0], second)
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("action", [-1, 63, 1.0, [1, 2], np.nan])
def test_wrong_actions_are_refused(action):
    env = TdmaEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action: must be"):
        env.step(action)
    vector = TdmaVectorEnv(2)
    vector.reset(seed=0)
    with pytest.raises(ValueError, match="action: must be"):
        vector.step([0, action] if np.ndim(action) == 0 else [*action, 3])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal": np.zeros(9)}, "must be of target, start"),
        ({"target": np.zeros(8)}, r"options\['target'\]: last axis must have 9 entries"),
        ({"target": np.full(9, 0.5)}, r"options\['target'\]: tendon 1 is at 500 mm"),
        ({"target": np.zeros(9)}, r"options\['target'\]: is the start"),
        ({"axial": 10}, "must be 1 to 9, found 10"),
        ({"servos": (4,)}, "must be a non-empty set"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        TdmaEnv().reset(options=options)


def test_reset_comes_first():
    for ask in (lambda env: env.step(0), lambda env: env.action_masks()):
        with pytest.raises(ResetNeeded, match="reset comes first"):
            ask(TdmaEnv())
    with pytest.raises(ValueError, match="render_mode"):
        TdmaEnv(render_mode="ansi")
    with pytest.raises(ValueError, match="continuous actions have none"):
        TdmaEnv("muxarm_continuous").action_masks()


def test_a_window_shows_the_arm(monkeypatch):
    monkeypatch.setattr("envs.gymnasium_adapter.time.sleep", lambda seconds: None)
    import matplotlib.pyplot as plt

    plt.switch_backend("agg")
    env = TdmaEnv(render_mode="human")
    env.reset(seed=0)
    assert "muxjax/TDMA" in plt.get_figlabels()
    env.close()
    assert "muxjax/TDMA" not in plt.get_figlabels()


@pytest.mark.slow
def test_pickled_environments_go_on_alike():
    single, vector = TdmaEnv(ONE_SERVO), TdmaVectorEnv(3, ONE_SERVO)
    stable = TdmaVecEnv(ONE_SERVO, 3, seed=1)
    single.reset(seed=1), vector.reset(seed=1), stable.reset()
    for env, actions in ((single, 0), (vector, np.zeros(3, int)), (stable, np.zeros(3, int))):
        copy = pickle.loads(pickle.dumps(env))
        for _ in range(4 if env is not single else 2):
            mine, its = env.step(actions), copy.step(actions)
            np.testing.assert_array_equal(mine[0], its[0])
            np.testing.assert_array_equal(mine[1], its[1])


def test_vector_environment_resets_in_the_same_step(rng):
    env = gymnasium.make_vec(DISCRETE, num_envs=16, config=ONE_SERVO)
    assert isinstance(env, TdmaVectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    observation, _ = env.reset(seed=3)
    again, _ = TdmaVectorEnv(16, ONE_SERVO).reset(seed=list(range(3, 19)))
    np.testing.assert_array_equal(observation, again)
    for number in range(1, 4):
        observation, reward, terminated, truncated, infos = env.step(
            possible(env.action_masks(), rng)
        )
        assert env.observation_space.contains(observation)
        assert not terminated.any()
        assert truncated.all() == (number == 3)
        assert ("final_obs" in infos) == (number == 3)
    np.testing.assert_allclose(reward, -infos["cost"] - 5.0, rtol=1e-6)
    final = np.stack(infos["final_obs"])
    assert infos["_final_obs"].all()
    assert not infos["final_info"]["is_success"].any()
    assert (final[:, -1] == 0.0).all()  # no time left at the end, all of it in the new episode
    assert (observation[:, -1] == 1.0).all()
    assert not np.array_equal(final[:, :9], observation[:, :9])


@pytest.mark.slow
def test_lanes_agree_with_single_episodes(muxarm, rng):
    targets = np.stack([random_target(muxarm, rng) for _ in range(4)])
    vector = TdmaVectorEnv(4)
    vector.reset(seed=0, options={"target": targets, "servos": (1, 2)})
    total = np.zeros(4)
    for _ in range(3):
        actions = possible(vector.action_masks(), np.random.default_rng(0))
        total += vector.step(actions)[1]
    singles = []
    for target in targets:
        env = TdmaEnv()
        env.reset(seed=0, options={"target": target, "servos": (1, 2)})
        singles.append(0.0)
        lane = len(singles) - 1
        for _ in range(3):
            masks = np.zeros((4, 63), bool)
            masks[lane] = env.action_masks()
            singles[-1] += env.step(int(possible(masks, np.random.default_rng(0))[lane]))[1]
    np.testing.assert_allclose(total, singles, rtol=1e-4)


@pytest.mark.slow
def test_stable_baselines_environment_reports_ends(rng):
    env = TdmaVecEnv(ONE_SERVO, 8, seed=0)
    env.reset()
    assert is_masking_supported(env)
    total = np.zeros(8)
    for _ in range(3):
        masks = get_action_masks(env)
        assert masks.shape == (8, 63)
        observation, reward, done, infos = env.step(possible(masks, rng))
        total += reward
    assert done.all()
    for k, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert not info["is_success"]
        assert info["terminal_observation"][-1] == 0.0
        assert observation[k, -1] == 1.0
        assert info["episode"]["l"] == 3
        assert info["episode"]["r"] == pytest.approx(total[k], rel=1e-5)


def test_stable_baselines_environment_tells_solved_from_truncated(muxarm, rng):
    env = TdmaVecEnv("muxarm", 3, seed=0)
    target = random_target(muxarm, rng)
    env.set_options([{"target": target, "servos": (1, 2, 3)}] * 3)
    env.reset()
    plan = muxjax.plan(muxarm, muxjax.Problem(np.zeros(9), target))
    for action in actions_of(muxarm, plan):
        _, _, done, infos = env.step(np.full(3, action))
    assert done.all()
    assert not any(info["TimeLimit.truncated"] for info in infos)
    assert all(info["is_success"] for info in infos)
    assert infos[0]["episode"]["r"] == pytest.approx(-plan.cost, rel=1e-5)
    assert not is_masking_supported(TdmaVecEnv("muxarm_continuous", 2))


def rl_config(environment: str, **fields) -> RlConfig:
    small = {"lanes": 16, "rollout": 8, "batch": 64, "epochs": 1, "hidden": (16,)}
    return RlConfig(
        schema="muxjax/rl/1",
        environment=environment,
        **{**small, "evaluate_every": 128, "evaluation_problems": 4, "keep_every": 128, **fields},
    )


@pytest.fixture
def one_thread():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_training_goes_on_and_its_policy_plans(tmp_path, muxarm, rng):
    config = rl_config("muxarm_one_servo", total_steps=128)
    fit(config, tmp_path)
    fit(config.model_copy(update={"total_steps": 384}), tmp_path)
    curve = json.loads((tmp_path / "curve.json").read_text())
    assert [line["steps"] for line in curve] == [0, 128, 256, 384]
    assert all(line["solved"] == 1.0 and line["median_gap"] >= -1e-5 for line in curve)
    assert list(tmp_path.glob("tensorboard/*/events*"))
    with pytest.raises(ConfigError, match=r"another configuration \(seed\)"):
        fit(config.model_copy(update={"seed": 1}), tmp_path)
    policy = load_policy(tmp_path, "steps_256")
    problem = muxjax.Problem(np.zeros(9), random_target(muxarm, rng), servos=(1,))
    plan = policy.plan(muxarm, problem)
    best = muxjax.plan(muxarm, problem)
    assert (plan.status, plan.method) == ("feasible", "policy")
    assert best.cost - 1e-9 <= plan.cost <= 1.5 * best.cost
    run = muxjax.execute(muxjax.schedule(muxarm, plan), LockstepLink(muxarm))
    assert run.completed


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_continuous_training_runs_and_its_policy_fits_no_other_actions(tmp_path, muxarm, rng):
    fit(rl_config("muxarm_continuous", total_steps=128), tmp_path)
    policy = load_policy(tmp_path, "last")
    problem = muxjax.Problem(np.zeros(9), random_target(muxarm, rng))
    assert policy.plan(muxarm, problem).reason == "the time limit came first"
    with pytest.raises(CheckpointError, match=r"action space is Box\(12,\).*Discrete\(63\)"):
        Policy(policy.model, load_env_config("muxarm")).plan(muxarm, problem)
    document = json.loads((tmp_path / "config.json").read_text())
    document["environment"]["actions"] = "discrete"
    (tmp_path / "config.json").write_text(json.dumps(document))
    with pytest.raises(CheckpointError):
        load_policy(tmp_path, "last")
    (tmp_path / "best.zip").write_bytes(b"no model")
    with pytest.raises(CheckpointError, match="is no MaskablePPO"):
        load_policy(tmp_path)
    with pytest.raises(CheckpointError, match="is no training"):
        load_policy(tmp_path / "nowhere")


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", ["one_servo", "muxarm"])
def test_shipped_policies_are_near_the_optimum(name, muxarm):
    policy = load_policy(muxjax.config.data_folder("checkpoints") / "policies" / name)
    problems = evaluation_problems(Tdma(policy.config, robot=muxarm), 12, seed=3)
    plans = [policy.plan(muxarm, problem) for problem in problems]
    best = [muxjax.plan(muxarm, problem).cost for problem in problems]
    gaps = [plan.cost / cost - 1.0 for plan, cost in zip(plans, best, strict=True)]
    assert min(gaps) >= -1e-9
    assert np.median(gaps) <= 0.02
