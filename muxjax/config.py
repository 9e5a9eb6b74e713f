"""YAML files to frozen, validated types. Imports no JAX.

Every physical value of a robot is written with where it comes from::

    radius_m: {value: 0.030, source: assumed, why: "not published"}

so that a figure in a paper can be traced to a published, derived or assumed number.
Field names carry their unit. Tendons, segments, servos and axial positions count from 1 in files.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

_CHECKOUT = Path(__file__).resolve().parent.parent
_WHEEL = Path(__file__).resolve().parent / "_data"


_LEAST_GAP_DEG = 0.1  # between tendons of two segments; 0.05 mm on a circle of 30 mm


class ConfigError(ValueError):
    """A configuration file that cannot be used; the message names field, value and limit."""


def data_folder(kind: str) -> Path:
    """Folder of shipped data (``"configs"``), in a checkout or inside an installed wheel."""
    inside_wheel = _WHEEL / kind
    return inside_wheel if inside_wheel.is_dir() else _CHECKOUT / kind


def resolve(name_or_path: str | Path, folder: str) -> Path:
    """Path of a shipped file by its bare name, or of a user's file by its path.

    Args:
        name_or_path: ``"muxarm"`` for the shipped file, or any path that ends in .yaml or .yml.
        folder: Folder below ``configs`` in which bare names are looked up, such as ``"robots"``.

    Raises:
        ConfigError: No such file; the message lists the shipped names.
    """
    path = Path(name_or_path)
    if path.suffix in {".yaml", ".yml"}:
        if not path.is_file():
            raise ConfigError(f"{path}: no such file")
        return path
    shipped = data_folder("configs") / folder
    candidate = shipped / f"{name_or_path}.yaml"
    if path.name != str(name_or_path) or not candidate.is_file():
        names = ", ".join(sorted(p.stem for p in shipped.glob("*.yaml")))
        raise ConfigError(
            f"{folder}: no {str(name_or_path)!r} among the shipped files ({names}); "
            "a file of your own is named by a path ending in .yaml"
        )
    return candidate


class Strict(BaseModel):
    """Base of every configuration type: unknown keys, NaN and later changes are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True
    )


AnyStrict = TypeVar("AnyStrict", bound=Strict)


def load_yaml(model: type[AnyStrict], path: Path) -> AnyStrict:
    """Read one YAML file into ``model``.

    Raises:
        ConfigError: Unreadable YAML, or a field that is wrong; every wrong field is listed with
            its path, the value found and the limit.
    """
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: not readable as YAML: {error}") from error
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}: expected a mapping at the top, found {type(raw).__name__}")
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error)}") from error


def load_json(model: type[AnyStrict], path: str | Path) -> AnyStrict:
    """Read one JSON file into ``model``.

    Raises:
        ConfigError: No such file, not JSON, another schema or a wrong field; each named.
    """
    try:
        return model.model_validate_json(Path(path).read_bytes())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error)}") from error


def save_json(document: Strict, path: str | Path) -> None:
    """Write a document as JSON; a file of that name is replaced whole or not at all."""
    with replacing(path) as part:
        part.write_text(document.model_dump_json(by_alias=True, indent=2) + "\n", encoding="utf-8")


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A path beside this one to write to; what was written then takes this one's place.

    A writer that dies or raises leaves the old file as it was. The folder is made. The name keeps
    its suffix, by which some writers know their format.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    yield part
    os.replace(part, path)


