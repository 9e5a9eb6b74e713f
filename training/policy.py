"""A trained policy as a planner: its episode is a Plan like any other.

    python -m training.policy --folders out/rl/one_servo_0 out/rl/one_servo_1 --problems 5000

prints how many of so many new problems of its environment each policy solves.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Bool, Float
from pydantic import ValidationError
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO

from envs.config import TdmaConfig
from envs.gymnasium_adapter import TdmaEnv, action_space, made, observation_space
from envs.lanes import Lanes
from envs.tdma import Tdma, servo_bits
from muxjax.config import explain
from muxjax.planning.checkpoint import CheckpointError
from muxjax.planning.lattice import Lattice
from muxjax.planning.problem import Plan, Problem, check_problem
from muxjax.planning.replay import Step, failed, replay
from muxjax.robot import Robot
from training.problems import Regime, random_problem

METHOD = "policy"
EVALUATION_SEED = 1_000_003  # of the fixed problems, whatever a training's seed
SIGNED = "signed"  # the action set of continuous actions, of which no bound is known but zero
_OF_A_WORLD = ("collision", "clearance")  # terms that the network does not see


class Rollouts(NamedTuple):
    """Episodes on given problems."""

    cost: Float[np.ndarray, " N"]  # undiscounted, without any penalty
    solved: Bool[np.ndarray, " N"]


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained network, and the environment that it knows.

    Attributes:
        model: MaskablePPO or PPO, or anything with their ``predict``.
        config: The environment.
    """

    model: Any
    config: TdmaConfig
    _envs: dict[tuple[Any, ...], TdmaEnv] = field(default_factory=dict)

    def actions(self, observations: np.ndarray, masks: np.ndarray | None) -> np.ndarray:
        """The most likely actions."""
        given = {} if masks is None else {"action_masks": masks}
        return np.asarray(self.model.predict(observations, deterministic=True, **given)[0])

    def plan(self, robot: Robot, problem: Problem) -> Plan:
        """The plan that the policy's steps are, priced as every planner's.

        Raises:
            ValueError: A problem that does not fit the robot, or of another action set.
            CheckpointError: A policy of another robot's spaces.
        """
        if problem.action_set != "subsets":
            raise ValueError(f"{METHOD}: plans action set 'subsets', not {problem.action_set!r}")
        check_problem(robot, problem)
        lattice = Lattice(robot, problem)
        if not lattice.steps.any():
            return replay(lattice, [], method=METHOD)
        env = self._env_of(robot, problem)
        check_fits(self.model, env.core)
        options = {"start": problem.start, "target": problem.target, "servos": problem.servos}
        observation, info = env.reset(seed=0, options={**options, "axial": problem.axial})
        discrete = self.config.actions == "discrete"
        steps, path, axial, cost, ended = [], [info["displacements"]], [], 0.0, False
        while not ended:
            masks = env.action_masks() if discrete else None
            action = self.actions(observation, masks)
            observation, _, terminated, truncated, info = env.step(action)
            moves = (info["displacements"] != path[-1]).astype(np.int64)
            steps.append(Step(int(lattice.stop_of_axial[info["axial"] - 1]), moves))
            path.append(info["displacements"])
            axial.append(info["axial"])
            cost += info["cost"]
            ended = terminated or truncated
        if not info["is_success"]:
            reason = "a step is forbidden" if info["forbidden"] else "the time limit came first"
            return failed(lattice, method=METHOD, reason=reason, expansions=len(steps))
        if discrete:
            return replay(lattice, steps, method=METHOD, expansions=len(steps))
        if problem.world is not None:
            raise ValueError(f"{METHOD}: continuous actions have no plan among obstacles")
        return Plan(
            displacements=np.array(path),
            axial=np.array(axial, dtype=np.int64),
            cost=cost,
            lower_bound=0.0,
            expansions=len(steps),
            problem=problem,
            fingerprint=robot.fingerprint,
            method=METHOD,
            status="feasible",
            action_set=SIGNED,
        )

    def _env_of(self, robot: Robot, problem: Problem) -> TdmaEnv:
        """The policy's environment with the problem's limits and objective."""
        weights = {k: v for k, v in problem.cost_weights.items() if k not in _OF_A_WORLD}
        config = self.config.model_copy(
            update={
                "weights": weights or {"travel": 0.0},
                "max_step_mm": None if problem.max_step is None else 1e3 * problem.max_step,
                "tolerance_mm": 1e3 * problem.tolerance,
                "servo_sets": None,
                "servo_failure": 0.0,
                "difficulty": None,
                "world": None,
                "start_mm": None,
            }
        )
        terms = {name: term for name, term in problem.terms.items() if name in weights}
        key = (robot.fingerprint, config.model_dump_json(), *(id(t) for t in terms.values()))
        if key not in self._envs:
            self._envs[key] = TdmaEnv(config, terms, robot)
        return self._envs[key]


