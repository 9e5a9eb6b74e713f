"""The arm as a URDF, for viewers that know rigid links and joints only.

A segment becomes a chain of ``per_segment`` two-axis joints. Each stands for an equal part of the
segment's arc: half the part's length lies before the joint, half behind it, and the joint turns the
tangent by the part's share of the bending. Two axes cannot do that without a little twist t, which
has the other sign where they come in the other order. In the order xy yx yx xy the twist after each
part is t, 0, -t, 0: it neither adds up nor, on average, turns the plane in which the rest bends.
What is left of the error falls with the square of ``per_segment``, or faster, where that is even;
odd numbers leave one t a segment.

The file has geometry and joint limits, no masses: how MuxArm's 2.17 kg are spread is not published.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from jaxtyping import Float

from muxjax.kinematics import check_configuration, roll_pitch_yaw
from muxjax.robot import Robot

COLOURS = ((0.12, 0.35, 0.60), (0.85, 0.55, 0.15), (0.30, 0.55, 0.35))  # of segments, in turn
MOST = 1000  # joints a segment


def urdf_joints(robot: Robot, per_segment: int) -> tuple[str, ...]:
    """Names of the joints from base to tip, two for each of ``per_segment`` parts of a segment.

    Raises:
        ValueError: See ``urdf``.
    """
    _check(robot, per_segment)
    return tuple(
        f"segment{i}_{k}_{axis}"
        for i in range(1, robot.n_segments + 1)
        for k in range(1, per_segment + 1)
        for axis in _axes(k)
    )


def urdf_joint_angles(
    robot: Robot,
    q: Float[np.ndarray, "*batch dof"],
    per_segment: int,
    *,
    within_limits: bool = True,
) -> Float[np.ndarray, "*batch joints"]:
    """Angles [rad] of the joints of ``urdf_joints``, in its order, for configurations.

    A part bends by theta / n in the direction phi, so its joint must take the z axis to
    (sin cos phi, sin sin phi, cos). Rx(a) Ry(b) does with b = asin(sin cos phi) and
    a = atan2(-sin sin phi, cos); Ry(b) Rx(a) with a = -asin(sin sin phi) and
    b = atan2(sin cos phi, cos).

    Args:
        robot: The arm.
        q: (theta_1, phi_1, ...) [rad], any leading batch axes.
        per_segment: Parts a segment, as of the URDF.
        within_limits: Refuse bending beyond a segment's limit. A motion passes such shapes, as
            nothing keeps it within the limits between its ends.

    Raises:
        ValueError: See ``urdf``; or a configuration of wrong shape, not finite, or beyond a limit.
    """
    _check(robot, per_segment)
    checked = check_configuration(robot, q) if within_limits else np.asarray(q, dtype=np.float64)
    part, phi = checked[..., 0::2] / per_segment, checked[..., 1::2]
    x, y, z = np.sin(part) * np.cos(phi), np.sin(part) * np.sin(phi), np.cos(part)
    x_first = np.stack([np.arctan2(-y, z), np.arcsin(x)], axis=-1)
    y_first = np.stack([np.arctan2(x, z), -np.arcsin(y)], axis=-1)
    by_part = [x_first if _axes(k) == "xy" else y_first for k in range(1, per_segment + 1)]
    return np.stack(by_part, axis=-2).reshape(*checked.shape[:-1], -1)


def urdf(robot: Robot, per_segment: int = 6) -> str:
    """URDF of the arm: link "world", base frame, segments, link "tool".

    Lengths in metres. Links are drawn as cylinders of the discs' radius. The joints' limits are the
    segment's bending limit over ``per_segment``; effort and velocity are 0, which means nothing
    here: a viewer needs none.

    Args:
        robot: The arm.
        per_segment: Two-axis joints a segment, at least as many as keep each below 90 degrees.

    Raises:
        ValueError: ``per_segment`` is no whole number, too small for a segment's bending limit, or
            above 1000.
    """
    _check(robot, per_segment)
    root = ET.Element("robot", name=robot.config.name)
    for i in range(robot.n_segments):
        material = ET.SubElement(root, "material", name=f"segment{i + 1}")
        red, green, blue = COLOURS[i % len(COLOURS)]
        ET.SubElement(material, "color", rgba=f"{red} {green} {blue} 1")
    ET.SubElement(root, "link", name="world")
    _joint(root, "base_frame", "fixed", "world", "base", np.asarray(robot.base))
    half = np.asarray(robot.length) / (2 * per_segment)
    radius = float(robot.body_radius)
    _link(root, "base", float(half[0]), radius, "segment1")
    before, reach = "base", float(half[0])
    for i in range(robot.n_segments):
        limit = float(robot.theta_max[i]) / per_segment
        for k in range(1, per_segment + 1):
            name = f"segment{i + 1}_{k}"
            for axis, link in zip(_axes(k), (f"{name}_cross", name), strict=True):
                at = np.eye(4)
                at[2, 3] = reach
                joint = _joint(root, f"{name}_{axis}", "revolute", before, link, at)
                ET.SubElement(joint, "axis", xyz="1 0 0" if axis == "x" else "0 1 0")
                ET.SubElement(
                    joint,
                    "limit",
                    lower=f"{-limit!r}",
                    upper=f"{limit!r}",
                    effort="0",
                    velocity="0",
                )
                before, reach = link, 0.0
            ends = [float(half[i])]
            if k < per_segment:
                ends.append(float(half[i]))
            elif i + 1 < robot.n_segments:
                ends.append(float(half[i + 1]))
            ET.SubElement(root, "link", name=f"{name}_cross")
            reach = sum(ends)
            _link(root, name, reach, radius, f"segment{i + 1}")
    tip = np.eye(4)
    tip[2, 3] = reach
    ET.SubElement(root, "link", name="tool")
    _joint(root, "tool_frame", "fixed", before, "tool", tip @ np.asarray(robot.tool))
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def save_urdf(robot: Robot, path: str | Path, per_segment: int = 6) -> None:
    """Write ``urdf`` to a file.

    Raises:
        ValueError: See ``urdf``.
    """
    text = urdf(robot, per_segment)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _check(robot: Robot, per_segment: int) -> None:
    least = int(np.max(np.asarray(robot.theta_max)) / (np.pi / 2)) + 1
    if not isinstance(per_segment, int) or not least <= per_segment <= MOST:
        raise ValueError(
            f"per_segment: must be a whole number from {least} (each joint below 90 degrees of "
            f"{np.degrees(np.max(robot.theta_max)):g}) to {MOST}, found {per_segment!r}"
        )


def _axes(part: int) -> str:
    """Order of the two axes of a part, which counts from 1."""
    return ("xy", "yx", "yx", "xy")[(part - 1) % 4]


def _link(root: ET.Element, name: str, length: float, radius: float, material: str) -> None:
    link = ET.SubElement(root, "link", name=name)
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=f"0 0 {length / 2!r}", rpy="0 0 0")
    geometry = ET.SubElement(visual, "geometry")
    ET.SubElement(geometry, "cylinder", radius=repr(radius), length=repr(length))
    ET.SubElement(visual, "material", name=material)


def _joint(
    root: ET.Element, name: str, kind: str, parent: str, child: str, at: Float[np.ndarray, "4 4"]
) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    rpy = roll_pitch_yaw(at[:3, :3])  # fixed axes, as URDF has them
    texts = (" ".join(repr(float(v) + 0.0) for v in row) for row in (at[:3, 3], rpy))
    ET.SubElement(joint, "origin", xyz=next(texts), rpy=next(texts))
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint
