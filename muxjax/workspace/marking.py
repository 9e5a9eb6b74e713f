"""The device side of a sweep: samples in, marks in a table out.

Every device holds its own table of all bins and cells, one byte each, and takes every D-th block,
or K blocks in a row where one would not fill it.
Tables of several devices, in one process or many, are merged by a maximum: marks are either set
or not, so the order of merging, the number of devices and a repeated block change nothing.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Bool, Int32, UInt8, UInt32

from muxjax.batched import WIDE_VECTORS, Chain, Vector
from muxjax.collision import World, bending_clearance
from muxjax.robot import Robot
from muxjax.workspace.cells import slot_index
from muxjax.workspace.sampling import (
    BLOCK,
    COLUMNS,
    ROWS,
    Sampler,
    bending_of,
    lattice_fractions,
    lattice_parts,
    random_fractions,
)

_AXIS = "device"
BLOCKS_PER_FLUSH = 1 << 13  # 2^13 blocks of 2^17 samples: an int32 count cannot reach 2^31
# Blocks of a device in a round. On a CPU one fits the cache; a GPU waits for the host unless it is
# given many, and in a world each sample needs some kilobytes.
BLOCKS, BLOCKS_ELSEWHERE, BLOCKS_IN_WORLD = 1, 64, 4


class Tables(NamedTuple):
    """Marks and counts of each device."""

    marks: UInt8[jax.Array, "D B*C"]  # bin * cells + cell: 1 if some sample fell there
    # Samples in each cell since the last flush; in a world, followed by those that were clear.
    counts: Int32[jax.Array, "D K"]


class Layout(NamedTuple):
    """What a compiled sweep depends on."""

    shape: tuple[int, int, int]  # (sectors, radii, heights)
    per_axis: int  # orientation bins
    n_bins: int
    sampler: Sampler
    in_world: bool = False  # only clear samples leave marks; all are counted

    @property
    def n_blocks(self) -> int:
        """Blocks that a device takes in a round."""
        if _on_cpu():
            return BLOCKS
        return BLOCKS_IN_WORLD if self.in_world else BLOCKS_ELSEWHERE

    @property
    def n_counts(self) -> int:
        """Of all samples, and of the clear ones if there is a world."""
        return self.n_cells * (1 + self.in_world)

    @property
    def n_cells(self) -> int:
        """Cells in all."""
        return int(np.prod(self.shape))

    @property
    def in_plane(self) -> bool:
        """The arm is axially symmetric: phi_1 is not sampled, poses are turned into one plane."""
        return self.shape[0] == 1


class Scale(NamedTuple):
    """The robot of a sweep; none of it is compiled in, so that designs share a compilation."""

    arm: Chain
    theta_max: jax.Array
    reach: jax.Array
    arena: tuple[Robot, World] | None = None  # for the clearance of samples


@lru_cache(maxsize=1)
def all_devices() -> Mesh:
    """The devices of all processes, as one axis."""
    return Mesh(np.array(jax.devices()), (_AXIS,))


def _on_cpu() -> bool:
    return all_devices().devices.flat[0].platform == "cpu"


def new_tables(layout: Layout, marks: np.ndarray | None = None) -> Tables:
    """Empty tables; or with the given marks, of size (bins * cells,), on the first device."""
    mesh = all_devices()
    sharding = NamedSharding(mesh, PartitionSpec(_AXIS))
    size = layout.n_bins * layout.n_cells

    if marks is None:
        empty = jnp.zeros((mesh.size, size), jnp.uint8, device=sharding)
        return Tables(empty, _zero_counts(layout))

    def rows(index: Any) -> np.ndarray:
        first = index[0].start in (0, None)
        return marks[None] if first else np.zeros((1, size), np.uint8)

    filled = jax.make_array_from_callback((mesh.size, size), sharding, rows)
    return Tables(filled, _zero_counts(layout))


def _zero_counts(layout: Layout) -> jax.Array:
    mesh = all_devices()
    return jax.make_array_from_callback(
        (mesh.size, layout.n_counts),
        NamedSharding(mesh, PartitionSpec(_AXIS)),
        lambda index: np.zeros((1, layout.n_counts), np.int32),
    )


def visit_round(
    layout: Layout, tables: Tables, scale: Scale, seed: int, first: int, samples: int
) -> Tables:
    """Every device marks K blocks, ``first`` ... ``first`` + D K - 1 in all, up to ``samples``."""
    mesh = all_devices()
    whole, rest = divmod(samples, BLOCK)
    limits = np.array([first, whole, rest], np.uint32)
    dimensions = 2 * len(scale.arm.n_discs) - layout.in_plane
    if layout.sampler == "random":
        draws: tuple[Any, ...] = (np.array([seed, seed >> 32], np.uint64).astype(np.uint32),)
    else:
        # Beyond the end a device repeats block 0, which changes nothing.
        last = first + mesh.size * layout.n_blocks
        blocks = [b if b * BLOCK < samples else 0 for b in range(first, last)]
        parts = [lattice_parts(dimensions, seed, block) for block in blocks]
        rows = np.stack([rows for rows, _ in parts])
        # Each device is handed its own: picking it on the device would undo the vector code.
        sharding = NamedSharding(mesh, PartitionSpec(_AXIS))
        own = jax.make_array_from_callback(rows.shape, sharding, lambda index: rows[index])
        draws = (own, parts[0][1])
    slots, clear, mark = _compiled_round(layout, layout.n_blocks, dimensions, mesh)
    seen = clear(scale, limits, draws) if layout.in_world else None
    return mark(tables, slots(scale._replace(arena=None), limits, draws), seen, limits)


@lru_cache(maxsize=16)
def _compiled_round(
    layout: Layout, n_blocks: int, dimensions: int, mesh: Mesh
) -> tuple[Any, Any, Any]:
    """Samples to slots, samples to whether they are clear, and both to marks.

    They are several programs because XLA would otherwise compute the samples again inside the
    scatters, one by one, at ten times the cost.
    """
    split, same = PartitionSpec(_AXIS), PartitionSpec()
    slots, clear = (
        jax.shard_map(
            partial(block, layout, n_blocks, dimensions),
            mesh=mesh,
            in_specs=(same, same, (same,) if layout.sampler == "random" else (split, same)),
            out_specs=split,
        )
        for block in (_block_slots, _block_clear)
    )
    mark = jax.shard_map(
        partial(_mark, layout, n_blocks),
        mesh=mesh,
        in_specs=(split, split, split, same),
        out_specs=split,
    )
    return (
        jax.jit(slots, compiler_options=WIDE_VECTORS),
        jax.jit(clear),
        jax.jit(mark, donate_argnums=0),
    )


def _assignment(
    n_blocks: int, limits: UInt32[jax.Array, " 3"]
) -> tuple[UInt32[jax.Array, " K"], UInt32[jax.Array, " K"]]:
    """This device's blocks in a round and how many of their samples are wanted.

    A device without work repeats block 0 with no sample counted, which changes nothing: marking
    twice is marking once, and block 0 is part of every sweep.
    """
    own = lax.axis_index(_AXIS).astype(jnp.uint32) * np.uint32(n_blocks)
    wanted = limits[0] + own + lax.iota(jnp.uint32, n_blocks)
    whole, rest = limits[1], limits[2]
    valid = jnp.where(wanted < whole, np.uint32(BLOCK), jnp.where(wanted == whole, rest, 0))
    return jnp.where(valid > 0, wanted, 0), valid


def _block_slots(
    layout: Layout,
    n_blocks: int,
    dimensions: int,
    scale: Scale,
    limits: UInt32[jax.Array, " 3"],
    draws: tuple[jax.Array, ...],
) -> Int32[jax.Array, "K*R C"]:
    """Slots of one device's blocks, all their lanes."""
    u = _block_bending(layout, n_blocks, dimensions, scale, limits, draws)
    # Not flattened here: a one-dimensional loop over outer sums is not vectorised.
    return slot_index(scale.arm, u, scale.reach, layout.shape, layout.per_axis)


