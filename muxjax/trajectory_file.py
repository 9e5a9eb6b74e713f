"""Trajectories as CSV or NPZ files for other programs, in SI units that every name states."""

from __future__ import annotations

import csv
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from jaxtyping import Float

from muxjax.config import ConfigError, replacing
from muxjax.kinematics import forward_kinematics
from muxjax.precision import pad_rows
from muxjax.robot import Robot
from muxjax.scheduler import Trajectory
from muxjax.tendons import configuration_from_tendons

SCHEMA = "muxjax/trajectory/1"
MOST = 1_000_000  # samples of one trajectory


@dataclass(frozen=True, eq=False)
class Samples:
    """A trajectory at equal times.

    Attributes:
        robot: Name of the robot.
        fingerprint: Hash of its values.
        time_s: From 0 at equal distances; only the last one, the end, may come sooner.
        displacements: Of the tendons from straight [m]; negative = wound in.
        q: Bending angle and azimuth of each segment [rad] that the displacements define
            (M Eq. 4-5); NaN where they define none.
        tool: Pose of the tool in the world [m].
    """

    robot: str
    fingerprint: str
    time_s: Float[np.ndarray, " T"]
    displacements: Float[np.ndarray, "T SJ"]
    q: Float[np.ndarray, "T dof"]
    tool: Float[np.ndarray, "T 4 4"]


def sample(robot: Robot, trajectory: Trajectory, rate_hz: float = 50.0) -> Samples:
    """A trajectory at a rate, with the arm's shape.

    Args:
        robot: The arm.
        trajectory: Tendon displacements over time, of a program (``metrics.program.timeline``) or
            of a run (``Run.trajectory``).
        rate_hz: Samples a second.

    Raises:
        ValueError: A rate that is not above 0, or more than a million samples.
    """
    begin, end = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
    if not 0 < rate_hz < math.inf or (end - begin) * rate_hz > MOST:
        raise ValueError(
            f"rate_hz: must be above 0 and give at most {MOST} samples of {end - begin:g} s, "
            f"found {rate_hz:g}"
        )
    # The end itself is a sample; the slack keeps rounding from making two of it.
    time_s = np.arange(math.floor((end - begin) * rate_hz * (1 - 1e-12)) + 1) / rate_hz
    if end - begin > time_s[-1]:
        time_s = np.append(time_s, end - begin)
    points = trajectory.at(begin + time_s)
    q = np.asarray(configuration_from_tendons(robot, pad_rows(points)))
    tool = np.array(forward_kinematics(robot, np.nan_to_num(q)))
    tool[~np.isfinite(q).all(axis=-1)] = np.nan
    return Samples(
        robot=robot.config.name,
        fingerprint=robot.fingerprint,
        time_s=time_s,
        displacements=points,
        q=q[: len(points)],
        tool=tool[: len(points)],
    )


def columns(samples: Samples) -> dict[str, Float[np.ndarray, " T"]]:
    """The columns of a CSV file by name. Tendons and segments count from 1.

    The quaternion is scalar first and does not jump in sign from one row to the next.
    """
    found = {"time_s": samples.time_s}
    for c, column in enumerate(samples.displacements.T, start=1):
        found[f"tendon_{c}_m"] = column
    for i, (theta, phi) in enumerate(samples.q.T.reshape(-1, 2, len(samples.q)), start=1):
        found |= {f"theta_{i}_rad": theta, f"phi_{i}_rad": phi}
    found |= dict(zip(("x_m", "y_m", "z_m"), samples.tool[:, :3, 3].T, strict=True))
    found |= dict(zip(("qw", "qx", "qy", "qz"), _quaternions(samples.tool).T, strict=True))
    return found


