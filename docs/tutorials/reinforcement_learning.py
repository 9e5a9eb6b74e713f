"""The planning problem as an environment. Shown by docs/tutorials/reinforcement_learning.md.

Run it from the repository's root; it needs the extra [train] and takes about half a minute.
"""

# %% [markdown]
# # Reinforcement learning
# An episode is a plan, its return minus the plan's cost.

# %% --8<-- [start:episode]
from pathlib import Path

import gymnasium
import numpy as np

import envs.gymnasium_adapter  # noqa: F401  registers the environments
import muxjax
from muxjax.config import load_yaml
from training.config import RlConfig
from training.train_rl import fit

config = "docs/tutorials/my_env.yaml"
env = gymnasium.make("muxjax/TDMA-v0", config=config)
observation, info = env.reset(seed=0)
print(f"{len(observation)} observed values, {env.action_space.n} actions")
rng = np.random.default_rng(0)
total, done = 0.0, False
while not done:  # any possible action moves towards the target
    action = rng.choice(np.flatnonzero(env.unwrapped.action_masks()))
    observation, reward, done, truncated, info = env.step(action)
    total += reward
print(f"random actions: return {total:.3f}, solved: {info['is_success']}")
# --8<-- [end:episode]

# %% --8<-- [start:train]
policy = fit(load_yaml(RlConfig, Path("docs/tutorials/tiny_rl.yaml")), Path("out/tiny_rl"))
# --8<-- [end:train]

# %% --8<-- [start:plan]
robot = muxjax.load_robot("docs/tutorials/my_arm.yaml")
target = muxjax.tendon_displacements(robot, np.radians([50, 30, 40, 200]))
problem = muxjax.Problem(np.zeros(robot.n_tendons), target, servos=(1,))
best = muxjax.plan(robot, problem)
plan = policy.plan(robot, problem)  # a plan like any other: schedule and execute it
print(f"policy: cost {plan.cost:.3f}, {100 * (plan.cost / best.cost - 1):.1f} % over the optimum")
# --8<-- [end:plan]