def _block_clear(
    layout: Layout,
    n_blocks: int,
    dimensions: int,
    scale: Scale,
    limits: UInt32[jax.Array, " 3"],
    draws: tuple[jax.Array, ...],
) -> Bool[jax.Array, "K*R C"]:
    """Whether each lane of one device's blocks is clear of the world and of itself."""
    assert scale.arena is not None
    robot, world = scale.arena
    u = jnp.stack(_block_bending(layout, n_blocks, dimensions, scale, limits, draws), axis=-1)
    return jnp.asarray(bending_clearance(robot, u.reshape(*u.shape[:-1], -1, 2), world) >= 0)


def _block_bending(
    layout: Layout,
    n_blocks: int,
    dimensions: int,
    scale: Scale,
    limits: UInt32[jax.Array, " 3"],
    draws: tuple[jax.Array, ...],
) -> Vector:
    """Bending of one device's blocks, one below the other, arrays (K R, C)."""
    if layout.sampler == "random":
        shape = (n_blocks * ROWS, COLUMNS)
        lane = lax.broadcasted_iota(jnp.uint32, shape, 0) % np.uint32(ROWS) * np.uint32(COLUMNS)
        lane = lane + lax.broadcasted_iota(jnp.uint32, shape, 1)
        block = jnp.repeat(_assignment(n_blocks, limits)[0], ROWS)[:, None]
        fractions = random_fractions(draws[0], block, lane, dimensions)
    else:
        rows = jnp.moveaxis(draws[0], 0, 1).reshape(dimensions, -1)
        fractions = lattice_fractions(rows, draws[1])
    return bending_of(scale.arm, scale.theta_max, fractions, layout.in_plane)


