"""Where a sweep stands, and the file from which it can go on."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np

from muxjax.workspace import marking
from muxjax.workspace.files import SweepFileError, read_file, write_file
from muxjax.workspace.marking import Layout, Tables
from muxjax.workspace.sampling import BLOCK

CHECKPOINT_SCHEMA = "muxjax/sweep-checkpoint/1"


@dataclass
class State:
    """What a checkpoint holds, apart from the marks."""

    tables: Tables
    blocks: int = 0  # done by all devices together
    counts: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    looks: list[tuple[int, np.ndarray]] = field(default_factory=list)  # (samples, met)
    unflushed: int = 0  # blocks of each device


def start(layout: Layout, identity: str, path: Path | None, samples: int) -> State:
    """A fresh state, or that of a checkpoint if there is one."""
    if path is None or not path.exists():
        return State(marking.new_tables(layout), counts=np.zeros(layout.n_counts, np.int64))
    header, arrays = read_file(path, CHECKPOINT_SCHEMA)
    if header["identity"] != identity:
        raise SweepFileError(
            f"{path}: is of another sweep (robot, world, seed, sampler, cells or bins differ)"
        )
    blocks = header["blocks"]
    if blocks > -(-samples // BLOCK) or (blocks * BLOCK > samples):
        raise SweepFileError(
            f"{path}: already holds {blocks * BLOCK} samples, more than the {samples} asked for"
        )
    marks = marking.unpacked_marks(layout, arrays["marks"])
    looks = list(zip(header["looks"], arrays["looks"], strict=True))
    return State(marking.new_tables(layout, marks), blocks, arrays["counts"], looks)


def save_checkpoint(path: Path, layout: Layout, identity: str, state: State) -> None:
    """Merge what all devices have and write it; every process takes part, the first writes."""
    marks = marking.merged_marks(layout, state.tables)
    flush(layout, state)
    if jax.process_index() != 0:
        return
    header = {
        "schema": CHECKPOINT_SCHEMA,
        "identity": identity,
        "blocks": state.blocks,
        "looks": [samples for samples, _ in state.looks],
    }
    looks = np.array([met for _, met in state.looks], np.int32).reshape(-1, layout.n_cells)
    write_file(
        path, header, {"marks": marks, "counts": state.counts, "looks": looks}, compress=False
    )


def flush(layout: Layout, state: State) -> None:
    """Move the devices' counts into the state's int64 ones."""
    state.tables, new = marking.flush_counts(layout, state.tables)
    state.counts = state.counts + new
    state.unflushed = 0
