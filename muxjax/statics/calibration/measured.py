"""Measured readings and tip poses from a CSV file, checked row by row.

One row a static posture, SI units, a header line with these columns:

==============================  ============================================================
``tension_1_n`` ...             tension of every tendon [N], at least 0
``displacement_1_m`` ...        displacement of every tendon's end [m], negative = wound in
``x_m``, ``y_m``, ``z_m``       measured tip position in the world [m]
``qw``, ``qx``, ``qy``, ``qz``  measured tip orientation in the world, all four or none
``force_x_n``, ``_y_``, ``_z_`` known force on the tip, base frame [N]; 0 where left out
``moment_x_nm``, ...            known moment on the tip, base frame [N m]; 0 where left out
==============================  ============================================================

Either tensions or displacements drive the model. With both, displacements drive it and tensions
are compared with what it says.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from jaxtyping import Float, Int

from muxjax.statics.chain import ElasticChain
from muxjax.statics.checks import tendon_lengths
from muxjax.statics.newton import Given

POSITION = ("x_m", "y_m", "z_m")
QUATERNION = ("qw", "qx", "qy", "qz")
WRENCH = ("moment_x_nm", "moment_y_nm", "moment_z_nm", "force_x_n", "force_y_n", "force_z_n")


@dataclass(frozen=True)
class Measurements:
    """Readings that drive the model, and what was measured then. R rows, m tendons."""

    kind: Given
    given: Float[np.ndarray, "R m"]  # [N] or [m]
    position: Float[np.ndarray, "R 3"]  # [m]
    rotation: Float[np.ndarray, "R 3 3"] | None = None
    tension: Float[np.ndarray, "R m"] | None = None  # compared, where lengths drive the model [N]
    wrench: Float[np.ndarray, "R 6"] | None = None  # (moment, force) on the tip, dead
    lines: Int[np.ndarray, " R"] | None = None  # of the file
    source: str = "data"

    @property
    def n_rows(self) -> int:
        """R."""
        return len(self.given)

    def row_name(self, row: int) -> str:
        """How messages call a row, counted from 0 here."""
        return f"{self.source}, " + (
            f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"
        )


def read_measurements(path: str | Path, chain: ElasticChain) -> Measurements:
    """Read a CSV file of the columns at the top of this module.

    Args:
        path: The file.
        chain: Whose tendons the columns are; its size also tells millimetres from metres.

    Raises:
        ValueError: No such file, missing or unknown columns, text, NaN, negative tension, a
            quaternion that is not of length 1, or values that look like another unit; names line
            and column.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file")
    columns, lines = _columns(Path(path))
    source = Path(path).name
    m = chain.n_tendons
    tensions = [f"tension_{k}_n" for k in range(1, m + 1)]
    displacements = [f"displacement_{k}_m" for k in range(1, m + 1)]
    known = {*tensions, *displacements, *POSITION, *QUATERNION, *WRENCH}
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise ValueError(
            f"{source}: unknown column {unknown[0]!r}; known are tension_1_n to tension_{m}_n, "
            f"displacement_1_m to displacement_{m}_m, {', '.join((*POSITION, *QUATERNION))}, "
            f"{', '.join(WRENCH)}"
        )
    present = {}
    for group in (tensions, displacements, POSITION, QUATERNION):
        missing = [name for name in group if name not in columns]
        if missing and (len(missing) < len(group) or group is POSITION):
            raise ValueError(f"{source}: column {missing[0]} is missing")
        if not missing:
            present[group[0]] = np.stack([columns[name] for name in group], axis=-1)
    tension, length = present.get(tensions[0]), present.get(displacements[0])
    if tension is None and length is None:
        raise ValueError(
            f"{source}: needs tension_1_n to tension_{m}_n or displacement_1_m to "
            f"displacement_{m}_m, one column for each tendon of {chain.name}"
        )
    wrench = None
    if any(name in columns for name in WRENCH):
        zero = np.zeros(len(lines))
        wrench = np.stack([columns.get(name, zero) for name in WRENCH], axis=-1)
    quaternion = present.get(QUATERNION[0])
    _check_quaternion(quaternion, lines, source)
    found = Measurements(
        kind="tension" if length is None else "displacements",
        given=tension if length is None else length,  # type: ignore[arg-type]
        position=present[POSITION[0]],
        rotation=_rotation(quaternion),
        tension=None if length is None else tension,
        wrench=wrench,
        lines=lines,
        source=source,
    )
    _check_sizes(found, chain, tension)
    return found


def _columns(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Every column as numbers, and each row's line in the file."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(reader, [])]
        if not any(header):
            raise ValueError(f"{path.name}: empty, expected a header line of column names")
        twice = [name for name in header if header.count(name) > 1]
        if twice:
            raise ValueError(f"{path.name}: column {twice[0]!r} stands twice in the header")
        rows, lines = [], []
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            where = f"{path.name}, line {reader.line_num}"
            if len(row) != len(header):
                raise ValueError(f"{where}: {len(row)} values for {len(header)} columns")
            rows.append([_number(c, f"{where}, {n}") for c, n in zip(row, header, strict=True)])
            lines.append(reader.line_num)
    if not rows:
        raise ValueError(f"{path.name}: no rows below the header")
    return dict(zip(header, np.array(rows).T, strict=True)), np.array(lines)


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise ValueError(f"{where}: expected a number, found {cell.strip()!r}") from None
    if not math.isfinite(value):
        raise ValueError(f"{where}: is {value:g}, must be finite")
    return value


def _check_quaternion(values: np.ndarray | None, lines: np.ndarray, source: str) -> None:
    if values is None:
        return
    norm = np.linalg.norm(values, axis=-1)
    wrong = np.flatnonzero(abs(norm - 1) > 0.01)
    if len(wrong):
        raise ValueError(
            f"{source}, line {lines[wrong[0]]}, qw to qz: length is {norm[wrong[0]]:.4g}, must be 1"
        )


def _rotation(quaternion: np.ndarray | None) -> np.ndarray | None:
    if quaternion is None:
        return None
    return scipy.spatial.transform.Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def _check_sizes(data: Measurements, chain: ElasticChain, tension: np.ndarray | None) -> None:
    """Values that this arm cannot have, most often in another unit."""
    longest = float(tendon_lengths(chain).max())
    distance = np.linalg.norm(data.position - np.asarray(chain.base)[:3, 3], axis=-1)
    if data.kind == "displacements":
        _first_beyond(data, abs(data.given).max(axis=-1), longest, "displacement", "m")
    _first_beyond(data, distance, 2 * longest, "distance from the base, x_m to z_m,", "m")
    if tension is not None:
        rows = np.argwhere(tension < 0)
        if len(rows):
            row, tendon = (int(i) for i in rows[0])
            raise ValueError(
                f"{data.row_name(row)}, tension_{tendon + 1}_n: is {tension[row, tendon]:g}, must "
                "be at least 0; a load cell's zero is what fitting offsets finds, clip at 0"
            )


def _first_beyond(
    data: Measurements, values: np.ndarray, limit: float, what: str, unit: str
) -> None:
    beyond = np.flatnonzero(values > limit)
    if len(beyond):
        row = int(beyond[0])
        raise ValueError(
            f"{data.row_name(row)}: {what} of {values[row]:.4g} {unit} is more than the arm allows "
            f"({limit:.3g} {unit}); millimetres in a column of metres?"
        )
