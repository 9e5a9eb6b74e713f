"""The cells that a sweep fills: where the tool is, seen from the arm's root.

Positions and orientations are taken in the base frame. Turning every phi_i by one angle a turns
the arm about its base axis: T becomes Rz(a) T Rz(-a), up to a constant turn in the tool frame. If
the tool's origin lies on the last segment's axis, its position turns by a and nothing else
changes, so all azimuths are equivalent: a pose is turned into the xz half plane, and its mirror
image in that plane is reached as well. Otherwise cells are also told apart by azimuth.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from muxjax.batched import Chain, Vector, pose_values
from muxjax.kinematics import forward_kinematics
from muxjax.robot import Robot
from muxjax.workspace.orientation import bin_index


def axially_symmetric(robot: Robot) -> bool:
    """Whether turning all bending azimuths turns the tool's position about the base axis.

    Decided on 32 random configurations with the kinematics themselves, to 1e-9 of the length.
    """
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.0, robot.theta_max, (32, robot.n_segments))
    phi = rng.uniform(0.0, 2 * np.pi, (32, robot.n_segments))
    angle = rng.uniform(0.5, 5.5, 32)
    places = []
    for azimuth in (phi, phi + angle[:, None]):
        q = np.stack([theta, azimuth], axis=-1).reshape(32, -1)
        poses = np.linalg.inv(np.asarray(robot.base)) @ forward_kinematics(robot, q)
        places.append(poses[:, :3, 3])
    before, after = places
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = before.T
    expected = np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
    return bool(np.max(np.abs(after - expected)) < 1e-9 * np.sum(robot.length))


@dataclass(frozen=True)
class Cells:
    """Cylindrical cells about the base axis: radius, azimuth sector, height."""

    n_r: int
    n_z: int
    n_sectors: int  # 1 for an axially symmetric arm
    reach: float  # r in [0, reach] and z in [-reach, reach] [m]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(sectors, radii, heights), the order of every table of a sweep."""
        return self.n_sectors, self.n_r, self.n_z

    @property
    def count(self) -> int:
        """Cells in all."""
        return self.n_sectors * self.n_r * self.n_z

    @property
    def r_edges(self) -> Float[np.ndarray, " R+1"]:
        """Radii between the cells [m]."""
        return np.linspace(0.0, self.reach, self.n_r + 1)

    @property
    def z_edges(self) -> Float[np.ndarray, " Z+1"]:
        """Heights between the cells [m]."""
        return np.linspace(-self.reach, self.reach, self.n_z + 1)

    @property
    def volume(self) -> Float[np.ndarray, "A R Z"]:
        """Volume of each cell [m^3]."""
        ring = np.pi * np.diff(self.r_edges**2) / self.n_sectors
        return np.broadcast_to((ring[:, None] * np.diff(self.z_edges))[None], self.shape)


def cells_for(
    robot: Robot, shape: tuple[int, int] | None, sectors: int | None, in_world: bool = False
) -> Cells:
    """Cells that hold every pose of a robot.

    Args:
        robot: The arm.
        shape: (radii, heights); default (48, 96), or (16, 32) where azimuth counts too.
        sectors: Azimuth sectors; default 1 for an axially symmetric arm, 12 for another.
        in_world: Among obstacles, which make every arm unsymmetric.

    Raises:
        ValueError: A count below 1, or one sector for an arm that is not symmetric.
    """
    symmetric = not in_world and axially_symmetric(robot)
    n_r, n_z = shape or ((48, 96) if symmetric else (16, 32))
    n_sectors = sectors or (1 if symmetric else 12)
    if min(n_r, n_z, n_sectors) < 1:
        raise ValueError(f"cells: counts must be at least 1, found {(n_r, n_z)}, {n_sectors}")
    if symmetric != (n_sectors == 1):
        raise ValueError(
            "sectors: must be 1 for an axially symmetric arm without obstacles, more for another; "
            f"{n_sectors} found, and this arm is {'' if symmetric else 'not '}symmetric"
        )
    tool = np.asarray(robot.tool)[:3, 3]
    reach = float(np.sum(robot.length) + np.linalg.norm(tool))
    return Cells(int(n_r), int(n_z), int(n_sectors), reach)


def slot_index(
    arm: Chain, u: Vector, reach: jax.Array, shape: tuple[int, int, int], per_axis: int
) -> jax.Array:
    """Where each configuration leaves its mark: bin * cells + cell, int32.

    Args:
        arm: The robot.
        u: Cartesian bending, 2S arrays [rad].
        reach: Half height of the cells [m].
        shape: (sectors, radii, heights).
        per_axis: Orientation bins, see ``orientation.bin_index``.
    """
    sectors, n_r, n_z = shape
    x, y, z, *q = pose_values(arm, u, "quaternion", in_base=True)
    square = x * x + y * y
    inverse = inverse_root(square)
    cell = _place(square * inverse * (1 / reach), n_r)
    if sectors == 1:
        # On the axis every azimuth is as good as another; but it must be one.
        c, s = jnp.where(square > 0, x * inverse, 1), y * inverse
        q = [q[0], c * q[1] + s * q[2], c * q[2] - s * q[1], q[3]]
    else:
        azimuth = jnp.arctan2(y, x) * np.float32(0.5 / np.pi)
        cell = _place(azimuth - jnp.floor(azimuth), sectors) * n_r + cell
    cell = cell * n_z + _place(0.5 + z * (0.5 / reach), n_z)
    orientation = bin_index(q, per_axis, mirrored=sectors == 1)
    return orientation * (sectors * n_r * n_z) + cell


def inverse_root(square: jax.Array) -> jax.Array:
    """1 / sqrt of float32 numbers, to 2e-7; finite at 0.

    The exponent is halved in the bits, three Newton steps do the rest. XLA counts rsqrt as
    expensive, and would cut the kernel around it into four that each draw the samples again.
    """
    bits = jax.lax.bitcast_convert_type(square, jnp.int32)
    root = jax.lax.bitcast_convert_type(np.int32(0x5F3759DF) - (bits >> 1), jnp.float32)
    for _ in range(3):
        root = root * (np.float32(1.5) - (np.float32(0.5) * square * root) * root)
    return root


def _place(fraction: jax.Array, count: int) -> jax.Array:
    """Interval of [0, 1] that holds a fraction; rounding at the ends stays inside."""
    return jnp.clip((fraction * np.float32(count)).astype(jnp.int32), 0, count - 1)
