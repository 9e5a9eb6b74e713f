"""The URDF, read back as XML by a chain evaluation written here, beside the arm's formulas."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import muxjax
from muxjax.cli import main
from muxjax.kinematics import forward_kinematics
from muxjax.urdf import urdf, urdf_joint_angles, urdf_joints
from tests.conftest import random_configurations


def numbers(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])


def chain_pose(text: str, angles: dict[str, float]) -> np.ndarray:
    """Pose of link "tool" in link "world", from the URDF's own rules.

    A joint's frame lies at its origin in the parent (fixed-axis roll, pitch, yaw), and turns by
    the joint's angle about its axis.
    """
    root = ET.fromstring(text)
    by_child = {joint.find("child").get("link"): joint for joint in root.iter("joint")}
    assert len(by_child) == len(list(root.iter("joint")))
    used, pose, link = set(), np.eye(4), "tool"
    while link != "world":
        joint = by_child[link]
        origin = joint.find("origin")
        turn = Rotation.from_euler("xyz", numbers(origin.get("rpy"))).as_matrix()
        if joint.get("type") == "revolute":
            axis = numbers(joint.find("axis").get("xyz"))
            turn = turn @ Rotation.from_rotvec(angles[joint.get("name")] * axis).as_matrix()
            used.add(joint.get("name"))
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = turn, numbers(origin.get("xyz"))
        pose, link = step @ pose, joint.find("parent").get("link")
    assert used == angles.keys()
    return pose


def errors(robot: muxjax.Robot, q: np.ndarray, per_segment: int) -> np.ndarray:
    """Distances [m] and angles [rad] of the chain's tool from the formulas', shape (2, rows)."""
    text, names = urdf(robot, per_segment), urdf_joints(robot, per_segment)
    angles = urdf_joint_angles(robot, q, per_segment)
    off = []
    for row, true in zip(angles, forward_kinematics(robot, q), strict=True):
        pose = chain_pose(text, dict(zip(names, row.tolist(), strict=True)))
        turn = Rotation.from_matrix(true[:3, :3].T @ pose[:3, :3]).magnitude()
        off.append((np.linalg.norm(pose[:3, 3] - true[:3, 3]), turn))
    return np.array(off).T


def worst(robot: muxjax.Robot, q: np.ndarray, per_segment: int) -> tuple[float, float]:
    """The greatest distance [m] and angle [rad]."""
    position, turn = np.max(errors(robot, q, per_segment), axis=1).tolist()
    return position, turn


def test_the_chain_comes_to_the_arms_pose_as_resolution_rises(robot, rng):
    """At least with the square: a quarter at twice the joints, a sixteenth at four times."""
    q = random_configurations(robot, rng, 8)
    coarse, fine, finest = (worst(robot, q, n) for n in (8, 16, 64))
    assert finest[0] < 1e-4  # m
    assert finest[1] < 1e-4  # rad
    for a, b, c in zip(coarse, fine, finest, strict=True):
        assert a / b > 3.5
        assert b / c > 14.0


def test_the_order_of_the_axes_cancels_twist(muxarm, rng, monkeypatch):
    """Always x before y is another chain, ten times further off."""
    q = random_configurations(muxarm, rng, 8)
    ours = worst(muxarm, q, 16)
    monkeypatch.setattr("muxjax.urdf._axes", lambda part: "xy")
    always = worst(muxarm, q, 16)
    assert always[0] > 10 * ours[0]
    assert always[1] > 10 * ours[1]


def test_straight_arm_and_planar_bends(muxarm):
    """Straight is exact; in a coordinate plane the orientation is, at any resolution."""
    position, turn = worst(muxarm, np.zeros((1, 6)), 3)
    assert position < 1e-15
    assert turn == 0
    for azimuth in (0.0, np.pi / 2, np.pi):
        q = np.array([[1.2, azimuth, 2.0, azimuth, 0.9, azimuth]])
        position, turn = worst(muxarm, q, 4)
        assert turn < 1e-12
        assert 1e-4 < position < 0.05


def test_frames_of_base_and_tool_are_in_it(muxarm, rng):
    config = muxarm.config.model_dump(by_alias=True)
    config["base_frame"] = {"xyz_m": [0.1, -0.2, 0.3], "rpy_deg": [10, 20, 30]}
    config["tool_frame"] = {"xyz_m": [0.01, 0.02, 0.05], "rpy_deg": [-40, 50, 60]}
    moved = muxjax.robot.robot_from_config(muxjax.config.RobotConfig.model_validate(config))
    position, turn = worst(moved, np.zeros((1, 6)), 6)
    assert position < 1e-12
    assert turn < 1e-12


def test_every_allowed_configuration_is_within_the_joints_limits(robot, rng):
    q = random_configurations(robot, rng, 200)
    q[:100, 0::2] = robot.theta_max
    for n in (5, 6):
        joints = ET.fromstring(urdf(robot, n)).iter("joint")
        limits = {j.get("name"): j.find("limit") for j in joints if j.get("type") == "revolute"}
        assert tuple(limits) == urdf_joints(robot, n)
        upper = np.array([float(limit.get("upper")) for limit in limits.values()])
        lower = np.array([float(limit.get("lower")) for limit in limits.values()])
        angles = urdf_joint_angles(robot, q, n)
        assert angles.shape == (200, len(limits))
        assert (angles <= upper + 1e-12).all()
        assert (angles >= lower - 1e-12).all()
        assert np.max(angles / upper) > 0.95


def test_links_are_a_tree_and_cylinders_fill_the_length(muxarm):
    root = ET.fromstring(urdf(muxarm, 6))
    links = [link.get("name") for link in root.iter("link")]
    assert len(links) == len(set(links)) == len(list(root.iter("joint"))) + 1
    lengths = [float(c.get("length")) for c in root.iter("cylinder")]
    assert sum(lengths) == pytest.approx(0.47)
    materials = {m.get("name") for m in root.findall("material")}
    assert {m.get("name") for m in root.findall(".//visual/material")} == materials


@pytest.mark.parametrize("per_segment", [0, 2, 1001])
def test_a_resolution_that_cannot_serve_is_refused(muxarm, per_segment):
    with pytest.raises(ValueError, match=r"per_segment: must be a whole number from 3 .* to 1000"):
        urdf(muxarm, per_segment)
    with pytest.raises(ValueError, match=r"per_segment"):
        urdf_joint_angles(muxarm, np.zeros(6), per_segment)


def test_a_configuration_beyond_a_limit_is_refused(muxarm):
    with pytest.raises(ValueError, match="bending of segment 1 is 200 degrees, limit 180"):
        urdf_joint_angles(muxarm, np.radians([200, 0, 0, 0, 0, 0]), 6)


def test_the_command_writes_it_and_prints_a_posture(capsys, monkeypatch, tmp_path, muxarm):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(["urdf", *arguments])
        out, err = capsys.readouterr()
        return int(stop.value.code or 0), out, err

    path = tmp_path / "arm.urdf"
    posture = ("--q-deg", "60", "0", "75", "180", "40", "0")
    code, out, _ = call("--out", str(path), "--per-segment", "24", *posture, "--json")
    assert code == 0
    document = json.loads(out)
    angles = dict(zip(document["joints"], document["angles_rad"], strict=True))
    pose = chain_pose(path.read_text(), angles)
    np.testing.assert_allclose(pose[:3, 3], [0.15225047, 0, 0.41377691], atol=5e-4)
    code, out, _ = call(*posture)
    assert code == 0
    assert "segment1_1_y  10.0000 deg" in out
    code, _, err = call()
    assert code == 2
    assert "give --out" in err