def _mark(
    layout: Layout,
    n_blocks: int,
    tables: Tables,
    slots: Int32[jax.Array, "K*R C"],
    clear: Bool[jax.Array, "K*R C"] | None,
    limits: UInt32[jax.Array, " 3"],
) -> Tables:
    """Set the marks of one device's blocks and count their wanted samples.

    Lanes beyond the last sample repeat lane 0 of their block, uncounted.
    """
    _, valid = _assignment(n_blocks, limits)
    wanted = lax.broadcasted_iota(jnp.uint32, (n_blocks, BLOCK), 1) < valid[:, None]
    slot = jnp.where(wanted, slots.reshape(n_blocks, BLOCK), slots[::ROWS, :1]).reshape(-1)
    wanted = wanted.reshape(-1)
    cell = slot % layout.n_cells
    counts = tables.counts.at[0, cell].add(wanted.astype(jnp.int32), mode="promise_in_bounds")
    if clear is None:
        marks = tables.marks.at[0, slot].set(np.uint8(1), mode="promise_in_bounds")
        return Tables(marks, counts)
    free = wanted & clear.reshape(-1)
    return Tables(
        tables.marks.at[0, slot].max(free.astype(jnp.uint8), mode="promise_in_bounds"),
        counts.at[0, layout.n_cells + cell].add(free.astype(jnp.int32), mode="promise_in_bounds"),
    )


def merged_marks(layout: Layout, tables: Tables) -> np.ndarray:
    """Marks of all devices together, bits of cells, shape (bins, ceil(cells / 8))."""
    merged = tables.marks if all_devices().size == 1 else _largest()(tables.marks)
    marks, shape = merged.addressable_data(0), (layout.n_bins, layout.n_cells)
    if _on_cpu():
        return np.packbits(np.asarray(marks).reshape(shape), axis=1)
    return np.asarray(_packed(marks, shape))  # an eighth of the bytes leaves the GPU


def flush_counts(layout: Layout, tables: Tables) -> tuple[Tables, np.ndarray]:
    """Counts of all devices since the last flush as int64, and tables that count from zero."""
    total = _summed()(tables.counts) if all_devices().size > 1 else tables.counts
    # Many devices' sums would leave int32, so they are gathered, not added, on the device.
    counts = np.asarray(total.addressable_data(0), np.int64).reshape(-1, layout.n_counts)
    return Tables(tables.marks, _zero_counts(layout)), counts.sum(axis=0)


@partial(jax.jit, static_argnums=1)
def _packed(marks: UInt8[jax.Array, "1 B*C"], shape: tuple[int, int]) -> UInt8[jax.Array, "B C8"]:
    return jnp.packbits(marks.reshape(shape), axis=1)


@lru_cache(maxsize=1)
def _largest() -> Any:
    return jax.jit(
        jax.shard_map(
            lambda marks: lax.pmax(marks, _AXIS),
            mesh=all_devices(),
            in_specs=PartitionSpec(_AXIS),
            out_specs=PartitionSpec(),
        )
    )


@lru_cache(maxsize=1)
def _summed() -> Any:
    mesh = all_devices()
    return jax.jit(lambda counts: counts, out_shardings=NamedSharding(mesh, PartitionSpec()))


def unpacked_marks(layout: Layout, packed: np.ndarray) -> np.ndarray:
    """Inverse of ``merged_marks``'s packing, shape (bins * cells,)."""
    return np.unpackbits(packed, axis=1, count=layout.n_cells).reshape(-1)
