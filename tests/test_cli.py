"""The command line as a user meets it, in its own process once and in this one otherwise."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import get_args

import numpy as np
import pytest
from PIL import Image

from muxjax.cli import main, plans, runs
from muxjax.cli.plans import Method
from muxjax.hardware import Journal
from muxjax.planning import METHODS, PlanningError
from muxjax.program_file import load_program
from muxjax.workspace import load_sweep


@pytest.fixture
def muxjax(capsys, monkeypatch, tmp_path):
    """Run a command; returns exit code, standard output and standard error."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out, captured.err

    return call


def test_fk_prints_millimetres_and_json_metres(muxjax):
    code, out, _ = muxjax("fk", "60", "0", "75", "180", "40", "0")
    assert code == 0
    assert "152.25  0.00  413.78" in out
    assert "[mm]" in out
    code, out, _ = muxjax("fk", "60", "0", "75", "180", "40", "0", "--json")
    document = json.loads(out)
    assert document["position_m"] == pytest.approx([0.15225047, 0, 0.41377691], abs=1e-8)
    assert np.linalg.norm(document["quaternion_wxyz"]) == pytest.approx(1)


def test_ik_answers_with_its_exit_code(muxjax):
    pose = ("ik", "--xyz-mm", "152.25", "0", "413.777", "--rpy-deg", "0", "25", "0")
    code, out, _ = muxjax(*pose, "--json")
    assert code == 0
    assert json.loads(out)["converged"] is True
    code, out, _ = muxjax("ik", "--xyz-mm", "0", "100", "550")
    assert code == 1
    assert "NOT REACHED" in out
    code, out, _ = muxjax("ik", "--xyz-mm", "0", "100", "550", "--json")
    assert code == 1
    assert json.loads(out)["status"] == "out_of_reach"


def test_ik_lists_all_solutions_and_minds_a_world(muxjax):
    pose = ("ik", "--xyz-mm", "152.25", "0", "413.777", "--rpy-deg", "0", "25", "0")
    code, out, _ = muxjax(*pose, "--all", "--json")
    document = json.loads(out)
    assert code == 0
    assert document["complete"] is True
    given = np.radians([60, 0, 75, 180, 40, 0])
    assert any(np.allclose(q, given, atol=1e-4) for q in document["q"])
    assert len(document["q"]) > 1
    code, out, _ = muxjax(*pose, "--all")
    assert code == 0
    assert f"{len(document['q'])} solutions" in out
    code, out, _ = muxjax(*pose, "--world", "cabinet", "--json")
    document = json.loads(out)
    assert (code == 0) == (document["clearance_m"] > 0)
    code, _, err = muxjax(*pose, "--world", "moon")
    assert code == 2
    assert "no 'moon' among" in err


MATRIX = [
    "0.9063",
    "0",
    "0.4226",
    "0.15225",
    "0",
    "1",
    "0",
    "0",
    "-0.4226",
    "0",
    "0.9063",
    "0.413777",
]
MATRIX += ["0", "0", "0", "1"]


def test_ik_reads_poses_from_any_file(muxjax, tmp_path):
    named = {"x_mm": 152.25, "y_mm": 0, "z_mm": 413.777}
    turn = {"qw": 0.97629601, "qx": 0, "qy": 0.21643961, "qz": 0}
    angles = {"roll_deg": 0, "pitch_deg": 25, "yaw_deg": 0}
    metres = {"x_m": 0.15225, "y_m": 0.0, "z_m": 0.413777}
    pose = np.eye(4)
    pose[:3, 3] = list(metres.values())
    c, s = np.cos(np.radians(25)), np.sin(np.radians(25))
    pose[0, [0, 2]], pose[2, [0, 2]] = (c, s), (-s, c)
    files = {name: tmp_path / name for name in ("a.csv", "b.csv", "c.json", "d.json", "e.npy")}
    files |= {name: tmp_path / name for name in ("f.npy", "g.txt")}
    for name, row in (("a.csv", named | turn), ("b.csv", metres | angles)):
        lines = [",".join(row), *[",".join(map(str, row.values()))] * 2]
        files[name].write_text("\n".join(lines))
    files["c.json"].write_text(json.dumps([named | angles, {"matrix": pose.tolist()}]))
    files["d.json"].write_text(json.dumps({"poses": [pose.tolist()] * 2}))
    np.save(files["e.npy"], np.stack([pose, pose]))
    np.save(files["f.npy"], np.array([[*metres.values(), *turn.values()]] * 2))
    np.savetxt(files["g.txt"], pose)
    answers = []
    for name, path in files.items():
        code, out, err = muxjax("ik", "--poses", str(path), "--json")
        assert code == 0, (name, err)
        answers += [row["q"] for row in json.loads(out)]
    assert len(answers) == 13
    np.testing.assert_allclose(answers, [answers[0]] * 13, atol=1e-6)
    code, out, _ = muxjax("ik", "--poses", str(files["a.csv"]))
    assert code == 0
    assert "2 of 2 poses reached" in out
    assert out.count("converged") == 2


