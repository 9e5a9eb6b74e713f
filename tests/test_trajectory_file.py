"""Exported trajectories: what the columns say is what the arm does."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import muxjax
from muxjax.cli import main
from muxjax.metrics.program import timeline
from muxjax.program_file import save_program
from muxjax.scheduler import Program, Trajectory
from muxjax.trajectory_file import columns, load_trajectory, sample, save_trajectory

Q = np.array([0.5, 1.0, 0.7, 2.0, 0.4, 3.0])


@pytest.fixture(scope="module")
def program() -> Program:
    robot = muxjax.load_robot("muxarm")
    target = muxjax.tendon_displacements(robot, Q)
    problem = muxjax.Problem(np.zeros(9), target, max_step=0.02)
    return muxjax.schedule(robot, muxjax.plan(robot, problem, "sequential"))


def test_samples_begin_and_end_with_the_program(muxarm, program):
    samples = sample(muxarm, timeline(muxarm, program), 20.0)
    metrics = muxjax.evaluate(muxarm, program)
    assert samples.time_s[0] == 0
    assert samples.time_s[-1] == pytest.approx(metrics.time_s, abs=1e-12)
    np.testing.assert_allclose(np.diff(samples.time_s)[:-1], 0.05, atol=1e-12)
    assert 0 < np.diff(samples.time_s)[-1] <= 0.05 + 1e-12
    np.testing.assert_allclose(samples.displacements[0], 0, atol=1e-15)
    np.testing.assert_allclose(samples.displacements[-1], program.target, atol=1e-5)
    np.testing.assert_allclose(samples.q[-1], Q, atol=1e-3)
    pose = muxjax.forward_kinematics(muxarm, samples.q[-1])
    np.testing.assert_allclose(samples.tool[-1], pose, atol=1e-12)


def test_no_tendon_moves_faster_than_its_servo(muxarm, program):
    """At any rate: samples are taken at their times, not at the program's corners."""
    samples = sample(muxarm, timeline(muxarm, program), 37.0)
    speed = np.abs(np.diff(samples.displacements, axis=0)) / np.diff(samples.time_s)[:, None]
    limit = float(muxarm.tendon_speed)
    assert 0.99 * limit < speed.max() < limit * (1 + 1e-9)


def test_an_end_on_the_grid_is_one_sample(muxarm):
    line = Trajectory(np.array([1.0, 1.3]), np.zeros((2, 9)))
    np.testing.assert_allclose(sample(muxarm, line, 10.0).time_s, [0, 0.1, 0.2, 0.3])
    still = Trajectory(np.array([0.0]), np.zeros((1, 9)))
    np.testing.assert_array_equal(sample(muxarm, still).time_s, [0.0])


def test_csv_and_npz_hold_the_same_numbers(muxarm, program, tmp_path):
    samples = sample(muxarm, timeline(muxarm, program), 10.0)
    save_trajectory(samples, tmp_path / "t.csv")
    save_trajectory(samples, tmp_path / "t.npz")
    table = np.genfromtxt(tmp_path / "t.csv", delimiter=",", names=True)
    with np.load(tmp_path / "t.npz", allow_pickle=False) as arrays:
        assert str(arrays["schema"]) == "muxjax/trajectory/1"
        assert str(arrays["fingerprint"]) == muxarm.fingerprint
        np.testing.assert_array_equal(table["time_s"], arrays["time_s"])
        for c in range(9):
            np.testing.assert_array_equal(
                table[f"tendon_{c + 1}_m"], arrays["displacements_m"][:, c]
            )
        for i in range(3):
            q = arrays["configuration_rad"]
            np.testing.assert_array_equal(table[f"theta_{i + 1}_rad"], q[:, 2 * i])
            np.testing.assert_array_equal(table[f"phi_{i + 1}_rad"], q[:, 2 * i + 1])
        position = np.stack([table[name] for name in ("x_m", "y_m", "z_m")], axis=-1)
        np.testing.assert_array_equal(position, arrays["tool_pose_m"][:, :3, 3])
        turn = np.stack([table[name] for name in ("qw", "qx", "qy", "qz")], axis=-1)
        np.testing.assert_allclose(
            Rotation.from_quat(turn, scalar_first=True).as_matrix(),
            arrays["tool_pose_m"][:, :3, :3],
            atol=1e-12,
        )
    assert len(table.dtype.names) == 1 + 9 + 6 + 7


