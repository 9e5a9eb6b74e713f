"""``muxjax fk`` and ``muxjax ik``: configurations to poses and back."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from pydantic import ValidationError
from rich.table import Table

from muxjax.cli.output import (
    configuration_argument,
    console,
    pose_document,
    print_json,
    row_of,
    verdict,
)
from muxjax.cli.pose_input import matrix_from, read_poses
from muxjax.collision import World, load_world, tightest
from muxjax.config import ConfigError, TargetConfig, explain
from muxjax.ik import AllIkResult, IkResult, IkStatus, all_ik, solve_ik
from muxjax.kinematics import forward_kinematics
from muxjax.pipeline import target_pose
from muxjax.robot import Robot, load_robot
from muxjax.tendons import tendon_displacements

Xyz = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def fk(
    q_deg: Annotated[tuple[float, ...], tyro.conf.Positional],
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """Tool pose and tendon displacements of a configuration.

    Example: muxjax fk 60 0  75 180  40 0

    Args:
        q_deg: Bending angle (not negative) and azimuth of each segment [degrees], base to tip.
        robot: Shipped robot or path of a YAML file.
        json: Print JSON in SI units.
    """
    arm = load_robot(robot)
    q = configuration_argument(arm, "fk", q_deg)
    pose, displacements = forward_kinematics(arm, q), tendon_displacements(arm, q)
    if json:
        print_json(
            {"robot": arm.config.name, "q": q, "displacements_m": displacements}
            | pose_document(pose)
        )
        return 0
    document = pose_document(pose)
    table = Table("tool of " + arm.config.name, "")
    table.add_row("position [mm]", row_of(document["position_m"], 1e3))
    table.add_row("roll, pitch, yaw [deg]", row_of(document["rpy_deg"], 1))
    table.add_row("quaternion w x y z", row_of(document["quaternion_wxyz"], 1, 6))
    by_segment = displacements.reshape(arm.n_segments, -1)
    for number, row in enumerate(by_segment, start=1):
        table.add_row(f"tendons of segment {number} [mm]", row_of(row, 1e3, 3))
    console.print(table)
    return 0


def pose_argument(xyz_mm: Xyz, rpy_deg: Xyz | None, quat: Quaternion | None) -> np.ndarray:
    """Pose typed as millimetres and either degrees or a quaternion; upright by default."""
    if rpy_deg is None and quat is None:
        rpy_deg = (0.0, 0.0, 0.0)
    try:
        target = TargetConfig(
            name="pose",
            position_m=(xyz_mm[0] / 1e3, xyz_mm[1] / 1e3, xyz_mm[2] / 1e3),
            rpy_deg=rpy_deg,
            quaternion_wxyz=quat,
        )
    except ValidationError as error:
        raise ConfigError(explain(error)) from None
    return target_pose(target)


def ik(
    xyz_mm: Xyz | None = None,
    rpy_deg: Xyz | None = None,
    quat: Quaternion | None = None,
    matrix: tuple[float, ...] = (),
    poses: Path | None = None,
    every: Annotated[bool, tyro.conf.arg(name="all")] = False,
    world: str | None = None,
    prefer: Literal["distance", "bending", "clearance"] = "distance",
    q0_deg: tuple[float, ...] = (),
    project_rotations: bool = False,
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """Configurations that put the tool at a pose, or at each pose of a file.

    Example: muxjax ik --xyz-mm 152.25 0 413.777 --rpy-deg 0 25 0 --all

    Example: muxjax ik --poses grasps.csv --world cabinet --json

    Args:
        xyz_mm: Tool position in the world [mm].
        rpy_deg: Roll, pitch, yaw [degrees], as Rz(yaw) Ry(pitch) Rx(roll); upright by default.
        quat: Orientation as a quaternion w x y z instead.
        matrix: The pose as 16 numbers of a 4 x 4 matrix, row by row, position in METRES.
        poses: File of many poses. CSV: columns x_mm y_mm z_mm (or x_m y_m z_m) and qw qx qy qz or
            roll_deg pitch_deg yaw_deg. JSON: a list of such objects or of 4 x 4 matrices [m].
            NPY: (n, 4, 4), or (n, 7) of x y z [m] qw qx qy qz. TXT: one 4 x 4 matrix [m].
        every: List every solution instead of one.
        world: Shipped world or path of a YAML file, to be clear of.
        prefer: Of several solutions: nearest to --q0-deg, least bent, or clearest (with --world).
        q0_deg: Configuration to stay near [degrees]; the straight arm by default.
        project_rotations: Take the nearest rotation where a matrix is not quite one.
        robot: Shipped robot or path of a YAML file.
        json: Print JSON in SI units.
    """
    arm = load_robot(robot)
    target = _poses(xyz_mm, rpy_deg, quat, matrix, poses)
    obstacles = None if world is None else load_world(world)
    try:
        return _solve_and_report(
            arm, target, obstacles, every, prefer, q0_deg, project_rotations, json, poses
        )
    except ValueError as error:
        # Rows count from 1 at this face.
        row = re.match(r"pose\[(\d+)\]", str(error))
        if row is None:
            raise
        name = "pose" if poses is None else f"{poses}, pose {int(row[1]) + 1}"
        raise ValueError(name + str(error)[row.end() :]) from None


def _solve_and_report(
    arm: Robot,
    target: np.ndarray,
    obstacles: World | None,
    every: bool,
    prefer: Literal["distance", "bending", "clearance"],
    q0_deg: tuple[float, ...],
    project_rotations: bool,
    json: bool,
    poses: Path | None,
) -> int:
    if every:
        if q0_deg or prefer != "distance":
            raise ValueError("ik: --all lists every solution; leave out --q0-deg and --prefer")
        found = all_ik(arm, target, project_rotations=project_rotations)
        clear = None if obstacles is None else _clearances(arm, found, obstacles)
        return _report_all(arm, found, clear, json, many=poses is not None)
    near = configuration_argument(arm, "--q0-deg", q0_deg) if q0_deg else None
    one = solve_ik(
        arm,
        target,
        q0=near,
        world=obstacles,
        prefer=prefer,
        project_rotations=project_rotations,
    )
    if poses is not None:
        return _report_many(arm, one, json)
    return _report_one(arm, jax.tree.map(lambda x: x[0], one), json)


def _poses(
    xyz_mm: Xyz | None,
    rpy_deg: Xyz | None,
    quat: Quaternion | None,
    matrix: tuple[float, ...],
    path: Path | None,
) -> np.ndarray:
    """Poses (n, 4, 4) of whichever argument gives them."""
    if (xyz_mm is not None) + bool(matrix) + (path is not None) != 1:
        raise ValueError("ik: give one of --xyz-mm, --matrix and --poses")
    if xyz_mm is not None:
        return pose_argument(xyz_mm, rpy_deg, quat)[None]
    if rpy_deg is not None or quat is not None:
        raise ValueError("ik: --rpy-deg and --quat go with --xyz-mm")
    return matrix_from(matrix, where="--matrix")[None] if path is None else read_poses(path)


def _clearances(arm: Robot, found: AllIkResult, world: World) -> np.ndarray:
    """Clearance [m] of each solution, NaN where there is none."""
    clear = np.full(found.mask.shape, np.nan)
    if np.any(found.mask):
        with jax.enable_x64(True):
            clear[found.mask] = np.asarray(tightest(arm, found.q[found.mask], world).clearance)
    return clear


def _one_document(arm: Robot, found: IkResult) -> dict[str, Any]:
    document = {
        "robot": arm.config.name,
        "converged": bool(found.converged),
        "status": IkStatus(int(found.status)).name.lower(),
        "q": found.q,
        "position_error_m": float(found.position_error),
        "orientation_error_rad": float(found.orientation_error),
        "binding_limit": found.binding_limit,
    }
    if found.clearance is not None:
        document |= {
            "clearance_m": float(found.clearance),
            "nearest_segment": int(np.asarray(found.nearest_segment)),
            "nearest_point_m": found.nearest_point,
        }
    return document


def _rows(found: IkResult) -> list[IkResult]:
    return [jax.tree.map(lambda x, k=k: x[k], found) for k in range(len(found.q))]


def _report_many(arm: Robot, found: IkResult, json: bool) -> int:
    reached = int(np.sum(found.converged))
    if json:
        print_json([_one_document(arm, row) for row in _rows(found)])
        return 0 if reached == len(found.q) else 1
    headings = ["pose", "status", "bending and azimuth of each segment [deg]", "off [mm]"]
    headings += [] if found.clearance is None else ["clearance [mm]"]
    table = Table(*headings)
    for number, row in enumerate(_rows(found), start=1):
        line = [str(number), IkStatus(int(row.status)).name.lower(), _angles(row.q)]
        line.append(f"{1e3 * float(row.position_error):.3g}")
        table.add_row(*line, *([] if row.clearance is None else [f"{1e3 * row.clearance:.1f}"]))
    console.print(table)
    console.print(f"{reached} of {len(found.q)} poses reached")
    return 0 if reached == len(found.q) else 1


def _angles(q: Any) -> str:
    return "   ".join(f"{t:.2f} at {p:.2f}" for t, p in np.degrees(q).reshape(-1, 2))


def _report_one(arm: Robot, found: IkResult, json: bool) -> int:
    if json:
        print_json(_one_document(arm, found))
        return 0 if found.converged else 1
    status = IkStatus(int(found.status)).name.lower()
    reached = bool(found.converged)
    heading = verdict(
        "solution" if reached else f"NOT REACHED ({status}); the closest found", reached
    )
    table = Table("segment", "bending [deg]", "azimuth [deg]", "at its limit", title=heading)
    for i, (theta, phi) in enumerate(np.degrees(found.q.reshape(-1, 2)), start=1):
        limit = "yes" if found.binding_limit[i - 1] else ""
        table.add_row(str(i), f"{theta:.4f}", f"{phi:.4f}", limit)
    console.print(table)
    console.print(
        f"position error {1e3 * found.position_error:.3g} mm, "
        f"orientation error {np.degrees(found.orientation_error):.3g} deg"
    )
    if not reached:
        console.print("muxjax sweep draws where the arm reaches", style="aside")
    if found.clearance is not None:
        console.print(
            f"clearance {1e3 * float(found.clearance):.1f} mm, least at segment "
            f"{int(np.asarray(found.nearest_segment))} (one more than the last is the tool)"
        )
    return 0 if found.converged else 1


def _report_all(
    arm: Robot, found: AllIkResult, clear: np.ndarray | None, json: bool, many: bool
) -> int:
    """Solutions of each pose; with a world, success is a clear solution of every pose."""
    documents = []
    for row, mask in enumerate(found.mask):
        document: dict[str, Any] = {
            "robot": arm.config.name,
            "q": found.q[row][mask],
            "singular_value": found.singular_value[row][mask],
            "complete": bool(found.complete[row]),
        }
        if clear is not None:
            document["clearance_m"] = clear[row][mask]
        documents.append(document)
    good = found.mask if clear is None else found.mask & (clear >= 0)
    code = 0 if bool(np.all(np.any(good, axis=-1))) else 1
    if json:
        print_json(documents if many else documents[0])
        return code
    headings = ["bending and azimuth of each segment [deg]", "smallest singular value"]
    table = Table(*headings, *([] if clear is None else ["clearance [mm]"]))
    for number, document in enumerate(documents, start=1):
        if many:
            table.add_section()
            table.add_row(f"pose {number}")
        for k, q in enumerate(document["q"]):
            line = [_angles(q), f"{document['singular_value'][k]:.4f}"]
            line += [] if clear is None else [f"{1e3 * document['clearance_m'][k]:.1f}"]
            table.add_row(*line)
    console.print(table)
    more = "" if np.all(found.complete) else "; there may be more"
    if clear is not None:
        more += f"; {int(np.sum(good))} of them clear"
    console.print(f"{int(np.sum(found.mask))} solutions within the bending limits{more}")
    return code
