"""Robot files: shipped ones load anywhere, wrong ones are refused by field, value and limit."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path

import numpy as np
import pytest
import yaml

import muxjax
from muxjax.config import ConfigError, RobotConfig, data_folder
from muxjax.robot import robot_from_config


@pytest.fixture(params=["muxarm", "penta"])
def raw(request) -> dict:
    """A shipped robot's file as plain data, free to be broken."""
    text = (data_folder("configs") / "robots" / f"{request.param}.yaml").read_text()
    return copy.deepcopy(yaml.safe_load(text))  # YAML anchors would share segments


@pytest.fixture
def muxarm_raw() -> dict:
    return yaml.safe_load((data_folder("configs") / "robots" / "muxarm.yaml").read_text())


def put(raw: dict, path: str, value: object) -> None:
    """Set ``raw["a"][0]["b"]`` for path "a.0.b"; None removes the key."""
    *parents, last = (int(p) if p.isdigit() else p for p in path.split("."))
    for parent in parents:
        raw = raw[parent]
    if value is None:
        del raw[last]
    else:
        raw[last] = value


def load(raw: dict, folder: Path) -> muxjax.Robot:
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(raw))
    return muxjax.load_robot(path)


def test_shipped_robots_load_from_any_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    muxarm, penta = muxjax.load_robot("muxarm"), muxjax.load_robot("penta")
    assert (muxarm.n_segments, muxarm.tendons_per_segment, muxarm.n_tendons) == (3, 3, 9)
    assert (penta.n_segments, penta.tendons_per_segment, penta.n_tendons) == (5, 4, 20)
    np.testing.assert_allclose(muxarm.length.sum(), 0.47)
    np.testing.assert_array_equal(muxarm.n_discs, [9, 9, 7])
    np.testing.assert_allclose(muxarm.theta_max, np.radians([180, 180, 140]))


def test_a_robot_of_ones_own_is_named_by_path(raw, tmp_path, monkeypatch):
    put(raw, "segments.0.length_m.value", 0.2)
    load(raw, tmp_path)
    monkeypatch.chdir(tmp_path)
    assert muxjax.load_robot("robot.yaml").length[0] == 0.2


BROKEN = [
    ("segments.0.length_m.value", -0.1, r"segments\[1\]\.length_m\.value: .*greater than 0.*-0\.1"),
    ("segments.2.length_m.value", float("nan"), r"segments\[3\]\.length_m\.value: .*nan"),
    ("segments.1.n_discs.value", 0, r"segments\[2\]\.n_discs\.value: .*equal to 1.*found 0"),
    ("segments.1.n_discs.value", 2.5, r"segments\[2\]\.n_discs\.value: .*integer.*2\.5"),
    ("segments.0.theta_max_deg.value", 400, r"theta_max_deg\.value: .*equal to 360.*found 400"),
    ("segments.0.n_discs.value", 1, r"segment 1: theta_max_deg / n_discs is 180 .*below 180"),
    ("segments.0.colour", "red", r"segments\[1\]\.colour: .*not permitted.*'red'"),
    ("segments.0.length_m.source", "guessed", r"length_m\.source: .*'published', 'derived' or"),
    ("segments.0.length_m.why", "", r"segments\[1\]\.length_m\.why: .*at least 3"),
    ("segments.0.length_m", 0.17, r"segments\[1\]\.length_m: .*found 0\.17"),
    (
        "segments.1.theta_max_deg",
        90,
        r"segments\[2\]\.theta_max_deg: write \{value: 90, source: published \| derived \| "
        r"assumed, why: \.\.\.\}, found 90$",
    ),
    ("servo.speed_rpm", [52], r"servo\.speed_rpm: write \{value: \.\.\., source: .*found \[52\]$"),
    ("segments", [], r"segments: .*at least 1 item"),
    ("segments.0.length_m.value", 169.2, r"length_m\.value: .*less than or equal to 10"),
    ("tendons.radius_m.value", 30, r"tendons\.radius_m\.value: .*equal to 1, found 30$"),
    ("body.disc_radius_m.value", 35, r"body\.disc_radius_m\.value: .*equal to 1, found 35$"),
    ("transmission.wheel_radius_m.value", 25, r"wheel_radius_m\.value: .*equal to 1, found 25$"),
    ("clutch.slip_m.value", 0.5, r"clutch\.slip_m\.value: .*equal to 0\.1, found 0\.5$"),
    (
        "body.disc_radius_m.value",
        0.029,
        r"tendons\.radius_m: must not be above body\.disc_radius_m \(0\.029\).*found 0\.03$",
    ),
    (
        "servo.rated_torque_nm.value",
        2.5,
        r"servo: rated_torque_nm: must not be above peak_torque_nm \(2\.26\), found 2\.5$",
    ),
    (
        "servo.peak_torque_nm.value",
        5,
        r"servo: peak_torque_nm: must not be above stall_torque_nm \(4\.9\), found 5$",
    ),
    (
        "segments.1.tendon_offset_deg.value",
        -119.95,
        r"segments\[2\]\.tendon_offset_deg: the tendons of segments 1 and 2 lie on each other.* "
        r"0\.05 degrees apart; must be at least 0\.1, .*modulo 120, .*found 0 and -119\.95",
    ),
    ("segments.2.tendon_offset_deg.value", 160, r"the tendons of segments 2 and 3 lie on each"),
    ("transmission.gear_ratio", None, r"transmission\.gear_ratio: Field required"),
    ("tendons.per_segment.value", 2, r"tendons\.per_segment\.value: .*equal to 3.*found 2"),
    ("tendons.radius_m.value", 0, r"tendons\.radius_m\.value: .*greater than 0.*found 0"),
    ("tendons.routing.value", "table", r"tendons\.azimuth_deg: given if and only if"),
    ("tendons.azimuth_deg", [[[0, 120, 240]]], r"tendons\.azimuth_deg: given if and only if"),
    (
        "axial.map.value",
        [[1, 2, 3], [4, 5, 6]],
        r"no axial position reaches tendons (?=.*7)(?=.*8)(?=.*9)",
    ),
    (
        "axial.map.value",
        [[1, 2, 4], [4, 5, 6], [7, 8, 9]],
        r"axial\.map\.value\[1\]: .*one segment \(the layer constraint P_i\), found \(1, 2, 4\)",
    ),
    ("axial.map.value", [[1, 2, 2], [4, 5, 6], [7, 8, 9]], r"must meet different tendons"),
    ("axial.map.value", [[1, 2], [4, 5, 6], [7, 8, 9]], r"\[1\]: must name 3 tendons.*found 2"),
    ("axial.map.value", [[0, 1, 2], [4, 5, 6], [7, 8, 9]], r"\[1\]: tendons are 1 to 9, found"),
    ("axial.switch_time_s.value", -1, r"axial\.switch_time_s\.value: .*greater than 0.*found -1"),
    ("base_frame", {"xyz_m": [0, 0]}, r"base_frame\.xyz_m\[3\]: Field required"),
    ("schema", "muxjax/robot/2", r"schema: .*'muxjax/robot/1'.*found 'muxjax/robot/2'"),
    ("name", "Mux Arm", r"name: .*found 'Mux Arm'"),
]


