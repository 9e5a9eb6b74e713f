"""Inverse statics: what it holds, forward statics confirms."""

from __future__ import annotations

import numpy as np
import pytest

import muxjax
from muxjax.statics.chain import ElasticChain


@pytest.fixture(scope="module")
def arm() -> ElasticChain:
    return muxjax.load_chain("hyper_redundant", resolution=8)


@pytest.fixture(scope="module")
def reached(arm: ElasticChain) -> muxjax.Equilibrium:
    tension = [3.0, 1.0, 0.0, 0.0, 0.5, 2.0, 0.0, 0.0]
    return muxjax.forward_statics(arm, tension=tension).check()


def test_a_posture_is_held_with_less_tension(arm, reached):
    """A posture that tensions gave is held by them, or by less: co-contraction is left out."""
    taut = muxjax.forward_statics(arm, tension=[3.5, 1.5, 0.5, 0.5, 0.5, 2.0, 0.0, 0.0]).check()
    held = muxjax.inverse_statics(arm, angles=taut.angles).check()
    assert held.tension.sum() < taut.tension.sum()
    back = muxjax.forward_statics(arm, tension=held.tension).check()
    np.testing.assert_allclose(back.pose, taut.pose, atol=1e-5)


def test_a_pose_is_held_within_bounds(arm, reached):
    held = muxjax.inverse_statics(arm, pose=reached.pose, bounds=(0.0, 20.0)).check()
    assert (held.tension >= 0).all()
    assert (held.tension <= 20).all()
    again = muxjax.forward_statics(arm, tension=held.tension).check()
    np.testing.assert_allclose(again.pose, reached.pose, atol=2e-5)


def test_a_position_needs_no_more_than_a_pose(arm, reached):
    pose = muxjax.inverse_statics(arm, pose=reached.pose).check()
    place = muxjax.inverse_statics(arm, position=reached.pose[:3, 3]).check()
    assert place.position_error < 1e-6
    assert (place.tension**2).sum() <= (pose.tension**2).sum() * (1 + 1e-3)


def test_what_cannot_be_held_says_so(arm, reached):
    far = reached.pose.copy()
    far[:3, 3] = [2.0, 0.0, 0.0]
    out = muxjax.inverse_statics(arm, pose=far, bounds=(0.0, 5.0))
    assert not out.converged
    assert out.position_error > 1.0
    with pytest.raises(muxjax.StaticsError, match=r"mm and .* degrees are left"):
        out.check()
    twisted = reached.angles.copy()
    twisted[3] += 0.5
    with pytest.raises(muxjax.StaticsError, match=r"cannot hold the posture: .* N m is left"):
        muxjax.inverse_statics(arm, angles=twisted).check()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give one of pose, position and angles"),
        ({"position": [0.0] * 3, "angles": [0.0] * 16}, "give one of"),
        ({"position": [0.0] * 2}, "position: last axis must have 3"),
        ({"angles": [[0.0] * 16] * 2}, "angles: one case at a time"),
        ({"pose": [[0.0] * 4] * 3}, r"pose: must have shape \(4, 4\)"),
        ({"position": [0.0] * 3, "bounds": (5.0, 1.0)}, "bounds: must be 0 <= least < greatest"),
        ({"position": [0.0] * 3, "bounds": (-1.0, 1.0)}, "bounds: must be 0 <= least"),
        ({"position": [0.0] * 3, "bounds": ([0.0] * 3, 1.0)}, "bounds: each must be a number or 8"),
        ({"position": [0.0, 0.0, np.nan]}, "position: entry"),
    ],
)
def test_bad_calls_name_the_field(arm, arguments, message):
    with pytest.raises(ValueError, match=message):
        muxjax.inverse_statics(arm, **arguments)
