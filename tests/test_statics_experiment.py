"""The synthetic experiment: its filter, its errors, and that it tells models apart."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from muxjax.config import resolve
from muxjax.statics import load_chain
from muxjax.statics.curvature import (
    bending_between,
    pcc_bending,
    pcc_displacements,
    pcc_frames,
    segment_lengths,
)
from muxjax.statics.experiment import (
    Perturbation,
    Recording,
    pose_errors,
    run_experiment,
    static_samples,
)

NOTHING = Perturbation(**{f.name: 0.0 for f in dataclasses.fields(Perturbation)})


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> str:
    document = yaml.safe_load(resolve("hyper_redundant", "chains").read_text())
    for segment in document["segments"]:
        segment["n_beads"]["value"] = 6
        segment["hinge"]["bending_nm_rad"]["value"] = 0.8
    path = tmp_path_factory.mktemp("chains") / "small.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return str(path)


def test_constant_curvature_agrees_with_the_chain_bent_evenly():
    """Independent of ``pcc_frames``: a fine chain whose joints all turn alike is nearly an arc."""
    chain = load_chain("hyper_redundant", resolution=400)
    assert segment_lengths(chain) == pytest.approx([0.35, 0.35])
    bend = np.array([[0.3, -0.5], [-0.4, 0.2]])
    own = np.searchsorted(chain.segment_bodies, np.arange(1, chain.n_joints + 1))
    # Turning about x by a bends towards -y, about y towards x; half of the joints for each axis.
    about = np.stack([-bend[:, 1], bend[:, 0]], axis=-1)[own] / 200
    angles = np.where(chain.axis[:, 0] > 0.5, about[:, 0], about[:, 1])
    pose = np.eye(4)
    for axis, offset, angle in zip(chain.axis, chain.offset, angles, strict=True):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        step[:3, 3] = offset
        pose = pose @ step
    np.testing.assert_allclose(pcc_frames(chain, bend)[-1], pose @ chain.tip, atol=2e-3)
    ends = pcc_frames(chain, bend)[1:]
    np.testing.assert_allclose(bending_between(chain, ends), bend, atol=1e-12)
    lengths = pcc_displacements(chain, bend)
    np.testing.assert_allclose(pcc_bending(chain, lengths), bend, atol=1e-12)
    # Tendon 1 runs at +x of segment 1: bending towards +x shortens it by r b_x.
    assert lengths[0] == pytest.approx(-0.025 * 0.3)


def still(speed: float = 0.0, rate: float = 0.0, acceleration: float = 0.0) -> Recording:
    time = np.arange(100) / 10
    ends = np.broadcast_to(np.eye(4), (100, 1, 4, 4)).copy()
    ends[:, 0, 0, 3] = speed * time + 0.5 * acceleration * (time - 5) ** 2
    return Recording(time, rate * time[:, None] + 1.0, np.zeros((100, 1)), ends)


@pytest.mark.parametrize(
    ("motion", "static"),
    [
        (still(), True),
        (still(speed=0.4e-3), True),
        (still(speed=0.6e-3), False),
        (still(rate=0.09), True),
        (still(rate=-0.11), False),
    ],
)
def test_static_is_what_the_paper_calls_so(motion, static):
    assert static_samples(motion).all() == static
    assert static_samples(motion).any() == static


def test_a_jerk_is_not_static_though_it_is_slow():
    """At the turning point the speed is nought, the acceleration is not."""
    turning = slice(49, 52)
    assert static_samples(still(acceleration=1e-3))[turning].all()
    assert not static_samples(still(acceleration=30e-3)).any()


def test_errors_are_what_they_are_called(rng):
    home = np.eye(4)
    measured = np.eye(4)[None].copy()
    measured[0, :3, 3] = [0.0, 0.0, 0.2]
    measured[0, :3, :3] = Rotation.from_rotvec([0.5, 0, 0]).as_matrix()
    predicted = measured.copy()
    predicted[0, 0, 3] = 0.01
    predicted[0, :3, :3] = Rotation.from_rotvec([0.6, 0, 0]).as_matrix()
    found = pose_errors(predicted, measured, home)
    assert found.position == pytest.approx([0.01])
    assert found.relative_position == pytest.approx([0.05])
    assert found.orientation == pytest.approx([0.1])
    assert found.relative_orientation == pytest.approx([0.2])


@pytest.mark.slow
def test_the_unperturbed_truth_is_predicted_and_a_perturbed_one_less_well(small):
    """Of the same resolution and without perturbation, statics has no error; PCC still has."""
    options = {"postures": 9, "seed": 3, "finer": 1, "largest_tension": 5.0}
    exact = run_experiment(small, perturbation=NOTHING, **options)
    assert len(exact.travel) == 9
    assert exact.unsolved == ()
    for name in ("FST", "FSL"):
        # Means over stretches in which the last of a move still fades.
        assert exact.errors[name].position.max() < 1e-4
    assert exact.errors["PCC from lengths"].position.max() > 2e-3
    assert abs(exact.tension_error).max() < 0.05
    assert abs(exact.length_errors["FST"]).max() < 1e-4
    real = run_experiment(small, **options)
    again = run_experiment(small, **options)
    assert real.errors["FST"].position.max() > 10 * exact.errors["FST"].position.max()
    np.testing.assert_array_equal(real.errors["FSL"].position, again.errors["FSL"].position)
    rubbed = dataclasses.replace(NOTHING, friction=0.05)
    friction = run_experiment(small, perturbation=rubbed, **options)
    # Friction falsifies tensions at the load cell, not lengths.
    assert friction.errors["FSL"].position.max() < 1e-4
    assert friction.errors["FST"].position.max() > 1e-3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"postures": 0}, "postures: must be at least 1, found 0"),
        ({"finer": 0}, "finer: must be at least 1"),
        ({"largest_tension": -1.0}, "largest_tension: must be above 0 N"),
        ({"largest_tension": float("nan")}, "largest_tension: must be above 0 N"),
    ],
)
def test_wrong_settings_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        run_experiment(**wrong)