@pytest.mark.parametrize(("path", "value", "message"), BROKEN)
def test_a_wrong_file_fails_with_field_value_and_limit(muxarm_raw, tmp_path, path, value, message):
    put(muxarm_raw, path, value)
    with pytest.raises(ConfigError, match=message) as caught:
        load(muxarm_raw, tmp_path)
    assert str(tmp_path / "robot.yaml") in str(caught.value)


def test_every_wrong_field_is_listed(muxarm_raw, tmp_path):
    put(muxarm_raw, "segments.0.length_m.value", -1)
    put(muxarm_raw, "servo.speed_rpm.value", 0)
    with pytest.raises(ConfigError) as caught:
        load(muxarm_raw, tmp_path)
    first, *lines = str(caught.value).splitlines()
    assert first.endswith("robot.yaml: 2 faults")
    assert lines[0].startswith("  segments[1].length_m.value: ")
    assert lines[1].startswith("  servo.speed_rpm.value: ")
    assert len(lines) == 2  # and none of a list that were too short without its wrong items


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segments: [1, 2", r"not readable as YAML"),
        ("- a list", r"expected a mapping at the top, found list"),
        ("", r"expected a mapping at the top, found NoneType"),
    ],
)
def test_what_is_not_a_yaml_mapping_is_refused(tmp_path, text, message):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        muxjax.load_robot(path)


@pytest.mark.parametrize("name", ["mux_arm", "../robots/muxarm", "", "."])
def test_an_unknown_robot_is_refused_with_the_known_names(name):
    with pytest.raises(ConfigError, match=r"robots: no .* among the shipped files \(muxarm, penta"):
        muxjax.load_robot(name)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"nothing\.yaml: no such file"):
        muxjax.load_robot(tmp_path / "nothing.yaml")


def test_every_number_says_where_it_comes_from(raw):
    """Outside frames and identity, no bare number stands in a shipped robot."""

    def walk(tree: object, path: str) -> None:
        if isinstance(tree, dict) and {"source", "why"} <= tree.keys():
            assert {"value", "price_usd"} & tree.keys(), path
            assert tree["source"] in {"published", "derived", "assumed"}, path
            assert len(tree["why"]) > 5, path
        elif isinstance(tree, dict):
            for key, item in tree.items():
                if key not in {"base_frame", "tool_frame", "schema", "name"}:
                    walk(item, f"{path}.{key}")
        elif isinstance(tree, list):
            for item in tree:
                walk(item, path)
        else:
            pytest.fail(f"{path}: {tree!r} is not marked")

    walk(raw, "robot")


def test_axial_map_is_the_rule_of_the_model(robot):
    """MODEL.md section 4: servo s at axial a meets plug (a + S s) mod (S J)."""
    s_count, j_count = robot.n_segments, robot.tendons_per_segment
    for a, servo in itertools.product(range(s_count * j_count), range(j_count)):
        plug = (a + s_count * servo) % (s_count * j_count)
        layer, tendon = plug % s_count, plug // s_count
        assert robot.axial_map[a, servo] == j_count * layer + tendon


