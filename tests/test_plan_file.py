"""Plan files: the same plan back, or a refusal that names the field."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

import muxjax
from muxjax.cli import main
from muxjax.metrics import program_cost
from muxjax.plan_file import load_plan, save_plan
from muxjax.program_file import load_program


@pytest.fixture(scope="module")
def plan() -> muxjax.Plan:
    robot = muxjax.load_robot("muxarm")
    target = muxjax.tendon_displacements(robot, [0.5, 1.0, 0.7, 2.0, 0.4, 3.0])
    problem = muxjax.Problem(np.zeros(9), target, servos=(1, 3), max_step=0.01, axial=2)
    return muxjax.plan(robot, problem, "greedy")


def test_a_plan_survives_the_file(plan, muxarm, tmp_path):
    save_plan(plan, tmp_path / "plan.json")
    found = load_plan(tmp_path / "plan.json")
    np.testing.assert_array_equal(found.displacements, plan.displacements)
    np.testing.assert_array_equal(found.axial, plan.axial)
    for name in ("cost", "lower_bound", "gap", "status", "method", "action_set", "fingerprint"):
        assert getattr(found, name) == getattr(plan, name)
    assert dict(found.problem.cost_weights) == dict(plan.problem.cost_weights)
    program = muxjax.schedule(muxarm, found)
    assert program == muxjax.schedule(muxarm, plan)
    # Nor does the problem's objective change: weights are in the file, whatever preset they had.
    assert program_cost(muxarm, found.problem, program) == pytest.approx(plan.cost, rel=1e-9)


def test_a_plan_of_no_steps_survives_too(muxarm, tmp_path):
    still = muxjax.plan(muxarm, muxjax.Problem(np.zeros(9), np.zeros(9)), "greedy")
    save_plan(still, tmp_path / "plan.json")
    found = load_plan(tmp_path / "plan.json")
    assert found.n_steps == 0
    assert muxjax.schedule(muxarm, found).instructions == ()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("schema",), "muxjax/plan/9", r"schema: .*muxjax/plan/1.*found 'muxjax/plan/9'"),
        (("colour",), "red", r"colour: .*not permitted"),
        (("cost",), -1, r"cost: .*equal to 0, found -1"),
        (("status",), "failed", r"status: .*'optimal' or 'feasible'"),
        (("axial", 0), 0, r"axial\[1\]: .*equal to 1, found 0"),
        (("axial",), [1], r"axial: must name a position for each of \d+ steps, found 1"),
        (("displacements_m", 0), [0.0], r"displacements_m\[1\]: must have 9 tendons, found 1"),
        (("problem", "start_m"), [0.0], r"problem\.start_m: must have 9 tendons, found 1"),
        (("problem", "start_m"), [0.1] * 9, r"0\.1 m off the problem's start, tolerance 1e-05"),
        (("displacements_m", -1, 4), 0.5, r"off the problem's target, tolerance 1e-05"),
        (("problem", "action_set"), "any", r"action_set: must be one of subsets, .*found 'any'"),
        (("problem", "weights"), {"beauty": 1}, r"weights: no term 'beauty' among"),
        (("problem", "servos"), [1, 1], r"servos: servo 1 is named twice"),
    ],
)
def test_a_wrong_file_is_refused_by_field(plan, tmp_path, path, value, message):
    file = tmp_path / "plan.json"
    save_plan(plan, file)
    document = json.loads(file.read_text())
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    file.write_text(json.dumps(document))
    with pytest.raises(muxjax.ConfigError, match=message) as caught:
        load_plan(file)
    assert str(file) in str(caught.value)


def test_a_torn_or_missing_file_is_refused(plan, tmp_path):
    path = tmp_path / "plan.json"
    save_plan(plan, path)
    path.write_text(path.read_text()[:200])
    with pytest.raises(muxjax.ConfigError, match=r"plan\.json: .*JSON"):
        load_plan(path)
    with pytest.raises(muxjax.ConfigError, match="cannot be read"):
        load_plan(tmp_path / "nothing.json")


def test_a_plan_that_a_robot_cannot_do_is_refused_by_schedule(plan, muxarm, tmp_path):
    file = tmp_path / "plan.json"
    save_plan(plan, file)
    document = json.loads(file.read_text())
    document["axial"] = [a % 9 + 1 for a in document["axial"]]
    file.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=r"plan: step 1 moves tendon .* do not reach"):
        muxjax.schedule(muxarm, load_plan(file))
    with pytest.raises(ValueError, match=r"plan: made for robot"):
        muxjax.schedule(muxjax.load_robot("penta"), plan)


def test_what_no_file_holds_is_refused(plan, tmp_path):
    problem = plan.problem
    own = dataclasses.replace(
        problem, weights={"travel": 1.0, "mine": 1.0}, terms={"mine": lambda robot, t: t.wait}
    )
    among = dataclasses.replace(problem, world=muxjax.load_world("cabinet"))
    for other, what in ((own, r"own terms \['mine'\]"), (among, "a world")):
        with pytest.raises(ValueError, match=rf"plan: its problem has {what}.*save its program"):
            save_plan(dataclasses.replace(plan, problem=other), tmp_path / "plan.json")
    failed = dataclasses.replace(plan, status="failed", reason="for this test")
    with pytest.raises(ValueError, match=r"plan: greedy found none \(for this test\)"):
        save_plan(failed, tmp_path / "plan.json")
    assert list(tmp_path.iterdir()) == []


def test_commands_write_a_plan_and_make_a_program_of_it(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def call(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        return int(stop.value.code or 0), capsys.readouterr().err

    steps, once, twice = (str(tmp_path / n) for n in ("plan.json", "once.json", "twice.json"))
    to = ("plan", "--q-deg", "30", "0", "20", "90", "10", "180", "--method", "sequential")
    assert call(*to, "--save-plan", steps, "--out", once) == (0, "")
    assert call("export", steps, "--out", twice) == (0, "")
    assert load_program(twice) == load_program(once)
    assert call("export", steps, "--out", str(tmp_path / "t.csv"))[0] == 0
    assert (tmp_path / "t.csv").read_text().startswith("time_s,")
    document = json.loads((tmp_path / "plan.json").read_text())
    (tmp_path / "plan.json").write_text(json.dumps(document | {"schema": "muxjax/plan/9"}))
    code, err = call("export", steps, "--out", twice)
    assert code == 2
    assert "muxjax/plan/1" in err
    code, err = call("plan", "--poses", "fig9a", "--save-plan", steps)
    assert code == 2
    assert "--save-plan" in err
