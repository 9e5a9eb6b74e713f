"""The arm among obstacles: signed distances, differentiable.

The arm is a chain of capsules of radius ``robot.body_radius`` along its backbone, and a capsule to
the tool point. Obstacles are spheres, capsules, boxes, half-spaces and bent tubes that the arm
works inside of; a world lists them in a YAML file. A distance is positive where the arm is clear
and minus the depth where it is not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.spatial.transform import Rotation

from muxjax.config import Positive, Strict, Vector3, load_yaml, resolve
from muxjax.kinematics import backbone
from muxjax.robot import Robot

Array = jax.Array | np.ndarray

CAPSULES = 8  # a segment
# Points along a capsule at which boxes and tubes are asked for their distance: between them it is
# short by at most an eighth of their spacing squared over the obstacle's radius of curvature.
POINTS = 3
# Capsules nearer to each other along the arm than this many body radii do not count as touching:
# a bend so tight would be the discs' own limit.
NEIGHBOURS = np.pi


class SphereConfig(Strict):
    """A ball."""

    kind: Literal["sphere"]
    centre_m: Vector3
    radius_m: Positive


class CapsuleConfig(Strict):
    """Everything within a radius of a line from one point to another."""

    kind: Literal["capsule"]
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
    """The wall of a bent tube, whose bore is free; its line goes through points."""

    kind: Literal["tube"]
    through_m: Annotated[tuple[Vector3, ...], Field(min_length=2)]
    bore_radius_m: Positive


Obstacle = Annotated[
    SphereConfig | CapsuleConfig | BoxConfig | HalfSpaceConfig | TubeConfig,
    Field(discriminator="kind"),
]


class WorldConfig(Strict):
    """Obstacles as a YAML file states them."""

    file_schema: Literal["muxjax/world/1"] = Field(alias="schema")
    name: str
    obstacles: tuple[Obstacle, ...]


class World(eqx.Module):
    """Obstacles, kind by kind. The leaves may be differentiated or swept."""

    round_from: Float[Array, "R 3"]  # spheres and capsules: axis and radius [m]
    round_to: Float[Array, "R 3"]
    round_radius: Float[Array, " R"]
    box_frame: Float[Array, "B 4 4"]  # world to box
    box_half: Float[Array, "B 3"]  # [m]
    plane_point: Float[Array, "P 3"]
    plane_normal: Float[Array, "P 3"]  # unit, towards the free side
    tube_line: tuple[Float[Array, "_ 3"], ...]  # through points of each tube
    tube_bore: tuple[Float[Array, ""], ...]  # [m]


def load_world(name_or_path: str | Path) -> World:
    """Read a world: a shipped one by name (``"cabinet"``, ``"s_pipe"``), or a YAML file by path.

    Raises:
        ConfigError: No such world, or a file with wrong values.
    """
    return world_from_config(load_yaml(WorldConfig, resolve(name_or_path, "worlds")))


def world_from_config(config: WorldConfig) -> World:
    """World of a validated configuration.

    Raises:
        ValueError: A half-space without a direction.
    """
    rounds: list[tuple[Vector3, Vector3, float]] = []
    boxes, planes, tubes = [], [], []
    for number, item in enumerate(config.obstacles, start=1):
        match item:
            case SphereConfig():
                rounds.append((item.centre_m, item.centre_m, item.radius_m))
            case CapsuleConfig():
                rounds.append((item.from_m, item.to_m, item.radius_m))
            case BoxConfig():
                frame = np.eye(4)
                frame[:3, :3] = Rotation.from_euler("xyz", item.rpy_deg, degrees=True).as_matrix().T
                frame[:3, 3] = -frame[:3, :3] @ np.array(item.centre_m)
                boxes.append((frame, 0.5 * np.array(item.size_m)))
            case HalfSpaceConfig():
                size = np.linalg.norm(item.normal)
                if size == 0:
                    raise ValueError(f"obstacles[{number}].normal: must not be zero")
                planes.append((item.point_m, np.array(item.normal) / size))
            case TubeConfig():
                tubes.append((np.array(item.through_m), np.array(item.bore_radius_m)))
    return World(
        round_from=np.array([r[0] for r in rounds]).reshape(-1, 3),
        round_to=np.array([r[1] for r in rounds]).reshape(-1, 3),
        round_radius=np.array([r[2] for r in rounds]),
        box_frame=np.array([b[0] for b in boxes]).reshape(-1, 4, 4),
        box_half=np.array([b[1] for b in boxes]).reshape(-1, 3),
        plane_point=np.array([p[0] for p in planes]).reshape(-1, 3),
        plane_normal=np.array([p[1] for p in planes]).reshape(-1, 3),
        tube_line=tuple(t[0] for t in tubes),
        tube_bore=tuple(t[1] for t in tubes),
    )


def arm_axis(robot: Robot, q: Float[Array, "*batch dof"]) -> Float[Array, "*batch points 3"]:
    """Ends of the arm's capsules from the root to the last disc, then the tool point [m]."""
    frames = jnp.asarray(backbone(robot, q, CAPSULES))
    tool = (frames[..., -1, :, :] @ jnp.asarray(robot.tool))[..., None, :3, 3]
    return jnp.concatenate([frames[..., :3, 3], tool], axis=-2)


