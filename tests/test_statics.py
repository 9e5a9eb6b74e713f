"""Statics against laws, hand-computed cases and a transcription in plain loops."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import approx_fprime

import muxjax
from muxjax.statics import implicit
from muxjax.statics import kernel as kn
from muxjax.statics.chain import ElasticChain
from muxjax.statics.loads import Loads
from muxjax.statics.newton import displacements_of
from muxjax.statics.recursion import eliminate, substitute
from muxjax.statics.tension import inverse_ramp, ramp

energy_of = eqx.filter_jit(implicit.energy_of)
residual_of = eqx.filter_jit(implicit.residual_of)
tangent_of = eqx.filter_jit(implicit.tangent_of)

DIRECTIONS = 9.81 * np.array([[0.0, 0, 1], [1, 0, 0], [0, 0, -1]])  # hanging, horizontal, upright


@pytest.fixture(scope="module")
def arm() -> ElasticChain:
    return muxjax.load_chain("hyper_redundant")


@pytest.fixture(scope="module")
def muxarm_chain() -> ElasticChain:
    return muxjax.elastic_chain(muxjax.load_robot("muxarm"))


def irregular() -> ElasticChain:
    """Three skew joints; one tendon skips a bead, so that chords of different lengths overlap."""
    rng = np.random.default_rng(4)
    axis = rng.normal(size=(5, 3))
    holes = np.array([[0.02, 0.01, 0], [0.02, 0.01, 0.01], [0.02, 0.0, 0.02]])
    more = np.array([[-0.02, 0, 0], [-0.02, 0.005, 0.01], [-0.02, 0, 0.01], [-0.02, 0, 0.02]])
    return ElasticChain(
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        offset=np.array([[0, 0, 0.05]] * 5) + rng.normal(size=(5, 3)) * 0.005,
        stiffness=np.array([1.0, 2.0, 1.5, 1.0, 0.8]),
        cubic=np.array([0.0, 0.3, 0.0, 0.1, 0.2]),
        mass=np.array([0.1, 0.2, 0.1, 0.3, 0.1]),
        com=rng.normal(size=(5, 3)) * 0.01,
        hole=np.concatenate([holes, more]),
        tendon_stiffness=np.array([2e4, 1e4]),
        slack_width=np.array(0.01),
        gravity=np.array([1.0, 2.0, -9.0]),
        base=np.eye(4),
        tip=np.eye(4),
        end_frame=np.eye(4)[None],
        routing=((0, 2, 4), (0, 1, 3, 4)),
        segment_bodies=(5,),
        name="irregular",
    )


CHAINS = {
    "hyper_redundant": lambda: muxjax.load_chain("hyper_redundant", resolution=2),
    "tdcr_c": lambda: muxjax.load_chain("tdcr_c", resolution=2),
    "irregular": irregular,
}


@pytest.fixture(
    scope="module",
    params=[
        "irregular",
        pytest.param("hyper_redundant", marks=pytest.mark.slow),
        pytest.param("tdcr_c", marks=pytest.mark.slow),
    ],
)
def chain(request: pytest.FixtureRequest) -> ElasticChain:
    return CHAINS[request.param]()


# --- an independent transcription: frames by matrix exponentials, energies by plain loops


def loop_frames(chain: ElasticChain, q: np.ndarray) -> list[np.ndarray]:
    pose, frames = np.eye(4), [np.eye(4)]
    for axis, offset, angle in zip(chain.axis, chain.offset, q, strict=True):
        joint = np.eye(4)
        x, y, z = axis * angle
        joint[:3, :3] = expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
        joint[:3, 3] = offset
        pose = pose @ joint
        frames.append(pose)
    return frames


def loop_lengths(chain: ElasticChain, q: np.ndarray) -> np.ndarray:
    frames, lengths, number = loop_frames(chain, q), [], 0
    for bodies in chain.routing:
        points = []
        for body in bodies:
            points.append((frames[body] @ [*chain.hole[number], 1.0])[:3])
            number += 1
        lengths.append(sum(np.linalg.norm(b - a) for a, b in pairwise(points)))
    return np.array(lengths)


def loop_energy(chain, q, tension, gravity, force, point):  # type: ignore[no-untyped-def]
    frames = loop_frames(chain, q)
    energy = float(tension @ loop_lengths(chain, q))
    for j in range(chain.n_joints):
        energy += chain.stiffness[j] * q[j] ** 2 / 2 + chain.cubic[j] * q[j] ** 4 / 4
        energy -= chain.mass[j] * gravity @ (frames[j + 1] @ [*chain.com[j], 1.0])[:3]
    energy -= force @ (frames[-1] @ chain.tip)[:3, 3]
    return energy - point @ (frames[2] @ [0.01, 0.02, 0.03, 1.0])[:3]


@dataclasses.dataclass
class Case:
    q: np.ndarray
    tension: np.ndarray
    gravity: np.ndarray
    wrench: np.ndarray
    point: np.ndarray

    def loads(self, following: bool = False) -> Loads:
        return Loads(
            self.gravity[:, None],
            self.wrench[:, None],
            self.point[None, :, None],
            np.array([[0.01, 0.02, 0.03]]),
            (2,),
            following,
        )


def random_case(chain: ElasticChain, rng: np.random.Generator, moment: float = 1.0) -> Case:
    return Case(
        q=rng.normal(size=chain.n_joints) * 0.2,
        tension=rng.uniform(0, 10, chain.n_tendons),
        gravity=rng.normal(size=3) * 9,
        wrench=rng.normal(size=6) * np.array([moment] * 3 + [1.0] * 3),
        point=rng.normal(size=3),
    )


def test_energy_is_that_of_plain_loops(chain, rng):
    case = random_case(chain, rng, moment=0.0)
    with jax.enable_x64(True):
        found = energy_of(chain, case.q[:, None], case.tension[:, None], case.loads())
    expected = loop_energy(chain, case.q, case.tension, case.gravity, case.wrench[3:], case.point)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_residual_is_the_gradient_of_the_energy(chain, rng):
    case = random_case(chain, rng, moment=0.0)
    with jax.enable_x64(True):
        args = jnp.asarray(case.tension[:, None]), case.loads()
        energy = lambda q: implicit.energy_of(chain, q[:, None], *args)[0]  # noqa: E731
        gradient = jax.jit(jax.grad(energy))(jnp.asarray(case.q))
        residual = residual_of(chain, case.q[:, None], *args, "virtual_work")[:, 0]
    np.testing.assert_allclose(residual, gradient, atol=1e-12 * np.abs(gradient).max())


@pytest.mark.parametrize(
    ("kernel", "following"), [("virtual_work", False), ("virtual_work", True), ("couple", True)]
)
def test_tangent_is_the_derivative_of_the_residual(chain, rng, following, kernel):
    case = random_case(chain, rng)
    with jax.enable_x64(True):
        args = jnp.asarray(case.tension[:, None]), case.loads(following), kernel
        residual = lambda q: implicit.residual_of(chain, q[:, None], *args)[:, 0]  # noqa: E731
        by_ad = jax.jit(jax.jacfwd(residual))(jnp.asarray(case.q))
        tangent = tangent_of(chain, case.q[:, None], *args)[..., 0]
    np.testing.assert_allclose(tangent, by_ad, atol=1e-12 * np.abs(by_ad).max())
    if kernel == "virtual_work":
        case.wrench[:3] = 0
        with jax.enable_x64(True):
            symmetric = tangent_of(chain, case.q[:, None], args[0], case.loads(), kernel)[..., 0]
        np.testing.assert_allclose(symmetric, symmetric.T, atol=1e-12 * np.abs(by_ad).max())


@eqx.filter_jit
def by_recursion(chain, case_q, tension, loads, rhs, lhs):  # type: ignore[no-untyped-def]
    """Solutions, products, count of negative pivots, and the dense tangent."""
    tangent, _ = implicit._tangent(chain, case_q, tension, loads, "virtual_work")
    factors = eliminate(tangent, rhs, lhs)
    found = [
        kn.from_joints(chain, substitute(factors, factors.solved[:, :, i]))[:, 0]
        for i in range(rhs.shape[2])
    ]
    dense = implicit.dense(chain, tangent)[..., 0]
    return jnp.stack(found, axis=1), factors.product[..., 0], factors.negative[0], dense


@pytest.mark.parametrize("following", [False, True])
def test_recursion_solves_what_the_dense_tangent_says(chain, rng, following):
    """The linear-cost elimination against LAPACK, and its bilinear products."""
    case = random_case(chain, rng)
    b, c = rng.normal(size=(chain.n_joints, 2, 1)), rng.normal(size=(chain.n_joints, 3, 1))
    with jax.enable_x64(True):
        tension, loads = jnp.asarray(case.tension[:, None]), case.loads(following)
        sides = kn.per_joint(chain, b), kn.per_joint(chain, c)
        found, product, _, matrix = by_recursion(chain, case.q[:, None], tension, loads, *sides)
    expected = np.linalg.solve(matrix, b[..., 0])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(product, c[..., 0].T @ expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("push", [0.0, 50.0, 300.0])
def test_pivots_count_the_negative_eigenvalues(chain, rng, push):
    case = random_case(chain, rng, moment=0.0)
    with jax.enable_x64(True):
        tension, loads = jnp.full((chain.n_tendons, 1), push), case.loads()
        sides = kn.per_joint(chain, rng.normal(size=(chain.n_joints, 1, 1))), None
        *_, count, matrix = by_recursion(chain, case.q[:, None], tension, loads, *sides)
    assert count == (np.linalg.eigvalsh(matrix) < 0).sum()


def test_tendon_lengths_are_those_of_plain_loops(chain, rng):
    case = random_case(chain, rng)
    straight = loop_lengths(chain, 0 * case.q)
    with jax.enable_x64(True):
        tension = jnp.asarray(case.tension[:, None])
        found = eqx.filter_jit(displacements_of)(chain, case.q[:, None], tension, "virtual_work")
    found = found[:, 0]
    stretched = case.tension / chain.tendon_stiffness
    np.testing.assert_allclose(
        found, loop_lengths(chain, case.q) - straight - stretched, atol=1e-13
    )


def test_ramp_and_its_inverse():
    width = 0.01
    s = np.linspace(-0.03, 0.05, 4001)
    with jax.enable_x64(True):
        value, slope, integral = (np.asarray(x) for x in ramp(jnp.asarray(s), width))
        back = np.asarray(inverse_ramp(jnp.asarray(value), width))
    assert (value[s <= -width] == 0).all()
    assert (value[s >= width] == s[s >= width]).all()
    np.testing.assert_allclose(np.gradient(value, s)[1:-1], slope[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(integral, s)[1:-1], value[1:-1], atol=1e-6)
    np.testing.assert_allclose(back, np.maximum(s, -width), atol=1e-9)


# --- cases that can be worked out by hand


def pendulum(stiffness: float = 2.0, cubic: float = 0.0) -> ElasticChain:
    """One joint about y at the root, a mass 0.3 m above it, a tendon on either side."""
    holes = [[0.02, 0, -0.05], [0.02, 0, 0.05], [-0.02, 0, -0.05], [-0.02, 0, 0.05]]
    tip = np.eye(4)
    tip[2, 3] = 0.3
    return ElasticChain(
        axis=np.array([[0.0, 1.0, 0.0]]),
        offset=np.zeros((1, 3)),
        stiffness=np.array([stiffness]),
        cubic=np.array([cubic]),
        mass=np.array([0.4]),
        com=np.array([[0.0, 0.0, 0.3]]),
        hole=np.array(holes),
        tendon_stiffness=np.array([1e4, 1e4]),
        slack_width=np.array(0.01),
        gravity=np.array([0.0, 0.0, -9.81]),
        base=np.eye(4),
        tip=tip,
        end_frame=tip[None],
        routing=((0, 1), (0, 1)),
        segment_bodies=(1,),
        name="pendulum",
    )


def solve_pendulum(chain, tension=(0.0, 0.0), **given):  # type: ignore[no-untyped-def]
    """One compiled form for most cases: a tip wrench, of zeros where there is none."""
    given = {"gravity": [0.0] * 3, "tip_wrench": [0.0] * 6, **given}
    return muxjax.forward_statics(chain, tension=list(tension), **given)


def test_a_pendulum_on_its_side():
    """K q = m g h cos q for gravity along x."""
    eq = solve_pendulum(pendulum(), gravity=[9.81, 0, 0]).check()
    q = eq.angles[0]
    assert 2.0 * q == pytest.approx(0.4 * 9.81 * 0.3 * math.cos(q), abs=1e-12)
    np.testing.assert_allclose(eq.pose[:3, 3], [0.3 * math.sin(q), 0, 0.3 * math.cos(q)])


def test_one_tendon_bends_a_cubic_hinge():
    """K q + c q^3 = T dl/dq with l = g cos(q/2) - 2 r sin(q/2)."""
    eq = solve_pendulum(pendulum(cubic=3.0), [20.0, 0.0]).check()
    q = eq.angles[0]
    slope = 0.05 * math.sin(q / 2) + 0.02 * math.cos(q / 2)
    assert 2 * q + 3 * q**3 == pytest.approx(20 * slope, abs=1e-12)
    length = 0.1 * math.cos(q / 2) - 0.04 * math.sin(q / 2)
    assert eq.displacements[0] == pytest.approx(length - 0.1 - 20 / 1e4, abs=1e-14)


def test_an_upright_mass_buckles_when_its_spring_is_too_weak():
    """Stable upright for K > m g h = 1.177; below, straight up is reported as unstable."""
    weak, firm = pendulum(1.1), pendulum(1.3)
    down = {"gravity": [0, 0, -9.81]}
    assert solve_pendulum(firm, **down).check().stable
    upright = solve_pendulum(weak, **down).check()
    assert upright.angles[0] == 0
    assert not upright.stable
    fallen = solve_pendulum(weak, **down, q0=[0.01]).check()
    assert fallen.stable
    q = fallen.angles[0]
    assert 1.1 * q == pytest.approx(0.4 * 9.81 * 0.3 * math.sin(q), abs=1e-12)


def test_tendons_held_by_their_length_keep_a_weak_arm_upright():
    """Co-contraction adds 2 K_t r^2: the same weak spring is stable between taut tendons."""
    held = muxjax.forward_statics(pendulum(1.1), displacements=[-0.001, -0.001]).check()
    assert held.stable
    assert (held.tension > 5).all()
    # Both chords are at their length, 0.1 m - nothing: tension is K_t times what was wound in.
    np.testing.assert_allclose(held.tension, 10.0, rtol=1e-9)


def test_dead_and_following_wrenches_differ_as_they_should():
    """A dead moment M gives K q = M; a following force F across the tip gives K q = F h."""
    light = eqx.tree_at(lambda c: c.mass, pendulum(), np.zeros(1))
    dead = solve_pendulum(light, tip_wrench=[0, 0.5, 0, 0, 0, 0]).check()
    assert dead.angles[0] == pytest.approx(0.25, abs=1e-12)
    force = [0, 0, 0, 3.0, 0, 0]
    along = solve_pendulum(light, tip_wrench=force, wrench_frame="following").check()
    assert along.angles[0] == pytest.approx(3 * 0.3 / 2, abs=1e-12)
    q = solve_pendulum(light, tip_wrench=force).check().angles[0]
    assert 2 * q == pytest.approx(3 * 0.3 * math.cos(q), abs=1e-12)
    at_mass = {"point_bodies": [1], "point_offsets": [[0, 0, 0.3]]}
    point = solve_pendulum(light, point_loads=[force[3:]], **at_mass).check()
    assert point.angles[0] == pytest.approx(q, abs=1e-13)


def test_without_weight_a_segment_is_an_arc(muxarm_chain):
    """One tendon alone gives every joint of its segment the same bend: constant curvature."""
    tension = np.zeros(9)
    tension[2] = 20.0
    eq = muxjax.forward_statics(muxarm_chain, tension=tension, gravity=[0, 0, 0]).check()
    bend = eq.angles.reshape(25, 2)
    flipped = muxarm_chain.axis.reshape(25, 2, 3)[:, 0, 1] == 1
    bend[flipped] = bend[flipped, ::-1]
    inner = bend[1:9]
    # Universal joints' order alternates: the bend does so in the third order of its size.
    assert np.ptp(inner[::2], axis=0).max() < 1e-3 * np.abs(bend).max()
    assert np.abs(bend[9:]).max() < 1e-9


# --- round trips, batches, the paper's form

FULL = 64  # rows; batches of one size share what is compiled


def random_loads(chain: ElasticChain, rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    """Tensions, two in five of them zero, in all three mountings, with a force at the tip."""
    tension = rng.uniform(0, 20, (n, chain.n_tendons)) * (
        rng.uniform(size=(n, chain.n_tendons)) < 0.6
    )
    wrench = np.concatenate([np.zeros((n, 3)), 0.3 * rng.normal(size=(n, 3))], axis=1)
    return {
        "tension": tension,
        "gravity": DIRECTIONS[rng.integers(0, 3, n)],
        "tip_wrench": wrench,
    }


def round_trip(chain: ElasticChain, rng: np.random.Generator, n: int) -> None:
    loads = random_loads(chain, rng, n)
    there = muxjax.forward_statics(chain, **loads)
    tension = loads.pop("tension")
    back = muxjax.forward_statics(chain, displacements=there.displacements, **loads)
    both = there.converged & back.converged
    assert both.mean() >= 0.995
    away = np.linalg.norm(there.pose[:, :3, 3] - back.pose[:, :3, 3], axis=-1)
    assert away[both].max() < 1e-9
    assert np.abs(back.tension - tension)[both].max() < 1e-6
    assert (back.slack[both] == (tension < 0.01)[both]).all()


def test_lengths_of_tensions_give_the_tensions_back(arm, rng):
    round_trip(arm, rng, FULL)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hyper_redundant", "muxarm"])
def test_lengths_of_tensions_give_the_tensions_back_always(name, rng):
    chain = (
        muxjax.load_chain(name)
        if name != "muxarm"
        else muxjax.elastic_chain(muxjax.load_robot(name))
    )
    round_trip(chain, rng, 1000)


def test_a_batch_is_its_rows(arm, rng):
    loads = random_loads(arm, rng, FULL)
    whole = muxjax.forward_statics(arm, **loads)
    one = muxjax.forward_statics(arm, **{k: v[1] for k, v in loads.items()})
    np.testing.assert_allclose(whole.angles[1], one.angles, atol=1e-11)
    loads = {"tension": loads["tension"][:21].reshape(21, 1, 8), "tip_wrench": np.zeros(6)}
    shared = muxjax.forward_statics(arm, gravity=DIRECTIONS, **loads)
    assert shared.angles.shape == (21, 3, arm.n_joints)
    assert shared.converged.shape == (21, 3)


def test_the_papers_form_takes_tensions_and_lengths(arm, rng):
    """Couple load, softplus, [q; s]: what its lengths give is what its tensions gave."""
    tension = rng.uniform(1, 6, (FULL, 8))
    there = muxjax.forward_statics(arm, tension=tension, kernel="couple").check()
    back = muxjax.forward_statics(arm, displacements=there.displacements, kernel="couple").check()
    np.testing.assert_allclose(back.angles, there.angles, atol=1e-9)
    np.testing.assert_allclose(back.tension, tension, atol=1e-6)
    # Its load is that of the default for fine pitch and small bends only.
    loads = {"gravity": arm.gravity, "tip_wrench": np.zeros(6)}
    default = muxjax.forward_statics(arm, tension=tension, **loads).check()
    away = np.linalg.norm(default.pose[:, :3, 3] - there.pose[:, :3, 3], axis=-1)
    assert 1e-4 < np.median(away) / 0.7 < 0.1


def test_a_paid_out_tendon_is_slack(arm):
    paid_out = np.array([[0.02, 0, 0, 0, 0, 0, 0, 0]] * FULL)
    loads = {"gravity": np.zeros(3), "tip_wrench": np.zeros(6)}
    eq = muxjax.forward_statics(arm, displacements=paid_out, **loads).check()
    assert eq.slack[:, 0].all()
    assert (eq.tension[:, 0] == 0).all()


# --- derivatives


@pytest.mark.parametrize(
    ("kernel", "kind", "resolution", "modes"),
    [
        ("virtual_work", "displacements", 2, [jax.grad]),
        *(
            pytest.param(*case, 4, [jax.grad, jax.jacfwd], marks=pytest.mark.slow)
            for case in (
                ("virtual_work", "displacements"),
                ("virtual_work", "tension"),
                ("couple", "displacements"),
            )
        ),
    ],
)
def test_derivatives_agree_with_finite_differences(kernel, kind, resolution, modes, rng):
    chain = muxjax.load_chain("hyper_redundant", resolution=resolution)
    tension = rng.uniform(0.5, 2.5, 8)
    gravity, force = np.array([1.0, 2.0, 9.0]), np.array([0.1, 0.2, 0.1])
    # Lengths that these tensions have under these loads: the paper's form takes lengths as
    # equalities, and has no solution where a tendon would have length to spare.
    start = muxjax.forward_statics(
        chain, tension=tension, gravity=gravity, tip_wrench=[0, 0, 0, *force], kernel=kernel
    ).check()
    given = tension if kind == "tension" else start.displacements

    def tip(x):  # type: ignore[no-untyped-def]
        """By the given values, gravity, tip force, stiffness, geometry and tendon stiffness."""
        own = eqx.tree_at(
            lambda c: (c.stiffness, c.hole, c.tendon_stiffness),
            chain,
            (
                chain.stiffness * (1 + x[14]),
                chain.hole * (1 + x[15]),
                chain.tendon_stiffness * (1 + x[16]),
            ),
        )
        wrench = [0 * x[0], 0 * x[0], 0 * x[0], x[11], x[12], x[13]]
        eq = muxjax.forward_statics(
            own,
            **{kind: x[:8]},
            gravity=x[8:11],
            tip_wrench=wrench if isinstance(x, np.ndarray) else jnp.stack(wrench),
            kernel=kernel,
        )
        eq = eq.check() if isinstance(x, np.ndarray) else eq
        return eq.pose[0, 3] + 2 * eq.pose[1, 3] + 3 * eq.pose[2, 3] + eq.pose[0, 2]

    x = np.concatenate([given, gravity, force, np.zeros(3)])
    with jax.enable_x64(True):
        gradient, *forwards = (jax.jit(mode(tip))(jnp.asarray(x)) for mode in modes)
    step = 1e-6 * np.maximum(np.abs(x), 1e-2)
    expected = np.array(
        [
            (tip(x + h * e) - tip(x - h * e)) / (2 * h)
            for h, e in zip(step, np.eye(len(x)), strict=True)
        ]
    )
    np.testing.assert_allclose(gradient, expected, rtol=2e-4, atol=1e-6 * np.abs(expected).max())
    for same in forwards:
        np.testing.assert_allclose(same, gradient, rtol=1e-9, atol=1e-12)


def test_float32_traces_are_refused(arm):
    with pytest.raises(ValueError, match="jax_enable_x64"):
        jax.jit(lambda t: muxjax.forward_statics(arm, tension=t).pose)(jnp.zeros(8))


# --- failures and bad input


def test_what_is_not_found_says_so():
    eq = solve_pendulum(pendulum(0.01), [30.0, 0.0], max_iterations=1)
    assert not eq.converged
    assert eq.residual > 0
    with pytest.raises(muxjax.StaticsError, match=r"not found \(\w+\) after \d+ iterations"):
        eq.check()


def test_crossed_holes_are_no_solution():
    """A tendon strong enough to fold the bead past its holes is outside the model."""
    eq = solve_pendulum(pendulum(0.05), [400.0, 0.0])
    assert not eq.converged
    assert eq.status == muxjax.StaticsStatus.FOLDED


def with_leaf(chain: ElasticChain, name: str, index: object, value: float) -> ElasticChain:
    leaf = np.array(getattr(chain, name))
    leaf[index] = value
    return eqx.tree_at(lambda c: getattr(c, name), chain, leaf)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give either tension or displacements"),
        ({"tension": [0.0] * 8, "displacements": [0.0] * 8}, "give either"),
        ({"tension": [0.0] * 7}, r"tension: last axis must have 8 entries, found shape \(7,\)"),
        ({"tension": [1, 1, -2.0, 1, 1, 1, 1, 1]}, r"tension: tendon 3 is at -2; must be at least"),
        ({"tension": [[0.0] * 8, [np.nan] * 8]}, r"tension: entry \(1, 0\) is nan"),
        ({"displacements": [-0.5, 0, 0, 0, 0, 0, 0, 0]}, "tendon 1 is at -0.5; impossible"),
        ({"tension": [0.0] * 8, "gravity": [1.0, 2.0]}, "gravity: last axis must have 3"),
        ({"tension": [[0.0] * 8] * 2, "gravity": [[0.0] * 3] * 3}, "gravity: batch axes"),
        ({"tension": [0.0] * 8, "tip_wrench": [1.0] * 5}, "tip_wrench: last axis must have 6"),
        ({"tension": [0.0] * 8, "wrench_frame": "tip"}, "wrench_frame: must be 'dead'"),
        ({"tension": [0.0] * 8, "point_loads": [[0, 0, 1.0]]}, "point_bodies: needed"),
        (
            {"tension": [0.0] * 8, "point_loads": [[0, 0, 1.0]], "point_bodies": [33]},
            "point_bodies: bodies are 1 to 32, found 33",
        ),
        (
            {"tension": [0.0] * 8, "point_loads": [[0, 0, 1.0]], "point_bodies": [1, 2]},
            r"point_loads: must have shape \(..., 2, 3\)",
        ),
        ({"tension": [0.0] * 8, "kernel": "magic"}, "kernel: must be one of virtual_work, couple"),
        ({"tension": [0.0] * 8, "q0": [0.0]}, "q0: last axis must have 32"),
        ({"tension": [0.0] * 8, "max_iterations": 0}, "max_iterations: must be at least 1"),
    ],
)
def test_bad_calls_name_the_field(arm, arguments, message):
    with pytest.raises(ValueError, match=message):
        muxjax.forward_statics(arm, **arguments)


@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("stiffness", 4, 0.0, "chain.stiffness: must be above 0 N m/rad, found 0 at joint 5"),
        ("mass", 2, -1.0, "chain.mass: must be at least 0, found -1 at joint 3"),
        ("axis", (0, 0), 2.0, "chain.axis: axes must have length 1"),
        ("hole", (3, 1), np.nan, "chain.hole: entry"),
        ("tendon_stiffness", 6, 0.0, "chain.tendon_stiffness: must be above 0 N/m"),
        ("tendon_stiffness", 6, np.inf, "lengths need tendons of finite stiffness"),
        ("slack_width", (), 0.0, "chain.slack_width: must be above 0 N"),
    ],
)
def test_bad_chains_name_the_field(arm, name, index, value, message):
    with pytest.raises(ValueError, match=message):
        muxjax.forward_statics(with_leaf(arm, name, index, value), displacements=[0.0] * 8)


def edited(tmp_path, old: str, new: str):  # type: ignore[no-untyped-def]
    from muxjax.config import resolve

    text = resolve("hyper_redundant", "chains").read_text()
    assert old in text
    path = tmp_path / "chain.yaml"
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("gravity_m_s2: {value: [0, 0, 9.81]", "spare: {value: [0, 0, 9.81]", "spare"),
        ("bending_nm_rad: {value: 2.0", "bending_nm_rad: {value: 0", "bending_nm_rad.value"),
        ("value: [x, y]", "value: [x, w]", "joints.value"),
        ("segment: 2, azimuth_deg: 45", "segment: 3, azimuth_deg: 45", r"tendons\[5\].segment"),
        ("value: 20000", "value: -1", "tendon_stiffness_n_m"),
    ],
)
def test_bad_files_name_the_field(tmp_path, old, new, message):
    with pytest.raises(muxjax.ConfigError, match=message):
        muxjax.load_chain(edited(tmp_path, old, new))


def test_masses_need_a_direction_of_gravity(tmp_path):
    from muxjax.config import resolve

    lines = resolve("hyper_redundant", "chains").read_text().splitlines()
    path = tmp_path / "chain.yaml"
    path.write_text("\n".join(x for x in lines if not x.startswith("gravity")))
    with pytest.raises(muxjax.ConfigError, match="gravity_m_s2: needed because beads have a mass"):
        muxjax.load_chain(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"bending_stiffness": 0.0}, "bending_stiffness: must be above 0"),
        ({"mass": -1.0}, "mass: must be at least 0 kg"),
        ({"gravity": [0.0]}, "gravity: last axis must have 3"),
    ],
)
def test_bad_springs_of_a_robot(muxarm, arguments, message):
    with pytest.raises(ValueError, match=message):
        muxjax.elastic_chain(muxarm, **arguments)


def test_the_elastic_robot_has_the_robots_geometry(muxarm, muxarm_chain):
    straight = muxjax.forward_statics(muxarm_chain, tension=np.zeros(9), gravity=[0, 0, 0]).check()
    expected = muxjax.forward_kinematics(muxarm, np.zeros(6))
    np.testing.assert_allclose(straight.pose, expected, atol=1e-12)
    heights = np.cumsum(muxarm.length)
    np.testing.assert_allclose(straight.segment_ends[:, 2, 3], heights, atol=1e-12)


def test_numerical_gradient_of_the_loop_energy(rng):
    """The transcription's own derivative against the residual: nothing of ours in between."""
    chain = irregular()
    case = random_case(chain, rng, moment=0.0)

    def energy(q):  # type: ignore[no-untyped-def]
        return loop_energy(chain, q, case.tension, case.gravity, case.wrench[3:], case.point)

    with jax.enable_x64(True):
        residual = residual_of(
            chain, case.q[:, None], jnp.asarray(case.tension[:, None]), case.loads(), "virtual_work"
        )[:, 0]
    np.testing.assert_allclose(approx_fprime(case.q, energy, 1e-7), residual, atol=1e-5)
