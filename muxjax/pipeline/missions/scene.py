"""What is where: the base, the tendons, the drum, and the objects, on their places or held."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from muxjax.collision import SphereConfig, World, WorldConfig, world_from_config
from muxjax.kinematics import forward_kinematics
from muxjax.pipeline.missions.files import MissionConfig
from muxjax.pipeline.swept import at_base
from muxjax.robot import Robot, frame_pose
from muxjax.tendons import configuration_from_tendons

# An object that is held is no obstacle, and one that is not held is no part of the tool. So that
# every world of a mission has the same shapes of arrays, and needs one compilation, it stays in
# both lists with a radius that puts its surface this far out of everybody's way.
_ABSENT = -100.0  # [m]


@dataclass(frozen=True, eq=False)
class Scene:
    """The state of a mission.

    Attributes:
        base: Pose of the arm's root in the world.
        displacements: Of the tendons [m].
        axial: Axial position, if known.
        centres: Of the objects [m], in the world; of one that is held, where it was.
        held: Number of the object in the gripper, from 0; None if it is empty.
        offset: Of that object's centre in the tool's frame [m].
    """

    base: Float[np.ndarray, "4 4"]
    displacements: Float[np.ndarray, " SJ"]
    axial: int | None
    centres: Float[np.ndarray, "objects 3"]
    held: int | None = None
    offset: Float[np.ndarray, " 3"] | None = None


def first_scene(robot: Robot, mission: MissionConfig) -> Scene:
    """The straight arm at its first place, with an empty gripper."""
    base = np.asarray(robot.base) if mission.base is None else frame_pose(mission.base)
    centres = np.array([item.centre_m for item in mission.objects]).reshape(-1, 3)
    return Scene(base, np.zeros(robot.n_tendons), None, centres)


def tool_pose(robot: Robot, scene: Scene) -> Float[np.ndarray, "4 4"]:
    """Where the tool is."""
    q = configuration_from_tendons(robot, scene.displacements)
    return np.asarray(forward_kinematics(at_base(robot, scene.base), q))


def grasped(robot: Robot, mission: MissionConfig, scene: Scene, what: str) -> tuple[Scene, float]:
    """The scene with an object in the gripper, and how far it is from the grasp point [m]."""
    number = [item.name for item in mission.objects].index(what)
    tool = tool_pose(robot, scene)
    offset = tool[:3, :3].T @ (scene.centres[number] - tool[:3, 3])
    miss = float(np.linalg.norm(offset - np.array(mission.grasp_point_m)))
    return replace(scene, held=number, offset=offset), miss


def released(robot: Robot, scene: Scene) -> Scene:
    """The scene with the object where the gripper opened."""
    assert scene.held is not None
    assert scene.offset is not None
    tool = tool_pose(robot, scene)
    centres = scene.centres.copy()
    centres[scene.held] = tool[:3, :3] @ scene.offset + tool[:3, 3]
    return replace(scene, centres=centres, held=None, offset=None)


class Worlds:
    """The worlds of a mission: obstacles, the gripper, and objects where they are."""

    def __init__(self, mission: MissionConfig) -> None:
        self._count = len(mission.objects)
        self._radius = np.array([item.radius_m for item in mission.objects])
        balls = tuple(
            SphereConfig(centre_m=item.centre_m, radius_m=item.radius_m) for item in mission.objects
        )
        held = tuple(
            SphereConfig(centre_m=(0.0, 0.0, 0.0), radius_m=item.radius_m)
            for item in mission.objects
        )
        config = WorldConfig(
            file_schema="muxjax/world/1",
            name=mission.name,
            obstacles=(*mission.obstacles, *balls),
            tool=(*mission.gripper, *held),
        )
        self._world = world_from_config(config)

    def at(self, scene: Scene) -> World:
        """The world of a scene."""
        world, n = self._world, self._count
        if not n:
            return world
        lying = np.where(np.arange(n) == scene.held, _ABSENT, self._radius)
        carried = np.where(np.arange(n) == scene.held, self._radius, _ABSENT)
        places = np.zeros((n, 3))
        if scene.held is not None:
            places[scene.held] = scene.offset
        new = (
            _with_last(world.round_from, scene.centres),
            _with_last(world.round_to, scene.centres),
            _with_last(world.round_radius, lying),
            _with_last(world.carried, places),
            _with_last(world.carried_radius, carried),
        )
        return eqx.tree_at(
            lambda w: (w.round_from, w.round_to, w.round_radius, w.carried, w.carried_radius),
            world,
            new,
        )


def _with_last(values: object, last: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    changed = np.array(values)
    changed[len(changed) - len(last) :] = last
    return changed
