"""A recording as an MCAP file, for Foxglove and PlotJuggler: JSON messages with JSON schemas.

Joint states and the tool's pose are of the kinds that Foxglove knows by name
(``foxglove.JointStates``, ``foxglove.PoseInFrame``); the others are plain objects of arrays. All
numbers are in SI units, which the fields name. The arm's URDF is attached, and its joints bear the
names of the joint states.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from muxjax.config import ConfigError, replacing
from muxjax.recording.recording import Recording
from muxjax.robot import Robot
from muxjax.trajectory_file import columns
from muxjax.urdf import urdf, urdf_joint_angles, urdf_joints

SCHEMA = "muxjax/mcap/1"
URDF_NAME = "arm.urdf"

_NUMBERS = {"type": "array", "items": {"type": "number"}}
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}


def _vector(names: str) -> dict[str, Any]:
    return {"type": "object", "properties": {name: {"type": "number"} for name in names}}


def _message(title: str, **fields: Any) -> dict[str, Any]:
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        "type": "object",
        "properties": {"timestamp": _TIME, **fields},
        "required": ["timestamp", *fields],
    }


_JOINT = {
    "type": "object",
    "properties": {"name": {"type": "string"}, "position": {"type": "number"}},
}
_POSE = {
    "type": "object",
    "properties": {"position": _vector("xyz"), "orientation": _vector("xyzw")},
}
# By topic: what its messages say.
SCHEMAS: dict[str, dict[str, Any]] = {
    "/joint_states": _message("foxglove.JointStates", joints={"type": "array", "items": _JOINT}),
    "/tool": _message("foxglove.PoseInFrame", frame_id={"type": "string"}, pose=_POSE),
    "/bending": _message("muxjax.Bending", theta_rad=_NUMBERS, phi_rad=_NUMBERS),
    "/wheels": _message("muxjax.Wheels", displacement_m=_NUMBERS, angle_rad=_NUMBERS),
    "/drum": _message("muxjax.Drum", axial={"type": "integer"}),
    "/servos": _message("muxjax.Servos", angle_rad=_NUMBERS),
    "/clutches": _message(
        "muxjax.Clutches", engaged={"type": "array", "items": {"type": "boolean"}}
    ),
}


def save_mcap(robot: Robot, recording: Recording, path: str | Path, per_segment: int = 6) -> int:
    """Write a recording; how many messages there are.

    Every topic has a message a sample, but that joint states, bending and the tool have none where
    the lengths define no shape, and servos none where an angle is not known.

    Args:
        robot: The arm.
        recording: What it did.
        path: File to write, ending in .mcap.
        per_segment: Two-axis joints of a segment, as of ``urdf``.

    Raises:
        ConfigError: A path with another ending, or the package mcap is not installed.
        ValueError: ``per_segment`` that cannot serve; see ``urdf``.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        raise ConfigError(f"{path}: an MCAP file ends in .mcap")
    description = urdf(robot, per_segment)  # a wrong number is refused before any work
    with replacing(path) as part, part.open("wb") as file:
        return _write(file, robot, recording, per_segment, description)


def _write(
    file: IO[bytes], robot: Robot, recording: Recording, per_segment: int, description: str
) -> int:
    try:
        from mcap.writer import Writer
    except ImportError:
        raise ConfigError("MCAP files need the package mcap: pip install 'muxjax[viz]'") from None
    writer = Writer(file)
    writer.start(library="muxjax")
    channels = {}
    for topic, schema in SCHEMAS.items():
        number = writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
        channels[topic] = writer.register_channel(topic, "json", number)
    about = {
        "schema": SCHEMA,
        "robot": recording.samples.robot,
        "fingerprint": recording.samples.fingerprint,
        "source": recording.source,
        "joints_a_segment": str(per_segment),
        "units": "m, rad, s",
    }
    writer.add_metadata("muxjax", about)
    writer.add_attachment(0, 0, URDF_NAME, "application/xml", description.encode())
    count = 0
    for topic, at_ns, message in messages(robot, recording, per_segment):
        stamp = {"sec": at_ns // 10**9, "nsec": at_ns % 10**9}
        text = json.dumps({"timestamp": stamp, **message}, separators=(",", ":"))
        writer.add_message(channels[topic], at_ns, text.encode(), at_ns, sequence=count)
        count += 1
    writer.finish()
    return count


def messages(
    robot: Robot, recording: Recording, per_segment: int
) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Topic, time [ns] and content, without its time stamp, in the order of time."""
    samples = recording.samples
    names = urdf_joints(robot, per_segment)
    known = np.isfinite(samples.q).all(axis=-1)
    angles = np.full((len(known), len(names)), np.nan)
    angles[known] = urdf_joint_angles(robot, samples.q[known], per_segment, within_limits=False)
    named = columns(samples)
    place = np.stack([named[f"{axis}_m"] for axis in "xyz"], axis=-1)
    turn = np.stack([named[f"q{axis}"] for axis in "xyzw"], axis=-1)
    wheel = samples.displacements / float(robot.wheel_radius)
    for k, time_s in enumerate(samples.time_s):
        at_ns = round((recording.begin_s + float(time_s)) * 1e9)
        if known[k]:
            joints = [
                {"name": name, "position": angle}
                for name, angle in zip(names, angles[k].tolist(), strict=True)
            ]
            pose = {
                "position": dict(zip("xyz", place[k].tolist(), strict=True)),
                "orientation": dict(zip("xyzw", turn[k].tolist(), strict=True)),
            }
            bending = samples.q[k].tolist()
            yield "/joint_states", at_ns, {"joints": joints}
            yield "/tool", at_ns, {"frame_id": "world", "pose": pose}
            yield "/bending", at_ns, {"theta_rad": bending[0::2], "phi_rad": bending[1::2]}
        lengths = samples.displacements[k].tolist()
        yield "/wheels", at_ns, {"displacement_m": lengths, "angle_rad": wheel[k].tolist()}
        yield "/drum", at_ns, {"axial": int(recording.axial[k])}
        if np.isfinite(recording.servo_rad[k]).all():
            yield "/servos", at_ns, {"angle_rad": recording.servo_rad[k].tolist()}
        yield "/clutches", at_ns, {"engaged": recording.engaged[k].tolist()}
