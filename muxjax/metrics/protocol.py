"""What a comparison of planners fixes: targets, servo sets, settings and the published cells."""

from __future__ import annotations

import hashlib
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from muxjax.config import Positive, Sourced, Strict
from muxjax.planning import METHODS, Problem
from muxjax.robot import Robot
from muxjax.tendons import tendon_displacements

Cell = tuple[float, float]  # median, interquartile range
Whose = Literal["theirs", "ours", "variants"]


class Setting(Strict):
    """A planner with its objective, as one row of the table."""

    name: Annotated[str, Field(min_length=1)]
    method: str
    preset: str | None = None
    weights: dict[str, Annotated[float, Field(ge=0)]] | None = None
    max_step_mm: Positive | None = None  # in place of the protocol's
    action_set: Literal["subsets", "all", "multistep", "splits"] = "subsets"
    whose: Whose

    @model_validator(mode="after")
    def _is_complete(self) -> Setting:
        if self.method not in METHODS:
            raise ValueError(
                f"{self.name}: method must be one of {', '.join(METHODS)}, found {self.method!r}"
            )
        if (self.preset is None) == (self.weights is None):
            raise ValueError(f"{self.name}: give either preset or weights")
        if self.action_set == "splits" and self.max_step_mm is not None:
            raise ValueError(f"{self.name}: action set 'splits' has no max_step_mm")
        return self


class Published(Strict):
    """A column of the paper's table; overshoot in percent by segment."""

    name: str
    servos: Annotated[int, Field(ge=1)]
    time_s: Cell
    printed_stages: Cell
    overshoot_duration: tuple[Cell, ...]
    overshoot_peak: tuple[Cell, ...]


class Protocol(Strict):
    """A comparison as its YAML file states it."""

    file_schema: Literal["muxjax/bench/1"] = Field(alias="schema")
    name: str
    robot: str
    theta_rad: Sourced[tuple[Positive, Positive]]
    max_step_mm: Sourced[Positive]
    servo_sets: Annotated[tuple[tuple[int, ...], ...], Field(min_length=1)]
    settings: Annotated[tuple[Setting, ...], Field(min_length=1)]
    greedy: str
    beamstep: str
    published: tuple[Published, ...] = ()
    notes: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _names_are_settings(self) -> Protocol:
        names = [setting.name for setting in self.settings]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"settings: two are named {name!r}")
        for field, name in (("greedy", self.greedy), ("beamstep", self.beamstep)):
            if name not in names:
                raise ValueError(f"{field}: no setting is named {name!r}")
        low, high = self.theta_rad.value
        if low > high:
            raise ValueError(f"theta_rad: {low:g} to {high:g} is empty")
        return self

    def names(self, *whose: Whose) -> list[str]:
        """Settings by whose they are, in the order of the file."""
        return [s.name for s in self.settings if s.whose in whose]

    def key(self, robot: Robot, seed: int) -> str:
        """Hash over whatever decides the results of a target."""
        deciding = self.model_dump_json(
            include={"theta_rad", "max_step_mm", "servo_sets", "settings"}
        )
        text = f"{deciding} {robot.fingerprint} {seed}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def problem(
        self, target: Float[np.ndarray, " SJ"], servos: tuple[int, ...], setting: Setting
    ) -> Problem:
        """From the straight arm to a target [m]."""
        objective = {"preset": setting.preset} if setting.preset else {"weights": setting.weights}
        largest = (setting.max_step_mm or self.max_step_mm.value) / 1e3
        return Problem(
            np.zeros_like(target),
            target,
            servos=servos,
            max_step=None if setting.action_set == "splits" else largest,
            action_set=setting.action_set,
            **objective,
        )

    def target(self, robot: Robot, seed: int, number: int) -> Float[np.ndarray, " SJ"]:
        """Displacements [m] of one random target, counting from 1.

        Each has its own stream of random numbers, so a longer run begins with the shorter one's.

        Raises:
            ValueError: A segment of the robot does not bend that far.
        """
        low, high = self.theta_rad.value
        if high > robot.theta_max.min():
            raise ValueError(
                f"protocol {self.name!r}: theta_rad: its targets bend each segment by up to "
                f"{np.degrees(high):.1f} degrees, a segment of {robot.config.name!r} bends by at "
                f"most {np.degrees(robot.theta_max.min()):.1f}; give a protocol with a lower one"
            )
        rng = np.random.default_rng([seed, number - 1])
        theta = rng.uniform(low, high, robot.n_segments)
        phi = rng.uniform(0.0, 2 * np.pi, robot.n_segments)
        q = np.stack([theta, phi], axis=-1).reshape(-1)
        return np.asarray(tendon_displacements(robot, q))
