"""Mission files: the scene, what is in it, and the steps one after the other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from muxjax.collision.world import AnyShape, Obstacle, TubeConfig
from muxjax.config import (
    FrameConfig,
    Positive,
    Strict,
    TargetConfig,
    Vector3,
    load_yaml,
    resolve,
)

Name = Annotated[str, Field(min_length=1, max_length=40)]


class ObjectConfig(Strict):
    """A ball that can be grasped."""

    name: Name
    centre_m: Vector3
    radius_m: Positive


class MoveStep(Strict):
    """The tendons take the tool to a pose, or the arm to a configuration."""

    do: Literal["move"]
    name: Name
    to: TargetConfig | None = None
    q_deg: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _one_goal(self) -> MoveStep:
        if (self.to is None) == (self.q_deg is None):
            raise ValueError(f"{self.name}: give either to or q_deg")
        return self


class BaseStep(Strict):
    """The base goes through poses of the arm's root, in straight lines; the tendons stand still."""

    do: Literal["base"]
    name: Name
    through: Annotated[tuple[FrameConfig, ...], Field(min_length=1)]


class InsertStep(Strict):
    """Base and tendons in turn, until the tip is so deep in a tube."""

    do: Literal["insert"]
    name: Name
    tube: Annotated[int, Field(ge=1, description="of the scene's tubes, from 1")] = 1
    from_m: Annotated[float, Field(le=0, description="depth of the tip at the start")] = -0.1
    depth_m: Positive
    step_m: Annotated[float, Field(ge=1e-3, description="greatest advance of the base at once")]


class ExtractStep(Strict):
    """The last insertion backwards."""

    do: Literal["extract"]
    name: Name


class GraspStep(Strict):
    """The gripper closes on an object, which from then on is part of the tool."""

    do: Literal["grasp"]
    name: Name = "grasp"
    what: Name


class ReleaseStep(Strict):
    """The gripper opens; the object stays where it is."""

    do: Literal["release"]
    name: Name = "release"


Step = Annotated[
    MoveStep | BaseStep | InsertStep | ExtractStep | GraspStep | ReleaseStep,
    Field(discriminator="do"),
]


class MissionConfig(Strict):
    """A mission as its YAML file states it."""

    file_schema: Literal["muxjax/mission/1"] = Field(alias="schema")
    name: str
    base: FrameConfig | None = Field(
        default=None,
        description="where the arm's root stands at the start; the robot's own if none",
    )
    obstacles: tuple[Obstacle, ...]
    objects: tuple[ObjectConfig, ...] = ()
    gripper: tuple[AnyShape, ...] = ()
    grasp_point_m: Vector3 = (0.0, 0.0, 0.0)
    grasp_tolerance_m: Positive = 0.005
    margin_m: Annotated[float, Field(ge=1e-3, description="kept by every plan")] = 0.002
    steps: Annotated[tuple[Step, ...], Field(min_length=1)]

    @property
    def tubes(self) -> tuple[TubeConfig, ...]:
        """The tubes among the obstacles."""
        return tuple(item for item in self.obstacles if isinstance(item, TubeConfig))

    @model_validator(mode="after")
    def _steps_make_sense(self) -> MissionConfig:
        names = [item.name for item in self.objects]
        if len(set(names)) < len(names):
            raise ValueError(f"objects: names must differ, found {names}")
        held, inside = False, False
        for number, step in enumerate(self.steps, start=1):
            where = f"steps[{number}]"
            match step:
                case GraspStep() if step.what not in names:
                    raise ValueError(f"{where}.what: no object {step.what!r} among {names}")
                case GraspStep() if held:
                    raise ValueError(f"{where}: the gripper holds something already")
                case ReleaseStep() if not held:
                    raise ValueError(f"{where}: the gripper holds nothing")
                case InsertStep() if step.tube > len(self.tubes):
                    raise ValueError(
                        f"{where}.tube: the scene has {len(self.tubes)} tubes, found {step.tube}"
                    )
                case ExtractStep() if not inside:
                    raise ValueError(f"{where}: nothing was inserted before")
                case BaseStep() | MoveStep() if inside:
                    raise ValueError(f"{where}: the arm is in a tube; extract comes first")
            held = isinstance(step, GraspStep) or (held and not isinstance(step, ReleaseStep))
            inside = isinstance(step, InsertStep) or (inside and not isinstance(step, ExtractStep))
        return self


def load_mission(name_or_path: str | Path) -> MissionConfig:
    """Read a mission: a shipped one by name (``"cabinet"``, ``"pipe"``), or a YAML file by path.

    Raises:
        ConfigError: No such mission, or a file with wrong values.
    """
    return load_yaml(MissionConfig, resolve(name_or_path, "missions"))
