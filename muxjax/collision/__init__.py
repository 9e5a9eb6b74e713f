"""The arm among obstacles: signed distances, differentiable and on the safe side.

Obstacles are spheres, capsules, boxes, half-spaces, bent tubes, grids of signed distances and point
clouds; a world lists them in a YAML file, with the shape of the tool if it matters (``world``).
A distance is positive where the arm is clear and minus the depth where it is not (``arm``).
"""

from muxjax.collision.arm import (
    MOUNT,
    POINTS,
    Tightest,
    bending_clearance,
    clearance,
    part_clearances,
    tightest,
)
from muxjax.collision.distances import point_distance
from muxjax.collision.sampled import Grid
from muxjax.collision.world import (
    CapsuleConfig,
    SphereConfig,
    World,
    WorldConfig,
    attach,
    load_world,
    world_from_config,
)

__all__ = [
    "MOUNT",
    "POINTS",
    "CapsuleConfig",
    "Grid",
    "SphereConfig",
    "Tightest",
    "World",
    "WorldConfig",
    "attach",
    "bending_clearance",
    "clearance",
    "load_world",
    "part_clearances",
    "point_distance",
    "tightest",
    "world_from_config",
]
