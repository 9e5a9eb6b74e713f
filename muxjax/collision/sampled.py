"""Obstacles that come as numbers: grids of signed distances, and point clouds made into them."""

from __future__ import annotations

import zipfile
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Float

from muxjax.config import ConfigError, Vector3

Array = jax.Array | np.ndarray

MOST_NODES = 1 << 24  # of a grid: 128 MiB
PADDING = 0.06  # of a point cloud's grid around the points [m], about what an arm is thick


class Grid(eqx.Module):
    """Signed distances on a regular grid, in the world's axes."""

    values: Float[Array, "X Y Z"]  # [m], negative inside obstacles
    origin: Float[Array, " 3"]  # place of values[0, 0, 0] [m]
    spacing: Float[Array, " 3"]  # [m]
    free: bool = eqx.field(static=True)  # no obstacle reaches beyond the grid


def read_grid(
    where: str,
    path: Path,
    origin: Vector3 | None,
    spacing: float | tuple[float, float, float] | None,
    free: bool,
) -> Grid:
    """Grid of an .npz file (values, origin, spacing), or of an .npy file with the other two given.

    Raises:
        ConfigError: Names the obstacle, the file and what is wrong with it.
    """
    if path.suffix == ".npz":
        if origin is not None or spacing is not None:
            raise ConfigError(f"{where}: origin_m and spacing_m stand in {path.name} itself")
        stored = _arrays(where, path)
        missing = [name for name in ("values", "origin", "spacing") if name not in stored]
        if missing:
            raise ConfigError(f"{where}: {path} holds no array {', '.join(missing)}")
        values, begin, step = (stored[name] for name in ("values", "origin", "spacing"))
    elif path.suffix == ".npy":
        if origin is None or spacing is None:
            raise ConfigError(f"{where}: an .npy file needs origin_m and spacing_m beside it")
        values = _arrays(where, path)["values"]
        begin, step = np.array(origin), np.array(spacing)
    else:
        raise ConfigError(f"{where}.file: must end in .npz or .npy, found {path.name}")
    if values.ndim != 3 or min(values.shape) < 2 or values.size > MOST_NODES:
        raise ConfigError(
            f"{where}: {path}: values must have three axes of at least 2 and at most {MOST_NODES} "
            f"entries in all, found shape {values.shape}"
        )
    if begin.shape != (3,) or step.shape not in ((), (1,), (3,)):
        raise ConfigError(
            f"{where}: {path}: origin must be 3 numbers and spacing 1 or 3, "
            f"found shapes {begin.shape} and {step.shape}"
        )
    for name, array in (("values", values), ("origin", begin), ("spacing", step)):
        _finite(where, path, name, array)
    if (step <= 0).any():
        raise ConfigError(f"{where}: {path}: spacing must be above 0, found {step.tolist()}")
    return Grid(
        values.astype(np.float64),
        begin.astype(np.float64),
        np.broadcast_to(step.astype(np.float64), 3).copy(),
        free,
    )


def read_points(where: str, path: Path) -> Float[np.ndarray, "n 3"]:
    """Points [m] of an .npy file, an .npz file (array ``points``), or text with x y z a line.

    Raises:
        ConfigError: Names the obstacle, the file and what is wrong with it.
    """
    if path.suffix in {".npy", ".npz"}:
        stored = _arrays(where, path)
        name = "points" if path.suffix == ".npz" else "values"
        if name not in stored:
            raise ConfigError(f"{where}: {path} holds no array points")
        points = stored[name]
    elif path.suffix in {".csv", ".xyz"}:
        points = _text_points(where, path)
    else:
        raise ConfigError(f"{where}.file: must end in .npy, .npz, .csv or .xyz, found {path.name}")
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ConfigError(f"{where}: {path}: must be n x 3 numbers, found shape {points.shape}")
    _finite(where, path, "points", points)
    return points.astype(np.float64)


def _text_points(where: str, path: Path) -> np.ndarray:
    """Three numbers a line, apart by commas or spaces; a first line of names is skipped."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{where}: {path} cannot be read: {error}") from None
    rows = []
    for number, line in enumerate(lines, start=1):
        cells = line.replace(",", " ").split()
        if not cells or cells[0].startswith("#"):
            continue
        try:
            if len(cells) != 3:
                raise ValueError
            rows.append([float(cell) for cell in cells])
        except ValueError:
            if number > 1:
                raise ConfigError(
                    f"{where}: {path}, line {number}: must be three numbers, found {line[:60]!r}"
                ) from None
    return np.array(rows).reshape(-1, 3)


def around_points(
    where: str, points: Float[np.ndarray, "n 3"], radius: float, spacing: float
) -> Grid:
    """Signed distance to balls about points, exact at the nodes of a grid around them.

    Raises:
        ConfigError: So fine a grid that it has more than MOST_NODES nodes.
    """
    low, high = points.min(axis=0) - radius - PADDING, points.max(axis=0) + radius + PADDING
    counts = np.ceil((high - low) / spacing).astype(np.int64) + 1
    if np.prod(counts.astype(float)) > MOST_NODES:
        raise ConfigError(
            f"{where}.spacing_m: {spacing:g} m over {np.round(high - low, 3).tolist()} m makes "
            f"{np.prod(counts.astype(float)):.3g} nodes, at most {MOST_NODES}"
        )
    axes = [low[k] + spacing * np.arange(counts[k]) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    away, _ = scipy.spatial.cKDTree(points).query(nodes.reshape(-1, 3))
    return Grid(away.reshape(counts) - radius, low, np.full(3, spacing), free=True)


def _arrays(where: str, path: Path) -> dict[str, np.ndarray]:
    """Arrays of an .npz file, or the one of an .npy file as ``values``."""
    if not path.is_file():
        raise ConfigError(f"{where}: {path}: no such file")
    try:
        stored = np.load(path, allow_pickle=False)
        found = (
            {"values": stored}
            if isinstance(stored, np.ndarray)
            else {name: stored[name] for name in stored.files}
        )
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{where}: {path} is not readable as arrays: {error}") from None
    for name, array in found.items():
        if array.dtype.kind not in "iuf":
            raise ConfigError(f"{where}: {path}: {name} must be numbers, found {array.dtype}")
    return found


def _finite(where: str, path: Path, name: str, array: np.ndarray) -> None:
    wrong = np.argwhere(~np.isfinite(array))
    if len(wrong):
        index = tuple(int(i) for i in wrong[0])
        raise ConfigError(f"{where}: {path}: {name} entry {index} is {array[index]}, not finite")
