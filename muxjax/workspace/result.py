"""What a sweep found, and the file that holds it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from muxjax.workspace.cells import Cells
from muxjax.workspace.convergence import Limit, extrapolate
from muxjax.workspace.files import SweepFileError, read_file, write_file
from muxjax.workspace.orientation import TEST_ORIENTATIONS

SCHEMA = "muxjax/sweep/1"


@dataclass(frozen=True, eq=False)
class Sweep:
    """Reach and dexterity of a robot on cylindrical cells about its base axis.

    Tables have the shape of ``cells``: (sectors, radii, heights).
    """

    about: dict[str, Any]  # robot, seed, sampler, tolerance, bins and their error, versions
    cells: Cells
    samples: int
    counts: Int[np.ndarray, "A R Z"]  # samples in each cell, int64
    met: Int[np.ndarray, "A R Z"]  # test orientations met, of TEST_ORIENTATIONS
    met_bounds: Int[np.ndarray, "2 A R Z"]  # for the tolerance less and plus the typical bin error
    met_tests: Int[np.ndarray, "T C8"]  # which ones: a bit for each cell
    ladder_samples: Int[np.ndarray, " K"]  # sample counts at which the sweep was looked at
    ladder_met: Int[np.ndarray, "K A R Z"]
    # Of a sweep in a world: samples in each cell that were clear. Only they meet orientations.
    clear_counts: Int[np.ndarray, "A R Z"] | None = None

    @property
    def reached(self) -> Bool[np.ndarray, "A R Z"]:
        """Cells that some sample fell into."""
        return self.counts > 0

    @property
    def clear_share(self) -> Float[np.ndarray, "A R Z"]:
        """Share of the samples in each cell that are clear of the world, NaN where there are none.

        Raises:
            ValueError: The sweep had no world.
        """
        clear = self._clear()
        return np.where(self.reached, clear / np.maximum(self.counts, 1), np.nan)

    @property
    def clear_volume(self) -> float:
        """Volume of the cells that some clear sample fell into [m^3]."""
        return float(self.cells.volume[self._clear() > 0].sum())

    def _clear(self) -> Int[np.ndarray, "A R Z"]:
        if self.clear_counts is None:
            raise ValueError("clear_counts: the sweep had no world")
        return self.clear_counts

    @property
    def dexterity(self) -> Float[np.ndarray, "A R Z"]:
        """Share of the test orientations met, NaN where nothing was reached."""
        return self._share(self.met)

    @property
    def dexterity_bounds(self) -> Float[np.ndarray, "2 A R Z"]:
        """Dexterity for the tolerance less and plus the typical bin error."""
        return self._share(self.met_bounds)

    @property
    def half_plane(self) -> Float[np.ndarray, "R Z"]:
        """Dexterity in the r-z half plane; the mean over the azimuth sectors that reach a cell."""
        table, reached = self.dexterity, self.reached
        total = np.where(reached, table, 0.0).sum(axis=0)
        sectors = reached.sum(axis=0)
        return np.where(sectors > 0, total / np.maximum(sectors, 1), np.nan)

    @property
    def reach_radius(self) -> float:
        """Largest radius with a reached cell, its outer edge [m]."""
        rings = np.flatnonzero(self.reached.any(axis=(0, 2)))
        return float(self.cells.r_edges[rings[-1] + 1])

    @property
    def reach_volume(self) -> float:
        """Volume of the reached cells [m^3]."""
        return float(self.cells.volume[self.reached].sum())

    @property
    def mean_dexterity(self) -> float:
        """Dexterity averaged over the reached volume."""
        return float(self.mean_ladder[-1])

    @property
    def peak_dexterity(self) -> float:
        """Dexterity of the best cell."""
        return float(np.nanmax(self.dexterity))

    @property
    def mean_ladder(self) -> Float[np.ndarray, " K"]:
        """Mean dexterity at each sample count, over the volume that is reached at the end."""
        weight = np.where(self.reached, self.cells.volume, 0.0)
        met = (self.ladder_met * weight).sum(axis=(1, 2, 3))
        return met / weight.sum() / TEST_ORIENTATIONS

    def limit(self) -> Limit:
        """Mean dexterity extrapolated to endless sampling, with its uncertainty."""
        return extrapolate(self.ladder_samples, self.mean_ladder)

    def _share(self, met: np.ndarray) -> np.ndarray:
        return np.where(self.reached, met / TEST_ORIENTATIONS, np.nan)

    def save(self, path: str | Path) -> Path:
        """Write the one file that says everything about this sweep.

        Raises:
            ValueError: The path does not end in .npz.
        """
        path = Path(path)
        if path.suffix != ".npz":
            raise ValueError(f"path: must end in .npz, found {path}")
        cells = self.cells
        header = {
            "schema": SCHEMA,
            **self.about,
            "samples": self.samples,
            "cells": {
                "sectors": cells.n_sectors,
                "radii": cells.n_r,
                "heights": cells.n_z,
                "reach_m": cells.reach,
            },
        }
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        if self.clear_counts is not None:
            arrays["clear_counts"] = self.clear_counts
        write_file(path, header, arrays, compress=True)
        return path


_ARRAYS = ("counts", "met", "met_bounds", "met_tests", "ladder_samples", "ladder_met")


def load_sweep(path: str | Path) -> Sweep:
    """Read a sweep's file.

    Raises:
        SweepFileError: No such file, damaged, or not a sweep's; the message names the file.
    """
    path = Path(path)
    header, arrays = read_file(path, SCHEMA)
    try:
        sizes = header.pop("cells")
        cells = Cells(sizes["radii"], sizes["heights"], sizes["sectors"], sizes["reach_m"])
        samples = header.pop("samples")
        header.pop("schema")
        tables = {name: arrays[name] for name in _ARRAYS}
        clear = arrays.get("clear_counts")
        return Sweep(about=header, cells=cells, samples=samples, clear_counts=clear, **tables)
    except KeyError as error:
        raise SweepFileError(f"{path}: {error} is missing") from error
