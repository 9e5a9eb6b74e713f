"""Two-segment spring-steel robots against the reference values of golden/statics_two_segments.json.

The chain with holes in every bead discretises a rod with continuous tendons (``cr``), the one with
holes at the discs alone a rod with spacer discs (``sscr``). That model drops the axial part of the
force of a tendon on a disc that it passes, so here it is taken back by loads at the holes. Both
references also stretch and shear, which a chain of revolute joints does not: up to 0.02 % of length
under the tensions of robot A and C, and 0.04 % in B.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import muxjax
from muxjax.config import resolve
from muxjax.statics import kernel as kn
from muxjax.statics.chain import ElasticChain

SSCR_ROUNDS = 5  # of the discs' axial forces, the first without
GOLDEN = json.loads((Path(__file__).parent / "golden" / "statics_two_segments.json").read_text())


def disc_chain(robot: str, path: Path, per_disc: int) -> ElasticChain:
    """Beads of 1 / per_disc of a disc's pitch, holes at the discs."""
    raw = yaml.safe_load(resolve(f"tdcr_{robot.lower()}", "chains").read_text())
    discs = GOLDEN["robots"][robot]["disks_per_segment"]
    for segment, count in zip(raw["segments"], discs, strict=True):
        segment["n_beads"]["value"] = per_disc * count
        segment["joints"]["value"] = ["xyz", "zyx"]
    raw["hole_every"] = per_disc
    file = path / f"{robot}.yaml"
    file.write_text(yaml.safe_dump(raw))
    return muxjax.load_chain(file)


class PointLoads(NamedTuple):
    """Dead forces (cases, Q, 3) [N], the bodies they act on and where (Q, 3) [m]."""

    force: Any
    bodies: list[int]
    offsets: Any


def weights(chain: ElasticChain, robot: str, model: str, cases: list[dict[str, Any]]) -> PointLoads:
    """Weight of the discs: by arc length in ``cr``, at the discs in ``sscr``."""
    discs = np.array(GOLDEN["robots"][robot]["disks_per_segment"])
    weight = np.array([case["disk_weight_N"] for case in cases])
    down = np.array([case["gravity_direction"] for case in cases])
    joints = np.diff([0, *chain.segment_bodies])
    if model == "cr":  # every bead of six joints has its share
        beads = joints // 6
        bodies = [1 + 6 * i for i in range(sum(beads))]
        offsets = np.zeros((len(bodies), 3))
        force = np.repeat(weight * discs / beads, beads, axis=1)
    else:  # tendon 4 ends at the tip and passes every disc
        bodies = list(chain.routing[3][1:])
        own = slice(1 + sum(len(b) for b in chain.routing[:3]), None)
        offsets = chain.hole[own][: len(bodies)] * [0, 0, 1]
        force = np.repeat(weight, discs, axis=1)
    return PointLoads(force[..., None] * down[:, None], bodies, offsets)


@eqx.filter_jit
def holes(chain: ElasticChain, angles: Any) -> tuple[Any, Any]:
    """All holes and the axes of their discs in the base frame, (H, 3, cases) each."""
    frames = kn.frames_of(chain, kn.per_joint(chain, angles.T))
    rotation = frames.rotation.reshape(-1, 3, 3, len(angles))[chain.layout.place]
    origin = frames.origin.reshape(-1, 3, len(angles))[chain.layout.place]
    root = jnp.broadcast_to(jnp.eye(3)[None, :, :, None], (1, 3, 3, len(angles)))
    bodies = np.concatenate(chain.routing)
    rotation = jnp.concatenate([root, rotation])[bodies]
    origin = jnp.concatenate([jnp.zeros((1, 3, len(angles))), origin])[bodies]
    return origin + jnp.einsum("hijb,hj->hib", rotation, chain.hole), rotation[:, :, 2]


