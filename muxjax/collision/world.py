"""Worlds: obstacles and what the tool carries, from a YAML file to arrays."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Float
from pydantic import Field, model_validator

from muxjax.collision.sampled import Grid, around_points, read_grid, read_points
from muxjax.config import Positive, Strict, Vector3, load_yaml, resolve

Array = jax.Array | np.ndarray
Scalar = Float[Array, ""] | float

# Balls along a capsule that the tool carries: their spacing is at most this share of its radius.
CARRIED_SPACING = 0.5


class SphereConfig(Strict):
    """A ball."""

    kind: Literal["sphere"] = "sphere"
    centre_m: Vector3
    radius_m: Positive


class CapsuleConfig(Strict):
    """Everything within a radius of a line from one point to another."""

    kind: Literal["capsule"] = "capsule"
    from_m: Vector3
    to_m: Vector3
    radius_m: Positive


class BoxConfig(Strict):
    """A cuboid."""

    kind: Literal["box"]
    centre_m: Vector3
    size_m: tuple[Positive, Positive, Positive]
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)


class HalfSpaceConfig(Strict):
    """Everything below a plane."""

    kind: Literal["half_space"]
    point_m: Vector3
    normal: Vector3


class TubeConfig(Strict):
    """A bent tube about a line through points; its bore is free."""

    kind: Literal["tube"]
    through_m: Annotated[tuple[Vector3, ...], Field(min_length=2)]
    bore_radius_m: Positive
    wall_m: Positive | None = Field(
        default=None, description="thickness, with open ends; without it all but the bore is solid"
    )


class GridConfig(Strict):
    """Signed distances sampled on a regular grid: an .npz file, or an .npy file and its place."""

    kind: Literal["grid"]
    file: str = Field(description="beside the world's own file: .npz of values, origin, spacing")
    origin_m: Vector3 | None = None
    spacing_m: Positive | tuple[Positive, Positive, Positive] | None = None
    beyond: Literal["unknown", "free"] = Field(
        default="unknown", description="whether there may be obstacles outside the grid"
    )


class PointsConfig(Strict):
    """A point cloud, each point a ball; kept as a grid of signed distances."""

    kind: Literal["points"]
    file: str | None = Field(default=None, description="beside the world's: .npy .npz .csv .xyz")
    points_m: tuple[Vector3, ...] | None = None
    radius_m: Positive
    spacing_m: Annotated[float, Field(gt=0, description="of the grid")] = 0.01

    @model_validator(mode="after")
    def _one_source(self) -> PointsConfig:
        if (self.file is None) == (not self.points_m):
            raise ValueError("points: give either file or points_m")
        return self


Obstacle = Annotated[
    SphereConfig
    | CapsuleConfig
    | BoxConfig
    | HalfSpaceConfig
    | TubeConfig
    | GridConfig
    | PointsConfig,
    Field(discriminator="kind"),
]
Shape = SphereConfig | CapsuleConfig
AnyShape = Annotated[Shape, Field(discriminator="kind")]


class WorldConfig(Strict):
    """Obstacles as a YAML file states them."""

    file_schema: Literal["muxjax/world/1"] = Field(alias="schema")
    name: str
    obstacles: tuple[Obstacle, ...]
    tool: tuple[AnyShape, ...] | None = Field(
        default=None, description="shape of the tool, in its frame, in place of the default"
    )


class World(eqx.Module):
    """Obstacles, kind by kind, and what the tool carries. The leaves may be differentiated."""

    round_from: Float[Array, "R 3"]  # spheres and capsules: axis and radius [m]
    round_to: Float[Array, "R 3"]
    round_radius: Float[Array, " R"]
    box_frame: Float[Array, "B 4 4"]  # world to box
    box_half: Float[Array, "B 3"]  # [m]
    plane_point: Float[Array, "P 3"]
    plane_normal: Float[Array, "P 3"]  # unit, towards the free side
    tube_line: tuple[Float[Array, "_ 3"], ...]  # through points of each tube
    tube_bore: tuple[Scalar, ...]  # [m]
    tube_wall: tuple[Scalar | None, ...]  # thickness [m] of tubes with open ends
    grids: tuple[Grid, ...]
    carried: Float[Array, "A 3"]  # balls that move with the tool, in its frame [m]
    carried_radius: Float[Array, " A"]
    carried_slack: Float[Array, " A"]  # half the distance to the next one of the same shape [m]
    tool_line: bool = eqx.field(static=True)  # a capsule of the arm's radius to the tool point
    name: str = eqx.field(static=True)

    @property
    def fingerprint(self) -> str:
        """Hash over every value, by which sweeps name their world."""
        digest = hashlib.sha256(str((self.tool_line, [g.free for g in self.grids])).encode())
        for leaf in jax.tree.leaves(self):
            digest.update(str(np.shape(leaf)).encode())
            digest.update(np.asarray(leaf, dtype=np.float64).tobytes())
        return digest.hexdigest()[:16]


def load_world(name_or_path: str | Path) -> World:
    """Read a world: a shipped one by name (``"cabinet"``, ``"s_pipe"``), or a YAML file by path.

    Raises:
        ConfigError: No such world, or a file with wrong values, among them the files of grids and
            points that it names.
    """
    path = resolve(name_or_path, "worlds")
    return world_from_config(load_yaml(WorldConfig, path), path.parent)


def world_from_config(config: WorldConfig, folder: Path | None = None) -> World:
    """World of a validated configuration.

    Args:
        config: Obstacles and tool.
        folder: Where the files of grids and points lie; default: the current folder.

    Raises:
        ValueError: A half-space without a direction, or a file that cannot be used.
    """
    rounds: list[tuple[Vector3, Vector3, float]] = []
    boxes, planes, tubes = [], [], []
    grids: list[Grid] = []
    for number, item in enumerate(config.obstacles, start=1):
        where = f"obstacles[{number}]"
        match item:
            case SphereConfig():
                rounds.append((item.centre_m, item.centre_m, item.radius_m))
            case CapsuleConfig():
                rounds.append((item.from_m, item.to_m, item.radius_m))
            case BoxConfig():
                frame = np.eye(4)
                frame[:3, :3] = (
                    scipy.spatial.transform.Rotation.from_euler("xyz", item.rpy_deg, degrees=True)
                    .as_matrix()
                    .T
                )
                frame[:3, 3] = -frame[:3, :3] @ np.array(item.centre_m)
                boxes.append((frame, 0.5 * np.array(item.size_m)))
            case HalfSpaceConfig():
                size = np.linalg.norm(item.normal)
                if size == 0:
                    raise ValueError(f"{where}.normal: must not be zero")
                planes.append((item.point_m, np.array(item.normal) / size))
            case TubeConfig():
                tubes.append(item)
            case GridConfig():
                path = (folder or Path()) / item.file
                grids.append(
                    read_grid(where, path, item.origin_m, item.spacing_m, item.beyond == "free")
                )
            case PointsConfig():
                points = (
                    np.array(item.points_m)
                    if item.file is None
                    else read_points(where, (folder or Path()) / item.file)
                )
                grids.append(around_points(where, points, item.radius_m, item.spacing_m))
    world = World(
        round_from=np.array([r[0] for r in rounds]).reshape(-1, 3),
        round_to=np.array([r[1] for r in rounds]).reshape(-1, 3),
        round_radius=np.array([r[2] for r in rounds]),
        box_frame=np.array([b[0] for b in boxes]).reshape(-1, 4, 4),
        box_half=np.array([b[1] for b in boxes]).reshape(-1, 3),
        plane_point=np.array([p[0] for p in planes]).reshape(-1, 3),
        plane_normal=np.array([p[1] for p in planes]).reshape(-1, 3),
        tube_line=tuple(np.array(t.through_m) for t in tubes),
        tube_bore=tuple(np.array(t.bore_radius_m) for t in tubes),
        tube_wall=tuple(None if t.wall_m is None else np.array(t.wall_m) for t in tubes),
        grids=tuple(grids),
        carried=np.zeros((0, 3)),
        carried_radius=np.zeros(0),
        carried_slack=np.zeros(0),
        tool_line=config.tool is None,
        name=config.name,
    )
    return attach(world, config.tool or ())


def attach(world: World, shapes: Sequence[Shape]) -> World:
    """The same world with more spheres and capsules that move with the tool, such as a grasp.

    Args:
        world: Obstacles, and what the tool carries already.
        shapes: In the tool's frame: ``SphereConfig(centre_m=..., radius_m=...)`` or
            ``CapsuleConfig(from_m=..., to_m=..., radius_m=...)``.
    """
    balls = [np.asarray(world.carried)]
    radius, slack = [np.asarray(world.carried_radius)], [np.asarray(world.carried_slack)]
    for shape in shapes:
        if isinstance(shape, SphereConfig):
            begin = end = np.array(shape.centre_m)
        else:
            begin, end = np.array(shape.from_m), np.array(shape.to_m)
        span = float(np.linalg.norm(end - begin))
        parts = int(np.ceil(span / (CARRIED_SPACING * shape.radius_m)))
        balls.append(begin + np.linspace(0.0, 1.0, parts + 1)[:, None] * (end - begin))
        radius.append(np.full(parts + 1, shape.radius_m))
        slack.append(np.full(parts + 1, 0.5 * span / max(parts, 1)))
    return eqx.tree_at(
        lambda w: (w.carried, w.carried_radius, w.carried_slack),
        world,
        tuple(np.concatenate(x) for x in (balls, radius, slack)),
    )