def test_axial_map_serves_every_tendon_and_keeps_to_one_layer(robot):
    j = robot.tendons_per_segment
    for servo in range(j):  # any single servo reaches all tendons
        assert sorted(robot.axial_map[:, servo]) == list(range(robot.n_tendons))
    assert (np.bincount(robot.axial_map.ravel()) == j).all()
    assert (np.ptp(robot.axial_map // j, axis=1) == 0).all()


def test_an_axial_map_of_ones_own_is_used(muxarm_raw, tmp_path):
    table = [[7, 8, 9], [4, 6, 5], [1, 2, 3]]
    put(muxarm_raw, "axial.map.value", table)
    np.testing.assert_array_equal(load(muxarm_raw, tmp_path).axial_map, np.array(table) - 1)


def test_fingerprint_follows_values_and_not_reasons(raw):
    def fingerprint() -> str:
        return RobotConfig.model_validate(raw).fingerprint

    original = fingerprint()
    put(raw, "servo.speed_rpm.why", "because")
    put(raw, "servo.speed_rpm.source", "published")
    assert fingerprint() == original
    put(raw, "servo.speed_rpm.value", 53)
    assert fingerprint() != original


def test_robots_compare_and_hash_by_their_values(raw):
    one, same = RobotConfig.model_validate(raw), RobotConfig.model_validate(raw)
    put(raw, "tendons.radius_m.value", 0.024)
    other = RobotConfig.model_validate(raw)
    assert one == same
    assert hash(one) == hash(same)
    assert one != other


def test_printed_routing_differs_only_through_proximal_segments(raw):
    parallel = robot_from_config(RobotConfig.model_validate(raw))
    put(raw, "tendons.routing.value", "printed")
    printed = robot_from_config(RobotConfig.model_validate(raw))
    s, j = parallel.n_segments, parallel.tendons_per_segment
    alpha = np.radians([item["tendon_offset_deg"]["value"] for item in raw["segments"]])
    for n, i, k in itertools.product(range(s), range(s), range(j)):
        own = 2 * np.pi * k / j
        assert parallel.tendon_azimuth[n, i, k] == pytest.approx(alpha[i] + own)
        assert printed.tendon_azimuth[n, i, k] == pytest.approx(alpha[n] + own)
    q = np.tile([0.7, 0.4], s)
    change = muxjax.tendon_displacements(printed, q) - muxjax.tendon_displacements(parallel, q)
    np.testing.assert_allclose(change[:j], 0, atol=1e-15)
    assert (np.abs(change[j:]) > 1e-4).all()


@pytest.mark.parametrize("routing", ["printed", "table"])
def test_only_parallel_tendons_need_azimuths_of_their_own(muxarm_raw, tmp_path, routing):
    put(muxarm_raw, "segments.1.tendon_offset_deg.value", 0)
    with pytest.raises(ConfigError, match="lie on each other"):
        load(muxarm_raw, tmp_path)
    put(muxarm_raw, "tendons.routing.value", routing)
    if routing == "table":
        table = [[[40.0 * i + 120 * j for j in range(3)] for i in range(3)] for _ in range(3)]
        put(muxarm_raw, "tendons.azimuth_deg", table)
    assert load(muxarm_raw, tmp_path).n_segments == 3


def test_an_azimuth_table_is_used_and_checked(muxarm_raw, tmp_path):
    put(muxarm_raw, "tendons.routing.value", "table")
    table = [[[10.0 * n + 40 * i + 120 * j for j in range(3)] for i in range(3)] for n in range(3)]
    put(muxarm_raw, "tendons.azimuth_deg", table)
    np.testing.assert_allclose(load(muxarm_raw, tmp_path).tendon_azimuth, np.radians(table))
    table[1][1][2] += 5
    with pytest.raises(ConfigError, match=r"azimuth_deg\[2\]\[2\]: .*tendon 3 is 5 degrees off"):
        load(muxarm_raw, tmp_path)
    put(muxarm_raw, "tendons.azimuth_deg", table[:2])
    with pytest.raises(ConfigError, match=r"azimuth_deg: must have shape 3 x 3 x 3"):
        load(muxarm_raw, tmp_path)


def test_frames_are_roll_pitch_yaw_about_fixed_axes(muxarm_raw, tmp_path):
    put(muxarm_raw, "base_frame", {"xyz_m": [1, 2, 3], "rpy_deg": [0, 0, 90]})
    put(muxarm_raw, "tool_frame", {"rpy_deg": [90, 0, 90]})
    robot = load(muxarm_raw, tmp_path)
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(robot.base, expected, atol=1e-15)
    # x -> x -> y; y -> z -> z: first roll, then yaw
    np.testing.assert_allclose(robot.tool[:3, :2], [[0, 0], [1, 0], [0, 1]], atol=1e-15)
