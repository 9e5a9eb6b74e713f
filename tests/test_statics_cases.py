"""Two-segment spring-steel robots against the reference values of golden/statics_two_segments.json.

The chain with holes in every bead discretises a rod with continuous tendons (``cr``), the one with
holes at the discs alone a rod with spacer discs (``sscr``, which drops the discs' axial forces).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import muxjax
from muxjax.config import resolve
from muxjax.statics.chain import ElasticChain

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


def tip_errors(chain: ElasticChain, robot: str, model: str, cases: list[dict[str, Any]]) -> Any:
    """Tip errors over length; a case that did not converge has an infinite one."""
    own = GOLDEN["robots"][robot]
    beads = np.diff([0, *chain.segment_bodies])
    joints_a_bead = 6 if model == "cr" else 3
    beads = beads // joints_a_bead
    weight = np.array([case["disk_weight_N"] for case in cases])
    direction = np.array([case["gravity_direction"] for case in cases])
    if model == "cr":  # weight by arc length, so every bead has its share
        share = np.array(own["disks_per_segment"]) / beads
        bodies = [1 + joints_a_bead * i for i in range(sum(beads))]
        offsets = np.zeros((len(bodies), 3))
        force = np.repeat(weight * share, beads, axis=1)
    else:  # weight at the discs, which are the upper faces of some beads
        per_disc = beads // np.array(own["disks_per_segment"])
        tops = np.cumsum(np.repeat(per_disc, own["disks_per_segment"]))
        bodies = [3 * int(top) for top in tops]
        pitch = np.array(own["segment_length_m"]) / beads
        offsets = np.zeros((len(bodies), 3))
        offsets[:, 2] = np.repeat(pitch / 2, own["disks_per_segment"])
        force = np.repeat(weight, own["disks_per_segment"], axis=1)
    found = muxjax.forward_statics(
        chain,
        tension=np.array([case["tension_N"] for case in cases]),
        tip_wrench=np.array([[*case["tip_moment_Nm"], *case["tip_force_N"]] for case in cases]),
        point_loads=force[..., None] * direction[:, None],
        point_bodies=bodies,
        point_offsets=offsets,
    )
    tip = np.array([case["tip"][f"{model}_independent"] for case in cases])
    away = np.linalg.norm(found.pose[:, :3, 3] - tip[:, :3, 3], axis=-1)
    return np.where(found.converged, away / sum(own["segment_length_m"]), np.inf)


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
