"""Poses as a person types them, or as a file lists them, to matrices."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

# Columns of a table, or keys of a JSON object: (positions, their scale to metres).
POSITIONS = {("x_mm", "y_mm", "z_mm"): 1e-3, ("x_m", "y_m", "z_m"): 1.0}
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
COLUMNS = (
    "x_mm y_mm z_mm (or x_m y_m z_m), then qw qx qy qz or roll_deg pitch_deg yaw_deg, or neither "
    "for an upright tool"
)


def pose_from(
    position_m: Any, quaternion: Any = None, rpy_deg: Any = None, *, where: str
) -> Float[np.ndarray, "4 4"]:
    """One pose of a position and an orientation, upright without one.

    Raises:
        ValueError: A quaternion whose norm is not 1, or a number that is not finite.
    """
    pose = np.eye(4)
    pose[:3, 3] = position_m
    if quaternion is not None:
        norm = float(np.linalg.norm(quaternion))
        if not abs(norm - 1) <= 1e-3:
            raise ValueError(f"{where}: quaternion has norm {norm:g}, must be 1")
        pose[:3, :3] = scipy.spatial.transform.Rotation.from_quat(
            quaternion, scalar_first=True
        ).as_matrix()
    elif rpy_deg is not None:
        pose[:3, :3] = scipy.spatial.transform.Rotation.from_euler(
            "xyz", rpy_deg, degrees=True
        ).as_matrix()
    if not np.isfinite(pose).all():
        raise ValueError(f"{where}: must be finite numbers")
    return pose


def read_poses(path: Path) -> Float[np.ndarray, "rows 4 4"]:
    """Poses of a file.

    A .csv file has a first line of column names (COLUMNS). A .json file has a list of objects with
    the same keys, of 4 x 4 matrices, or both. A .npy file has matrices (n, 4, 4) or (4, 4), or rows
    (n, 7) of x y z [m] and the quaternion qw qx qy qz. A .txt file has one matrix.

    Raises:
        ValueError: The message names the file and the row.
    """
    try:
        match path.suffix:
            case ".csv":
                return _from_csv(path)
            case ".json":
                return _from_json(path)
            case ".npy":
                return _from_array(path, np.load(path, allow_pickle=False))
            case ".txt":
                return _from_array(path, np.loadtxt(path))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from None
    raise ValueError(f"{path}: must end in .csv, .json, .npy or .txt")


def matrix_from(numbers: Any, *, where: str) -> Float[np.ndarray, "4 4"]:
    """A matrix of 16 numbers, or of 4 x 4."""
    try:
        matrix = np.array(numbers, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise ValueError(f"{where}: a matrix must be 16 numbers, row by row") from None
    return matrix


def _from_csv(path: Path) -> np.ndarray:
    with open(path, newline="", encoding="utf-8-sig") as file:
        lines = [line for line in csv.reader(file, skipinitialspace=True) if any(line)]
    if len(lines) < 2:
        raise ValueError(f"{path}: needs a line of column names and a line a pose")
    names = [name.strip() for name in lines[0]]
    poses = []
    for number, line in enumerate(lines[1:], start=1):
        where = f"{path}, pose {number}"
        if len(line) != len(names):
            raise ValueError(f"{where}: {len(line)} values for {len(names)} columns")
        poses.append(_from_names(dict(zip(names, line, strict=True)), where))
    return np.array(poses)


def _from_json(path: Path) -> np.ndarray:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not readable as JSON: {error}") from None
    if isinstance(document, Mapping):
        document = document.get("poses", [document])
    if not isinstance(document, list) or not document:
        raise ValueError(f"{path}: must be a list of poses, with at least one")
    poses = []
    for number, item in enumerate(document, start=1):
        where = f"{path}, pose {number}"
        given = item.get("matrix") if isinstance(item, Mapping) and "matrix" in item else item
        poses.append(
            _from_names(given, where)
            if isinstance(given, Mapping)
            else matrix_from(given, where=where)
        )
    return np.array(poses)


def _from_names(item: Mapping[str, Any], where: str) -> np.ndarray:
    """One row of named values."""
    known = {*QUATERNION, *ANGLES, *(name for names in POSITIONS for name in names)}
    unknown = [name for name in item if name not in known]
    if unknown:
        raise ValueError(f"{where}: no column {unknown[0]!r}; they are {COLUMNS}")

    def numbers(names: tuple[str, ...]) -> np.ndarray | None:
        given = [name for name in names if name in item]
        if not given:
            return None
        values = []
        for name in names:
            if name not in item:
                raise ValueError(f"{where}: {name} is missing beside {given[0]}")
            try:
                values.append(float(item[name]))
            except (TypeError, ValueError):
                raise ValueError(
                    f"{where}: {name} must be a number, found {item[name]!r}"
                ) from None
        if not np.isfinite(values).all():
            raise ValueError(f"{where}: {', '.join(names)} must be finite, found {values}")
        return np.array(values)

    positions = [(numbers(names), scale) for names, scale in POSITIONS.items()]
    found = [values * scale for values, scale in positions if values is not None]
    if len(found) != 1:
        raise ValueError(f"{where}: needs one position; columns are {COLUMNS}")
    quaternion, angles = numbers(QUATERNION), numbers(ANGLES)
    if quaternion is not None and angles is not None:
        raise ValueError(f"{where}: give either a quaternion or angles")
    return pose_from(found[0], quaternion, angles, where=where)


def _from_array(path: Path, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{path}: must hold numbers, found {array.dtype}")
    if array.ndim == 2 and array.shape[1] == 7:
        return np.array(
            [
                pose_from(row[:3], row[3:], where=f"{path}, pose {number}")
                for number, row in enumerate(array, start=1)
            ]
        )
    if array.shape == (4, 4):
        array = array[None]
    if array.ndim != 3 or array.shape[1:] != (4, 4) or not len(array):
        raise ValueError(f"{path}: must have shape (n, 4, 4) or (n, 7), found {array.shape}")
    return array.astype(np.float64)
