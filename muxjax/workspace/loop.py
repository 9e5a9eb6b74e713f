"""The host side of a sweep: the loop, its checkpoints, and the ladder of looks at the table."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from muxjax.batched import chain
from muxjax.collision import World
from muxjax.robot import Robot
from muxjax.workspace import marking
from muxjax.workspace.about import about_sweep, identity_of
from muxjax.workspace.cells import Cells, cells_for
from muxjax.workspace.checkpoint import State, flush, save_checkpoint, start
from muxjax.workspace.marking import Layout, Scale
from muxjax.workspace.orientation import bin_error, count_met, n_bins, tests_met
from muxjax.workspace.progress import Progress
from muxjax.workspace.result import Sweep
from muxjax.workspace.sampling import BLOCK, MAX_SAMPLES, SAMPLERS, Sampler

CHECKPOINT_EVERY = 30.0  # seconds
_FIRST_LOOK = 8  # blocks; then at every doubling
_AGREE_EVERY = 64  # rounds between which several processes do not talk


class SweepInterruptedError(KeyboardInterrupt):
    """Ctrl-C during a sweep; the message says what was saved and where."""


def sweep(
    robot: Robot,
    *,
    samples: int,
    seed: int = 0,
    sampler: Sampler = "random",
    cells: tuple[int, int] | None = None,
    sectors: int | None = None,
    tolerance_deg: float = 10.0,
    bins_per_axis: int | None = None,
    world: World | None = None,
    out: str | Path | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    checkpoint_every_s: float = CHECKPOINT_EVERY,
    progress: bool | None = None,
) -> Sweep:
    """Reach and dexterity of a robot over all its configurations (M VI-C).

    Dexterity of a cell is the share of 4608 evenly spread orientations that some sample in the
    cell meets within the tolerance. The tables depend on the robot, the seed, the sampler and
    the grids alone: not on interruptions, nor on how many devices or processes took part. (A GPU
    rounds otherwise than a CPU: samples on the edge of a cell or bin may fall to its other side.)

    Under ``jax.distributed`` all processes call this with the same arguments, and all get the
    result; the first one writes files.

    Args:
        robot: The arm. Cells lie in its base frame.
        samples: How many configurations, 1 to 5.6e14.
        seed: 0 to 2^63 - 1.
        sampler: ``"random"`` or ``"lattice"``, see ``sampling``.
        cells: (radii, heights) of the half plane.
        sectors: Azimuth sectors, for arms that are not axially symmetric.
        tolerance_deg: Angle within which an orientation counts as met, 1 to 60 degrees.
        bins_per_axis: Fineness of the orientation bins, even; default 32 (typical error 2.5
            degrees), or 20 (4.0 degrees) where azimuth sectors need the memory.
        world: Obstacles. Every sample is then checked for clearance: all are counted, but only
            the clear ones make a cell dexterous. A world is not axially symmetric, so cells have
            azimuth sectors.
        out: File for the result, .npz.
        checkpoint: File to save progress in; also on Ctrl-C.
        resume: Go on from ``checkpoint`` if it exists.
        checkpoint_every_s: Seconds between checkpoints.
        progress: Show a bar; default: if standard error is a terminal.

    Raises:
        ValueError: An argument out of range; the message names it and the limit.
        SweepFileError: ``checkpoint`` is damaged, or of another sweep.
        SweepInterruptedError: Ctrl-C.
    """
    grid = cells_for(robot, cells, sectors, world is not None)
    symmetric = grid.n_sectors == 1
    per_axis = bins_per_axis or (32 if symmetric else 20)
    layout = Layout(grid.shape, per_axis, n_bins(per_axis, symmetric), sampler, world is not None)
    _check_arguments(layout, samples, seed, tolerance_deg, checkpoint, resume, out)
    about = about_sweep(robot, layout, seed, tolerance_deg, world)
    identity = identity_of(about, grid)
    path = Path(checkpoint) if checkpoint is not None else None
    state = start(layout, identity, path if resume else None, samples)
    scale = Scale(
        jax.tree.map(jnp.asarray, chain(robot)),
        jnp.asarray(robot.theta_max, jnp.float32),
        jnp.asarray(grid.reach, jnp.float32),
        None if world is None else jax.tree.map(_float32, (robot, world)),
    )
    tolerance = np.radians(tolerance_deg)
    widest = tolerance + bin_error(per_axis, symmetric).typical

    def look(marks: np.ndarray) -> np.ndarray:
        met = tests_met(marks, per_axis, symmetric, tolerance, widest)
        return count_met(met, layout.n_cells)

    def save() -> str:
        if path is None:
            return "nothing is saved, as no checkpoint was named"
        save_checkpoint(path, layout, identity, state)
        return f"saved in {path}"

    _run(layout, state, scale, seed, samples, look, save, checkpoint_every_s, progress)
    result = _finish(layout, state, grid, about, samples, tolerance, widest)
    if out is not None and jax.process_index() == 0:
        result.save(out)
    return result


def _float32(leaf: np.ndarray) -> jax.Array:
    return jnp.asarray(leaf, jnp.float32)


def _check_arguments(
    layout: Layout,
    samples: int,
    seed: int,
    tolerance_deg: float,
    checkpoint: str | Path | None,
    resume: bool,
    out: str | Path | None,
) -> None:
    if not 1 <= samples <= MAX_SAMPLES or samples != int(samples):
        raise ValueError(f"samples: must be a whole number, 1 to {MAX_SAMPLES:.2g}, not {samples}")
    if not 0 <= seed < 1 << 63:
        raise ValueError(f"seed: must be 0 to 2^63 - 1, found {seed}")
    if layout.sampler not in SAMPLERS:
        raise ValueError(f"sampler: must be one of {SAMPLERS}, found {layout.sampler!r}")
    if not 1 <= tolerance_deg <= 60:
        raise ValueError(f"tolerance_deg: must be 1 to 60, found {tolerance_deg}")
    if not 4 <= layout.per_axis <= 128 or layout.per_axis % 2:
        raise ValueError(f"bins_per_axis: must be even, 4 to 128, found {layout.per_axis}")
    size = layout.n_bins * layout.n_cells
    if size >= 1 << 31:
        raise ValueError(
            f"cells and bins_per_axis: {layout.n_cells} cells x {layout.n_bins} bins are "
            f"{size / 2**30:.1f} GiB, must be below 2 GiB"
        )
    if resume and checkpoint is None:
        raise ValueError("resume: needs a checkpoint file to go on from")
    if out is not None and Path(out).suffix != ".npz":
        raise ValueError(f"out: must end in .npz, found {out}")


def _run(
    layout: Layout,
    state: State,
    scale: Scale,
    seed: int,
    samples: int,
    look: Callable[[np.ndarray], np.ndarray],
    save: Callable[[], str],
    every_s: float,
    progress: bool | None,
) -> None:
    """Visit all blocks; look at the table at each doubling, save now and then."""
    blocks = marking.all_devices().size * layout.n_blocks  # of a round
    total = -(-samples // BLOCK)
    saved = time.monotonic()
    with _ctrl_c() as asked, Progress(samples, state.blocks * BLOCK, progress) as bar:
        rounds = 0
        while state.blocks < total:
            # A round never crosses the next look, so that every look sees whole doublings.
            stop = min(total, _next_look(state.blocks))
            last = min(stop * BLOCK, samples)
            state.tables = marking.visit_round(
                layout, state.tables, scale, seed, state.blocks, last
            )
            state.blocks = min(state.blocks + blocks, stop)
            state.unflushed += layout.n_blocks
            rounds += 1
            done = state.blocks == total
            if state.unflushed >= marking.BLOCKS_PER_FLUSH:
                flush(layout, state)
            if state.blocks == _next_look(state.blocks - 1) and not done:
                marks = marking.merged_marks(layout, state.tables)
                state.looks.append((state.blocks * BLOCK, look(marks)))
            bar.update(min(state.blocks * BLOCK, samples))
            if done:
                break
            stopping, due = _agreed(rounds, asked.is_set(), time.monotonic() - saved > every_s)
            if stopping or due:
                outcome = save()
                saved = time.monotonic()
                if stopping:
                    done_so_far = f"stopped after {state.blocks * BLOCK:.4g} samples"
                    raise SweepInterruptedError(f"{done_so_far}; {outcome}")
    flush(layout, state)


def _next_look(blocks: int) -> int:
    """The first look after this many blocks: 8, 16, 32, ..."""
    return max(_FIRST_LOOK, 1 << blocks.bit_length())


def _agreed(rounds: int, *flags: bool) -> tuple[bool, ...]:
    """Flags raised by any process; asked of the others only every so many rounds."""
    if jax.process_count() == 1:
        return flags
    if rounds % _AGREE_EVERY:
        return (False,) * len(flags)
    gathered = multihost_utils.process_allgather(np.array(flags))
    raised = np.asarray(gathered).reshape(-1, len(flags))
    return tuple(bool(np.any(column)) for column in raised.T)


@contextmanager
def _ctrl_c() -> Iterator[threading.Event]:
    """Ctrl-C sets the event in place of stopping mid-round, when the table belongs to nobody.

    A second one stops at once. Outside the main thread signals are left alone.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    before = signal.getsignal(signal.SIGINT)

    def handler(number: int, frame: Any) -> None:
        del number, frame
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    signal.signal(signal.SIGINT, handler)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)


def _finish(
    layout: Layout,
    state: State,
    grid: Cells,
    about: dict[str, Any],
    samples: int,
    tolerance: float,
    widest: float,
) -> Sweep:
    marks = marking.merged_marks(layout, state.tables)

    def met(angle: float) -> np.ndarray:
        return tests_met(marks, layout.per_axis, layout.in_plane, angle, widest)

    tests = met(tolerance)
    final = count_met(tests, layout.n_cells)
    bounds = [count_met(met(angle), layout.n_cells) for angle in (2 * tolerance - widest, widest)]
    looks = [*(look for look in state.looks if look[0] < samples), (samples, final)]
    return Sweep(
        about=about,
        cells=grid,
        samples=samples,
        counts=state.counts[: layout.n_cells].reshape(grid.shape),
        clear_counts=(
            state.counts[layout.n_cells :].reshape(grid.shape) if layout.in_world else None
        ),
        met=final.reshape(grid.shape),
        met_bounds=np.array(bounds).reshape(2, *grid.shape),
        met_tests=tests,
        ladder_samples=np.array([n for n, _ in looks], np.int64),
        ladder_met=np.array([m for _, m in looks], np.int32).reshape(-1, *grid.shape),
    )
