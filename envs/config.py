"""An environment as its YAML file states it. Imports no JAX."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from muxjax.config import NotNegative, Positive, Strict, load_yaml, resolve

Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]


class Difficulty(Strict):
    """A schedule: how much of the targets' range is drawn from.

    Attributes:
        begin: Share of the range at first, from its lower end.
        steps: Environment steps after which all of it is drawn from.
    """

    begin: Share
    steps: Count

    def level(self, steps: int) -> float:
        """Share after so many environment steps."""
        return self.begin + (1.0 - self.begin) * min(steps / self.steps, 1.0)


class TdmaConfig(Strict):
    """The task, its objective, and when an episode ends. Everything counts from 1.

    Attributes:
        robot: Name of a shipped robot, or path of a YAML file.
        actions: "discrete": an axial position and a non-empty subset of the servos; "continuous":
            a preference for every axial position and a signed displacement for every servo.
        preset: Name of a shipped set of weights, or path of a YAML file.
        weights: Weights by term name instead of a preset.
        max_step_mm: Greatest displacement of a tendon in one step; null for no limit.
        tolerance_mm: The target is reached when no tendon is further off than this.
        snap_mm: Continuous actions only: a displacement that ends no further than this from the
            tendon's target ends there.
        servo_sets: Sets of available servos to draw from; null for all that reach every tendon.
        servo_failure: Probability that a servo is lost after a step; the last one never is.
        start_mm: Displacements at the start; null for the straight arm.
        bent: Share of episodes that start bent instead, drawn as targets are.
        axial: Axial position at the start: a number, "random", or null for not known.
        theta_rad: Range of the targets' bending angles; azimuths are uniform.
        world: Obstacles: a shipped world by name, or path of a YAML file.
        time_limit: Steps after which an episode is truncated.
        unsolved_penalty: What an episode costs more that ends without having reached its target.
        difficulty: Schedule of the targets' range; null for all of it from the start.
        lookahead: Observe what moving each tendon alone would cost.
    """

    file_schema: Literal["muxjax/env/1"] = Field(alias="schema")
    robot: str = "muxarm"
    actions: Literal["discrete", "continuous"] = "discrete"
    preset: str = "paper"
    weights: dict[str, NotNegative] | None = None
    max_step_mm: Positive | None = None
    tolerance_mm: Positive = 0.01
    snap_mm: NotNegative = 5.0
    servo_sets: Annotated[tuple[tuple[Count, ...], ...], Field(min_length=1)] | None = None
    servo_failure: Share = 0.0
    start_mm: tuple[float, ...] | None = None
    bent: Share = 0.0
    axial: Count | Literal["random"] | None = None
    theta_rad: tuple[NotNegative, Annotated[float, Field(ge=0.01)]] = (0.2, 1.6)
    world: str | None = None
    time_limit: Count = 100
    unsolved_penalty: NotNegative = 5.0
    difficulty: Difficulty | None = None
    lookahead: bool = False

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if self.theta_rad[0] > self.theta_rad[1]:
            raise ValueError(f"theta_rad: must not fall, found {self.theta_rad}")
        if self.max_step_mm is not None and self.max_step_mm <= self.tolerance_mm:
            raise ValueError(
                f"max_step_mm: must be above tolerance_mm ({self.tolerance_mm:g}), "
                f"found {self.max_step_mm:g}"
            )
        for servos in self.servo_sets or ():
            if not servos or len(set(servos)) < len(servos):
                raise ValueError(f"servo_sets: must be non-empty sets of servos, found {servos}")
        return self


def load_env_config(name_or_path: str) -> TdmaConfig:
    """A shipped environment by name (``"muxarm"``), or a YAML file by path.

    Raises:
        ConfigError: No such file, or wrong values; the message names each field and its limit.
    """
    return load_yaml(TdmaConfig, resolve(name_or_path, "envs"))