def axial_forces(chain: ElasticChain, angles: Any, tension: Any) -> PointLoads:
    """What takes back the axial force of every tendon on every disc that it passes."""
    with jax.enable_x64(True):
        point, axis = (np.asarray(x) for x in holes(chain, angles))
    forces, bodies, offsets, first = [], [], [], 0
    for k, passed in enumerate(chain.routing):
        own = point[first : first + len(passed)]
        along = np.diff(own, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        pull = tension[:, k] * (along[1:] - along[:-1])
        z = axis[first + 1 : first + len(passed) - 1]
        forces.append(-(pull * z).sum(1, keepdims=True) * z)
        bodies.extend(passed[1:-1])
        offsets.append(chain.hole[first + 1 : first + len(passed) - 1])
        first += len(passed)
    return PointLoads(np.moveaxis(np.concatenate(forces), -1, 0), bodies, np.concatenate(offsets))


def tip_errors(chain: ElasticChain, robot: str, model: str, cases: list[dict[str, Any]]) -> Any:
    """Tip errors over length; a case that did not converge has an infinite one."""
    tension = np.array([case["tension_N"] for case in cases])
    wrench = np.array([[*case["tip_moment_Nm"], *case["tip_force_N"]] for case in cases])
    loads = weights(chain, robot, model, cases)
    angles = np.zeros((len(cases), chain.n_joints))
    # The forces of a posture, the posture of these forces: 30 times nearer each time.
    for _ in range(1 if model == "cr" else SSCR_ROUNDS):
        acting = loads
        if model == "sscr":
            more = axial_forces(chain, angles, tension)
            acting = PointLoads(
                np.concatenate([loads.force, more.force], axis=1),
                loads.bodies + more.bodies,
                np.concatenate([loads.offsets, more.offsets]),
            )
        found = muxjax.forward_statics(
            chain,
            tension=tension,
            tip_wrench=wrench,
            point_loads=acting.force,
            point_bodies=acting.bodies,
            point_offsets=acting.offsets,
            q0=angles,
        )
        angles = found.angles
    tip = np.array([case["tip"][f"{model}_independent"] for case in cases])
    away = np.linalg.norm(found.pose[:, :3, 3] - tip[:, :3, 3], axis=-1)
    length = sum(GOLDEN["robots"][robot]["segment_length_m"])
    return np.where(found.converged, away / length, np.inf)


def cases_of(robot: str) -> list[dict[str, Any]]:
    return [case for case in GOLDEN["cases"] if case["robot"] == robot]


def test_the_cases_are_all_here():
    assert len(GOLDEN["cases"]) == 53
    assert sum(len(cases_of(robot)) for robot in "ABC") == 53


def test_the_fine_chain_meets_a_cosserat_rod_in_robot_b():
    """The robot with the largest errors; the slow test looks at all of them."""
    errors = tip_errors(muxjax.load_chain("tdcr_b"), "B", "cr", cases_of("B"))
    assert errors.max() < 0.006
    assert np.median(errors) < 0.0005


@pytest.mark.slow
def test_the_fine_chain_meets_a_cosserat_rod_in_all_cases():
    errors = np.concatenate(
        [
            tip_errors(muxjax.load_chain(f"tdcr_{robot.lower()}"), robot, "cr", cases_of(robot))
            for robot in "ABC"
        ]
    )
    assert np.isfinite(errors).all()
    assert np.median(errors) < 0.0002
    assert errors.max() < 0.006


@pytest.mark.slow
def test_the_chain_with_discs_meets_the_rod_with_discs(tmp_path):
    errors = np.concatenate(
        [
            tip_errors(disc_chain(robot, tmp_path, 4), robot, "sscr", cases_of(robot))
            for robot in "ABC"
        ]
    )
    assert np.isfinite(errors).all()
    assert np.median(errors) < 0.0002
    assert errors.max() < 0.006


@pytest.mark.slow
def test_errors_fall_with_the_square_of_the_pitch():
    """Halving the pitch quarters the error, within what higher orders may add."""
    coarse, fine = (
        np.median(tip_errors(muxjax.load_chain("tdcr_b", resolution=n), "B", "cr", cases_of("B")))
        for n in (10, 20)
    )
    assert 2.5 < coarse / fine < 6