def test_ik_of_many_poses_fails_if_one_does(muxjax, tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("x_mm,y_mm,z_mm\n0,0,460\n0,100,550\n")
    code, out, _ = muxjax("ik", "--poses", str(path))
    assert code == 1
    assert "1 of 2 poses reached" in out
    assert "out_of_reach" in out


def test_ik_all_tells_which_solutions_are_clear(muxjax):
    pose = ("ik", "--xyz-mm", "152.25", "0", "413.777", "--rpy-deg", "0", "25", "0")
    code, out, _ = muxjax(*pose, "--all", "--world", "cabinet", "--json")
    document = json.loads(out)
    assert code == (0 if max(document["clearance_m"]) >= 0 else 1)
    assert len(document["clearance_m"]) == len(document["q"])
    code, out, _ = muxjax(*pose, "--world", "cabinet", "--prefer", "clearance", "--json")
    best = json.loads(out)
    assert best["clearance_m"] == pytest.approx(max(document["clearance_m"]), abs=1e-9)
    assert best["nearest_segment"] in (1, 2, 3)
    code, out, _ = muxjax(*pose, "--all", "--world", "cabinet")
    assert "of them clear" in out


def test_ik_goes_near_and_projects_on_request(muxjax):
    code, out, _ = muxjax("ik", "--matrix", *MATRIX, "--project-rotations", "--json")
    straightest = json.loads(out)["q"]
    near = ("--q0-deg", "60", "0", "75", "180", "40", "0")
    code, out, _ = muxjax("ik", "--matrix", *MATRIX, "--project-rotations", *near, "--json")
    assert code == 0
    q = np.degrees(json.loads(out)["q"])
    np.testing.assert_allclose(q[0::2], [60, 75, 40], atol=1)
    assert not np.allclose(np.radians(q), straightest, atol=0.1)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "x_mm,y_mm,z_mm\n1,2,3\n1,2,x\n", "pose 2: z_mm must be a number, found 'x'"),
        ("a.csv", "x_mm,y_mm,z_mm\n1,2\n", "pose 1: 2 values for 3 columns"),
        ("a.csv", "x_mm,y_mm\n1,2\n", "pose 1: z_mm is missing beside x_mm"),
        ("a.csv", "x,y,z\n1,2,3\n", "no column 'x'"),
        ("a.csv", "x_mm,y_mm,z_mm\n1,2,nan\n", "pose 1: x_mm, y_mm, z_mm must be finite"),
        ("a.csv", "x_mm,y_mm,z_mm\n", "needs a line of column names and a line a pose"),
        ("a.csv", "qw,qx,qy,qz\n1,0,0,0\n", "pose 1: needs one position"),
        ("a.csv", "x_m,y_m,z_m\n0,0,0.4\n0,0,400\n", "a.csv, pose 2: position must be within"),
        ("a.csv", "x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0.4,2,0,0,0\n", "quaternion has norm 2"),
        ("a.json", "[[1, 2]]", "pose 1: a matrix must be 16 numbers"),
        ("a.json", "{", "not readable as JSON"),
        ("a.json", "[]", "must be a list of poses"),
        ("a.txt", "1 2\n3 4\n", "must have shape (n, 4, 4) or (n, 7)"),
        ("a.xlsx", "", "must end in .csv, .json, .npy or .txt"),
    ],
)
def test_bad_pose_files_name_the_row(muxjax, tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    code, out, err = muxjax("ik", "--poses", str(tmp_path / name))
    assert code == 2
    assert out == ""
    assert message in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give one of --xyz-mm, --matrix and --poses"),
        (["--poses", "nothing.csv"], "nothing.csv: cannot be read"),
        (["--matrix", "1", "2"], "must be 16 numbers"),
        (["--matrix", *MATRIX], "pose: not a rotation"),
        (["--matrix", *MATRIX, "--quat", "1", "0", "0", "0"], "go with --xyz-mm"),
        (["--xyz-mm", "0", "0", "400", "--all", "--prefer", "bending"], "leave out --q0-deg"),
        (["--xyz-mm", "0", "0", "400", "--prefer", "clearance"], "'clearance' needs a world"),
        (["--xyz-mm", "0", "0", "400", "--q0-deg", "1"], "--q0-deg: muxarm has 3 segments; give 6"),
    ],
)
def test_bad_ik_arguments_are_errors_of_one_line(muxjax, arguments, message):
    code, out, err = muxjax("ik", *arguments)
    assert code == 2
    assert out == ""
    assert message in err
    assert len(err.strip().splitlines()) == 1


