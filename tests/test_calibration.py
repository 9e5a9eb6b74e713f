"""Calibration against known truths: recovery, honest intervals, honest refusals."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from muxjax.config import load_yaml, resolve
from muxjax.statics import ElasticChain, forward_statics, load_chain
from muxjax.statics.calibration import Measurements, calibrate, read_measurements, save_chain
from muxjax.statics.calibration.fit import _Model
from muxjax.statics.calibration.parameters import (
    as_document,
    offsets_of,
    parameters_of,
    with_parameters,
)
from muxjax.statics.files import ChainConfig

GROUPS = ("stiffness", "elasticity", "offsets", "geometry", "base")
POSITION_NOISE, ANGLE_NOISE, TENSION_NOISE = 3e-4, 2e-3, 0.05
ROWS = 20


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> str:
    """A hanging arm of two segments with six beads each, as a file."""
    document = yaml.safe_load(resolve("hyper_redundant", "chains").read_text())
    document["gravity_m_s2"]["value"] = [0.0, 0.0, 9.81]
    for segment in document["segments"]:
        segment["n_beads"]["value"] = 6
        segment["hinge"]["bending_nm_rad"]["value"] = 0.8
    path = tmp_path_factory.mktemp("chains") / "small.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return str(path)


def applied(chain: ElasticChain, config: ChainConfig, parameters, theta) -> ElasticChain:
    with jax.enable_x64(True):
        made = with_parameters(chain, config, parameters, jnp.asarray(theta))
        return jax.tree.map(np.asarray, made)


def a_theta(parameters, rng) -> np.ndarray:
    """A truth within a fraction of the plausible spread."""
    return np.array([rng.uniform(-0.2, 0.2) * p.spread for p in parameters])


def measured(
    truth: ElasticChain, offsets: np.ndarray, rng: np.random.Generator, noise: float = 1.0
) -> Measurements:
    """Lengths, tensions and poses of a truth with every tendon taut."""
    tension = rng.uniform(1.0, 4.0, (ROWS, truth.n_tendons))
    found = forward_statics(truth, tension=tension).check()
    turn = Rotation.from_rotvec(noise * rng.normal(0, ANGLE_NOISE, (ROWS, 3))).as_matrix()
    return Measurements(
        kind="displacements",
        given=found.displacements + offsets,
        position=found.pose[:, :3, 3] + noise * rng.normal(0, POSITION_NOISE, (ROWS, 3)),
        rotation=found.pose[:, :3, :3] @ turn,
        tension=tension + noise * rng.normal(0, TENSION_NOISE, tension.shape),
    )


@pytest.fixture(scope="module")
def setting(small):
    """File, chain, parameters, true theta, true chain."""
    rng = np.random.default_rng(5)
    config, chain = load_yaml(ChainConfig, resolve(small, "chains")), load_chain(small)
    parameters = parameters_of(config, GROUPS, "displacements")
    theta = a_theta(parameters, rng)
    return small, chain, config, parameters, theta, applied(chain, config, parameters, theta)


def true_offsets(parameters, theta, m: int) -> np.ndarray:
    with jax.enable_x64(True):
        return np.array(offsets_of(parameters, jnp.asarray(theta), m))


@pytest.mark.parametrize("name", ["hyper_redundant", "tdcr_a", "tdcr_c"])
def test_the_written_file_is_the_fitted_chain(name, tmp_path, rng):
    """Two ways to a chain with other values: its leaves, and its file loaded again."""
    config, chain = load_yaml(ChainConfig, resolve(name, "chains")), load_chain(name)
    groups = ("stiffness", "elasticity", "geometry", "base")
    groups += ("twist",) if name != "hyper_redundant" else ()
    parameters = parameters_of(config, groups, "tension")
    theta = a_theta(parameters, rng)
    values = {p.name: p.physical(t) for p, t in zip(parameters, theta, strict=True)}
    path = tmp_path / "again.yaml"
    path.write_text(yaml.safe_dump(as_document(config, values, "a test"), sort_keys=False))
    loaded = load_chain(path)
    made = applied(chain, config, parameters, theta)
    assert loaded.routing == made.routing
    for field in dataclasses.fields(ElasticChain):
        one, two = getattr(loaded, field.name), getattr(made, field.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-13, err_msg=field.name)


@pytest.mark.slow
def test_the_jacobian_agrees_with_finite_differences(setting, rng):
    _, chain, config, parameters, theta, truth = setting
    data = measured(truth, true_offsets(parameters, theta, chain.n_tendons), rng, noise=5.0)
    model = _Model(chain, config, parameters, data)
    at = 0.5 * theta
    exact = model.jacobian(at)
    for _ in range(3):  # directions in which all parameters change
        way = rng.normal(size=len(parameters)) * [p.spread for p in parameters]
        step = 1e-4 * way
        slope = (model.look(at + step).residual - model.look(at - step).residual) / 2e-4
        np.testing.assert_allclose(exact @ way, slope, atol=1e-5 * abs(slope).max())


@pytest.mark.slow
def test_exact_data_give_the_truth_back(setting, tmp_path):
    """Without noise everything comes back, and the file of the fit holds it."""
    small, chain, _, parameters, theta, truth = setting
    offsets = true_offsets(parameters, theta, chain.n_tendons)
    data = measured(truth, offsets, np.random.default_rng(1), noise=0.0)
    found = calibrate(small, data, fit=GROUPS)
    assert found.converged, found.reason
    for estimate, parameter, t in zip(found.estimates, parameters, theta, strict=True):
        miss = abs(estimate.value - parameter.physical(t))
        scale = parameter.physical(t) if parameter.logarithmic else parameter.spread
        assert miss < 1e-4 * abs(scale), estimate
    before, after = found.rms["position"]
    assert before > 1e-3
    assert after < 1e-6
    path = save_chain(found, tmp_path / "fitted.yaml")
    loaded = load_chain(path)
    for name in ("stiffness", "hole", "offset", "base", "gravity", "tendon_stiffness"):
        np.testing.assert_allclose(getattr(loaded, name), getattr(found.chain, name), atol=1e-12)
    text = yaml.safe_load(path.read_text())
    assert text["segments"][0]["hinge"]["bending_nm_rad"]["source"] == "derived"
    assert "20 rows" in text["segments"][0]["hinge"]["bending_nm_rad"]["why"]
    assert text["segments"][0]["bead_mass_kg"]["source"] == "published"


@pytest.mark.parametrize("repeats", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_intervals_hold_the_truth_as_often_as_they_say(setting, repeats):
    """95 % intervals over noisy repeats, and the noise found is the noise put in."""
    small, chain, _, parameters, theta, truth = setting
    offsets = true_offsets(parameters, theta, chain.n_tendons)
    wanted = np.array([p.physical(t) for p, t in zip(parameters, theta, strict=True)])
    inside, noise = [], []
    for seed in range(repeats):
        found = calibrate(small, measured(truth, offsets, np.random.default_rng(seed)), fit=GROUPS)
        assert found.converged, found.reason
        by_name = {e.name: e for e in found.estimates}
        # A shift along the arm and its length can hardly be told apart.
        assert all(e.identifiable for name, e in by_name.items() if name != "base_z")
        inside.append([e.low <= v <= e.high for e, v in zip(found.estimates, wanted, strict=True)])
        noise.append(found.noise)
    share = np.mean(inside)
    # 21 intervals a repeat, correlated within it; the prior makes some a little too wide.
    assert 0.95 - 0.2 / np.sqrt(repeats) < share <= 1.0
    for kind, true in (
        ("position", POSITION_NOISE),
        ("orientation", ANGLE_NOISE),
        ("tension", TENSION_NOISE),
    ):
        found_noise = np.mean([n[kind] for n in noise])
        assert found_noise == pytest.approx(true, rel=0.28 / np.sqrt(repeats)), kind


def test_what_the_data_cannot_tell_is_said_and_held(setting):
    """Tensions alone say nothing about the tendons' stretch; nothing is invented."""
    small, _, _, _, _, truth = setting
    lengths = measured(truth, np.zeros(truth.n_tendons), np.random.default_rng(2))
    data = dataclasses.replace(
        lengths, kind="tension", given=np.maximum(lengths.tension, 0), tension=None
    )
    found = calibrate(small, data, fit=("stiffness", "elasticity"))
    by_name = {e.name: e for e in found.estimates}
    assert not by_name["elasticity"].identifiable
    assert "hardly depend" in by_name["elasticity"].remark
    assert by_name["elasticity"].value == pytest.approx(by_name["elasticity"].start)
    assert not np.isfinite(by_name["elasticity"].high)
    assert by_name["stiffness_1"].identifiable
    assert "elasticity" not in found.values()