def explain(error: ValidationError) -> str:
    """Every wrong field of a file with its path, the value found and the limit; one a line."""
    lines = []
    items = error.errors(include_url=False)
    for item in items:
        if item["type"] == "too_short" and any(_is_within(o["loc"], item["loc"]) for o in items):
            continue  # wrong items were not counted; they are named themselves
        where = "".join(f"[{p + 1}]" if isinstance(p, int) else f".{p}" for p in item["loc"])
        silent = item["type"] in {"missing", "value_error", "json_invalid"}
        found = "" if silent else f", found {_clipped(item['input'])}"
        message = item["msg"].removeprefix("Value error, ")
        if item["type"] == "model_type" and item["ctx"]["class_name"].startswith("Sourced"):
            shown = _clipped(item["input"]) if _is_plain(item["input"]) else "..."
            message = f"write {{value: {shown}, source: published | derived | assumed, why: ...}}"
        place = where.lstrip(".")
        if not place and item["type"] != "value_error":  # a check across fields names them itself
            place = "file"
        lines.append(f"{place}: {message}{found}" if place else message)
    if len(lines) == 1:
        return lines[0]
    return "\n  ".join([f"{len(lines)} faults", *lines])


def _is_within(inner: tuple[int | str, ...], outer: tuple[int | str, ...]) -> bool:
    return len(inner) > len(outer) and inner[: len(outer)] == outer


def _is_plain(value: object) -> bool:
    """A number or a word, which a person can be shown how to write."""
    return isinstance(value, (int, float, str)) and not isinstance(value, bool)


def _clipped(value: object, length: int = 80) -> str:
    text = repr(value)
    return text if len(text) <= length else text[: length - 3] + "..."


Value = TypeVar("Value")


class Sourced(Strict, Generic[Value]):
    """A value, where it comes from, and why it is what it is."""

    value: Value
    source: Literal["published", "derived", "assumed"]
    why: Annotated[str, Field(min_length=3)]


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Radius = Annotated[float, Field(gt=0, le=1)]  # [m]; more was meant as millimetres
Vector3 = tuple[float, float, float]


class FrameConfig(Strict):
    """A rigid frame: translation, then roll-pitch-yaw as Rz(yaw) Ry(pitch) Rx(roll)."""

    xyz_m: Vector3 = (0.0, 0.0, 0.0)
    rpy_deg: Vector3 = (0.0, 0.0, 0.0)


class TargetConfig(Strict):
    """A named tool pose in the world, its orientation as a quaternion or as roll-pitch-yaw."""

    name: Annotated[str, Field(pattern=r"^\w[\w .-]*$", description="also names its picture")]
    position_m: Vector3
    quaternion_wxyz: tuple[float, float, float, float] | None = None
    rpy_deg: Vector3 | None = None
    near_q_deg: tuple[float, ...] | None = Field(
        default=None, description="of several configurations that reach the pose, one near this"
    )
    base: FrameConfig | None = Field(
        default=None, description="where the arm's root stands; the robot's own base if left out"
    )

    @model_validator(mode="after")
    def _one_orientation(self) -> Self:
        if (self.quaternion_wxyz is None) == (self.rpy_deg is None):
            raise ValueError(f"{self.name}: give either quaternion_wxyz or rpy_deg")
        if self.quaternion_wxyz is not None:
            norm = math.hypot(*self.quaternion_wxyz)
            if abs(norm - 1) > 1e-3:
                raise ValueError(f"{self.name}: quaternion_wxyz has norm {norm:g}, must be 1")
        return self


class TaskConfig(Strict):
    """Tool poses to reach one after the other, each from the straight arm."""

    file_schema: Literal["muxjax/task/1"] = Field(alias="schema")
    name: str
    world: str | None = Field(
        default=None, description="obstacles: a shipped world, or a file beside the task's own"
    )
    targets: Annotated[tuple[TargetConfig, ...], Field(min_length=1)]

    @field_validator("targets")
    @classmethod
    def _names_differ(cls, targets: tuple[TargetConfig, ...]) -> tuple[TargetConfig, ...]:
        names = [target.name.replace(" ", "_") for target in targets]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two targets are named {name!r}")
        return targets


class SegmentConfig(Strict):
    """One continuum segment, base to tip."""

    length_m: Sourced[Annotated[float, Field(gt=0, le=10)]]
    n_discs: Sourced[Annotated[int, Field(ge=1, le=1000)]]
    theta_max_deg: Sourced[Annotated[float, Field(gt=0, le=360)]]
    tendon_offset_deg: Sourced[float]