def clearance(robot: Robot, q: Float[Array, "*batch dof"], world: World) -> Float[Array, "*batch"]:
    """Least signed distance [m] of the arm to the world's obstacles and to itself.

    Differentiable almost everywhere; the precision is that of q. The root's first capsule does
    not count: it stands in the arm's own mount.

    Args:
        robot: The arm; ``body_radius`` is its radius, also around the tool's line.
        q: Configuration [rad].
        world: Obstacles in the world frame.
    """
    return jnp.min(part_clearances(robot, q, world), axis=-1)


def part_clearances(
    robot: Robot, q: Float[Array, "*batch dof"], world: World
) -> Float[Array, "*batch parts"]:
    """Signed distance [m] of each capsule after the first, root to tool."""
    points = arm_axis(robot, jnp.asarray(q))
    begin, end = points[..., 1:-1, :], points[..., 2:, :]
    radius = jnp.asarray(robot.body_radius)
    distances = [self_distances(robot, begin, end) - 2 * radius]
    if len(world.round_radius):
        between = segment_distance(
            begin[..., None, :], end[..., None, :], world.round_from, world.round_to
        )
        distances.append(jnp.min(between - world.round_radius, axis=-1) - radius)
    fraction = jnp.linspace(0.0, 1.0, POINTS)[:, None]
    samples = begin[..., None, :] + fraction * (end - begin)[..., None, :]
    apart = [_planes(world, samples)] if len(world.plane_point) else []
    apart += [_boxes(world, samples)] if len(world.box_half) else []
    apart += [
        bore - _to_line(samples, jnp.asarray(line))
        for line, bore in zip(world.tube_line, world.tube_bore, strict=True)
    ]
    distances += [jnp.min(d, axis=-1) - radius for d in apart]
    return jnp.min(jnp.stack(distances), axis=0)


def segment_distance(
    a: Float[Array, "*#n 3"],
    b: Float[Array, "*#n 3"],
    c: Float[Array, "*#n 3"],
    d: Float[Array, "*#n 3"],
) -> Float[Array, "*n"]:
    """Distance between the segments a-b and c-d, either of which may be a point.

    The closest pair lies inside both, or has an end of one of them: the least of five candidates.
    """
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    uw, vw = _dot(u, w), _dot(v, w)
    cross = uu * vv - uv * uv
    flat = cross <= 1e-12 * uu * vv
    safe = jnp.where(flat, 1.0, cross)
    s = jnp.clip((uv * vw - vv * uw) / safe, 0.0, 1.0)
    t = jnp.clip((uu * vw - uv * uw) / safe, 0.0, 1.0)
    inside = _norm(w + s[..., None] * u - t[..., None] * v)
    ends = [_to_segment(a, c, d), _to_segment(b, c, d), _to_segment(c, a, b), _to_segment(d, a, b)]
    best = jnp.where(flat, jnp.inf, inside)
    for candidate in ends:
        best = jnp.minimum(best, candidate)
    return best


def self_distances(
    robot: Robot, begin: Float[Array, "*batch parts 3"], end: Float[Array, "*batch parts 3"]
) -> Float[Array, "*batch parts"]:
    """Distance of each capsule's axis to those of the arm that are not its neighbours."""
    between = segment_distance(
        begin[..., :, None, :], end[..., :, None, :], begin[..., None, :, :], end[..., None, :, :]
    )
    arcs = jnp.repeat(jnp.asarray(robot.length) / CAPSULES, CAPSULES)[1:]
    stop = jnp.cumsum(jnp.append(arcs, jnp.linalg.norm(jnp.asarray(robot.tool)[:3, 3])))
    start = jnp.concatenate([jnp.zeros(1), stop[:-1]])
    gap = jnp.maximum(start[:, None] - stop[None, :], start[None, :] - stop[:, None])
    near = gap < NEIGHBOURS * jnp.asarray(robot.body_radius)
    return jnp.min(jnp.where(near, jnp.inf, between), axis=-1)


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def _norm(v: Array) -> Array:
    """Length, with gradient 0 at 0."""
    square = jnp.sum(v * v, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _to_segment(p: Array, a: Array, b: Array) -> Array:
    along = b - a
    square = _dot(along, along)
    t = jnp.clip(_dot(p - a, along) / jnp.where(square > 0, square, 1.0), 0.0, 1.0)
    return _norm(p - a - t[..., None] * along)


def _to_line(points: Float[Array, "*n 3"], line: Float[Array, "m 3"]) -> Float[Array, "*n"]:
    return jnp.min(_to_segment(points[..., None, :], line[:-1], line[1:]), axis=-1)


def _planes(world: World, points: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    apart = _dot(points[..., None, :] - world.plane_point, jnp.asarray(world.plane_normal))
    return jnp.min(apart, axis=-1)


def _boxes(world: World, points: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    frame = jnp.asarray(world.box_frame)
    local = jnp.einsum("bij,...j->...bi", frame[:, :3, :3], points) + frame[:, :3, 3]
    over = jnp.abs(local) - world.box_half
    outside = _norm(jnp.maximum(over, 0.0))
    return jnp.min(outside + jnp.minimum(jnp.max(over, axis=-1), 0.0), axis=-1)
