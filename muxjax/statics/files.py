"""Chains from YAML files (schema ``muxjax/chain/1``) and from a robot's disc data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from muxjax.config import (
    ConfigError,
    FrameConfig,
    NotNegative,
    Positive,
    Sourced,
    Strict,
    Vector3,
    load_yaml,
    resolve,
)
from muxjax.precision import host_array
from muxjax.robot import Robot, frame_pose
from muxjax.statics.chain import ElasticChain

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class HingeConfig(Strict):
    """Elastic hinges, one stiffness for all of a segment's joints of a kind."""

    bending_nm_rad: Sourced[Positive]
    twist_nm_rad: Sourced[Positive] | None = None
    cubic_nm_rad3: Sourced[NotNegative] | None = None


class RodConfig(Strict):
    """A solid round elastic rod; joint stiffness is EI / pitch and GJ / pitch."""

    radius_m: Sourced[Positive]
    youngs_modulus_pa: Sourced[Positive]
    shear_modulus_pa: Sourced[Positive]


class ChainSegmentConfig(Strict):
    """Beads of one segment, base to tip."""

    n_beads: Sourced[Annotated[int, Field(ge=1, le=2000)]]
    length_m: Sourced[Positive]
    joints: Sourced[tuple[Annotated[str, Field(pattern=r"^[xyz]+(\|[xyz]+)?$")], ...]] = Field(
        description="joint axes of successive beads, repeated, all in the middle of the pitch (a "
        "rod with holes at every second, fourth ... bead: at 1/3 and 2/3 in turn); holes are in "
        "the bead's upper face, or where a bar stands: between the joints"
    )
    hinge: HingeConfig | None = None
    rod: RodConfig | None = None
    bead_mass_kg: Sourced[NotNegative]

    @model_validator(mode="after")
    def _one_kind_of_spring(self) -> ChainSegmentConfig:
        if (self.hinge is None) == (self.rod is None):
            raise ValueError("segment: give either hinge or rod")
        twists = any("z" in axes for axes in self.joints.value)
        if twists and self.hinge is not None and self.hinge.twist_nm_rad is None:
            raise ValueError("segment: twist joints (z) need hinge.twist_nm_rad")
        return self


class ChainTendonConfig(Strict):
    """One tendon, parallel to the straight backbone, through every n-th bead."""

    segment: Annotated[int, Field(ge=1, description="where it ends")]
    azimuth_deg: float
    radius_m: Positive


class ChainConfig(Strict):
    """An elastic joint chain as its YAML file states it."""

    file_schema: Literal["muxjax/chain/1"] = Field(alias="schema")
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    base_frame: FrameConfig = FrameConfig()
    tip_frame: FrameConfig = Field(default=FrameConfig(), description="in the last bead")
    gravity_m_s2: Sourced[Vector3] | None = Field(
        default=None, description="in the base frame; needed where beads have a mass"
    )
    segments: Annotated[tuple[ChainSegmentConfig, ...], Field(min_length=1, max_length=32)]
    tendons: Sourced[Annotated[tuple[ChainTendonConfig, ...], Field(min_length=1, max_length=64)]]
    hole_every: Annotated[int, Field(ge=1, description="beads from one hole to the next")] = 1
    tendon_stiffness_n_m: Sourced[Positive]
    slack_width_n: Sourced[Positive]

    @model_validator(mode="after")
    def _parts_fit(self) -> ChainConfig:
        heavy = any(s.bead_mass_kg.value > 0 for s in self.segments)
        if heavy and self.gravity_m_s2 is None:
            raise ValueError(
                "gravity_m_s2: needed because beads have a mass; (0, 0, 0) is no gravity"
            )
        for number, segment in enumerate(self.segments, start=1):
            if segment.n_beads.value % self.hole_every:
                raise ValueError(
                    f"hole_every: must divide the {segment.n_beads.value} beads of segment "
                    f"{number}, found {self.hole_every}"
                )
            if self.hole_every > 1 and any("|" in axes for axes in segment.joints.value):
                raise ValueError("hole_every: must be 1 with holes between the joints ('|')")
        for number, tendon in enumerate(self.tendons.value, start=1):
            if tendon.segment > len(self.segments):
                raise ValueError(
                    f"tendons[{number}].segment: segments are 1 to {len(self.segments)}, "
                    f"found {tendon.segment}"
                )
        return self


