"""``muxjax urdf``: the arm for other viewers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from muxjax.cli.output import configuration_argument, console, print_json
from muxjax.robot import load_robot
from muxjax.urdf import save_urdf, urdf_joint_angles, urdf_joints


def urdf(
    out: Path | None = None,
    per_segment: int = 6,
    q_deg: tuple[float, ...] | None = None,
    robot: str = "muxarm",
    json: bool = False,
) -> int:
    """Write an arm as a URDF, each segment a chain of two-axis joints; or print a posture of it.

    Example: muxjax urdf --robot muxarm --per-segment 6 --out arm.urdf

    Example: muxjax urdf --q-deg 60 0 75 180 40 0 --json

    Args:
        out: File to write.
        per_segment: Two-axis joints a segment; even numbers are more exact.
        q_deg: Print the joints' angles at this bending angle (not negative) and azimuth of each
            segment [degrees].
        robot: Shipped robot or path of a YAML file.
        json: Print JSON, angles in rad.
    """
    if out is None and q_deg is None:
        raise ValueError("urdf: give --out (a file to write), --q-deg (a posture), or both")
    arm = load_robot(robot)
    names = urdf_joints(arm, per_segment)
    document: dict[str, object] = {"robot": arm.config.name, "joints": names}
    angles = None
    if q_deg is not None:
        q = configuration_argument(arm, "--q-deg", q_deg)
        angles = urdf_joint_angles(arm, q, per_segment)
    if out is not None:
        save_urdf(arm, out, per_segment)
        document["file"] = str(out)
    if angles is not None:
        document["angles_rad"] = angles
    if json:
        print_json(document)
        return 0
    if angles is not None:
        for name, angle in zip(names, np.degrees(angles), strict=True):
            console.print(f"{name}  {angle + 0.0:.4f} deg")
    if out is not None:
        console.print(f"{len(names)} joints written to {out}")
    return 0
