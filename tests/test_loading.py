"""MuxArm under load: true posture, tension along programs, transmission, friction, the term."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import muxjax
from muxjax.config import RobotConfig
from muxjax.metrics.tension import TensionProfile, tension_along
from muxjax.planning.tension import Tension
from muxjax.robot import robot_from_config
from muxjax.statics import elastic_chain, forward_statics
from muxjax.statics.follow import follow
from muxjax.statics.friction import friction_path, winding_loop
from muxjax.statics.posture import segment_bending, true_posture
from muxjax.statics.transmission import load_test, tendon_forces

THETA = [0.6, 0.3, 0.9, 2.0, 0.5, -1.0]


@pytest.fixture(scope="module")
def chain(muxarm):
    return elastic_chain(muxarm, bending_stiffness=15.0, mass=0.5)


@pytest.fixture(scope="module")
def goal(muxarm):
    return muxjax.tendon_displacements(muxarm, np.array(THETA))


# -- transmission --------------------------------------------------------------------------------


def test_tendon_force_is_torque_times_ratio_times_efficiency_over_radius(muxarm):
    forces = tendon_forces(muxarm, worm_efficiency=0.5)
    assert forces.rated == pytest.approx(0.88 * 60 * 0.5 / 0.025)
    assert forces.peak == pytest.approx(2.26 * 60 * 0.5 / 0.025)
    assert forces.stall == pytest.approx(4.90 * 60 * 0.5 / 0.025)
    assert forces.momentary == min(forces.peak, forces.clutch)
    assert forces.continuous == min(forces.rated, forces.clutch)


def test_load_test_lifts_the_published_payload(muxarm):
    found = load_test(muxarm)
    assert found.tension == pytest.approx(10 * 9.80665)
    efficiency = muxarm.config.drive_strength.worm_efficiency.value
    # Power in equals power out over the efficiency: torque * angle = force * length / eta.
    assert found.servo_torque * 60 / 0.025 * efficiency == pytest.approx(found.tension)
    assert found.margin_peak / found.margin_rated == pytest.approx(2.26 / 0.88)


@pytest.mark.parametrize("efficiency", [0.0, -0.1, 1.2, float("nan")])
def test_an_impossible_efficiency_is_refused(muxarm, efficiency):
    with pytest.raises(ValueError, match="worm_efficiency"):
        tendon_forces(muxarm, worm_efficiency=efficiency)


def test_a_weightless_load_test_is_refused(muxarm):
    with pytest.raises(ValueError, match="mass: must be above 0 kg"):
        load_test(muxarm, mass=0.0)


def test_strength_is_no_part_of_the_fingerprint_and_may_be_missing(muxarm):
    raw = muxarm.config.model_dump(by_alias=True)
    raw["drive_strength"] = None
    weak = robot_from_config(RobotConfig.model_validate(raw))
    assert weak.fingerprint == muxarm.fingerprint
    with pytest.raises(ValueError, match="no drive_strength"):
        tendon_forces(weak)


# -- posture -------------------------------------------------------------------------------------


def test_posture_without_weight_and_with_stiff_tendons_is_near_constant_curvature(muxarm, goal):
    light = elastic_chain(muxarm, bending_stiffness=5.0, tendon_stiffness=5e5, mass=0.0)
    found = true_posture(muxarm, light, goal)
    assert found.converged
    assert found.position_gap < 0.02 * muxarm.length.sum()
    np.testing.assert_allclose(found.bending, found.bending_pcc, atol=0.06)


def test_payload_pulls_the_horizontal_arm_down(muxarm, goal):
    level = elastic_chain(muxarm, bending_stiffness=15.0, mass=0.5, gravity=(-9.81, 0.0, 0.0))
    height = [true_posture(muxarm, level, goal, payload=m).pose[0, 3] for m in (0.0, 0.2, 0.4)]
    assert height[0] > height[1] > height[2]


def test_segment_bending_is_the_angle_between_end_axes(muxarm):
    q = np.array(THETA)
    frames = muxjax.backbone(muxarm, q, 1)
    np.testing.assert_allclose(segment_bending(frames[0], frames[1:]), q[0::2], atol=1e-12)


def test_bad_posture_input_names_the_field(muxarm, chain, goal):
    other = dataclasses.replace(chain, name="penta")
    with pytest.raises(ValueError, match=r"chain: has 9 tendons in 3 segments"):
        true_posture(muxarm, other, goal)
    with pytest.raises(ValueError, match="payload: must be at least 0 kg"):
        true_posture(muxarm, chain, goal, payload=-1.0)
    with pytest.raises(ValueError, match="displacements"):
        true_posture(muxarm, chain, np.full(9, np.nan))
    with pytest.raises(ValueError, match="needs samples along a path"):
        follow(chain, np.zeros((0, 9)))


# -- tension along a program ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def profiled(muxarm, chain, goal):
    found = muxjax.plan(muxarm, muxjax.Problem(np.zeros(9), goal, servos=(1,)), "sequential")
    program = muxjax.schedule(muxarm, found)
    return program, tension_along(muxarm, chain, [program], samples_a_leg=3)[0]


@pytest.mark.slow
def test_a_program_ends_in_the_equilibrium_of_its_target(chain, goal, profiled):
    _, profile = profiled
    assert profile.unsolved == 0
    end = forward_statics(chain, displacements=goal)
    np.testing.assert_allclose(profile.tension[-1], end.tension, atol=1e-5)


def test_time_and_lengths_are_the_programs(muxarm, goal, profiled):
    program, profile = profiled
    assert profile.times[-1] == pytest.approx(muxjax.evaluate(muxarm, program).time_s)
    np.testing.assert_allclose(profile.displacements[-1], goal, atol=1e-12)
    assert (np.diff(profile.times) > 0).all()


def test_peak_is_found_where_it_is(profiled):
    _, profile = profiled
    tendon, when = profile.peak_at
    sample = int(np.flatnonzero(profile.times == when)[0])
    assert profile.tension[sample, tendon - 1] == profile.peak == profile.tension.max()
    assert 0 < profile.mean < profile.mean_of_largest < profile.peak
    assert 0 < profile.slack < 1


def by_hand(tension: list[float], bending: list[float], times: list[float]) -> TensionProfile:
    """One segment and one tendon; NaN where nothing was solved."""
    pull, bent = (np.array(x, dtype=float)[:, None] for x in (tension, bending))
    solved = np.isfinite(pull[:, 0])
    return TensionProfile(np.array(times), 0 * pull, pull, bent, solved, solved)


def test_averages_and_overshoot_of_a_profile_by_hand():
    profile = by_hand([0, 10, 10, 4], [0.0, 2.0, 2.0, 1.0], [0.0, 1.0, 3.0, 4.0])
    assert profile.mean == pytest.approx((5 * 1 + 10 * 2 + 7 * 1) / 4)
    share, peak = profile.overshoot()
    assert peak[0] == pytest.approx(1.0)
    assert share[0] == pytest.approx((0.5 + 2 + 1) / 4, abs=1e-5)


def test_unsolved_samples_are_counted_and_left_out():
    nan = float("nan")
    profile = by_hand([2, nan, 4, 6], [0.1, nan, 0.1, 0.1], [0.0, 1.0, 2.0, 3.0])
    assert profile.unsolved == 1
    assert profile.mean == pytest.approx(5.0)
    assert profile.peak == 6.0
    with pytest.raises(ValueError, match="no sample"):
        _ = by_hand([nan, nan], [nan, nan], [0.0, 1.0]).peak_at


def test_bad_tension_input_names_the_field(muxarm, chain, profiled):
    program, _ = profiled
    with pytest.raises(ValueError, match="programs: needs at least one"):
        tension_along(muxarm, chain, [])
    with pytest.raises(ValueError, match="pretension: must be at least 0 N"):
        tension_along(muxarm, chain, [program], pretension=-1.0)
    with pytest.raises(ValueError, match="samples_a_leg: must be at least 1"):
        tension_along(muxarm, chain, [program], samples_a_leg=0)


# -- friction ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loops(chain):
    return {mu: winding_loop(chain, 1, depth=0.03, friction=mu, steps=8) for mu in (0.0, 0.15)}


@pytest.mark.slow
def test_without_friction_the_path_is_the_frictionless_one(chain, loops):
    free = loops[0.0]
    assert free.converged.all()
    expected = forward_statics(chain, displacements=free.displacements)
    np.testing.assert_allclose(free.angles, expected.angles, atol=1e-8)
    np.testing.assert_allclose(free.tension, expected.tension, atol=1e-5)
    np.testing.assert_allclose(free.end_tension, free.tension, rtol=1e-12)
    assert abs(free.work) < 1e-7


def test_friction_takes_energy_and_pulls_differ_by_direction(loops):
    rough = loops[0.15]
    assert rough.converged.all()
    inward, outward = rough.tension[16 + 4, 0], rough.tension[24 + 4, 0]
    assert inward > loops[0.0].tension[16 + 4, 0] > outward
    pull = 0.5 * (rough.tension[17:] + rough.tension[16:-1])
    assert -(pull * np.diff(rough.displacements[16:], axis=0)).sum() > 1e-3


def test_tension_falls_by_capstan_over_the_angle_turned(chain, loops):
    """The angle is summed here from rotation matrices of the joints, hole by hole."""
    rough = loops[0.15]
    sample = 8  # wound in all the way
    pose, bodies = np.eye(4), [np.eye(4)]
    for axis, offset, q in zip(chain.axis, chain.offset, rough.angles[sample], strict=True):
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(axis * q).as_matrix(), offset
        pose = pose @ step
        bodies.append(pose)
    route = chain.routing[0]
    points = np.array(
        [(bodies[b] @ [*h, 1.0])[:3] for b, h in zip(route, chain.hole, strict=False)]
    )
    units = np.diff(points, axis=0) / np.linalg.norm(np.diff(points, axis=0), axis=1)[:, None]
    units = np.concatenate([[[0.0, 0.0, 1.0]], units])
    turned = np.arccos(np.clip((units[1:] * units[:-1]).sum(1), -1, 1)).sum()
    ratio = rough.end_tension[sample, 0] / rough.tension[sample, 0]
    # Corners are rounded by a milliradian a hole.
    assert np.log(ratio) == pytest.approx(-0.15 * turned, abs=0.15 * 1e-3 * len(route))
    assert turned > 0.3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"friction": -0.1}, "friction: must be at least 0"),
        ({"friction": float("nan")}, "friction"),
        ({"friction": 0.1, "presliding": 0.0}, "presliding: must be above 0"),
        ({"friction": 0.1, "sigma": np.full(9, 2.0)}, "sigma: must be 9 numbers"),
    ],
)
def test_bad_friction_names_the_field(chain, options, message):
    with pytest.raises(ValueError, match=message):
        friction_path(chain, np.zeros((2, 9)), **options)


def test_a_loop_needs_a_tendon_of_the_chain(chain):
    with pytest.raises(ValueError, match="tendon: the chain has tendons 1 to 9, found 10"):
        winding_loop(chain, 10, depth=0.01, friction=0.1)


# -- the planners' term --------------------------------------------------------------------------


def test_the_reduced_statics_has_the_tensions_of_the_full_one(muxarm, chain, rng):
    """On states of random plans: each tendon somewhere between start and target."""
    theta = rng.uniform(0.2, 1.6, (40, 3))
    phi = rng.uniform(0, 2 * np.pi, (40, 3))
    goals = muxjax.tendon_displacements(muxarm, np.stack([theta, phi], -1).reshape(40, -1))
    states = goals * rng.choice([0.0, 0.5, 1.0], size=goals.shape)
    full = forward_statics(chain, displacements=states)
    solved = full.converged
    assert solved.mean() > 0.9
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(lambda x: Tension().tensions(muxarm, x))(states))
    gap = abs(found - full.tension).max(axis=-1)[solved]
    scale = full.tension.max(axis=-1)[solved]
    assert np.median(gap / scale) < 0.03
    assert np.percentile(gap, 90) < 3.0


def test_gentle_has_its_term_unless_another_is_given(goal):
    own = Tension(bending_stiffness=40.0)
    for given, expected in (({}, Tension()), ({"tension": own}, own)):
        problem = muxjax.Problem(np.zeros(9), goal, preset="gentle", terms=given)
        assert dict(problem.weighted_terms)["tension"].term == expected


@pytest.mark.parametrize("field", ["bending_stiffness", "tendon_stiffness"])
def test_a_term_without_springs_is_refused(field):
    with pytest.raises(ValueError, match=f"Tension.{field}: must be finite and above 0"):
        Tension(**{field: 0.0})


@pytest.mark.slow
def test_gentle_plans_pull_less_than_the_fastest(muxarm, chain, goal):
    """By the full statics, which the planner does not know."""
    programs = []
    for preset in ("gentle", "fastest"):
        problem = muxjax.Problem(np.zeros(9), goal, servos=(1,), preset=preset)
        programs.append(muxjax.schedule(muxarm, muxjax.plan(muxarm, problem, "exact")))
    gentle, fastest = tension_along(muxarm, chain, programs)
    assert gentle.unsolved + fastest.unsolved == 0
    assert gentle.mean < fastest.mean
    assert gentle.mean_of_largest < fastest.mean_of_largest