def load_chain(
    name_or_path: str | Path,
    *,
    resolution: int | None = None,
    hole_every: int | None = None,
    length: float | None = None,
) -> ElasticChain:
    """Read a chain: ``"hyper_redundant"``, ``"tdcr_a"``, ``"tdcr_b"``, ``"tdcr_c"``, or a path.

    Args:
        name_or_path: A shipped chain, or a YAML file of the schema ``muxjax/chain/1``.
        resolution: Beads a segment instead of the file's number, with the same total mass and, for
            rods, the same rod: how convergence with pitch is studied. Hinges keep their stiffness
            only as a whole segment: each one gets stiffer with their number.
        hole_every: Beads from one hole to the next instead of the file's number.
        length: Length of every segment [m] instead of the file's.

    Raises:
        ConfigError: No such chain, or wrong values; names each field, the value and the limit.
    """
    config = load_yaml(ChainConfig, resolve(name_or_path, "chains"))
    every = config.hole_every if hole_every is None else hole_every
    if resolution is not None and (resolution < 1 or resolution % every):
        raise ConfigError(
            f"resolution: must be a positive multiple of hole_every ({every}), found {resolution}"
        )
    if length is not None and not 0 < length < math.inf:
        raise ConfigError(f"length: must be above 0 m, found {length}")
    counts = [resolution or s.n_beads.value for s in config.segments]
    if any(every < 1 or n % every for n in counts):
        raise ConfigError(f"hole_every: must divide the {counts} beads, found {every}")
    return _assemble(config, counts, every, length)


class _Parts(NamedTuple):
    """Lists that grow bead by bead."""

    axis: list[tuple[float, float, float]]
    height: list[float]  # of each joint above the one before [m]
    stiffness: list[float]
    cubic: list[float]
    mass: list[float]
    centre: list[float]  # of mass above its joint [m]
    holes: list[tuple[int, float]]  # bodies with holes and the holes' height in them
    ends: list[tuple[int, float]]  # the same of the segments' ends


def _assemble(
    config: ChainConfig, counts: Sequence[int], every: int, length: float | None
) -> ElasticChain:
    """Joints bead by bead, then holes tendon by tendon."""
    parts = _Parts([], [], [], [], [], [], [(0, 0.0)], [])
    above = 0.0
    for segment, count in zip(config.segments, counts, strict=True):
        pitch = (length or segment.length_m.value) / count
        for bead in range(count):
            below = pitch * _joint_height(segment, bead, every)
            _add_bead(parts, segment, count, bead, pitch, above + below)
            above = pitch - below
            if parts.holes[-1][0] != len(parts.axis) and (
                "|" not in _pattern(segment, bead) or bead == count - 1
            ):
                parts.holes.append((len(parts.axis), above))
        parts.ends.append(parts.holes[-1])
    threaded = [hole for i, hole in enumerate(parts.holes) if i % every == 0 or hole in parts.ends]
    routing: list[tuple[int, ...]] = []
    hole: list[tuple[float, float, float]] = []
    for tendon in config.tendons.value:
        azimuth = math.radians(tendon.azimuth_deg)
        x, y = tendon.radius_m * math.cos(azimuth), tendon.radius_m * math.sin(azimuth)
        own = threaded[: threaded.index(parts.ends[tendon.segment - 1]) + 1]
        routing.append(tuple(body for body, _ in own))
        hole.extend((x, y, height) for _, height in own)
    n = len(parts.axis)
    ends = np.stack([_raised(height) for _, height in parts.ends])
    return ElasticChain(
        axis=np.array(parts.axis),
        offset=np.stack([np.zeros(n), np.zeros(n), parts.height], axis=-1),
        stiffness=np.array(parts.stiffness),
        cubic=np.array(parts.cubic),
        mass=np.array(parts.mass),
        com=np.stack([np.zeros(n), np.zeros(n), parts.centre], axis=-1),
        hole=np.array(hole),
        tendon_stiffness=np.full(len(routing), config.tendon_stiffness_n_m.value),
        slack_width=np.array(config.slack_width_n.value),
        gravity=np.array(config.gravity_m_s2.value if config.gravity_m_s2 else (0.0, 0.0, 0.0)),
        base=frame_pose(config.base_frame),
        tip=ends[-1] @ frame_pose(config.tip_frame),
        end_frame=ends,
        routing=tuple(routing),
        segment_bodies=tuple(body for body, _ in parts.ends),
        name=config.name,
    )


