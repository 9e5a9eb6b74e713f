"""NumPy in, NumPy float64 out; JAX in, JAX out."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import random_configurations
from jax.extend.core import jaxprs_in_params

import muxjax
from muxjax import batched
from muxjax.collision import clearance
from muxjax.planning import tension
from muxjax.planning.batch import plan_batch
from muxjax.planning.value import value_net
from muxjax.precision import by_device, in_threads

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


def products(jaxpr):
    """Precisions of every matrix product in a jaxpr, inner ones too."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general" and equation.outvars[0].aval.dtype.kind == "f":
            yield equation.params["precision"]
        for inner in jaxprs_in_params(equation.params):
            yield from products(inner)


def network(robot, features):
    return value_net((features.shape[-1], 8, 8, 1), jax.random.key(0))(features)


@pytest.mark.parametrize(
    "function",
    [
        muxjax.forward_kinematics,
        muxjax.jacobian,
        lambda robot, q: muxjax.backbone(robot, q, 3),
        muxjax.tendon_displacements,
        lambda robot, q: clearance(robot, q, muxjax.load_world("cabinet")),
        lambda robot, q: tension._lengths(robot, q.T),
        network,
    ],
    ids=["pose", "jacobian", "backbone", "tendons", "clearance", "tension", "network"],
)
def test_no_product_may_be_rounded_to_tf32(function, muxarm):
    """What a GPU does with the factors of a float32 product unless it is told not to."""
    q = jnp.ones((200, 6), jnp.float32)
    found = list(products(jax.make_jaxpr(lambda q: function(muxarm, q))(q).jaxpr))
    full = jax.lax.Precision.HIGHEST
    assert all(given == (full, full) for given in found)
    if function in (muxjax.forward_kinematics, muxjax.jacobian, network):
        assert found


def test_threads_compute_on_the_callers_device():
    with jax.default_device("cpu"):
        seen = in_threads(lambda _: jax.config.jax_default_device, range(3))
    assert seen == ["cpu"] * 3
    assert in_threads(lambda _: jax.config.jax_default_device, range(3)) == [None] * 3


def as_on_a_gpu(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def test_sizes_follow_the_device_of_the_caller(monkeypatch):
    assert by_device(1, 2) == (1 if jax.default_backend() == "cpu" else 2)
    as_on_a_gpu(monkeypatch)
    assert by_device(1, 2) == 2
    for place in (jax.devices("cpu")[0], "cpu"):
        with jax.default_device(place):
            assert by_device(1, 2) == 1


def test_the_sizes_of_a_gpu_change_no_result(muxarm, rng, monkeypatch):
    q = random_configurations(muxarm, rng, 40)
    pose = muxjax.forward_kinematics(muxarm, q)
    lengths = muxjax.tendon_displacements(muxarm, q)
    chain = muxjax.load_chain("tdcr_a", resolution=3)
    pull = rng.uniform(0, 1, (9, chain.n_tendons))

    def all_of_it():
        every = muxjax.all_ik(muxarm, pose)
        return [
            every.q[every.mask],
            muxjax.solve_ik(muxarm, pose, method="levenberg_marquardt").position_error < 1e-10,
            muxjax.solve_ik(muxarm, pose[:8], method="pseudo_inverse").position_error < 1e-10,
            muxjax.forward_statics(chain, tension=pull).angles,
            plan_batch(muxarm, np.zeros(9), lengths).cost,
            batched.poses(muxarm, np.zeros((70, 3, 2))),
        ]

    with jax.default_device("cpu"):
        before = all_of_it()
    as_on_a_gpu(monkeypatch)
    # Smaller ones than a GPU has, so that a CPU can take them.
    for place, size in {
        "ik.newton.ROWS_ELSEWHERE": (100,),
        "ik.all_solutions.SWEEP_ROWS_ELSEWHERE": (30,),
        "ik.every.CHUNK_ELSEWHERE": 33,
        "ik.levenberg.ROWS_ELSEWHERE": 100,
        "ik.descent._BUCKETS_ELSEWHERE": (6,),
        "statics.forward.LANES_ELSEWHERE": (6,),
        "planning.batch._CHUNK_ELSEWHERE": 24,
        "batched.chunks.CHUNK_ELSEWHERE": 64,
    }.items():
        monkeypatch.setattr(f"muxjax.{place}", size)
    for ours, others in zip(before, all_of_it(), strict=True):
        assert np.allclose(ours, others, rtol=1e-9, atol=1e-9)
