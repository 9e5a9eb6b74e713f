"""What of a chain can be fitted, and where it stands in the chain and in its file.

A parameter is a number theta that is 0 for the chain as its file states it: the logarithm of a
factor for stiffness, tendon stiffness, lengths and radii, the value itself for offsets and base.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float, Int

from muxjax.kinematics import stumpff
from muxjax.statics.chain import ElasticChain
from muxjax.statics.files import ChainConfig
from muxjax.statics.newton import Given

Array = Any
Group = Literal["stiffness", "twist", "elasticity", "offsets", "geometry", "base"]

# How far a value may plausibly be from the file's: standard deviations of the fit's prior.
SPREAD = 0.5  # of a logarithm
SPREAD_M, SPREAD_RAD, SPREAD_N = 0.01, 0.1, 1.0
REACH = 4.0  # bounds of the fit, in spreads


class Parameter(NamedTuple):
    """One number to be fitted."""

    name: str  # such as "stiffness_1"
    kind: str  # what it scales or shifts
    which: int  # segment, tendon or axis, counted from 0
    unit: str
    start: float  # physical value in the file
    logarithmic: bool
    spread: float

    def physical(self, theta: float) -> float:
        """Value in its unit."""
        return float(self.start * np.exp(theta) if self.logarithmic else self.start + theta)


def parameters_of(
    config: ChainConfig, groups: Sequence[str], given: Given
) -> tuple[Parameter, ...]:
    """All parameters of the named groups.

    Raises:
        ValueError: Unknown group, none at all, or twist without twist joints.
    """
    makers = {
        "stiffness": lambda: _stiffness(config, "stiffness"),
        "twist": lambda: _stiffness(config, "twist"),
        "elasticity": lambda: [_scale("elasticity", 0, "N/m", config.tendon_stiffness_n_m.value)],
        "offsets": lambda: _offsets(config, given),
        "geometry": lambda: _geometry(config),
        "base": lambda: _base(config),
    }
    wrong = [group for group in groups if group not in makers]
    if wrong or not groups:
        found = f"found {wrong[0]!r}" if wrong else "found none"
        raise ValueError(f"fit: must name some of {', '.join(makers)}; {found}")
    return tuple(p for name, make in makers.items() if name in groups for p in make())


def _scale(name: str, index: int, unit: str, start: float, *, numbered: bool = False) -> Parameter:
    label = f"{name}_{index + 1}" if numbered else name
    return Parameter(label, name, index, unit, start, True, SPREAD)


def _stiffness(config: ChainConfig, kind: str) -> list[Parameter]:
    found = []
    for index, segment in enumerate(config.segments):
        if kind == "twist" and not any("z" in axes for axes in segment.joints.value):
            raise ValueError(f"fit: twist needs twist joints (z), segment {index + 1} has none")
        if segment.rod is not None:
            modulus = "youngs_modulus_pa" if kind == "stiffness" else "shear_modulus_pa"
            unit, value = "Pa", getattr(segment.rod, modulus).value
        else:
            field = "bending_nm_rad" if kind == "stiffness" else "twist_nm_rad"
            unit, value = "N m/rad", getattr(segment.hinge, field).value
        found.append(_scale(kind, index, unit, value, numbered=True))
    return found


def _offsets(config: ChainConfig, given: Given) -> list[Parameter]:
    unit, spread = ("N", SPREAD_N) if given == "tension" else ("m", SPREAD_M)
    return [
        Parameter(f"offset_{k + 1}", "offset", k, unit, 0.0, False, spread)
        for k in range(len(config.tendons.value))
    ]


def _geometry(config: ChainConfig) -> list[Parameter]:
    lengths = [
        _scale("length", i, "m", s.length_m.value, numbered=True)
        for i, s in enumerate(config.segments)
    ]
    radii = []
    for i in range(len(config.segments)):
        own = [t.radius_m for t in config.tendons.value if t.segment == i + 1]
        if own:
            radii.append(_scale("radius", i, "m", float(np.mean(own)), numbered=True))
    return lengths + radii


def _base(config: ChainConfig) -> list[Parameter]:
    axes = "xyz"
    moves = [
        Parameter(f"base_{a}", "base", i, "m", config.base_frame.xyz_m[i], False, SPREAD_M)
        for i, a in enumerate(axes)
    ]
    turns = [
        Parameter(f"base_r{a}", "base", 3 + i, "rad", 0.0, False, SPREAD_RAD)
        for i, a in enumerate(axes)
    ]
    return moves + turns


def _by_kind(
    parameters: Sequence[Parameter], theta: Float[Array, " P"], kind: str, size: int
) -> Float[Array, " N"]:
    """The thetas of one kind, 0 where there is no parameter."""
    values = jnp.zeros(size)
    for place, parameter in enumerate(parameters):
        if parameter.kind == kind:
            values = values.at[parameter.which].set(theta[place])
    return values


def segments_of(
    chain: ElasticChain, bodies: Sequence[int] | Int[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """Segment, from 0, that each body belongs to; the base (body 0) belongs to the first."""
    last = len(chain.segment_bodies) - 1
    return np.minimum(np.searchsorted(chain.segment_bodies, np.asarray(bodies)), last)


def with_parameters(
    chain: ElasticChain,
    config: ChainConfig,
    parameters: Sequence[Parameter],
    theta: Float[Array, " P"],
) -> ElasticChain:
    """The chain with the parameters applied; differentiable by theta.

    It is the chain that ``load_chain`` makes of the file with the same values (``as_document``).
    """
    size = len(config.segments)
    scale = {
        kind: jnp.exp(_by_kind(parameters, theta, kind, size))
        for kind in ("stiffness", "twist", "length", "radius")
    }
    own = segments_of(chain, range(1, chain.n_joints + 1))
    twisting = abs(jnp.asarray(chain.axis)[:, 2]) > 0.5
    factor = jnp.where(twisting, scale["twist"][own], scale["stiffness"][own])
    # A rod's joints are EI / pitch and GJ / pitch.
    rod = np.array([s.rod is not None for s in config.segments])[own]
    stiffness = chain.stiffness * factor / jnp.where(rod, scale["length"][own], 1.0)
    elastic = jnp.exp(_by_kind(parameters, theta, "elasticity", 1))[0]
    base, gravity = _moved_base(chain, _by_kind(parameters, theta, "base", 6))
    changes: dict[str, Array] = {
        "stiffness": stiffness,
        "tendon_stiffness": jnp.asarray(chain.tendon_stiffness) * elastic,
        "base": base,
        "gravity": gravity,
        **_resized(chain, scale["length"], scale["radius"], own),
    }
    names = tuple(changes)
    return eqx.tree_at(lambda c: [getattr(c, name) for name in names], chain, [*changes.values()])


def _resized(
    chain: ElasticChain, length: Float[Array, " S"], radius: Float[Array, " S"], own: np.ndarray
) -> dict[str, Array]:
    """Heights by the length factors, holes across by the radius factors."""
    tops = jnp.asarray(chain.end_frame)[:, 2, 3]
    # Between two segments half a pitch of each.
    first = np.flatnonzero(np.diff(own)) + 1
    before = jnp.zeros(chain.n_joints).at[first].set(tops[own[first] - 1])
    rest = jnp.asarray(chain.offset)[:, 2] - before
    height = before * length[np.maximum(own - 1, 0)] + rest * length[own]
    bodies = np.concatenate(chain.routing)
    ends = np.concatenate([np.full(len(b), b[-1]) for b in chain.routing])
    wide = radius[segments_of(chain, ends)]
    tall = length[segments_of(chain, bodies)]
    return {
        "offset": jnp.asarray(chain.offset).at[:, 2].set(height),
        "com": chain.com * jnp.stack([jnp.ones_like(height)] * 2 + [length[own]], axis=-1),
        "hole": chain.hole * jnp.stack([wide, wide, tall], axis=-1),
        "end_frame": jnp.asarray(chain.end_frame).at[:, 2, 3].multiply(length),
        "tip": jnp.asarray(chain.tip).at[2, 3].add((length[-1] - 1) * tops[-1]),
    }


def _moved_base(chain: ElasticChain, move: Float[Array, " 6"]) -> tuple[Array, Array]:
    """Base frame shifted and turned in the world, and the world's gravity seen in it."""
    x, y, z = move[3], move[4], move[5]
    u = x * x + y * y + z * z
    zero = jnp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    cross = jnp.stack([jnp.stack(row) for row in rows])
    turn = jnp.eye(3) + stumpff(u, 1) * cross + stumpff(u, 2) * (cross @ cross)
    base = jnp.asarray(chain.base)
    rotation = turn @ base[:3, :3]
    moved = base.at[:3, :3].set(rotation).at[:3, 3].add(move[:3])
    return moved, rotation.T @ (base[:3, :3] @ jnp.asarray(chain.gravity))