class TendonConfig(Strict):
    """Tendon routing; see MODEL.md section 3 for the azimuth table psi[n, i, j]."""

    per_segment: Sourced[Annotated[int, Field(ge=3, le=64)]]
    radius_m: Sourced[Radius]
    routing: Sourced[Literal["parallel", "printed", "table"]]
    azimuth_deg: tuple[tuple[tuple[float, ...], ...], ...] | None = Field(
        default=None, description="psi[n][i][j], only with routing 'table'"
    )


class BodyConfig(Strict):
    """The arm's outer shape and mass."""

    disc_radius_m: Sourced[Radius]
    mass_kg: Sourced[Positive]
    driver_payload_kg: Sourced[Positive]


class TransmissionConfig(Strict):
    """From servo shaft to tendon."""

    gear_ratio: Sourced[Positive]
    wheel_radius_m: Sourced[Radius]


class ServoConfig(Strict):
    """One radial servo; there are as many as tendons in a segment."""

    speed_rpm: Sourced[Positive]
    rated_torque_nm: Sourced[Positive]
    peak_torque_nm: Sourced[Positive]
    stall_torque_nm: Sourced[Positive]

    @model_validator(mode="after")
    def _torques_rise(self) -> Self:
        rated, peak, stall = (
            torque.value
            for torque in (self.rated_torque_nm, self.peak_torque_nm, self.stall_torque_nm)
        )
        if rated > peak:
            raise ValueError(
                f"rated_torque_nm: must not be above peak_torque_nm ({peak:g}), found {rated:g}"
            )
        if peak > stall:
            raise ValueError(
                f"peak_torque_nm: must not be above stall_torque_nm ({stall:g}), found {peak:g}"
            )
        return self


class DriveStrengthConfig(Strict):
    """What the drive withstands. Lengths, times and programs do not depend on it."""

    worm_efficiency: Sourced[Annotated[float, Field(gt=0, le=1)]] = Field(
        description="worm and gear train together, servo driving"
    )
    clutch_torque_nm: Sourced[Positive] = Field(
        description="torque at the clutch, on the servo's shaft, above which its plug slips"
    )


class AxialConfig(Strict):
    """The axial motor and the map c = F(a, s) of M Eq. 10."""

    switch_time_s: Sourced[Positive] = Field(description="t_sw: repositioning and engagement")
    engage_time_s: Sourced[NotNegative] = Field(
        description="share of t_sw that remains where the drum need not turn"
    )
    map: Sourced[Literal["rule"] | tuple[tuple[int, ...], ...]] = Field(
        description="'rule' of MODEL.md section 4, or for each axial position the tendon number "
        "that each servo meets there"
    )


class ClutchConfig(Strict):
    """Electromagnetic clutches."""

    engage_time_s: Sourced[NotNegative]
    coil_current_a: Sourced[Positive]
    slip_m: Sourced[Annotated[float, Field(ge=0, le=0.1)]] = Field(
        description="tendon change at each switch"
    )


class EncoderConfig(Strict):
    """Winding-wheel encoders."""

    bits: Sourced[Annotated[int, Field(ge=8, le=24)]]
    inl_deg: Sourced[NotNegative]


class PartConfig(Strict):
    """One line of a cost sheet."""

    name: Annotated[str, Field(min_length=1)]
    kind: Literal["motor", "standard", "non-standard"]
    count: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="left out where it is not stated, as for screws"
    )
    price_usd: Positive = Field(description="of all of them together")
    source: Literal["published", "derived", "assumed"]
    why: Annotated[str, Field(min_length=3)]


class SingleActuatorConfig(Strict):
    """The actuator that every tendon would have of its own, without multiplexing."""

    name: Annotated[str, Field(min_length=1)]
    price_usd: Sourced[Positive] = Field(description="of one")


