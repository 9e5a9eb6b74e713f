"""Plans as JSON files, versioned and checked on the way in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from muxjax.config import ConfigError, NotNegative, Positive, Strict, load_json, save_json
from muxjax.planning.problem import Plan, Problem

Whole = Annotated[int, Field(ge=1)]


class ProblemEntry(Strict):
    """The problem that a plan solves; displacements in metres, counting from 1."""

    start_m: tuple[float, ...]
    target_m: tuple[float, ...]
    servos: Annotated[tuple[Whole, ...], Field(min_length=1)]
    max_step_m: Positive | None
    tolerance_m: Positive
    weights: dict[str, NotNegative] = Field(description="of the cost terms")
    axial: Whole | None = Field(description="position at the start, if known")
    action_set: str


class PlanFile(Strict):
    """A plan as its file states it."""

    file_schema: Literal["muxjax/plan/1"] = Field(alias="schema")
    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$", description="of the robot")]
    method: str
    status: Literal["optimal", "feasible"]
    cost: NotNegative
    lower_bound: NotNegative
    expansions: Annotated[int, Field(ge=0)]
    action_set: str = Field(description="what status and bound are for")
    displacements_m: tuple[tuple[float, ...], ...] = Field(
        min_length=1, description="at the start and after each step"
    )
    axial: tuple[Whole, ...] = Field(description="position of each step")
    problem: ProblemEntry

    @model_validator(mode="after")
    def _fits_its_problem(self) -> Self:
        if len(self.axial) != len(self.displacements_m) - 1:
            raise ValueError(
                f"axial: must name a position for each of {len(self.displacements_m) - 1} steps, "
                f"found {len(self.axial)}"
            )
        size = len(self.problem.target_m)
        for number, row in enumerate((self.problem.start_m, *self.displacements_m)):
            if len(row) != size:
                where = f"displacements_m[{number}]" if number else "problem.start_m"
                raise ValueError(f"{where}: must have {size} tendons, found {len(row)}")
        ends = {
            "start": (self.displacements_m[0], self.problem.start_m),
            "target": (self.displacements_m[-1], self.problem.target_m),
        }
        for name, (found, wanted) in ends.items():
            off = max(abs(a - b) for a, b in zip(found, wanted, strict=True))
            # The slack is for start + (target - start) != target in floating point.
            if off > self.problem.tolerance_m * (1 + 1e-9):
                raise ValueError(
                    f"displacements_m: {off:g} m off the problem's {name}, tolerance "
                    f"{self.problem.tolerance_m:g}"
                )
        return self


def save_plan(plan: Plan, path: str | Path) -> None:
    """Write a plan as JSON; a file of that name is replaced whole or not at all.

    Weights are written as numbers: the file does not change with a preset.

    Raises:
        ValueError: The plan failed, or its problem has what no file can hold: a world, or cost
            terms of one's own. The program of such a plan can be saved.
    """
    problem = plan.problem
    if plan.status == "failed":
        raise ValueError(f"plan: {plan.method} found none ({plan.reason})")
    if problem.world is not None or problem.terms:
        what = "a world" if problem.world is not None else f"own terms {sorted(problem.terms)}"
        raise ValueError(f"plan: its problem has {what}, which no file holds; save its program")
    document = PlanFile(
        file_schema="muxjax/plan/1",
        fingerprint=plan.fingerprint,
        method=plan.method,
        status=plan.status,
        cost=plan.cost,
        lower_bound=plan.lower_bound,
        expansions=plan.expansions,
        action_set=plan.action_set,
        displacements_m=plan.displacements.tolist(),
        axial=plan.axial.tolist(),
        problem=ProblemEntry(
            start_m=tuple(problem.start.tolist()),
            target_m=tuple(problem.target.tolist()),
            servos=problem.servos,
            max_step_m=problem.max_step,
            tolerance_m=problem.tolerance,
            weights=dict(problem.cost_weights),
            axial=problem.axial,
            action_set=problem.action_set,
        ),
    )
    save_json(document, path)


def load_plan(path: str | Path) -> Plan:
    """Read a plan. What a robot makes of it, its reach above all, ``schedule`` checks.

    Raises:
        ConfigError: No such file, not JSON, another schema, a wrong field, or a plan that does
            not go from its problem's start to its target; each named.
    """
    found = load_json(PlanFile, path)
    given = found.problem
    try:
        problem = Problem(
            start=given.start_m,
            target=given.target_m,
            servos=given.servos,
            max_step=given.max_step_m,
            tolerance=given.tolerance_m,
            weights=given.weights,
            axial=given.axial,
            action_set=given.action_set,
        )
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    return Plan(
        displacements=np.array(found.displacements_m),
        axial=np.array(found.axial, dtype=np.int64),
        cost=found.cost,
        lower_bound=found.lower_bound,
        expansions=found.expansions,
        problem=problem,
        fingerprint=found.fingerprint,
        method=found.method,
        status=found.status,
        action_set=found.action_set,
    )