def write(path, header: str, *rows: str) -> str:
    path.write_text("\n".join([header, *rows]) + "\n")
    return str(path)


TENSIONS = ",".join(f"tension_{k}_n" for k in range(1, 9))
GOOD = "1,1,1,1,1,1,1,1,0.01,0,0.69"


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("", [], "empty"),
        (f"{TENSIONS},x_m,y_m", ["1,1,1,1,1,1,1,1,0,0"], "column z_m is missing"),
        (f"{TENSIONS[:-12]},x_m,y_m,z_m", ["1,1,1,1,1,1,1,0,0,0"], "column tension_8_n is missing"),
        ("x_m,y_m,z_m", ["0,0,0.7"], "needs tension_1_n to tension_8_n or displacement_1_m"),
        (f"{TENSIONS},x_m,y_m,z_m,colour", [GOOD + ",1"], "unknown column 'colour'"),
        (f"{TENSIONS},x_m,y_m,z_m,x_m", [GOOD + ",1"], "'x_m' stands twice"),
        (f"{TENSIONS},x_m,y_m,z_m", [], "no rows"),
        (f"{TENSIONS},x_m,y_m,z_m", [GOOD, GOOD + ",3"], "line 3: 12 values for 11 columns"),
        (f"{TENSIONS},x_m,y_m,z_m", [GOOD, GOOD.replace("0.69", "nan")], "line 3, z_m: is nan"),
        (f"{TENSIONS},x_m,y_m,z_m", [GOOD.replace("0.69", "high")], "line 2, z_m: expected a numb"),
        (f"{TENSIONS},x_m,y_m,z_m", ["-" + GOOD], "line 2, tension_1_n: is -1, must be at least 0"),
        (f"{TENSIONS},x_m,y_m,z_m", ["1,1,1,1,1,1,1,1,10,0,690"], "millimetres in a column of met"),
        (f"{TENSIONS},x_m,y_m,z_m,qw,qx,qy,qz", [GOOD + ",1,1,0,0"], "line 2, qw to qz: length is"),
    ],
)
def test_a_bad_file_is_refused_by_line_and_column(header, rows, message, tmp_path):
    path = write(tmp_path / "data.csv", header, *rows)
    with pytest.raises(ValueError, match=message) as error:
        read_measurements(path, load_chain("hyper_redundant"))
    assert "data.csv" in str(error.value)