def test_the_quaternion_does_not_jump(muxarm):
    """From 160 to 320 degrees about y in all: the canonical sign would change on the way."""
    ends = [
        muxjax.tendon_displacements(muxarm, np.radians([a, 0, a, 0, 0, 0])) for a in (60.0, 170.0)
    ]
    line = Trajectory(np.array([0.0, 1.0]), np.array(ends))
    named = columns(sample(muxarm, line, 100.0))
    turn = np.stack([named[name] for name in ("qw", "qx", "qy", "qz")], axis=-1)
    assert named["qw"][0] > 0 > named["qw"][-1]
    assert np.max(np.abs(np.diff(turn, axis=0))) < 0.05


def test_lengths_that_define_no_shape_are_nan_and_the_rest_goes_on(muxarm):
    points = np.zeros((3, 9))
    points[1, :3] = -0.2  # segment 1 is 0.169 m long
    named = columns(sample(muxarm, Trajectory(np.array([0.0, 1.0, 2.0]), points), 1.0))
    np.testing.assert_array_equal(np.isnan(named["theta_1_rad"]), [False, True, False])
    np.testing.assert_array_equal(np.isnan(named["qw"]), [False, True, False])
    np.testing.assert_array_equal(np.isnan(named["z_m"]), [False, True, False])
    np.testing.assert_array_equal(named["tendon_1_m"], [0, -0.2, 0])


@pytest.mark.parametrize("rate", [0.0, -1.0, np.nan, np.inf, 1e9])
def test_a_rate_that_cannot_serve_is_refused(muxarm, program, rate):
    with pytest.raises(ValueError, match=r"rate_hz: must be above 0 and give at most 1000000 "):
        sample(muxarm, timeline(muxarm, program), rate)


def test_another_ending_is_refused(muxarm, program, tmp_path):
    samples = sample(muxarm, timeline(muxarm, program), 1.0)
    with pytest.raises(muxjax.ConfigError, match=r"t\.txt: .* ends in \.csv or \.npz"):
        save_trajectory(samples, tmp_path / "t.txt")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_holds_no_trajectory_is_refused(muxarm, tmp_path):
    def npz(time_s, points) -> None:
        about = {"schema": "muxjax/trajectory/1", "robot": "", "fingerprint": muxarm.fingerprint}
        np.savez(tmp_path / "t.npz", **about, time_s=time_s, displacements_m=points)

    header = ",".join(["time_s", *(f"tendon_{c}_m" for c in range(1, 10))]) + "\n"
    for name, write in (
        ("t.npz", lambda: npz(0.0, np.zeros((1, 9)))),
        ("t.npz", lambda: npz(np.zeros((1, 1)), np.zeros((1, 9)))),
        ("t.npz", lambda: npz(np.zeros(2), np.zeros((2, 8)))),
        ("t.npz", lambda: npz(np.zeros(0), np.zeros((0, 9)))),
        ("t.npz", lambda: npz(np.array(["now"]), np.zeros((1, 9)))),
        ("t.npz", lambda: npz(np.array([1.0, 0.0]), np.zeros((2, 9)))),
        ("t.npz", lambda: (tmp_path / "t.npz").write_bytes(b"")),
        ("t.npz", lambda: np.save((tmp_path / "t.npz").open("wb"), np.zeros(3))),
        ("t.csv", lambda: (tmp_path / "t.csv").write_text(header + "0," + "1" * 200_000)),
        ("t.csv", lambda: (tmp_path / "t.csv").write_text(header + "0,1\n")),
        ("t.csv", lambda: (tmp_path / "t.csv").write_text(header + "0" + ",inf" * 9)),
        ("t.csv", lambda: (tmp_path / "t.csv").write_text(header)),
    ):
        write()
        with pytest.raises(muxjax.ConfigError, match=rf"t\{name[1:]}: "):
            load_trajectory(muxarm, tmp_path / name)


def test_the_command_writes_the_file(capsys, monkeypatch, tmp_path, program, muxarm):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    save_program(program, tmp_path / "program.json")

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(["export", str(tmp_path / "program.json"), *arguments])
        out, err = capsys.readouterr()
        return int(stop.value.code or 0), out, err

    code, out, _ = call("--out", str(tmp_path / "t.csv"), "--json")
    assert code == 0
    document = json.loads(out)
    header, *rows = (tmp_path / "t.csv").read_text().splitlines()
    assert header.split(",") == document["columns"]
    assert len(rows) == document["samples"]
    assert document["duration_s"] == pytest.approx(muxjax.evaluate(muxarm, program).time_s)
    code, out, _ = call("--out", str(tmp_path / "t.npz"), "--rate-hz", "5")
    assert code == 0
    assert "samples of" in out
    code, _, err = call("--out", str(tmp_path / "t.csv"), "--robot", "penta")
    assert code == 2
    assert "made for robot 'muxarm'" in err