class CostConfig(Strict):
    """What the drive is built of and costs, and what the robot's makers say about that."""

    parts: Annotated[tuple[PartConfig, ...], Field(min_length=1)]
    total_usd: Sourced[Positive] | None = Field(
        default=None, description="as stated; the parts must add up to it, to the cent"
    )
    single_actuator: SingleActuatorConfig
    saving_percent: Sourced[Positive] | None = Field(
        default=None, description="as stated, against an actuator a tendon"
    )
    fewer_motors_percent: Sourced[Positive] | None = Field(default=None, description="as stated")

    @model_validator(mode="after")
    def _parts_add_up(self) -> Self:
        found = math.fsum(part.price_usd for part in self.parts)
        if self.total_usd is not None and abs(found - self.total_usd.value) >= 0.005:
            raise ValueError(
                f"cost.total_usd: the parts add up to {found:.2f}, found {self.total_usd.value:.2f}"
            )
        return self


class RobotConfig(Strict):
    """A time-multiplexed tendon arm as its YAML file states it."""

    file_schema: Literal["muxjax/robot/1"] = Field(alias="schema")
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    base_frame: FrameConfig = FrameConfig()
    tool_frame: FrameConfig = FrameConfig()
    segments: Annotated[tuple[SegmentConfig, ...], Field(min_length=1, max_length=32)]
    tendons: TendonConfig
    body: BodyConfig
    transmission: TransmissionConfig
    servo: ServoConfig
    axial: AxialConfig
    clutch: ClutchConfig
    encoder: EncoderConfig
    drive_strength: DriveStrengthConfig | None = None
    cost: CostConfig | None = None

    @field_validator("segments")
    @classmethod
    def _tendons_fit(cls, segments: tuple[SegmentConfig, ...]) -> tuple[SegmentConfig, ...]:
        for number, segment in enumerate(segments, start=1):
            per_gap = math.radians(segment.theta_max_deg.value) / segment.n_discs.value
            if per_gap >= math.pi:
                raise ValueError(
                    f"segment {number}: theta_max_deg / n_discs is {math.degrees(per_gap):g} "
                    "degrees a disc, must be below 180"
                )
        return segments

    @model_validator(mode="after")
    def _tendons_run_inside_the_discs(self) -> Self:
        circle, disc = self.tendons.radius_m.value, self.body.disc_radius_m.value
        if circle > disc:
            raise ValueError(
                f"tendons.radius_m: must not be above body.disc_radius_m ({disc:g}), the tendons "
                f"run through the discs; found {circle:g}"
            )
        return self

    @model_validator(mode="after")
    def _tendons_run_side_by_side(self) -> Self:
        """With parallel runs all tendons pass the base, each at its own azimuth."""
        if self.tendons.routing.value != "parallel":
            return self
        pitch = 360.0 / self.n_servos
        offsets = [segment.tendon_offset_deg.value for segment in self.segments]
        for second, at in enumerate(offsets, start=1):
            for first, other in enumerate(offsets[: second - 1], start=1):
                gap = abs((at - other + pitch / 2) % pitch - pitch / 2)
                if gap < _LEAST_GAP_DEG:
                    raise ValueError(
                        f"segments[{second}].tendon_offset_deg: the tendons of segments {first} "
                        f"and {second} lie on each other at the base, {gap:.2g} degrees apart; "
                        f"must be at least {_LEAST_GAP_DEG:g}, counting modulo {pitch:g}, one "
                        f"tendon's share; found {other:g} and {at:g}"
                    )
        return self

    @model_validator(mode="after")
    def _engaging_is_part_of_switching(self) -> Self:
        engage, switch = self.axial.engage_time_s.value, self.axial.switch_time_s.value
        if engage >= switch:
            raise ValueError(
                f"axial.engage_time_s: must be below switch_time_s ({switch:g}), found {engage:g}"
            )
        return self

    @model_validator(mode="after")
    def _routing_is_complete(self) -> Self:
        table, kind = self.tendons.azimuth_deg, self.tendons.routing.value
        s, j = self.n_segments, self.n_servos
        if (table is not None) != (kind == "table"):
            raise ValueError("tendons.azimuth_deg: given if and only if routing is 'table'")
        if table is None:
            return self
        if [len(row) for row in table] != [s] * s or any(len(t) != j for r in table for t in r):
            raise ValueError(f"tendons.azimuth_deg: must have shape {s} x {s} x {j}")
        for i in range(s):
            own = table[i][i]
            for k, azimuth in enumerate(own):
                gap = (azimuth - own[0] - 360.0 * k / j + 180.0) % 360.0 - 180.0
                if abs(gap) > 1e-9:
                    raise ValueError(
                        f"tendons.azimuth_deg[{i + 1}][{i + 1}]: the tendons of a segment must be "
                        f"evenly spaced in it; tendon {k + 1} is {gap:g} degrees off"
                    )
        return self

    @model_validator(mode="after")
    def _axial_map_is_onto(self) -> Self:
        rows, j = self.axial_map, self.n_servos
        for a, row in enumerate(rows, start=1):
            where = f"axial.map.value[{a}]"
            if len(row) != j:
                raise ValueError(f"{where}: must name {j} tendons, one a servo; found {len(row)}")
            if any(not 1 <= c <= self.n_tendons for c in row):
                raise ValueError(f"{where}: tendons are 1 to {self.n_tendons}, found {row}")
            if len({(c - 1) // j for c in row}) > 1 or len(set(row)) < j:
                raise ValueError(
                    f"{where}: all servos of one axial position must meet different tendons "
                    f"of one segment (the layer constraint P_i), found {row}"
                )
        missing = set(range(1, self.n_tendons + 1)) - {c for row in rows for c in row}
        if missing:
            raise ValueError(
                f"axial.map.value: no axial position reaches tendons {sorted(missing)}"
            )
        return self

    @model_validator(mode="after")
    def _cost_names_every_motor(self) -> Self:
        if self.cost is not None:
            motors = sum(part.count or 0 for part in self.cost.parts if part.kind == "motor")
            if motors != self.n_servos + 1:
                raise ValueError(
                    f"cost.parts: must count {self.n_servos + 1} motors, the {self.n_servos} "
                    f"servos and the axial motor, found {motors}"
                )
        return self

    @property
    def n_segments(self) -> int:
        """S."""
        return len(self.segments)

    @property
    def n_servos(self) -> int:
        """J: radial servos, equal to the tendons of a segment."""
        return self.tendons.per_segment.value

    @property
    def n_tendons(self) -> int:
        """S * J."""
        return self.n_segments * self.n_servos

    @cached_property
    def axial_map(self) -> tuple[tuple[int, ...], ...]:
        """Tendon number met by servo s at axial position a, as ``[a][s]``, counting from 1.

        The rule (MODEL.md section 4): plug = (a + S s) mod (S J), layer = plug mod S,
        tendon of the layer = plug div S, all counting from 0.
        """
        if self.axial.map.value != "rule":
            return self.axial.map.value
        s, j = self.n_segments, self.n_servos
        plugs = [[(a + s * servo) % (s * j) for servo in range(j)] for a in range(s * j)]
        return tuple(tuple(j * (p % s) + p // s + 1 for p in row) for row in plugs)

    @cached_property
    def fingerprint(self) -> str:
        """Hash over every value (not the reasons), by which programs name their robot.

        The strength of the drive and its cost are left out: the same program runs on a stronger
        one, and at any price.
        """
        values = _values_only(self.model_dump(mode="json", exclude={"drive_strength", "cost"}))
        text = json.dumps(values, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def __repr__(self) -> str:
        return f"RobotConfig({self.name!r}, {self.fingerprint})"

    # A robot is a static argument of compiled functions: comparing two 16-character strings keeps
    # the call overhead of those functions small.
    def __eq__(self, other: object) -> bool:
        return isinstance(other, RobotConfig) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)


def _values_only(tree: Any) -> Any:
    if isinstance(tree, dict):
        if tree.keys() == {"value", "source", "why"}:
            return tree["value"]
        return {key: _values_only(item) for key, item in tree.items()}
    if isinstance(tree, list):
        return [_values_only(item) for item in tree]
    return tree
