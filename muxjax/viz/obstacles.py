"""Obstacles and workspaces as shapes for a 3-D viewer, in metres, as plain NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from muxjax.collision import World
from muxjax.kinematics import forward_kinematics
from muxjax.robot import Robot
from muxjax.viz.scene import tube_mesh
from muxjax.workspace.result import Sweep

_PLANE = 0.7  # half the side of the square that stands for a half-space [m]
_SECTORS = 24  # a symmetric sweep's half plane is turned so often, over half a turn
_BOX = np.array(
    # Corners of ``product((-1, 1), repeat=3)``; two triangles a side, facing out.
    [
        *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
        *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
    ]
)


@dataclass(frozen=True, eq=False)
class Solid:
    """One surface.

    Attributes:
        kind: "round", "box", "plane", "tube".
        vertices: [m].
        faces: Triangles.
    """

    kind: str
    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]


def solids(world: World, around: Float[np.ndarray, "3"]) -> list[Solid]:
    """Surfaces of a world's obstacles; a half-space is a square below ``around`` [m].

    Sampled obstacles, grids and point clouds, are ``sampled_points``.
    """
    found = []
    ends = zip(world.round_from, world.round_to, world.round_radius, strict=True)
    for begin, end, radius in ends:
        line, radii = _capsule(np.asarray(begin), np.asarray(end), float(radius))
        found.append(Solid("round", *tube_mesh(line, radii)))
    for frame, half in zip(world.box_frame, world.box_half, strict=True):
        corners = np.array(list(product((-1, 1), repeat=3))) * np.asarray(half)
        turn, shift = np.asarray(frame)[:3, :3], np.asarray(frame)[:3, 3]
        # The frame takes the world to the box: its inverse is the transpose.
        found.append(Solid("box", (corners - shift) @ turn, _BOX))
    for point, normal in zip(world.plane_point, world.plane_normal, strict=True):
        found.append(Solid("plane", *_square(np.asarray(point), np.asarray(normal), around)))
    for through, bore, wall in zip(world.tube_line, world.tube_bore, world.tube_wall, strict=True):
        radii_m = [float(bore)] if wall is None else [float(bore), float(bore) + float(wall)]
        found += [Solid("tube", *tube_mesh(np.asarray(through), r, 32)) for r in radii_m]
    return found


def sampled_points(world: World) -> Float[np.ndarray, "n 3"]:
    """Nodes next to the surface of the world's grids [m]."""
    found = [np.zeros((0, 3))]
    for grid in world.grids:
        spacing = np.asarray(grid.spacing)
        near = np.argwhere(np.abs(np.asarray(grid.values)) <= 0.6 * spacing.max())
        found.append(np.asarray(grid.origin) + near * spacing)
    return np.concatenate(found)


def _capsule(
    begin: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], radius: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Centre line and radii of a surface of revolution; a ball is a capsule of no length."""
    span = float(np.linalg.norm(end - begin))
    along = (end - begin) / span if span else np.array([0.0, 0.0, 1.0])
    # Not quite to the poles, where a ring would have no size.
    angle = np.linspace(-np.pi / 2, 0.0, 9)
    angle[0] += 1e-3
    place = np.concatenate([radius * np.sin(angle), span - radius * np.sin(angle[::-1])])
    radii = radius * np.cos(np.concatenate([angle, angle[::-1]]))
    keep = np.concatenate([[True], np.diff(place) > 1e-12])
    return begin + place[keep, None] * along, radii[keep]


def _square(
    point: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], around: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "4 3"], Int[np.ndarray, "2 3"]]:
    centre = around - ((around - point) @ normal) * normal
    side = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    side *= _PLANE / np.linalg.norm(side)
    other = np.cross(normal, side)
    corners = np.array([-side - other, side - other, side + other, -side + other])
    return centre + corners, np.array([(0, 1, 2), (0, 2, 3)])


def sampled_cloud(robot: Robot, samples: int, seed: int = 0) -> Float[np.ndarray, "n 3"]:
    """Tool positions of random configurations [m], in float32 as the sweeps have them.

    Uniform in the paper's coordinates, theta within its limits and phi in [0, 2 pi). Only the half
    of positive y in the arm's base frame is kept, so that one sees inside.
    """
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.0, robot.theta_max, (samples, robot.n_segments))
    phi = rng.uniform(0.0, 2 * np.pi, (samples, robot.n_segments))
    q = np.stack([theta, phi], axis=-1).reshape(samples, -1)
    poses = forward_kinematics(robot, jnp.asarray(q, jnp.float32))
    points = np.array(poses[:, :3, 3], dtype=np.float32)
    beyond = (points - robot.base[:3, 3]) @ robot.base[:3, 1]
    return points[beyond >= 0]


def sweep_cloud(
    robot: Robot, sweep: Sweep
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Middles of the reached cells [m] and their dexterity.

    A symmetric arm's cells are rings: half of each is drawn, so that one sees inside.

    Raises:
        ValueError: The sweep is of another robot.
    """
    theirs = sweep.about["robot"]
    for name, own in (
        ("length_m", robot.length),
        ("theta_max_rad", robot.theta_max),
        ("base", robot.base),
        ("tool", robot.tool),
    ):
        if np.shape(theirs[name]) != np.shape(own) or not np.allclose(theirs[name], own):
            raise ValueError(
                f"sweep: of robot {theirs['config']['name']!r}, whose {name} is {theirs[name]}; "
                f"that of {robot.config.name!r} is {np.asarray(own).tolist()}"
            )
    cells = sweep.cells
    r = (cells.r_edges[1:] + cells.r_edges[:-1]) / 2
    z = (cells.z_edges[1:] + cells.z_edges[:-1]) / 2
    sector, ring, level = np.nonzero(sweep.reached)
    values = sweep.dexterity[sector, ring, level]
    if cells.n_sectors == 1:
        azimuth = np.repeat(np.linspace(0.0, np.pi, _SECTORS), len(ring))
        ring, level = np.tile(ring, _SECTORS), np.tile(level, _SECTORS)
        values = np.tile(values, _SECTORS)
    else:
        azimuth = (sector + 0.5) * 2 * np.pi / cells.n_sectors
    points = np.stack([r[ring] * np.cos(azimuth), r[ring] * np.sin(azimuth), z[level]], axis=-1)
    return points @ robot.base[:3, :3].T + robot.base[:3, 3], values
