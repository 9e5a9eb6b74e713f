"""A training of the value network, as its YAML file states it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from muxjax.config import NotNegative, Positive, Strict
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
