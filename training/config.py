"""Trainings of the value network and of policies, as their YAML files state them."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from muxjax.config import ConfigError, NotNegative, Positive, Strict
from training.problems import Regime

Count = Annotated[int, Field(ge=1)]


class TrainingConfig(Strict):
    """Data, network and optimiser.

    Attributes:
        robot: Name of a shipped robot, or path of a YAML file.
        seed: Of the initial network, the order of batches and the self-play.
        data_seed: Of the problems that are labelled once; trainings may share them.
        regimes: Problems that are labelled once.
        self_play: Problems that are labelled anew in each round, by the beam in the order of the
            network as it is then (approximate value iteration).
        rounds: Rounds of self-play.
        width: Plans a level of the beam that labels.
        shard: Problems in a file of the data; the last one of each regime is held back.
        hidden: Sizes of the hidden layers.
        epochs: At most, before and after each round.
        patience: Epochs without a better validation loss after which training ends.
        batch: Decisions a step.
        learning_rate: At the start; it falls to a hundredth along a cosine.
        weight_decay: Of AdamW.
        ranking: Weight of the loss on the order of actions.
        temperature: Of that order, in the scale of the problem.
        symmetry: Turn every decision by a random number of tendons.
        budget_s: Seconds after which training ends, if any.
    """

    file_schema: Literal["muxjax/training/1"] = Field(alias="schema")
    robot: str
    seed: Annotated[int, Field(ge=0)] = 0
    data_seed: Annotated[int, Field(ge=0)] = 0
    regimes: tuple[Regime, ...]
    self_play: tuple[Regime, ...] = ()
    rounds: Annotated[int, Field(ge=0)] = 0
    width: Count = 64
    shard: Count = 50
    hidden: tuple[Count, ...] = (64, 64)
    epochs: Count = 30
    patience: Count = 8
    batch: Count = 512
    learning_rate: Positive = 2e-3
    weight_decay: NotNegative = 1e-4
    ranking: NotNegative = 1.0
    temperature: Positive = 0.01
    symmetry: bool = True
    budget_s: Positive | None = None

    @model_validator(mode="after")
    def _has_data(self) -> TrainingConfig:
        names = [r.name for r in (*self.regimes, *self.self_play)]
        if not self.regimes or len(set(names)) < len(names):
            raise ValueError(f"regimes: need at least one, names of their own each; found {names}")
        return self


class RlConfig(Strict):
    """A policy trained by PPO: with masks where actions are discrete.

    Attributes:
        environment: Shipped environment by name, or path of a YAML file.
        seed: Of the network, its exploration and the episodes.
        total_steps: Environment steps of all lanes together; may be raised later.
        lanes: Episodes side by side.
        rollout: Steps of each lane before an update.
        batch: Steps of a gradient.
        epochs: Passes over a rollout.
        hidden: Sizes of the hidden layers, of the policy and of the critic.
        learning_rate: At the start; it falls linearly to zero.
        discount: Per step; 1 makes the objective the plan's cost.
        gae: Lambda of the generalised advantage.
        clip: Of the policy's ratio.
        entropy: Weight of the entropy's bonus.
        initial_std: Of continuous actions.
        evaluate_every: Environment steps between evaluations, each of which keeps the state.
        evaluation_problems: Fixed problems, each with its certified optimum.
        keep_every: Environment steps between checkpoints that are kept.
        threads: Of torch.
    """

    file_schema: Literal["muxjax/rl/1"] = Field(alias="schema")
    environment: str
    seed: Annotated[int, Field(ge=0)] = 0
    total_steps: Count
    lanes: Count = 512
    rollout: Count = 32
    batch: Count = 2048
    epochs: Count = 4
    hidden: tuple[Count, ...] = (128, 128)
    learning_rate: Positive = 1e-3
    discount: Annotated[float, Field(gt=0, le=1)] = 1.0
    gae: Annotated[float, Field(ge=0, le=1)] = 0.95
    clip: Positive = 0.2
    entropy: NotNegative = 0.003
    initial_std: Positive = 1.0
    evaluate_every: Count = 500_000
    evaluation_problems: Count = 200
    keep_every: Count = 5_000_000
    threads: Count = 1

    @model_validator(mode="after")
    def _batches_fit(self) -> RlConfig:
        if self.batch > self.lanes * self.rollout:
            raise ValueError(
                f"batch: must be at most lanes * rollout ({self.lanes * self.rollout}), "
                f"found {self.batch}"
            )
        return self


def keep_config(
    config: Strict, out: Path, *, more: Strict | None = None, free: Collection[str] = ()
) -> None:
    """Write the configuration beside the weights, or compare it with the one that lies there.

    Args:
        config: Of the training.
        out: Its folder.
        more: What belongs to it, under the key "environment".
        free: Fields that may differ from the last time.

    Raises:
        ConfigError: The folder holds a training of another configuration.
    """
    document = config.model_dump(mode="json", by_alias=True)
    if more is not None:
        document["environment"] = more.model_dump(mode="json", by_alias=True)
    kept = out / "config.json"
    if kept.is_file():
        before = json.loads(kept.read_text())
        changed = {k for k in document.keys() | before.keys() if document.get(k) != before.get(k)}
        if changed - set(free):
            raise ConfigError(
                f"{out}: holds a training of another configuration "
                f"({', '.join(sorted(changed - set(free)))}); take another folder"
            )
    kept.write_text(json.dumps(document, indent=1))
