"""The batched float32 form against the readable float64 one."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import muxjax
from muxjax import batched
from muxjax.config import FrameConfig
from muxjax.robot import Robot, robot_from_config
from tests.conftest import random_configurations


def bending(q: np.ndarray) -> np.ndarray:
    theta, phi = q[..., 0::2], q[..., 1::2]
    return np.stack([theta * np.cos(phi), theta * np.sin(phi)], axis=-1)


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Columns are the rotated axes, v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = quaternion[..., :1, None], quaternion[..., None, 1:]
    axes = np.eye(3)
    once = np.cross(u, axes)
    return np.swapaxes(axes + 2 * w * once + 2 * np.cross(u, once), -1, -2)


@pytest.fixture
def tilted(muxarm: Robot) -> Robot:
    """MuxArm with base and tool frames that leave no axis alone."""
    config = muxarm.config.model_copy(
        update={
            "base_frame": FrameConfig(xyz_m=(0.1, -0.2, 0.3), rpy_deg=(20, -35, 50)),
            "tool_frame": FrameConfig(xyz_m=(0.02, 0.03, 0.05), rpy_deg=(-15, 25, 80)),
        }
    )
    return robot_from_config(config)


def check_poses(robot: Robot, q: np.ndarray) -> None:
    exact = muxjax.forward_kinematics(robot, q)
    reach = (
        robot.length.sum() + np.linalg.norm(robot.base[:3, 3]) + np.linalg.norm(robot.tool[:3, 3])
    )
    matrix = batched.poses(robot, bending(q), "matrix")
    np.testing.assert_allclose(matrix[..., :3, 3], exact[..., :3, 3], atol=1e-6 * reach)
    np.testing.assert_allclose(matrix[..., :3, :3], exact[..., :3, :3], atol=2e-6)
    np.testing.assert_array_equal(
        matrix[..., 3, :], np.broadcast_to([0, 0, 0, 1], (*q.shape[:-1], 4))
    )
    both = batched.poses(robot, bending(q), "quaternion")
    np.testing.assert_allclose(both[..., :3], exact[..., :3, 3], atol=1e-6 * reach)
    np.testing.assert_allclose(rotation_of(both[..., 3:]), exact[..., :3, :3], atol=3e-6)
    place = batched.poses(robot, bending(q), "position")
    np.testing.assert_allclose(place, exact[..., :3, 3], atol=1e-6 * reach)


def test_poses_agree_with_the_readable_form(robot: Robot, rng: np.random.Generator) -> None:
    check_poses(robot, random_configurations(robot, rng, 40, 25))


def test_frames_are_included(tilted: Robot, rng: np.random.Generator) -> None:
    check_poses(tilted, random_configurations(tilted, rng, 300))


def test_straight_and_nearly_straight(robot: Robot, rng: np.random.Generator) -> None:
    q = random_configurations(robot, rng, 50)
    q[:, 0::2] *= np.logspace(-12, -1, 50)[:, None]
    q[0, 0::2] = 0.0
    check_poses(robot, q)


def test_one_segment(muxarm: Robot, rng: np.random.Generator) -> None:
    config = muxarm.config.model_copy(update={"segments": muxarm.config.segments[:1]})
    alone = robot_from_config(config)
    assert alone.n_segments == 1
    check_poses(alone, random_configurations(alone, rng, 20))


def test_lengths_agree_with_the_readable_form(robot: Robot, rng: np.random.Generator) -> None:
    q = random_configurations(robot, rng, 500)
    exact = muxjax.tendon_displacements(robot, q)
    np.testing.assert_allclose(batched.tendon_lengths(robot, bending(q)), exact, atol=2e-7)


@pytest.mark.parametrize("limit", [0.05, np.pi / 4, np.pi, 2 * np.pi])
def test_series_meet_their_stated_error(limit: float) -> None:
    x = np.linspace(0.0, 0.25 * limit**2, 4567)
    series = batched.series(0.25 * limit**2)
    for coefficients, exact in (
        (series.sinc, np.sinc(np.sqrt(x) / np.pi)),
        (series.cosine, np.cos(np.sqrt(x))),
    ):
        error = np.abs(np.polynomial.Polynomial(coefficients)(x) - exact).max()
        assert error <= 1.05 * batched.SERIES_ERROR


def test_series_do_not_waste_degrees() -> None:
    widths = [len(batched.series(0.25 * limit**2).sinc) for limit in (0.1, np.pi, 2 * np.pi)]
    assert widths == sorted(set(widths))


def test_every_chunk_is_filled(muxarm: Robot, rng: np.random.Generator) -> None:
    q = random_configurations(muxarm, rng, batched.CHUNK + 3)
    whole = batched.poses(muxarm, bending(q))
    for part in (slice(0, 1), slice(batched.CHUNK - 2, batched.CHUNK + 3)):
        np.testing.assert_allclose(batched.poses(muxarm, bending(q)[part]), whole[part], atol=3e-7)


def test_an_empty_batch(muxarm: Robot) -> None:
    assert batched.poses(muxarm, np.zeros((0, 3, 2))).shape == (0, 7)


def test_reused_memory_holds_the_new_result(muxarm: Robot, rng: np.random.Generator) -> None:
    arm = batched.chain(muxarm)
    first, second = rng.uniform(-1, 1, (2, 6, 64)).astype(np.float32)
    fresh = [n.copy() for n in batched.numbers(batched.pose_quads(arm, second))]
    old = batched.pose_quads(arm, first)
    again = batched.pose_quads(arm, second, reuse=old)
    np.testing.assert_array_equal(batched.numbers(again), fresh)


def test_values_are_traceable_and_differentiable(muxarm: Robot) -> None:
    arm = jax.tree.map(jnp.asarray, batched.chain(muxarm))
    u = jnp.array([0.3, -0.2, 0.0, 0.0, 0.5, 0.1], jnp.float32)

    def height(u: jax.Array) -> jax.Array:
        return batched.pose_values(arm, tuple(u), "position")[2]

    slope = jax.grad(height)(u)
    step = 1e-3
    for k in range(6):
        up, down = u.at[k].add(step), u.at[k].add(-step)
        difference = float(height(up) - height(down)) / (2 * step)
        assert float(slope[k]) == pytest.approx(difference, abs=2e-4)


def test_a_bend_beyond_the_polynomials_is_nan_on_the_device(muxarm: Robot) -> None:
    arm = batched.chain(muxarm)
    rows = np.zeros((6, 2), np.float32)
    rows[2, 1] = 3.5
    inside, beyond = batched.numbers(batched.pose_quads(arm, rows))[1]
    assert np.isfinite(inside).all()
    assert np.isnan(beyond).all()


def test_bad_input_is_named(muxarm: Robot) -> None:
    good = np.zeros((4, 3, 2))
    with pytest.raises(ValueError, match=r"bending: last axes must be \(3, 2\)"):
        batched.poses(muxarm, np.zeros((4, 2, 3)))
    far = good.copy()
    far[2, 1, 0] = 3.5
    with pytest.raises(ValueError, match=r"bending\[2\]: segment 2 is bent by 200.5 degrees"):
        batched.poses(muxarm, far)
    bad = good.astype(np.float32)
    bad[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="bending"):
        batched.poses(muxarm, bad)
    with pytest.raises(ValueError, match="output: must be one of position, quaternion, matrix"):
        batched.poses(muxarm, good, "euler")  # type: ignore[arg-type]
    arm = batched.chain(muxarm)
    with pytest.raises(ValueError, match="must be float32, found float64"):
        batched.pose_quads(arm, np.zeros((6, 8)))
    with pytest.raises(ValueError, match=r"must have shape \(6, N\)"):
        batched.pose_quads(arm, np.zeros((4, 8), np.float32))


def test_designs_close_to_each_other_share_a_compilation(muxarm: Robot) -> None:
    longer = eqx.tree_at(lambda r: r.length, muxarm, muxarm.length * 1.1)
    a, b = batched.chain(muxarm), batched.chain(longer)
    assert jax.tree.structure(a) == jax.tree.structure(b)
