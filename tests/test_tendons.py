"""Tendon maps against an independent transcription, finite differences and round trips."""

from __future__ import annotations

import equinox as eqx
import independent
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_configurations
from test_kinematics import SMALL, check_three_derivatives, with_small_angles

import muxjax
from muxjax.tendons import (
    bending_from_displacements,
    check_displacements,
    displacement_range,
    displacements_from_bending,
)


def test_displacements_agree_with_the_transcription(robot, rng):
    q = with_small_angles(robot, rng, 1000)
    expected = np.array([independent.tendons(robot, row) for row in q])
    np.testing.assert_allclose(muxjax.tendon_displacements(robot, q), expected, rtol=0, atol=1e-12)


def test_configuration_agrees_with_the_transcription(robot, rng):
    q = with_small_angles(robot, rng, 1000)
    lengths = np.array([independent.tendons(robot, row) for row in q])
    expected = np.array([independent.configuration(robot, row) for row in lengths])
    found = muxjax.configuration_from_tendons(robot, lengths)
    np.testing.assert_allclose(
        independent.bending(found), independent.bending(expected), rtol=0, atol=1e-12
    )


def test_round_trip_returns_the_configuration(robot, rng):
    q = with_small_angles(robot, rng, 1000)
    again = muxjax.configuration_from_tendons(robot, muxjax.tendon_displacements(robot, q))
    np.testing.assert_allclose(
        independent.bending(again), independent.bending(q), rtol=0, atol=1e-12
    )
    assert (again[:, 0::2] >= 0).all()
    assert ((again[:, 1::2] >= 0) & (again[:, 1::2] < 2 * np.pi)).all()


def test_bending_towards_a_tendon_winds_it_in(robot):
    """The sign of the convention: negative is wound in, on the inner side of the bend."""
    q = np.zeros(2 * robot.n_segments)
    q[0], q[1] = 0.5, robot.tendon_azimuth[0, 0, 0]
    own = muxjax.tendon_displacements(robot, q)[: robot.tendons_per_segment]
    assert own[0] == own.min() < 0 < own.max()
    assert own[0] == pytest.approx(-0.5 * robot.tendon_radius, rel=0.02)


def test_straight_arm_has_no_displacement(robot):
    q = np.zeros(2 * robot.n_segments)
    np.testing.assert_array_equal(muxjax.tendon_displacements(robot, q), np.zeros(robot.n_tendons))
    np.testing.assert_array_equal(
        muxjax.configuration_from_tendons(robot, np.zeros(robot.n_tendons)), q
    )


def test_tendon_map_has_three_derivatives_at_and_near_straight(robot):
    check_three_derivatives(robot, displacements_from_bending, independent.tendons)


@pytest.mark.parametrize("theta", [*SMALL, 1.0])
def test_inverse_map_has_the_inverse_derivative(robot, rng, theta):
    b = theta * np.ones((robot.n_segments, 2)) / np.sqrt(2)
    with jax.enable_x64(True):
        there = jax.jacfwd(lambda b: displacements_from_bending(robot, b))(jnp.asarray(b))
        lengths = displacements_from_bending(robot, jnp.asarray(b))
        back = jax.jacfwd(lambda x: bending_from_displacements(robot, x))(lengths)
    n = 2 * robot.n_segments
    # In NumPy: outside the context JAX has no float64 product.
    product = np.asarray(back).reshape(n, -1) @ np.asarray(there).reshape(-1, n)
    np.testing.assert_allclose(product, np.eye(n), rtol=0, atol=1e-12)


def test_any_batch_axes_and_precision(robot, rng):
    q = random_configurations(robot, rng, 2, 3)
    lengths = muxjax.tendon_displacements(robot, q)
    assert lengths.shape == (2, 3, robot.n_tendons)
    assert lengths.dtype == np.float64
    assert muxjax.configuration_from_tendons(robot, lengths).shape == q.shape
    np.testing.assert_allclose(
        lengths[1, 2], muxjax.tendon_displacements(robot, q[1, 2]), rtol=0, atol=1e-16
    )
    rough = jax.jit(lambda q: muxjax.tendon_displacements(robot, q))(jnp.asarray(q, jnp.float32))
    assert rough.dtype == jnp.float32
    np.testing.assert_allclose(rough, lengths, atol=1e-6)


def test_gradient_by_the_tendon_radius(robot, rng):
    q = random_configurations(robot, rng)

    def first(radius):
        varied = eqx.tree_at(lambda r: r.tendon_radius, robot, radius)
        return muxjax.tendon_displacements(varied, jnp.asarray(q))[-1]

    with jax.enable_x64(True):
        radius = jnp.asarray(robot.tendon_radius)
        numeric = (first(radius + 1e-6) - first(radius - 1e-6)) / 2e-6
        assert float(jax.grad(first)(radius)) == pytest.approx(float(numeric), rel=1e-7)


def test_range_holds_every_configuration_and_is_reached(robot, rng):
    limits = displacement_range(robot)
    lengths = muxjax.tendon_displacements(robot, random_configurations(robot, rng, 5000))
    assert (lengths >= limits[:, 0]).all()
    assert (lengths <= limits[:, 1]).all()
    reached = np.empty_like(limits)
    for c in range(robot.n_tendons):
        for side, turn in enumerate((0.0, np.pi)):
            i, j = divmod(c, robot.tendons_per_segment)
            theta = np.linspace(0, 1, 2001)[:, None] * robot.theta_max
            phi = np.broadcast_to(robot.tendon_azimuth[:, i, j] + turn, theta.shape)
            # Segments add independently, so each takes its own extreme along the plane.
            total = 0.0
            for n in range(i + 1):
                q = np.zeros((2001, 2 * robot.n_segments))
                q[:, 2 * n], q[:, 2 * n + 1] = theta[:, n], phi[:, n]
                part = muxjax.tendon_displacements(robot, q)[:, c]
                total += part.max() if side else part.min()
            reached[c, side] = total
    np.testing.assert_allclose(reached, limits, atol=1e-12)


def test_displacements_wound_in_beyond_the_segment_give_nan_from_there_on(muxarm):
    lengths = np.zeros(9)
    lengths[3:6] = -1.01 * muxarm.length[1]
    q = muxjax.configuration_from_tendons(muxarm, lengths)
    assert np.isfinite(q[:2]).all()
    assert np.isnan(q[2:4]).all()
    assert np.isnan(q[4:]).all()


def test_bad_displacements_are_refused(muxarm):
    for call in (
        muxjax.configuration_from_tendons,
        lambda robot, l: check_displacements(robot, "l", l),  # noqa: E741
    ):
        with pytest.raises(ValueError, match=r"l: last axis must have 9 entries"):
            call(muxarm, np.zeros(8))
        with pytest.raises(ValueError, match=r"l: entry \(3,\) is inf"):
            call(muxarm, np.where(np.arange(9) == 3, np.inf, 0))
    with pytest.raises(ValueError, match=r"q: last axis must have 6 entries"):
        muxjax.tendon_displacements(muxarm, np.zeros(9))
    beyond = np.zeros((2, 9))
    beyond[1, 4] = -0.5
    with pytest.raises(ValueError, match=r"target\[1\]: tendon 5 is at -500 mm, its range is"):
        check_displacements(muxarm, "target", beyond)
