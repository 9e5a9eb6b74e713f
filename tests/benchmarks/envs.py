"""Steps a second of the environment: in a scan, through the vector adapter, and in training.

    python -m tests.benchmarks.envs [scan|vector|ppo ...]

Environment "muxarm" (any servos, full moves, preset "paper"). Random possible actions, new episodes
with new targets within the same step, observations included. CPU seconds are of all threads.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

from envs.config import load_env_config
from envs.tdma import Tdma
from tests.benchmarks.common import machine, table

LANES, STEPS = 4096, 100
VECTOR_LANES, VECTOR_STEPS = 512, 200
FRAMES = 200_000
REPEATS = 5


def main() -> None:
    """Measure and print a table."""
    parts = sys.argv[1:] or ["scan", "vector", "ppo"]
    print(f"{machine()}; best of {REPEATS}\n")
    known: dict[str, Callable[[], list[list[str]]]] = {"scan": scan, "vector": vector, "ppo": ppo}
    rows = [row for part in parts for row in known[part]()]
    print(table(["what", "lanes", "CPU [us/step]", "wall [us/step]", "steps/s"], rows))


def row(what: str, lanes: int, steps: int, call: Callable[[], Any], repeats: int) -> list[str]:
    """Best of some calls after one that warms up."""
    call()
    cpu, wall = np.inf, np.inf
    for _ in range(repeats):
        before, began = time.process_time(), time.perf_counter()
        call()
        cpu = min(cpu, time.process_time() - before)
        wall = min(wall, time.perf_counter() - began)
    micro = 1e6 / steps
    return [what, str(lanes), f"{micro * cpu:.2f}", f"{micro * wall:.2f}", f"{steps / wall:,.0f}"]


def possible(mask: Any, chance: Any) -> Any:
    """One of the possible actions, each as likely."""
    count = jnp.cumsum(mask.astype(jnp.int32))
    return jnp.argmax(count > chance * count[-1]).astype(jnp.int32)


def random_steps(env: Tdma, steps: int) -> Callable[[Any], Any]:
    """A compiled scan of random steps: from (states, key) on, sums of rewards and observations."""

    def advance(carry: Any, _: None) -> Any:
        states, key = carry
        key, sub = jax.random.split(key)
        masks = jax.vmap(env.action_mask)(states)
        actions = jax.vmap(possible)(masks, jax.random.uniform(sub, states.steps.shape))
        after, outcome = jax.vmap(env.step)(states, actions)
        states = jax.vmap(env.autoreset)(after, outcome)
        seen = jax.vmap(env.observe)(states)
        return (states, key), (outcome.reward.sum(), seen.sum())

    return jax.jit(lambda carry: jax.lax.scan(advance, carry, None, length=steps))


def scan() -> list[list[str]]:
    """A compiled scan."""
    env = Tdma(load_env_config("muxarm"))
    run = random_steps(env, STEPS)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), LANES))
    start = (states, jax.random.key(1))
    call = lambda: jax.block_until_ready(run(start))  # noqa: E731
    halves = [jax.tree.map(lambda x, k=k: x[k::2], states) for k in range(2)]
    starts = [(half, jax.random.key(k)) for k, half in enumerate(halves)]

    def both() -> None:
        with ThreadPoolExecutor(2) as threads:
            list(threads.map(lambda start: jax.block_until_ready(run(start)), starts))

    return [
        row("scan, one thread", LANES, LANES * STEPS, call, REPEATS),
        row("scan, two threads", LANES, LANES * STEPS, both, REPEATS),
    ]


def vector() -> list[list[str]]:
    """The VecEnv of Stable-Baselines3; actions are drawn before, so some move nothing."""
    from envs.sb3_adapter import TdmaVecEnv

    env = TdmaVecEnv("muxarm", VECTOR_LANES, seed=0)
    env.reset()
    drawn = np.random.default_rng(0).integers(0, 63, (VECTOR_STEPS, VECTOR_LANES))

    def call() -> None:
        for actions in drawn:
            env.step(actions)

    return [row("SB3 VecEnv", VECTOR_LANES, drawn.size, call, REPEATS)]


def ppo() -> list[list[str]]:
    """MaskablePPO with the settings of ``configs/training/rl_muxarm.yaml``, one thread."""
    from sb3_contrib import MaskablePPO

    from envs.sb3_adapter import TdmaVecEnv
    from muxjax.config import load_yaml, resolve
    from training.config import RlConfig

    config = load_yaml(RlConfig, resolve("rl_muxarm", "training"))
    torch.set_num_threads(config.threads)
    model = MaskablePPO(
        "MlpPolicy",
        TdmaVecEnv(config.environment, config.lanes, seed=0),
        learning_rate=config.learning_rate,
        n_steps=config.rollout,
        batch_size=config.batch,
        n_epochs=config.epochs,
        policy_kwargs={"net_arch": list(config.hidden), "activation_fn": torch.nn.ReLU},
        device="cpu",
    )
    rollout = config.lanes * config.rollout
    frames = -(-FRAMES // rollout) * rollout
    return [row("MaskablePPO", config.lanes, frames, lambda: model.learn(frames), 1)]


if __name__ == "__main__":
    main()