def offsets_of(
    parameters: Sequence[Parameter], theta: Float[Array, " P"], m: int
) -> Float[Array, " m"]:
    """Zero offset of each tendon's reading: reading = true value + offset."""
    return _by_kind(parameters, theta, "offset", m)


def as_document(config: ChainConfig, values: Mapping[str, float], why: str) -> dict[str, Any]:
    """The chain's file with fitted values, marked as derived.

    Args:
        config: The file as it was.
        values: Physical values by parameter name; those not named stay.
        why: What they were derived from.
    """
    document: dict[str, Any] = config.model_dump(mode="json", by_alias=True, exclude_none=True)
    for number, segment in enumerate(document["segments"], start=1):
        spring = segment.get("rod") or segment["hinge"]
        fields = {
            f"stiffness_{number}": (spring, ("youngs_modulus_pa", "bending_nm_rad")),
            f"twist_{number}": (spring, ("shear_modulus_pa", "twist_nm_rad")),
            f"length_{number}": (segment, ("length_m",)),
        }
        for name, (place, options) in fields.items():
            if name in values:
                field = next(f for f in options if f in place)
                place[field] = _derived(values[name], why)
    if "elasticity" in values:
        document["tendon_stiffness_n_m"] = _derived(values["elasticity"], why)
    _write_radii(document, config, values, why)
    if any(name.startswith("base_") for name in values):
        _write_base(document, config, values, why)
    return document