def test_plan_then_run(muxjax, tmp_path):
    path = str(tmp_path / "program.json")
    code, out, _ = muxjax(
        "plan", "--q-deg", "30", "0", "20", "90", "10", "180", "--servos", "1", "3", "--out", path
    )
    assert code == 0
    assert "optimal" in out
    code, out, _ = muxjax("run", path, "--json")
    document = json.loads(out)
    assert code == 0
    assert document["completed"] is True
    assert document["largest_error_m"] < 2e-5
    code, out, _ = muxjax("run", path)
    assert code == 0
    assert "completed" in out


def test_an_arm_that_has_moved_is_moved_again(muxjax, tmp_path):
    q = ("30", "0", "20", "90", "10", "180")
    there, back = (str(tmp_path / name) for name in ("there.json", "back.json"))
    muxjax("plan", "--q-deg", *q, "--servos", "1", "3", "--out", there)
    code, out, _ = muxjax("plan", "--q-deg", *"000000", "--after", there, "--out", back)
    assert code == 0
    assert "overshoot peak -  -  - %" in out  # relative to no bending
    first, second = load_program(there), load_program(back)
    assert second.start == first.target
    assert second.axial == first.instructions[-1].axial
    assert np.abs(second.target).max() < 1e-12
    code, out, _ = muxjax("run", back, "--json")
    assert code == 0
    assert json.loads(out)["largest_error_m"] < 2e-5
    code, out, _ = muxjax("run", "--q-deg", *"000000", "--after", there, "--json")
    assert code == 0
    assert json.loads(out)["largest_error_m"] < 2e-5
    code, out, _ = muxjax("plan", "--q-deg", *"000000", "--start-q-deg", *q, "--json")
    assert code == 0
    program = json.loads(out)["program"]
    assert program["start"] == pytest.approx(first.target, abs=1e-12)
    assert program["axial"] is None


@pytest.mark.parametrize(
    ("name", "goal"),
    [("plan_to_pose", ("--xyz-mm", "0", "0", "420")), ("plan_task", ("--poses", "fig9a"))],
)
def test_poses_are_planned_from_where_the_arm_stands(muxjax, tmp_path, monkeypatch, name, goal):
    there, asked = str(tmp_path / "there.json"), {}
    muxjax("plan", "--q-deg", "10", "0", "5", "90", "3", "180", "--out", there)
    first = load_program(there)

    def seen(*_, **fields):
        asked.update(fields)
        raise PlanningError("seen")

    monkeypatch.setattr(plans, name, seen)
    monkeypatch.setattr(runs, name, seen, raising=False)
    for command in ("plan", "run") if name == "plan_to_pose" else ("plan",):
        asked.clear()
        code, _, err = muxjax(command, *goal, "--after", there)
        assert code == 2
        assert "seen" in err
        assert tuple(asked["start"]) == first.target
        assert asked["axial"] == first.instructions[-1].axial


def test_a_start_is_given_once(muxjax, tmp_path):
    path, straight = str(tmp_path / "program.json"), tuple("000000")
    muxjax("plan", "--q-deg", "10", "0", "5", "90", "3", "180", "--out", path)
    both = ("--start-q-deg", *straight, "--after", path)
    code, _, err = muxjax("plan", "--q-deg", *straight, *both)
    assert code == 2
    assert "give only one" in err
    code, _, err = muxjax("run", path, "--after", path)
    assert code == 2
    assert "has its own start" in err
    code, _, err = muxjax("plan", "--q-deg", *straight, "--start-q-deg", "1", "2")
    assert code == 2
    assert "--start-q-deg: muxarm has 3 segments" in err
    code, _, err = muxjax("plan", "--q-deg", "0", "0", "--after", path, "--robot", "penta")
    assert code == 2
    assert "made for robot 'muxarm'" in err


