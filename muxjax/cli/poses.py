"""``muxjax fk`` and ``muxjax ik``: configurations to poses and back."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import tyro
from pydantic import ValidationError
from rich.table import Table

from muxjax.cli.output import console, pose_document, print_json, row_of
from muxjax.collision import load_world
from muxjax.config import ConfigError, TargetConfig, explain
from muxjax.ik import AllIkResult, IkResult, IkStatus, all_ik, solve_ik
from muxjax.kinematics import check_configuration, forward_kinematics
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
        q_deg: Bending angle and azimuth of each segment [degrees], base to tip.
        robot: Shipped robot or path of a YAML file.
        json: Print JSON in SI units.
    """
    arm = load_robot(robot)
    q = check_configuration(arm, np.radians(q_deg))
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
    xyz_mm: Xyz,
    rpy_deg: Xyz | None = None,
    quat: Quaternion | None = None,
    every: Annotated[bool, tyro.conf.arg(name="all")] = False,
    world: str | None = None,
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """Configuration that puts the tool at a pose, or all of them.

    Example: muxjax ik --xyz-mm 152.25 0 413.777 --rpy-deg 0 25 0 --all

    Args:
        xyz_mm: Tool position in the world [mm].
        rpy_deg: Roll, pitch, yaw [degrees], as Rz(yaw) Ry(pitch) Rx(roll); upright by default.
        quat: Orientation as a quaternion w x y z instead.
        every: List every solution instead of the one nearest to the straight arm.
        world: Shipped world or path of a YAML file, to be clear of.
        robot: Shipped robot or path of a YAML file.
        json: Print JSON in SI units.
    """
    arm, pose = load_robot(robot), pose_argument(xyz_mm, rpy_deg, quat)
    if every:
        if world is not None:
            raise ValueError("ik: --all lists solutions whatever is around; leave out --world")
        return _report_all(arm, all_ik(arm, pose), json)
    obstacles = None if world is None else load_world(world)
    return _report_one(arm, solve_ik(arm, pose, world=obstacles), json)


def _report_one(arm: Robot, found: IkResult, json: bool) -> int:
    status = IkStatus(int(found.status)).name.lower()
    if json:
        document = {
            "robot": arm.config.name,
            "converged": bool(found.converged),
            "status": status,
            "q": found.q,
            "position_error_m": float(found.position_error),
            "orientation_error_rad": float(found.orientation_error),
            "binding_limit": found.binding_limit,
        }
        if found.clearance is not None:
            document["clearance_m"] = float(found.clearance)
        print_json(document)
        return 0 if found.converged else 1
    heading = "solution" if found.converged else f"NOT REACHED ({status}); the closest found"
    table = Table("segment", "bending [deg]", "azimuth [deg]", "at its limit", title=heading)
    for i, (theta, phi) in enumerate(np.degrees(found.q.reshape(-1, 2)), start=1):
        limit = "yes" if found.binding_limit[i - 1] else ""
        table.add_row(str(i), f"{theta:.4f}", f"{phi:.4f}", limit)
    console.print(table)
    console.print(
        f"position error {1e3 * found.position_error:.3g} mm, "
        f"orientation error {np.degrees(found.orientation_error):.3g} deg"
    )
    if found.clearance is not None:
        console.print(
            f"clearance {1e3 * float(found.clearance):.1f} mm, least at segment "
            f"{int(np.asarray(found.nearest_segment))} (one more than the last is the tool)"
        )
    return 0 if found.converged else 1


def _report_all(arm: Robot, found: AllIkResult, json: bool) -> int:
    solutions = found.q[np.asarray(found.mask)]
    singular_values = np.asarray(found.singular_value)[np.asarray(found.mask)]
    if json:
        print_json(
            {
                "robot": arm.config.name,
                "q": solutions,
                "singular_value": singular_values,
                "complete": bool(found.complete),
            }
        )
        return 0 if len(solutions) else 1
    table = Table("bending and azimuth of each segment [deg]", "smallest singular value")
    for q, value in zip(solutions, singular_values, strict=True):
        pairs = np.degrees(q).reshape(-1, 2)
        table.add_row("   ".join(f"{t:.2f} at {p:.2f}" for t, p in pairs), f"{value:.4f}")
    console.print(table)
    more = "" if found.complete else "; there are infinitely many"
    console.print(f"{len(solutions)} solutions within the bending limits{more}")
    return 0 if len(solutions) else 1