def save_trajectory(samples: Samples, path: str | Path) -> None:
    """Write samples as ``.csv``, one named column a number, or as ``.npz``, one array a quantity.

    The arrays of an NPZ file are named time_s, displacements_m, configuration_rad and tool_pose_m,
    and beside them stand schema, robot and fingerprint as text.

    Raises:
        ConfigError: A path that ends in neither.
    """
    path = Path(path)
    if path.suffix not in {".csv", ".npz"}:
        raise ConfigError(f"{path}: a trajectory's file ends in .csv or .npz")
    with replacing(path) as part:
        if path.suffix == ".csv":
            named = columns(samples)
            with open(part, "w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                writer.writerow(named)
                writer.writerows(np.stack(list(named.values()), axis=-1).tolist())
        else:
            with open(part, "wb") as file:
                np.savez_compressed(
                    file,
                    schema=np.array(SCHEMA),
                    robot=np.array(samples.robot),
                    fingerprint=np.array(samples.fingerprint),
                    time_s=samples.time_s,
                    displacements_m=samples.displacements,
                    configuration_rad=samples.q,
                    tool_pose_m=samples.tool,
                )


def load_trajectory(robot: Robot, path: str | Path) -> Trajectory:
    """Read the tendons of a file that ``save_trajectory`` or other software wrote.

    A .csv file needs the columns time_s and tendon_1_m ...; its other columns are not read. An
    .npz file also names its robot.

    Raises:
        ConfigError: No such file, another schema or robot, a column or array that is missing, or
            numbers that make no trajectory; the message names it.
    """
    path = Path(path)
    try:
        time_s, points = (_from_npz if path.suffix == ".npz" else _from_csv)(robot, path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (KeyError, TypeError, EOFError, zipfile.BadZipFile, csv.Error, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: not a trajectory of {robot.config.name} ({error})") from error
    if time_s.ndim != 1 or points.shape != (time_s.size, robot.n_tendons) or not time_s.size:
        raise ConfigError(
            f"{path}: displacements must have shape (T, {robot.n_tendons}) and times (T,) with T "
            f"at least 1, found {points.shape} and {time_s.shape}"
        )
    if not (np.isfinite(time_s).all() and np.isfinite(points).all()):
        raise ConfigError(f"{path}: times and displacements must be finite")
    if np.any(np.diff(time_s) < 0):
        raise ConfigError(f"{path}: time_s must not fall")
    return Trajectory(time_s, points)


def _from_npz(robot: Robot, path: Path) -> tuple[np.ndarray, np.ndarray]:
    with np.load(path, allow_pickle=False) as stored:
        if str(stored["schema"]) != SCHEMA:
            raise ConfigError(f"{path}: schema is {str(stored['schema'])!r}, expected {SCHEMA!r}")
        found = str(stored["fingerprint"])
        if found != robot.fingerprint:
            raise ConfigError(
                f"{path}: of robot {str(stored['robot'])!r} ({found}), this is "
                f"{robot.config.name!r} ({robot.fingerprint})"
            )
        return stored["time_s"].astype(float), stored["displacements_m"].astype(float)


def _from_csv(robot: Robot, path: Path) -> tuple[np.ndarray, np.ndarray]:
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = [f"tendon_{c}_m" for c in range(1, robot.n_tendons + 1)]
    missing = [name for name in ("time_s", *names) if not rows or name not in rows[0]]
    if missing:
        raise ConfigError(f"{path}: has no column {missing[0]}, or no line below the names")
    try:
        table = np.array([[float(row[name]) for name in ("time_s", *names)] for row in rows])
    except TypeError:
        raise ConfigError(f"{path}: a line is shorter than the names") from None
    return table[:, 0], table[:, 1:]


def _quaternions(poses: Float[np.ndarray, "T 4 4"]) -> Float[np.ndarray, "T 4"]:
    """Scalar first; NaN of an undefined pose; neighbours on the same side."""
    found = np.full((len(poses), 4), np.nan)
    defined = np.isfinite(poses).all(axis=(1, 2))
    if defined.any():
        turns = scipy.spatial.transform.Rotation.from_matrix(poses[defined, :3, :3]).as_quat(
            scalar_first=True, canonical=True
        )
        against = np.sum(turns[1:] * turns[:-1], axis=-1) < 0
        signs = np.cumprod(np.where(against, -1.0, 1.0))
        turns[1:] *= signs[:, None]
        found[defined] = turns
    return found
