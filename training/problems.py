"""Random planning problems: what a network is trained on, and what planners are compared on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, model_validator

import muxjax
from muxjax.config import ConfigError, NotNegative, Positive, Strict
from muxjax.planning import Problem
from muxjax.planning.problem import COLLISION, check_problem, preset_weights
from muxjax.robot import Robot

T = TypeVar("T")

_SCHEMA = "muxjax/problems/1"
_TRIES = 1000  # draws of a problem that a robot and world allow


class Regime(Strict):
    """A kind of problems.

    Attributes:
        name: Of the regime.
        problems: How many, for training.
        labels: "exact": cost to go by the certified optimum, of any state; "bound": by the pattern
            database, of any state, where its terms are all that the objective has; "search": by a
            beam, of the states that its best plan passes.
        decisions: States from which the actions are labelled, of each problem.
        max_step_mm: Steps to choose from; null for full moves.
        servo_sets: Sets of healthy servos to choose from; by default all.
        action_sets: Action sets to choose from.
        weights: Weights of the cost terms to choose from: presets by name, or mappings.
        spread: Every weight is multiplied by exp of a normal variable with this deviation.
        worlds: Worlds to choose from; null for none.
        theta_rad: Range of the targets' bending angles.
        bent: Share of problems that start bent, as far as their targets.
        underway: Share of problems that start in the middle of another one's plan.
    """

    name: str
    problems: Annotated[int, Field(ge=0)] = 0
    labels: Literal["exact", "bound", "search"] = "exact"
    decisions: Annotated[int, Field(ge=1)] = 48
    max_step_mm: tuple[Positive | None, ...] = (None,)
    servo_sets: tuple[tuple[int, ...], ...] | None = None
    action_sets: tuple[Literal["subsets", "all", "multistep", "splits"], ...] = ("subsets",)
    weights: tuple[str | dict[str, NotNegative], ...] = ("paper",)
    spread: NotNegative = 0.0
    worlds: tuple[str | None, ...] = (None,)
    theta_rad: tuple[NotNegative, NotNegative] = (0.2, 1.6)
    bent: Annotated[float, Field(ge=0, le=1)] = 0.0
    underway: Annotated[float, Field(ge=0, le=1)] = 0.0

    @model_validator(mode="after")
    def _is_ordered(self) -> Regime:
        if self.theta_rad[0] > self.theta_rad[1]:
            raise ValueError(f"{self.name}: theta_rad must not fall, found {self.theta_rad}")
        return self


def random_problem(robot: Robot, regime: Regime, rng: np.random.Generator) -> Problem:
    """A problem of a regime, drawn anew until robot and world allow it.

    Raises:
        ValueError: None was found.
    """
    for _ in range(_TRIES):
        problem = _drawn(robot, regime, rng)
        try:
            check_problem(robot, problem)
        except ValueError:
            continue
        return problem
    raise ValueError(f"{regime.name}: no problem that the robot and the world allow")


def write_problems(path: Path, robot: Robot, problems: Mapping[str, Sequence[Problem]]) -> None:
    """Write problems by regime, a line each; worlds by name.

    Args:
        path: Of the JSON file.
        robot: Whose problems they are.
        problems: By name of their regime.
    """
    head = {"schema": _SCHEMA, "robot": robot.config.name, "fingerprint": robot.fingerprint}
    lines = [
        f"{json.dumps(name)}: [\n" + ",\n".join(json.dumps(_document(p)) for p in rows) + "\n]"
        for name, rows in problems.items()
    ]
    text = json.dumps(head)[:-1] + ', "problems": {\n' + ",\n".join(lines) + "\n}}\n"
    path.write_text(text)


def read_problems(path: Path, robot: Robot) -> dict[str, list[Problem]]:
    """Problems of a file that ``write_problems`` wrote, by regime.

    Raises:
        ConfigError: No such file, another kind of file, or problems of another robot.
    """
    try:
        document = json.loads(path.read_text())
        schema, fingerprint = document["schema"], document["fingerprint"]
        found = {k: [_problem(d) for d in rows] for k, rows in document["problems"].items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: is no file of problems ({error})") from None
    if schema != _SCHEMA:
        raise ConfigError(f"{path}: schema is {schema!r}, must be {_SCHEMA!r}")
    if fingerprint != robot.fingerprint:
        raise ConfigError(f"{path}: holds problems of another robot than {robot.config.name!r}")
    for rows in found.values():
        for problem in rows:
            check_problem(robot, problem)
    return found


def _document(problem: Problem) -> dict[str, Any]:
    return {
        "start": problem.start.tolist(),
        "target": problem.target.tolist(),
        "servos": list(problem.servos),
        "max_step": problem.max_step,
        "weights": {k: v for k, v in problem.cost_weights.items() if k != COLLISION},
        "axial": problem.axial,
        "action_set": problem.action_set,
        "world": None if problem.world is None else problem.world.name,
    }


def _problem(document: Mapping[str, Any]) -> Problem:
    world = document["world"]
    return Problem(
        start=np.array(document["start"]),
        target=np.array(document["target"]),
        servos=tuple(document["servos"]),
        max_step=document["max_step"],
        weights=document["weights"],
        axial=document["axial"],
        action_set=document["action_set"],
        world=None if world is None else muxjax.load_world(world),
    )


def _drawn(robot: Robot, regime: Regime, rng: np.random.Generator) -> Problem:
    start, target = np.zeros(robot.n_tendons), _ends(robot, regime, rng)
    if rng.random() < regime.bent:
        start = _ends(robot, regime, rng)
    axial = None
    servos = _servos(robot, regime, rng)
    if rng.random() < regime.underway:
        gone = rng.random(robot.n_tendons) * (rng.random(robot.n_tendons) < 0.5)
        start = start + gone * (target - start)
        axial = int(rng.integers(1, len(robot.axial_map) + 1))
    world = _one_of(regime.worlds, rng)
    weights = _one_of(regime.weights, rng)
    weights = preset_weights(weights) if isinstance(weights, str) else weights
    weights = {k: v * float(np.exp(regime.spread * rng.normal())) for k, v in weights.items()}
    action_set = _one_of(regime.action_sets, rng)
    step = _one_of(regime.max_step_mm, rng)
    return Problem(
        start,
        target,
        servos=servos,
        max_step=None if step is None or action_set == "splits" else 1e-3 * step,
        weights=weights,
        axial=axial,
        action_set=action_set,
        world=None if world is None else muxjax.load_world(world),
    )


def _ends(robot: Robot, regime: Regime, rng: np.random.Generator) -> np.ndarray:
    theta = rng.uniform(*regime.theta_rad, robot.n_segments)
    phi = rng.uniform(0.0, 2 * np.pi, robot.n_segments)
    q = np.stack([np.minimum(theta, robot.theta_max), phi], axis=-1).reshape(-1)
    return np.asarray(muxjax.tendon_displacements(robot, q))


def _servos(robot: Robot, regime: Regime, rng: np.random.Generator) -> tuple[int, ...]:
    if regime.servo_sets is not None:
        return tuple(_one_of(regime.servo_sets, rng))
    bits = int(rng.integers(1, 2**robot.tendons_per_segment))
    return tuple(s + 1 for s in range(robot.tendons_per_segment) if bits >> s & 1)


def _one_of(choices: Sequence[T], rng: np.random.Generator) -> T:
    return choices[int(rng.integers(len(choices)))]