def test_a_dry_run_opens_no_bus_and_leaves_journal_and_log(muxjax, tmp_path):
    path, journal, log = (str(tmp_path / name) for name in ("program.json", "j", "log"))
    muxjax("plan", "--q-deg", "10", "0", "5", "90", "3", "180", "--out", path)
    options = ("--dry-run", "--physics", "realistic", "--journal", journal, "--log", log)
    code, out, err = muxjax("run", path, "--bus", "{}", *options, "--json")
    assert code == 0
    document = json.loads(out)
    assert document["completed"] is True
    assert all(check["passed"] for check in document["preflight"])
    assert "robot" in err
    assert "instruction 1 of" in err
    with open(log) as frames:
        assert frames.readline().startswith("(0.000000) can0 020#")
    with Journal.open(journal) as kept:
        assert kept.standing.completed
    code, out, err = muxjax("run", path, "--log", log)
    assert (code, out) == (2, "")
    assert "give another name, or remove the file" in err


def test_new_plans_are_made_as_the_command_line_says(muxjax, tmp_path, monkeypatch):
    path = str(tmp_path / "program.json")
    muxjax("plan", "--q-deg", "10", "0", "5", "90", "3", "180", "--out", path)
    asked, carry_out = {}, runs.run_to_target

    def run_to_target(*args, **fields):
        asked.update(fields)
        return carry_out(*args, **fields)

    monkeypatch.setattr(runs, "run_to_target", run_to_target)
    options = ("--world", "cabinet", "--max-step-mm", "5", "--preset", "fastest")
    code, _, _ = muxjax("run", path, *options, "--json")
    assert code == 0
    assert asked["world"].name == "cabinet"
    assert (asked["max_step"], asked["preset"]) == (0.005, "fastest")
    assert "servos" not in asked


def test_a_bus_that_cannot_be_opened_comes_after_the_rehearsal(muxjax, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = str(tmp_path / "program.json")
    muxjax("plan", "--q-deg", "10", "0", "5", "90", "3", "180", "--out", path)
    code, out, err = muxjax("run", path, "--bus", '{"interface": "none such"}')
    assert code == 2
    assert out == ""
    rehearsed, refused = err.strip().splitlines()
    assert "rehearsed on the virtual board" in rehearsed
    assert "cannot be opened" in refused
    code, out, _ = muxjax("run", path, "--bus", '{"interface": "none such"}', "--no-rehearse")
    assert (code, out) == (2, "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fk", "60", "0"], "fk: muxarm has 3 segments; give 6 numbers"),
        (["fk", "nan", "0", "0", "0", "0", "0"], "segment 1, must be finite, found nan"),
        (["fk", "200", "0", "0", "0", "0", "0"], "bending of segment 1 is 200 degrees, limit 180"),
        (["fk", "1", "2", "--robot", "nobody"], "no 'nobody' among the shipped files"),
        (["ik", "--xyz-mm", "0", "0", "5000000"], "millimetres?"),
        (["plan"], "give either --xyz-mm"),
        (["plan", "--q-deg", "1", "1", "1", "1", "1", "1", "--servos", "7"], "servos 1 to 3"),
        (["ik", "--xyz-mm", "nan", "0", "0"], "position_m[1]: Input should be a finite number"),
        (["ik", "--xyz-mm", "0", "0", "300", "--quat", "2", "0", "0", "0"], "norm 2, must be 1"),
        (["plan", "--q-deg", "1", "1", "1", "1", "1", "1", "--preset", "x"], "no 'x' among"),
        (["plan", "--q-deg", "1", "1", "1", "1", "1", "1", "--max-step-mm", "inf"], "max_step"),
        (["run", "nothing.json"], "nothing.json: cannot be read"),
        (["resume", "nothing.journal", "--bus", "{}"], "nothing.journal: no such journal"),
        (["board", "--physics", "nothing"], "no 'nothing' among the shipped files"),
        (["board", "--port", "99999"], "port: 99999 on 127.0.0.1 cannot be served"),
        (["conformance", "--mapping", "m.yaml"], "--mapping is of the board on --bus"),
        (["conformance", "--bus", "nothing"], "no such section in python-can's configuration"),
        (["run", "nothing.json", "--mapping", "m.yaml"], "--mapping is of the board on --bus"),
        (["run", "nothing.json", "--world", "nothing"], "no 'nothing' among the shipped files"),
        (["demo", "--task", "nothing"], "no 'nothing' among the shipped files"),
        (["demo", "--robot", "penta"], "--task: 'fig9a' is for a robot of 3 segments"),
    ],
)
def test_bad_input_is_an_error_of_one_line(muxjax, arguments, message):
    code, out, err = muxjax(*arguments)
    assert code == 2
    assert out == ""
    assert message in err
    assert len(err.strip().splitlines()) == 1