def test_a_good_file_is_read_as_it_stands(tmp_path):
    header = f"z_m,{TENSIONS},x_m,y_m,force_x_n"
    path = write(tmp_path / "data.csv", header, "0.69,1,2,3,4,5,6,7,8,0.01,0.02,0.5", "", "")
    data = read_measurements(path, load_chain("hyper_redundant"))
    assert data.kind == "tension"
    np.testing.assert_array_equal(data.given, [[1, 2, 3, 4, 5, 6, 7, 8]])
    np.testing.assert_array_equal(data.position, [[0.01, 0.02, 0.69]])
    np.testing.assert_array_equal(data.wrench, [[0, 0, 0, 0.5, 0, 0]])
    assert data.rotation is None


def test_too_few_rows_and_wrong_groups_are_refused(small, tmp_path):
    path = write(tmp_path / "data.csv", f"{TENSIONS},x_m,y_m,z_m", GOOD)
    data = read_measurements(path, load_chain(small))
    with pytest.raises(ValueError, match=r"1 rows give 3 measured numbers, too few for the 10"):
        calibrate(small, data, fit=("stiffness", "offsets"))
    with pytest.raises(ValueError, match=r"fit: must name some of stiffness, .*found 'colour'"):
        calibrate(small, data, fit=("colour",))
    with pytest.raises(ValueError, match="twist needs twist joints"):
        calibrate(small, data, fit=("twist",))


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "worst"), [("A", 3e-3), ("C", 1e-3)])
def test_a_wrong_rod_is_found_again_from_the_reference_cases(robot, worst, tmp_path):
    """Cosserat rods by another hand: modulus and lengths come back to a few parts in a thousand."""
    cases = json.loads((Path(__file__).parent / "golden/statics_two_segments.json").read_text())
    rows = [c for c in cases["cases"] if c["robot"] == robot and not any(c["disk_weight_N"])]
    tips = np.array([c["tip"]["cr_independent"] for c in rows])
    data = Measurements(
        kind="tension",
        given=np.array([c["tension_N"] for c in rows]),
        position=tips[:, :3, 3],
        rotation=tips[:, :3, :3],
        wrench=np.array([c["tip_moment_Nm"] + c["tip_force_N"] for c in rows]),
    )
    source = resolve(f"tdcr_{robot.lower()}", "chains")
    document = yaml.safe_load(source.read_text())
    for segment, modulus, length in zip(
        document["segments"], (1.3, 0.8), (0.98, 1.03), strict=True
    ):
        segment["rod"] = json.loads(json.dumps(segment["rod"]))  # both share one in the file
        segment["rod"]["youngs_modulus_pa"]["value"] *= modulus
        segment["length_m"]["value"] *= length
    start = tmp_path / "wrong.yaml"
    start.write_text(yaml.safe_dump(document))
    found = calibrate(start, data, fit=("stiffness", "geometry"))
    assert found.converged, found.reason
    right = load_yaml(ChainConfig, source)
    values = found.values()
    for number, segment in enumerate(right.segments, start=1):
        modulus, length = segment.rod.youngs_modulus_pa.value, segment.length_m.value
        assert values[f"stiffness_{number}"] == pytest.approx(modulus, rel=worst)
        assert values[f"length_{number}"] == pytest.approx(length, rel=worst)
