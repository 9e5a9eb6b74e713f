"""MCAP files and logs of runs: read back, they say what the arm and its drive did."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import muxjax
from muxjax.cli import main
from muxjax.config import ConfigError
from muxjax.hardware import LockstepLink
from muxjax.hardware.log import LoggedLink
from muxjax.hardware.protocol import BoardState, Fault, Frame, Port
from muxjax.metrics.program import timeline
from muxjax.program_file import save_program
from muxjax.recording import (
    logged_recording,
    program_recording,
    read_log,
    save_mcap,
    take,
)
from muxjax.recording.mcap import SCHEMA, SCHEMAS
from muxjax.scheduler import Program
from muxjax.trajectory_file import sample
from muxjax.urdf import urdf_joint_angles, urdf_joints
from muxjax.viz.recorded import track_of_run

Q = np.array([0.5, 1.0, 0.7, 2.0, 0.4, 3.0])


@pytest.fixture(scope="module")
def robot():
    return muxjax.load_robot("muxarm")


@pytest.fixture(scope="module")
def program(robot) -> Program:
    target = muxjax.tendon_displacements(robot, Q)
    problem = muxjax.Problem(np.zeros(9), target, max_step=0.015, servos=(1, 2))
    return muxjax.schedule(robot, muxjax.plan(robot, problem, "greedy"))


@pytest.fixture(scope="module")
def logged(robot, program, tmp_path_factory):
    """A run on the virtual board, and the file of its frames."""
    path = tmp_path_factory.mktemp("log") / "run.log"
    with closing(LoggedLink(LockstepLink(robot, stream_divider=4), path)) as link:
        run = muxjax.execute(program, link)
    assert run.completed
    return run, path


class Read:
    """Everything in an MCAP file, by topic."""

    def __init__(self, path: Path) -> None:
        from mcap.reader import make_reader

        self.messages: dict[str, list[tuple[int, dict]]] = {}
        self.schemas = {}
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for schema, channel, message in reader.iter_messages():
                assert channel.message_encoding == "json"
                assert schema.encoding == "jsonschema"
                self.schemas[channel.topic] = schema
                content = json.loads(message.data)
                stamp = content["timestamp"]
                assert stamp["sec"] * 10**9 + stamp["nsec"] == message.log_time
                self.messages.setdefault(channel.topic, []).append((message.log_time, content))
            self.attachments = {a.name: a.data for a in reader.iter_attachments()}
            self.metadata = {m.name: m.metadata for m in reader.iter_metadata()}

    def times(self, topic: str) -> np.ndarray:
        return 1e-9 * np.array([at for at, _ in self.messages[topic]], dtype=float)

    def of(self, topic: str, field: str) -> np.ndarray:
        return np.array([content[field] for _, content in self.messages[topic]])


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """Run muxjax export; exit code."""

    def call(*arguments: str) -> int:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
            with pytest.raises(SystemExit) as stop:
                main(["export", *arguments])
        return int(stop.value.code or 0)

    return call


@pytest.fixture(scope="module")
def both(robot, program, logged, command, tmp_path_factory):
    """MCAP and NPZ exports of the program and of the run, by the command."""
    folder = tmp_path_factory.mktemp("exports")
    save_program(program, folder / "program.json")
    found = {}
    for name, source in (("program", folder / "program.json"), ("run", logged[1])):
        for ending in ("mcap", "npz"):
            out = folder / f"{name}.{ending}"
            assert command(str(source), "--out", str(out), "--rate-hz", "20") == 0
        with np.load(folder / f"{name}.npz") as arrays:
            found[name] = Read(folder / f"{name}.mcap"), dict(arrays)
    return found


@pytest.mark.parametrize("name", ["program", "run"])
def test_topics_say_what_the_npz_says(robot, both, name):
    read, arrays = both[name]
    assert set(read.messages) == set(SCHEMAS)
    for topic in SCHEMAS:
        shift = read.times(topic) - arrays["time_s"]
        np.testing.assert_allclose(shift, shift[0], atol=2e-9)
    lengths = read.of("/wheels", "displacement_m")
    np.testing.assert_allclose(lengths, arrays["displacements_m"], atol=1e-15)
    turns = read.of("/wheels", "angle_rad")
    np.testing.assert_allclose(turns * float(robot.wheel_radius), lengths, atol=1e-15)
    q = arrays["configuration_rad"]
    np.testing.assert_array_equal(read.of("/bending", "theta_rad"), q[:, 0::2])
    np.testing.assert_array_equal(read.of("/bending", "phi_rad"), q[:, 1::2])
    poses = [content["pose"] for _, content in read.messages["/tool"]]
    place = np.array([[p["position"][a] for a in "xyz"] for p in poses])
    np.testing.assert_array_equal(place, arrays["tool_pose_m"][:, :3, 3])
    turn = np.array([[p["orientation"][a] for a in "xyzw"] for p in poses])
    np.testing.assert_allclose(
        Rotation.from_quat(turn).as_matrix(), arrays["tool_pose_m"][:, :3, :3], atol=1e-9
    )
    assert read.metadata["muxjax"]["schema"] == SCHEMA
    assert read.metadata["muxjax"]["fingerprint"] == robot.fingerprint
    assert read.metadata["muxjax"]["source"] == name


def test_joint_states_are_the_attached_urdfs_joints(robot, both):
    read, arrays = both["program"]
    tree = ET.fromstring(read.attachments["arm.urdf"])
    moving = [j.get("name") for j in tree.iter("joint") if j.get("type") == "revolute"]
    assert tuple(moving) == urdf_joints(robot, 6)
    expected = urdf_joint_angles(robot, arrays["configuration_rad"], 6)
    for row, (_, content) in zip(expected, read.messages["/joint_states"], strict=True):
        assert [joint["name"] for joint in content["joints"]] == moving
        np.testing.assert_allclose([j["position"] for j in content["joints"]], row, atol=1e-12)
    assert read.schemas["/joint_states"].name == "foxglove.JointStates"
    assert read.schemas["/tool"].name == "foxglove.PoseInFrame"


@pytest.mark.parametrize("name", ["program", "run"])
def test_the_drive_moves_what_it_is_coupled_to_and_nothing_else(robot, both, name):
    read, _ = both[name]
    lengths = read.of("/wheels", "displacement_m")
    engaged = read.of("/clutches", "engaged")
    axial, servo = read.of("/drum", "axial"), read.of("/servos", "angle_rad")
    moved = np.abs(np.diff(lengths, axis=0)) > 2 * np.pi * 0.025 / 2**14 * 1.5
    # Between two samples a clutch may have come in or gone out.
    assert not np.any(moved & ~(engaged[1:] | engaged[:-1]))
    assert moved.any(axis=0).sum() == 9
    checked = 0
    for k in np.flatnonzero(axial):
        reached = set(robot.axial_map[axial[k] - 1, :2])  # servos 1 and 2
        assert set(np.flatnonzero(engaged[k])) <= reached
    for k in range(len(axial) - 1):
        if axial[k] and axial[k] == axial[k + 1] and (engaged[k] == engaged[k + 1]).all():
            for s, c in enumerate(robot.axial_map[axial[k] - 1]):
                if engaged[k, c] and moved[k, c]:
                    turn = servo[k + 1, s] - servo[k, s]
                    way = (lengths[k + 1] - lengths[k])[c] * float(robot.servo_per_metre)
                    # Of a run: a count of the wheel, a tenth of a degree of the servo, and
                    # feedback that is up to 0.16 s old at a servo's speed.
                    slack = 1e-6 if name == "program" else 1.2
                    assert turn == pytest.approx(way, abs=slack)
                    checked += 1
    assert checked > 20
    assert not engaged[axial == 0].any()


def test_a_programs_servos_end_where_its_instructions_turn_them(robot, program):
    recording = program_recording(robot, program, 10.0)
    total = np.zeros(3)
    for item in program.instructions:
        for servo, angle in item.servo_angles.items():
            total[servo - 1] += angle
    np.testing.assert_allclose(recording.servo_rad[-1], total, rtol=1e-9)
    assert recording.servo_rad[-1, 2] == 0  # servo 3 is not available
    end = timeline(robot, program).time_s[-1]
    assert recording.samples.time_s[-1] == pytest.approx(end)


def test_a_program_without_instructions_stands_still(robot, program):
    still = Program(program.robot, program.fingerprint, (0.0,) * 9, (0.0,) * 9, 4, (1,), ())
    recording = program_recording(robot, still)
    assert recording.axial.tolist() == [4]
    assert not recording.engaged.any()
    np.testing.assert_array_equal(recording.servo_rad, np.zeros((1, 3)))


def test_a_visit_of_the_same_position_does_not_turn_the_drum(robot, program):
    first = program.instructions[0]
    twice = Program(
        program.robot, program.fingerprint, program.start, program.target, first.axial, (1, 2),
        (first, first),
    )  # fmt: skip
    assert set(program_recording(robot, twice).axial.tolist()) == {first.axial}


# -- logs of runs ---------------------------------------------------------------------------------


def test_the_log_ends_where_the_executor_measured(robot, logged):
    run, path = logged
    read = read_log(robot, path)
    np.testing.assert_array_equal(read.displacements[-1], run.measured)
    assert read.refused == 0
    assert np.all(np.diff(read.time_s) >= 0)
    # The true arm, from arming on; the log begins at the greeting.
    end = read.trajectory.time_s[-1]
    true = run.trajectory.at(np.linspace(0, run.duration_s, 50))
    seen = read.trajectory.at(np.linspace(end - run.duration_s, end, 50))
    # A count of a wheel, and feedback every 40 ms at the speed of a tendon.
    allowed = 1e-5 + 0.15 * float(robot.tendon_speed)
    assert np.max(np.abs(true - seen)) < allowed


def test_candumps_own_files_have_no_direction(robot, logged, tmp_path):
    _, path = logged
    plain = tmp_path / "plain.log"
    text = path.read_text().replace(" T\n", "\n").replace(" R\n", "\n")
    plain.write_text(text)
    ours, theirs = read_log(robot, path), read_log(robot, plain)
    np.testing.assert_array_equal(ours.displacements, theirs.displacements)
    assert theirs.refused == 0


def test_a_line_that_a_kill_cut_short_is_left_out(robot, logged, tmp_path):
    _, path = logged
    torn = tmp_path / "torn.log"
    torn.write_text(path.read_text() + "(9999.0) can0 05")
    assert read_log(robot, torn).time_s[-1] == read_log(robot, path).time_s[-1]


def test_a_log_of_another_robot_is_refused(logged):
    with pytest.raises(ConfigError, match="a program of another robot; this is 'penta'"):
        read_log(muxjax.load_robot("penta"), logged[1])


def test_times_of_a_bus_are_kept(robot, logged, tmp_path):
    _, path = logged
    later = tmp_path / "later.log"
    lines = [line.split(" ", 1) for line in path.read_text().splitlines()]
    later.write_text("".join(f"({float(at[1:-1]) + 1.7e9:.6f}) {rest}\n" for at, rest in lines))
    recording = logged_recording(robot, read_log(robot, later), 5.0)
    out = tmp_path / "later.mcap"
    save_mcap(robot, recording, out)
    times = Read(out).times("/wheels")
    first = read_log(robot, path).time_s[0]
    assert times[0] == pytest.approx(1.7e9 + first, abs=1e-5)
    assert recording.samples.time_s[0] == 0


def test_a_damaged_frame_is_left_out_and_counted(robot, logged, tmp_path):
    _, path = logged
    lines = path.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if " 058#" in line and k > 500)
    head, tail = lines[at].split("#")
    lines[at] = f"{head}#{'00' if tail[:2] != '00' else '01'}{tail[2:]}"
    broken = tmp_path / "broken.log"
    broken.write_text("\n".join(lines))
    assert read_log(robot, broken).refused == 1


def lines_of(port: Port, at_s: float, turns: int, lost: bool) -> str:
    """One report of everything by a board."""
    frames = [
        port.pack(
            "BOARD_HB", State=BoardState.READY, BootCount=1, LastSeq=0, Time=0,
            Faults=Fault.TURNS_LOST if lost else Fault(0),
        )
    ]  # fmt: skip
    frames += [port.pack(f"SERVO_FB_{s}", Group=0, Position=0, Status=0) for s in (1, 2, 3)]
    angles = {f"Angle{k}": 8192 for k in (1, 2, 3)} | {f"Status{k}": 0 for k in (1, 2, 3)}
    for _ in range(2):  # turns are anchored once the angle is known
        frames += [port.pack(f"WHEEL_FB_{k}", Group=0, **angles) for k in (1, 2, 3)]
        for group in (0, 1):
            six = {f"Turns{k}": turns for k in range(1, 7)}
            frames.append(port.pack("WHEEL_TURNS", Group=group, **six))
    return "".join(f"({at_s:.6f}) can0 {f.id:03X}#{f.data.hex().upper()} R\n" for f in frames)


def test_nothing_is_believed_while_turns_are_lost(robot, tmp_path):
    port, path = Port("BOARD"), tmp_path / "lost.log"
    lost, told = lines_of(port, 1.0, 0, True), lines_of(port, 2.0, 3, False)
    path.write_text(lost + told)
    run = read_log(robot, path)
    per_turn = 2 * np.pi * float(robot.wheel_radius)
    assert run.time_s.min() >= 2.0
    np.testing.assert_allclose(run.displacements, 3.5 * per_turn)
    path.write_text(told + told.replace("(2.0", "(2.1") + lost.replace("(1.0", "(3.0"))
    assert read_log(robot, path).time_s.max() < 3.0


def test_a_little_below_the_first_position_is_the_first_position(robot, tmp_path):
    port, path = Port("BOARD"), tmp_path / "drum.log"
    drum = port.pack("AXIAL_FB", InPosition=1, Moving=0, Position=359.99, Slot=1, Current=0)
    path.write_text(
        f"(0.5) can0 {drum.id:03X}#{drum.data.hex()} R\n" + lines_of(port, 1.0, 2, False)
    )
    run = read_log(robot, path)
    np.testing.assert_allclose(run.drum, -0.01 * 9 / 360, atol=1e-9)
    assert run.axial[0] == track_of_run(robot, run, "run").at(0.0).slot == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("(0.1) can0 050#00\nhello\n", r"line 2: is no line of candump -L.*muxjax run --log"),
        ("(0.1) can0 050#0\n", r"line 1: is no line of candump"),
        ("(0.2) can0 050#00\n(0.1) can0 050#00\n", r"line 2: time 0\.100000 s is before"),
        ("", r"at no moment has every wheel.*log of a run of this robot"),
    ],
)
def test_a_file_that_is_no_log_is_refused(robot, tmp_path, text, message):
    path = tmp_path / "bad.log"
    path.write_text(text)
    with pytest.raises(muxjax.ConfigError, match=message):
        read_log(robot, path)
    with pytest.raises(muxjax.ConfigError, match=r"none\.log: cannot be read"):
        read_log(robot, tmp_path / "none.log")


# -- files ----------------------------------------------------------------------------------------


def test_shapes_that_lengths_do_not_define_have_no_joint_states(robot, program, tmp_path):
    recording = program_recording(robot, program, 2.0)
    recording.samples.q[1] = np.nan
    recording.samples.tool[1] = np.nan
    recording.samples.q[2, 0] = 3.5  # beyond the limit of 180 degrees: shown, not refused
    count = save_mcap(robot, recording, tmp_path / "m.mcap")
    read, n = Read(tmp_path / "m.mcap"), len(recording.samples.time_s)
    assert len(read.messages["/joint_states"]) == len(read.messages["/tool"]) == n - 1
    assert len(read.messages["/wheels"]) == n
    assert count == sum(map(len, read.messages.values()))


def test_messages_have_the_fields_of_their_schemas(both):
    for read, _ in both.values():
        for topic, schema in read.schemas.items():
            stated = json.loads(schema.data)
            for _, content in read.messages[topic][:: max(1, len(read.messages[topic]) // 20)]:
                assert set(content) == set(stated["required"]) == set(stated["properties"])
                for field, kind in stated["properties"].items():
                    wanted = {"array": list, "object": dict, "integer": int, "string": str}
                    assert isinstance(content[field], wanted[kind["type"]])


def test_other_endings_and_chains_are_refused(robot, program, tmp_path):
    recording = program_recording(robot, program, 1.0)
    with pytest.raises(muxjax.ConfigError, match=r"m\.bag: an MCAP file ends in \.mcap"):
        save_mcap(robot, recording, tmp_path / "m.bag")
    with pytest.raises(ValueError, match=r"per_segment: must be a whole number"):
        save_mcap(robot, recording, tmp_path / "m.mcap", per_segment=1)
    assert list(tmp_path.iterdir()) == []


def test_take_holds_the_last_word():
    said, at = np.array([1, 2, 3, 4]), np.array([0.0, 1.0, 1.0, 2.0])
    times = np.array([-1.0, 0.0, 0.5, 1.0, 1.5, 2.0, 9.0])
    assert take(said, at, times).tolist() == [1, 1, 1, 3, 3, 4, 4]


def test_the_command_says_what_to_do(capsys, command, logged, tmp_path):
    assert command(str(logged[1]), "--out", str(tmp_path / "run.json")) == 2
    assert "a run is no program" in capsys.readouterr().err
    assert command(str(logged[1]), "--out", str(tmp_path / "run.bag")) == 2
    assert "must end in one of .csv, .npz, .mcap, .json" in capsys.readouterr().err
    out = tmp_path / "run.csv"
    assert command(str(logged[1]), "--out", str(out), "--json") == 0
    assert json.loads(capsys.readouterr().out)["samples"] == len(out.read_text().splitlines()) - 1


def test_a_frame_is_eight_bytes(robot, tmp_path):
    """A log with a frame of another length is read; the frame is refused as on the bus."""
    port, path = Port("BOARD"), tmp_path / "short.log"
    path.write_text("(0.5) can0 058#0011 R\n" + lines_of(port, 1.0, 2, False))
    assert read_log(robot, path).refused == 1


def test_the_npz_of_a_run_is_its_trajectory_at_the_same_times(robot, logged, both):
    _, arrays = both["run"]
    samples = sample(robot, read_log(robot, logged[1]).trajectory, 20.0)
    np.testing.assert_array_equal(samples.displacements, arrays["displacements_m"])


def test_a_log_grows_only_while_its_times_do(robot, tmp_path):
    path, link = tmp_path / "run.log", LockstepLink(robot)
    hello = [Frame(0x20, bytes(8))]
    for _ in range(2):  # one clock that goes on
        with closing(LoggedLink(link, path)) as logged:
            logged.wait(link.now + 0.02)
            logged.send(hello)
    kept = path.read_bytes()
    assert kept.count(b" T\n") == 2
    for begin_s in (0.0, 1.7e9):  # the virtual clock anew, then a real one after it
        with pytest.raises(ValueError, match=r"run\.log exists and ends at 0\.04.*another name"):
            LoggedLink(LockstepLink(robot), path, begin_s)
    assert path.read_bytes() == kept
    real = tmp_path / "real.log"
    for begin_s in (1.7e9, 1.8e9):  # since 1970
        with closing(LoggedLink(LockstepLink(robot), real, begin_s)) as logged:
            logged.send(hello)
    assert real.read_bytes().count(b" T\n") == 2
    with pytest.raises(ValueError, match=r"real\.log exists and ends at 1800000000\.0"):
        LoggedLink(LockstepLink(robot), real)


def test_a_log_goes_on_behind_its_last_whole_line(robot, tmp_path):
    path = tmp_path / "run.log"
    whole = "(1800000000.000000) can0 050#00 R\n"
    path.write_text(whole + "(1800000001.0000")
    with closing(LoggedLink(LockstepLink(robot), path, begin_s=1.8e9 + 2)):
        assert path.read_text() == whole