def test_a_plan_to_a_pose_out_of_reach_exits_with_1(muxjax):
    code, out, err = muxjax("plan", "--xyz-mm", "0", "100", "550")
    assert code == 1
    assert out == ""
    assert "not reached (OUT_OF_REACH)" in err


def test_the_methods_of_the_command_line_are_the_planners():
    assert set(get_args(Method)) == set(METHODS)


@pytest.mark.slow
def test_a_refusing_planner_does_not_end_the_demo(muxjax, tmp_path):
    task = tmp_path / "task.yaml"
    task.write_text(
        "schema: muxjax/task/1\nname: one\ntargets:\n"
        "  - {name: bent, position_m: [0.02901, 0.157179, 0.404852],"
        " quaternion_wxyz: [0.97691724, 0.03292573, -0.07370458, 0.19777825]}\n"
    )
    command = ("demo", "--task", str(task), "--out", str(tmp_path), "--max-step-mm", "1")
    code, text, _ = muxjax(*command, "--methods", "exact", "sequential", "--json")
    outcomes = json.loads(text)
    assert code == 0
    assert all("GiB" in o["refusals"]["exact"] for o in outcomes)
    assert all(o["moves"]["sequential"]["completed"] for o in outcomes)


def test_sweep_writes_a_file_that_reads_back(muxjax, tmp_path):
    code, out, _ = muxjax("sweep", "--samples", "2e5", "--out", str(tmp_path), "--json")
    assert code == 0
    found = load_sweep(tmp_path / "sweep.npz")
    assert json.loads(out)["reach_radius_m"] == found.reach_radius
    for name in ("dexterity.png", "convergence.png", "cut.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    vary = ("sweep", "--vary", "segments[1].length_m=0.1,0.2", "--samples", "2e5", "--json")
    code, out, _ = muxjax(*vary, "--out", str(tmp_path))
    small, large = json.loads(out)
    assert code == 0
    assert small["reach_radius_m"] < large["reach_radius_m"]
    for wrong in ("segments[1].length_m", "segments[9].length_m=1", "tendons.radius_m=x"):
        code, _, err = muxjax("sweep", "--vary", wrong, "--out", str(tmp_path))
        assert code == 2
        assert wrong.split("=")[0][:8] in err


def test_a_program_of_another_robot_does_not_run(muxjax, tmp_path):
    path = str(tmp_path / "program.json")
    muxjax("plan", "--q-deg", "30", "0", "20", "90", "10", "180", "--out", path)
    code, _, err = muxjax("run", path, "--robot", "penta")
    assert code == 2
    assert "muxarm" in err


def test_demo_draws_what_it_did(muxjax, tmp_path):
    task = tmp_path / "task.yaml"
    task.write_text(
        "schema: muxjax/task/1\nname: two\ntargets:\n"
        "  - {name: bent, position_m: [0.02901, 0.157179, 0.404852],"
        " quaternion_wxyz: [0.97691724, 0.03292573, -0.07370458, 0.19777825]}\n"
        "  - {name: too far, position_m: [0, 0, 0.6], rpy_deg: [0, 0, 0]}\n"
    )
    out = tmp_path / "pictures"
    command = ("demo", "--task", str(task), "--out", str(out), "--methods", "exact", "greedy")
    code, text, _ = muxjax(*command)
    assert code == 0
    assert "too far: not reached" in text
    assert text.count("greedy") == 3
    for name in ("bent.png", "arm.gif"):
        with Image.open(out / name) as picture:
            assert len(picture.convert("RGB").getcolors(1 << 24)) > 50, f"{name} is blank"


def test_the_installed_command_starts():
    done = subprocess.run(
        [sys.executable, "-c", "from muxjax.cli import main; main()", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    for command in ("board", "demo", "fk", "ik", "plan", "resume", "run", "sweep"):
        assert command in done.stdout
