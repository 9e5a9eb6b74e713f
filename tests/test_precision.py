"""NumPy in, NumPy float64 out; JAX in, JAX out."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import muxjax

Q = [0.5, 1.0, 0.7, 2.0, 0.4, 3.0]


def test_host_data_gives_writable_float64(muxarm):
    for q in (Q, tuple(Q), np.array(Q), np.array(Q, dtype=np.float32)):
        pose = muxjax.forward_kinematics(muxarm, q)
        assert isinstance(pose, np.ndarray)
        assert pose.dtype == np.float64
        assert pose.flags.writeable


def test_jax_data_stays_in_jax(muxarm):
    exact = muxjax.forward_kinematics(muxarm, Q)
    for q in (jnp.array(Q), [jnp.float32(x) for x in Q]):
        pose = muxjax.forward_kinematics(muxarm, q)
        assert isinstance(pose, jax.Array)
        assert pose.dtype == jnp.float32
        assert np.allclose(pose, exact, atol=1e-6)
    inside = jax.jit(lambda a: muxjax.forward_kinematics(muxarm, [a, *Q[1:]]))(Q[0])
    assert np.allclose(inside, exact, atol=1e-6)


def test_the_global_switch_is_left_alone(muxarm):
    muxjax.tendon_displacements(muxarm, Q)
    assert jnp.zeros(1).dtype == jnp.float32


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (["0.5"] * 6, "q: expected numbers"),
        ([1j] * 6, "q: expected numbers"),
        ([[0.1], [0.1, 0.2]], "q: expected numbers"),
        ([0.1] * 5, "q: last axis must have 6 entries"),
        ([np.inf] + [0.1] * 5, r"q: entry \(0,\) is inf"),
    ],
)
def test_what_is_not_an_array_of_numbers_is_refused(muxarm, q, message):
    with pytest.raises(ValueError, match=message):
        muxjax.forward_kinematics(muxarm, q)


def test_a_name_is_not_a_robot():
    with pytest.raises(ValueError, match="robot: expected a Robot, found str"):
        muxjax.forward_kinematics("muxarm", Q)


def test_intervals_are_whole(muxarm):
    with pytest.raises(ValueError, match="n: must be a whole number of intervals"):
        muxjax.backbone(muxarm, Q, 0)
