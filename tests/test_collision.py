"""Distances against brute force, their gradients against finite differences."""

from __future__ import annotations

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_configurations

from muxjax.collision import (
    CAPSULES,
    WorldConfig,
    arm_axis,
    clearance,
    load_world,
    part_clearances,
    segment_distance,
    world_from_config,
)
from muxjax.config import ConfigError


def world_of(*obstacles: dict):
    return world_from_config(
        WorldConfig.model_validate(
            {"schema": "muxjax/world/1", "name": "test", "obstacles": list(obstacles)}
        )
    )


def along(points: np.ndarray, n: int = 40) -> np.ndarray:
    """Dense points on the capsules' axes after the first one."""
    t = np.linspace(0, 1, n)[:, None]
    return np.concatenate([a + t * (b - a) for a, b in pairwise(points[1:])])


def test_segment_distance_equals_brute_force(rng):
    t = np.linspace(0, 1, 201)
    for kind in range(60):
        a, b, c, d = rng.normal(size=(4, 3))
        if kind % 3 == 1:
            d = c.copy()  # a point
        if kind % 3 == 2:
            d = c + 0.7 * (b - a)  # parallel
        first = a + t[:, None] * (b - a)
        second = c + t[:, None] * (d - c)
        brute = np.linalg.norm(first[:, None] - second, axis=-1).min()
        found = float(segment_distance(*(jnp.asarray(x) for x in (a, b, c, d))))
        assert found <= brute + 1e-5
        assert found >= brute - 0.02


OBSTACLES = {
    "sphere": {"kind": "sphere", "centre_m": [0.2, 0.1, 0.2], "radius_m": 0.05},
    "capsule": {
        "kind": "capsule",
        "from_m": [0.2, -0.2, 0.1],
        "to_m": [0.2, 0.3, 0.3],
        "radius_m": 0.03,
    },
    "half_space": {"kind": "half_space", "point_m": [0, 0, -0.1], "normal": [0, 0, 2.0]},
    "box": {
        "kind": "box",
        "centre_m": [0.3, 0.0, 0.1],
        "size_m": [0.1, 0.4, 0.2],
        "rpy_deg": [0.0, 0.0, 90.0],
    },
    "tube": {
        "kind": "tube",
        "through_m": [[0.0, 0, -0.1], [0.0, 0, 0.3], [0.1, 0, 0.5]],
        "bore_radius_m": 0.06,
    },
}


def brute(kind: str, p: np.ndarray) -> np.ndarray:
    """Signed distance of points, written out for the obstacles above."""
    if kind == "sphere":
        return np.linalg.norm(p - [0.2, 0.1, 0.2], axis=-1) - 0.05
    if kind == "half_space":
        return p[:, 2] + 0.1
    if kind == "box":  # turned by 90 degrees about z: x and y sizes change places
        over = np.abs(p - [0.3, 0.0, 0.1]) - [0.2, 0.05, 0.1]
        return np.linalg.norm(np.maximum(over, 0), axis=-1) + np.minimum(over.max(axis=-1), 0)
    if kind == "capsule":
        line = np.linspace([0.2, -0.2, 0.1], [0.2, 0.3, 0.3], 2000)
        return np.linalg.norm(p[:, None] - line, axis=-1).min(axis=1) - 0.03
    line = np.concatenate(
        [
            np.linspace([0.0, 0, -0.1], [0.0, 0, 0.3], 2000),
            np.linspace([0.0, 0, 0.3], [0.1, 0, 0.5], 2000),
        ]
    )
    return 0.06 - np.linalg.norm(p[:, None] - line, axis=-1).min(axis=1)


@pytest.mark.parametrize("kind", OBSTACLES)
def test_distances_equal_brute_force(muxarm, rng, kind):
    world, empty = world_of(OBSTACLES[kind]), world_of()
    with jax.enable_x64(True):
        for q in random_configurations(muxarm, rng, 6) * 0.6:
            points = np.asarray(arm_axis(muxarm, jnp.asarray(q)))
            expected = brute(kind, along(points)).min() - float(muxarm.body_radius)
            own = float(clearance(muxarm, jnp.asarray(q), empty))
            found = float(clearance(muxarm, jnp.asarray(q), world))
            assert found == pytest.approx(min(expected, own), abs=1.5e-3)


def test_gradients_equal_finite_differences(muxarm, rng):
    world = world_of(*OBSTACLES.values())
    with jax.enable_x64(True):
        gradient = jax.jit(jax.grad(lambda q: clearance(muxarm, q, world)))
        value = jax.jit(lambda q: clearance(muxarm, q, world))
        for q in random_configurations(muxarm, rng, 8) * 0.7:
            numeric = [(value(q + h) - value(q - h)) / 2e-6 for h in 1e-6 * np.eye(6)]
            np.testing.assert_allclose(gradient(jnp.asarray(q)), numeric, atol=2e-5)
        assert np.isfinite(gradient(jnp.zeros(6))).all()


def test_the_arm_collides_with_itself_when_it_is_rolled_up(muxarm):
    empty = world_of()
    with jax.enable_x64(True):
        straight = clearance(muxarm, jnp.zeros(6), empty)
        rolled = clearance(muxarm, jnp.asarray([np.pi, 0, np.pi, 0, np.radians(140), 0]), empty)
        assert straight > 0
        assert rolled < 0


def test_parts_say_where(muxarm):
    """A ball at the tip is hit by the last capsules alone."""
    world = world_of({"kind": "sphere", "centre_m": [0, 0, 0.47], "radius_m": 0.01})
    parts = np.asarray(part_clearances(muxarm, jnp.zeros(6), world))
    assert parts.shape == (3 * CAPSULES,)
    assert (parts[-2:] < 0).all()
    assert (parts[:16] > 0).all()


@pytest.mark.parametrize("name", ["cabinet", "s_pipe"])
def test_shipped_worlds_hold_clear_and_blocked_configurations(muxarm, rng, name):
    world = load_world(name)
    q = random_configurations(muxarm, rng, 400)
    q[:, 0::2] *= 0.5
    # In the plane of the pipe, its own bends among them.
    q[200:, 0::2] *= 0.5
    q[200:, 1::2] = [0, np.pi, np.pi]
    found = np.asarray(clearance(muxarm, jnp.asarray(q), world))
    assert (found < 0).any()
    assert (found > 0).any()


def test_bad_worlds_are_refused():
    with pytest.raises(ConfigError, match="no 'attic' among the shipped files"):
        load_world("attic")
    with pytest.raises(ValueError, match=r"obstacles\[1\]\.normal: must not be zero"):
        world_of({"kind": "half_space", "point_m": [0, 0, 0], "normal": [0, 0, 0]})
    with pytest.raises(ValueError, match="radius_m"):
        world_of({"kind": "sphere", "centre_m": [0, 0, 0], "radius_m": -1})
