"""Train a policy by PPO: with masks where actions are discrete.

    python -m training.train_rl --config configs/training/rl_one_servo.yaml --out out/rl

The output folder holds the configuration, the state after every evaluation (``last.zip``, from
which the same command goes on), the best policy (``best.zip``: most problems solved, then least
median gap), kept checkpoints, the learning curve and TensorBoard's files. The gap of an evaluation
is over the certified optimum of fixed problems. A training that was interrupted goes on with new
episodes, so it is repeatable to the last bit only when it runs through.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from envs.config import TdmaConfig, load_env_config
from envs.gymnasium_adapter import made
from envs.sb3_adapter import TdmaVecEnv
from envs.tdma import Tdma
from muxjax.config import load_yaml, replacing
from muxjax.planning import Problem, plan
from training.config import RlConfig, keep_config
from training.policy import Policy, check_fits, evaluation_problems, load_model, rollouts


@dataclass
class Options:
    """What the command line may change.

    Attributes:
        config: The YAML file of the training.
        out: Folder for everything.
        seed: Another seed than the file's.
        total_steps: Another number of steps than the file's; a finished training goes on.
    """

    config: Path = Path("configs/training/rl_one_servo.yaml")
    out: Path = Path("out/rl")
    seed: int | None = None
    total_steps: int | None = None


def main(options: Options) -> None:
    """Train as the file and the options say."""
    given = {"seed": options.seed, "total_steps": options.total_steps}
    config = load_yaml(RlConfig, options.config)
    fit(
        config.model_copy(update={k: v for k, v in given.items() if v is not None}),
        options.out,
    )


def fit(config: RlConfig, out: Path) -> Policy:
    """Train, or go on with a training in the folder.

    Raises:
        ConfigError: The folder holds a training of another configuration.
    """
    environment = load_env_config(config.environment)
    env = TdmaVecEnv(environment, config.lanes)
    out.mkdir(parents=True, exist_ok=True)
    keep_config(config, out, more=environment, free=("total_steps",))
    torch.set_num_threads(config.threads)
    model = _model(config, env, out)
    evaluation = Evaluation(config, environment, out)
    left = config.total_steps - model.num_timesteps
    if left > 0:
        name = type(model).__name__
        model.learn(left, evaluation, tb_log_name=name, reset_num_timesteps=False)
        evaluation.evaluate()
    return Policy(model, environment)


def _model(config: RlConfig, env: TdmaVecEnv, out: Path) -> Any:
    """A new model, or the one in the folder with its optimiser's state."""
    last, actions = out / "last.zip", env.lanes.env.config.actions
    if last.is_file():
        model = load_model(last, env.lanes.env.config)
        check_fits(model, env.lanes.env, str(last))
        model.set_env(env)
        model.set_random_seed(config.seed + model.num_timesteps)
        model.tensorboard_log = str(out / "tensorboard")
        return model
    kind = MaskablePPO if actions == "discrete" else PPO
    network: dict[str, Any] = {"net_arch": list(config.hidden), "activation_fn": torch.nn.ReLU}
    if actions == "continuous":
        network["log_std_init"] = math.log(config.initial_std)
    return kind(
        "MlpPolicy",
        env,
        learning_rate=LinearSchedule(config.learning_rate, 0.0, 1.0),
        n_steps=config.rollout,
        batch_size=config.batch,
        n_epochs=config.epochs,
        gamma=config.discount,
        gae_lambda=config.gae,
        clip_range=config.clip,
        ent_coef=config.entropy,
        policy_kwargs=network,
        tensorboard_log=str(out / "tensorboard"),
        seed=config.seed,
        device="cpu",
    )


class Evaluation(BaseCallback):
    """Between rollouts: the gap to the optimum on fixed problems, and the state is kept.

    Attributes:
        curve: Scores so far, also in ``curve.json``.
    """

    def __init__(self, config: RlConfig, environment: TdmaConfig, out: Path) -> None:
        super().__init__()
        self.config, self.out = config, out
        fixed = environment.model_copy(update={"servo_failure": 0.0, "difficulty": None})
        self.core = made(fixed)
        self.problems = evaluation_problems(self.core, config.evaluation_problems)
        self.optimum = _optima(self.core, self.problems, out / "optimum.json")
        self.curve: list[dict[str, float]] = []
        self._began = time.monotonic()

    def _on_training_start(self) -> None:
        env: Any = self.training_env
        env.lanes.total_steps = self.num_timesteps
        path = self.out / "curve.json"
        if path.is_file():
            known = json.loads(path.read_text())
            self.curve = [line for line in known if line["steps"] <= self.num_timesteps]

    def _on_rollout_start(self) -> None:
        done = self.curve[-1]["steps"] if self.curve else -self.config.evaluate_every
        if self.model.num_timesteps - done >= self.config.evaluate_every:
            self.evaluate()

    def _on_step(self) -> bool:
        return True

    def evaluate(self) -> dict[str, float]:
        """Score the policy, and keep it."""
        steps = self.model.num_timesteps
        found = rollouts(Policy(self.model, self.core.config), self.core, self.problems)
        gap = found.cost[found.solved] / self.optimum[found.solved] - 1.0
        quartiles = np.quantile(gap, (0.5, 0.25, 0.75)) if len(gap) else np.full(3, np.inf)
        line = {
            "steps": steps,
            "solved": float(found.solved.mean()),
            "median_gap": float(quartiles[0]),
            "lower_quartile": float(quartiles[1]),
            "upper_quartile": float(quartiles[2]),
            "seconds": time.monotonic() - self._began,
        }
        best = max((_score(known) for known in self.curve), default=(-1.0, 0.0))
        self.curve.append(line)
        for name in ("solved", "median_gap"):
            self.logger.record(f"evaluation/{name}", line[name])
        if _score(line) > best:
            self._keep("best")
        if steps // self.config.keep_every > self._kept_before // self.config.keep_every:
            self._keep(f"steps_{steps}")
        (self.out / "curve.json").write_text(json.dumps(self.curve, indent=0))
        self._keep("last")
        print(
            f"{steps} steps: solved {line['solved']:.4f}, median gap {line['median_gap']:.4f}, "
            f"{line['seconds']:.0f} s",
            flush=True,
        )
        return line

    @property
    def _kept_before(self) -> int:
        """Steps at the evaluation before this one."""
        return int(self.curve[-2]["steps"]) if len(self.curve) > 1 else 0

    def _keep(self, name: str) -> None:
        with replacing(self.out / f"{name}.zip") as part:
            self.model.save(part)


def _score(line: dict[str, float]) -> tuple[float, float]:
    return line["solved"], -line["median_gap"]


def _optima(env: Tdma, problems: list[Problem], path: Path) -> np.ndarray:
    """Certified costs of the problems; a beam's where the exact planner has no room."""
    if path.is_file() and len(known := json.loads(path.read_text())) == len(problems):
        return np.array(known)
    costs = [plan(env.robot, problem, "exact", fallback=True).cost for problem in problems]
    path.write_text(json.dumps(costs))
    return np.array(costs)


if __name__ == "__main__":
    main(tyro.cli(Options))