def policy_plan(robot: Robot, problem: Problem, model: Any, config: TdmaConfig) -> Plan:
    """``Policy.plan`` of a model trained in an environment."""
    return Policy(model, config).plan(robot, problem)


def load_policy(folder: str | Path, name: str = "best") -> Policy:
    """The policy of a training's folder: ``training.train_rl``.

    Args:
        folder: Of the training.
        name: "best", "last", or a kept one such as "steps_5000000".

    Raises:
        CheckpointError: No such file, not a model, or one of another environment.
    """
    folder = Path(folder)
    try:
        document = json.loads((folder / "config.json").read_text())
        config = TdmaConfig.model_validate(document["environment"])
    except ValidationError as error:
        raise CheckpointError(f"{folder}/config.json: {explain(error)}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{folder}: is no training of a policy ({error})") from None
    path = folder / f"{name}.zip"
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file")
    policy = Policy(load_model(path, config), config)
    check_fits(policy.model, Tdma(config), str(path))
    return policy


def load_model(path: Path, config: TdmaConfig, **given: Any) -> Any:
    """A model of the kind that the environment's actions need.

    Raises:
        CheckpointError: Not a model, or truncated.
    """
    kind = MaskablePPO if config.actions == "discrete" else PPO
    try:
        return kind.load(path, device="cpu", **given)
    except (zipfile.BadZipFile, KeyError, EOFError, RuntimeError, ValueError, TypeError) as error:
        raise CheckpointError(f"{path}: is no {kind.__name__} of this training ({error})") from None


def check_fits(model: Any, env: Tdma, name: str = METHOD) -> None:
    """Raise CheckpointError unless a model's spaces are the environment's."""
    for what, found, needed in (
        ("action space", model.action_space, action_space(env)),
        ("observation space", model.observation_space, observation_space(env)),
    ):
        if found != needed:
            raise CheckpointError(
                f"{name}: its {what} is {_named(found)}, the environment's is {_named(needed)}"
            )


def _named(space: Any) -> str:
    return f"{type(space).__name__}{space.shape or f'({space.n})'}"


def rollouts(policy: Policy, env: Tdma, problems: Sequence[Problem]) -> Rollouts:
    """Episodes on many problems of the environment at once, in float32.

    Args:
        policy: Acts.
        env: Without servo failures.
        problems: Their starts, targets, servos and axial positions.
    """
    lanes = Lanes(env, len(problems))
    given = {
        "start": np.array([p.start for p in problems]),
        "target": np.array([p.target for p in problems]),
        "axial": np.array([p.axial or 0 for p in problems]),
        "servos": np.array([servo_bits(p.servos) for p in problems]),
    }
    observation = lanes.begin(list(jax.random.split(jax.random.key(0), lanes.count)), given)
    cost, solved = np.zeros(lanes.count), np.zeros(lanes.count, bool)
    running = np.ones(lanes.count, bool)
    while running.any():
        found = lanes.step(policy.actions(observation, lanes.masks))
        cost += np.where(running, found.outcome.cost, 0.0)
        solved |= running & found.outcome.solved
        running &= ~found.ended
        observation = found.observation
    return Rollouts(cost, solved)


def evaluation_problems(env: Tdma, count: int, seed: int = EVALUATION_SEED) -> list[Problem]:
    """Fixed problems of an environment, the same for every training in it."""
    config = env.config
    regime = Regime(
        name="evaluation",
        max_step_mm=(config.max_step_mm,),
        servo_sets=config.servo_sets,
        weights=(config.preset if config.weights is None else dict(config.weights),),
        worlds=(config.world,),
        theta_rad=config.theta_rad,
        bent=config.bent,
    )
    rng = np.random.default_rng(seed)
    drawn = [random_problem(env.robot, regime, rng) for _ in range(count)]
    return [
        replace(
            problem,
            start=problem.start if problem.start.any() else env.start,
            axial=env.problem.axial,
            tolerance=env.problem.tolerance,
        )
        for problem in drawn
    ]


def main(folders: tuple[str, ...], problems: int = 5000, seed: int = 7) -> None:
    """Share of new problems that each policy solves.

    Args:
        folders: Of trainings.
        problems: How many.
        seed: By which they are drawn.
    """
    for folder in folders:
        policy = load_policy(folder)
        env = made(policy.config.model_copy(update={"servo_failure": 0.0, "difficulty": None}))
        drawn = evaluation_problems(env, problems, seed)
        solved = rollouts(policy, env, drawn).solved
        print(f"{folder}: {solved.sum()} of {problems} solved")


if __name__ == "__main__":
    tyro.cli(main)