def _pattern(segment: ChainSegmentConfig, bead: int) -> str:
    return segment.joints.value[bead % len(segment.joints.value)]


def _joint_height(segment: ChainSegmentConfig, bead: int, every: int) -> float:
    """Height of a bead's joints as a share of its pitch: hinges are in the middle.

    A rod that bends between two holes of a tendon stands off the tendon's chord, by h^2 / 12 of its
    curvature in the mean over a pitch h of holes, and that much the tendon's lever changes.
    Joints in the middle of N beads give (1 / 12 + 1 / (6 N^2)) h^2; pairs of joints at 1/6 and 5/6
    of two beads give exactly 1 / 12, and the arm's bending as a whole as well.
    """
    if segment.rod is None or every % 2:
        return 0.5
    return 1 / 3 if bead % 2 == 0 else 2 / 3


def _add_bead(
    parts: _Parts,
    segment: ChainSegmentConfig,
    count: int,
    bead: int,
    pitch: float,
    height: float,
) -> None:
    """The joints of one bead; where an axis occurs several times, they are springs in series."""
    finer = count / segment.n_beads.value
    pattern = _pattern(segment, bead)
    names = pattern.replace("|", "")
    for i, name in enumerate(names):
        series = names.count(name)
        parts.axis.append(AXES[name])
        parts.height.append(height if i == 0 else 0.0)
        parts.stiffness.append(series * _stiffness(segment, name, pitch, finer))
        parts.cubic.append(series**3 * _cubic(segment, name, finer))
        last = i == len(names) - 1
        parts.mass.append(segment.bead_mass_kg.value / finer if last else 0.0)
        # A bead's centre is between its joint and the next; a rod's weight is where it bends.
        parts.centre.append(pitch / 2 if segment.hinge else 0.0)
        if pattern[i + 1 : i + 2] == "|":
            parts.holes.append((len(parts.axis), 0.0))


def _stiffness(segment: ChainSegmentConfig, axis: str, pitch: float, finer: float) -> float:
    """Of all of a bead's joints about one axis in series [N m/rad]."""
    if segment.rod is not None:
        second = math.pi * segment.rod.radius_m.value**4 / 4
        if axis == "z":
            return segment.rod.shear_modulus_pa.value * 2 * second / pitch
        return segment.rod.youngs_modulus_pa.value * second / pitch
    assert segment.hinge is not None  # the schema demands one of the two
    twist = segment.hinge.twist_nm_rad
    per_bead = twist if axis == "z" and twist else segment.hinge.bending_nm_rad
    return per_bead.value * finer


def _cubic(segment: ChainSegmentConfig, axis: str, finer: float) -> float:
    if segment.hinge is None or segment.hinge.cubic_nm_rad3 is None or axis == "z":
        return 0.0
    return segment.hinge.cubic_nm_rad3.value * finer**3