def _derived(value: Any, why: str) -> dict[str, Any]:
    return {"value": value, "source": "derived", "why": why}


def _write_radii(
    document: dict[str, Any], config: ChainConfig, values: Mapping[str, float], why: str
) -> None:
    tendons = document["tendons"]["value"]
    changed = False
    for number in range(1, len(config.segments) + 1):
        own = [t for t in tendons if t["segment"] == number]
        if f"radius_{number}" in values:
            factor = values[f"radius_{number}"] / float(np.mean([t["radius_m"] for t in own]))
            changed = True
            for tendon in own:
                tendon["radius_m"] *= factor
    if changed:
        before = document["tendons"]["why"]
        document["tendons"] = _derived(tendons, f"radii {why}; azimuths as before: {before}")


def _write_base(
    document: dict[str, Any], config: ChainConfig, values: Mapping[str, float], why: str
) -> None:
    """Base frames have no source of their own; where there is gravity, it says why."""
    old = scipy.spatial.transform.Rotation.from_euler(
        "xyz", config.base_frame.rpy_deg, degrees=True
    )
    turn = scipy.spatial.transform.Rotation.from_rotvec(
        [values.get(f"base_r{a}", 0.0) for a in "xyz"]
    )
    place = [values.get(f"base_{a}", config.base_frame.xyz_m[i]) for i, a in enumerate("xyz")]
    new = turn * old
    rpy = [float(x) for x in new.as_euler("xyz", degrees=True)]
    document["base_frame"] = {"xyz_m": place, "rpy_deg": rpy}
    if config.gravity_m_s2 is not None:
        seen = new.inv().apply(old.apply(config.gravity_m_s2.value))
        document["gravity_m_s2"] = _derived([float(x) for x in seen], f"base frame {why}")