def elastic_chain(
    robot: Robot,
    *,
    bending_stiffness: float = 15.0,
    tendon_stiffness: float = 2e4,
    slack_width: float = 0.01,
    mass: float = 0.5,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
) -> ElasticChain:
    """A time-multiplexed arm as an elastic chain: a universal joint between any two discs.

    Discs, lengths, tendon routing, base and tool come from the robot. None of the paper's text
    gives the springs: their stiffness, and that of the tendons, are **assumed**, so state results
    with their range. The backbone does not twist.

    Args:
        robot: The arm.
        bending_stiffness: Of one universal joint, about both axes [N m/rad] (assumed: twelve
            springs of 4 N/mm, 25 mm from the axis; with soft springs and stiff tendons the arm
            kinks between its discs, see docs/muxarm_under_load.md).
        tendon_stiffness: K_t of every tendon [N/m] (assumed: about a metre of 1 mm steel rope).
        slack_width: Tension below which a tendon goes slack smoothly [N].
        mass: Of the arm beyond its base [kg], spread evenly over the discs (assumed: 20 g a
            disc; the published 2.17 kg is that of arm and driver together).
        gravity: In the **world** [m/s^2]; the chain keeps it in its base frame.

    Raises:
        ValueError: A stiffness or width that is not above 0, a mass below 0, or gravity that is
            not three finite numbers.
    """
    values = {
        "bending_stiffness": bending_stiffness,
        "tendon_stiffness": tendon_stiffness,
        "slack_width": slack_width,
    }
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name}: must be above 0, found {value:g}")
    if not 0 <= mass < math.inf:
        raise ValueError(f"mass: must be at least 0 kg, found {mass:g}")
    down = host_array("gravity", gravity, last=3)
    discs = robot.n_discs.astype(int)
    pitch = np.repeat(np.asarray(robot.length) / discs, discs)
    n = 2 * len(pitch)
    # x y, y x, x y ...: neither axis is systematically nearer to the tip.
    order = np.where(np.arange(len(pitch))[:, None] % 2 == 0, [[0, 1]], [[1, 0]])
    offset = np.zeros((n, 3))
    offset[0::2, 2] = (pitch + np.concatenate([[0.0], pitch[:-1]])) / 2
    disc_mass = np.zeros(n)
    disc_mass[1::2] = mass / len(pitch)
    com = np.zeros((n, 3))
    com[1::2, 2] = pitch / 2
    last_discs = np.cumsum(discs)
    routing, hole = _parallel_routing(robot, pitch)
    ends = np.stack([_raised(pitch[disc - 1] / 2) for disc in last_discs])
    base = np.asarray(robot.base, dtype=np.float64)
    return ElasticChain(
        axis=np.eye(3)[order.ravel()],
        offset=offset,
        stiffness=np.full(n, float(bending_stiffness)),
        cubic=np.zeros(n),
        mass=disc_mass,
        com=com,
        hole=hole,
        tendon_stiffness=np.full(robot.n_tendons, float(tendon_stiffness)),
        slack_width=np.array(float(slack_width)),
        gravity=base[:3, :3].T @ down,
        base=base,
        tip=ends[-1] @ np.asarray(robot.tool),
        end_frame=ends,
        routing=routing,
        segment_bodies=tuple(2 * int(disc) for disc in last_discs),
        name=robot.config.name,
    )


def _parallel_routing(
    robot: Robot, pitch: Float[np.ndarray, " discs"]
) -> tuple[tuple[tuple[int, ...], ...], Float[np.ndarray, "H 3"]]:
    """Holes at the azimuths psi[n, i, j] of each segment that a tendon crosses."""
    discs = robot.n_discs.astype(int)
    owner = np.repeat(np.arange(robot.n_segments), discs)
    routing, holes = [], []
    for i in range(robot.n_segments):
        count = int(discs[: i + 1].sum())
        for j in range(robot.tendons_per_segment):
            azimuth = np.asarray(robot.tendon_azimuth)[owner[:count], i, j]
            # In the base the tendon leaves straight into the first disc's hole.
            azimuth = np.concatenate([azimuth[:1], azimuth])
            height = np.concatenate([[0.0], pitch[:count] / 2])
            circle = float(robot.tendon_radius) * np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
            routing.append(tuple(range(0, 2 * count + 1, 2)))
            holes.append(np.concatenate([circle, height[:, None]], axis=-1))
    return tuple(routing), np.concatenate(holes)


def _raised(height: float) -> Float[np.ndarray, "4 4"]:
    frame = np.eye(4)
    frame[2, 3] = height
    return frame
