"""Figures: what is drawn is what the model says, and every axis has its unit."""

from __future__ import annotations

import csv
import importlib
import io
import json
import pkgutil
import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import muxjax
from muxjax.cli import main
from muxjax.cli.figure import Case as CaseName
from muxjax.config import load_yaml, resolve
from muxjax.hardware.accuracy import (
    CASES,
    Case,
    Trial,
    nearest,
    pose_errors,
    random_targets,
    run_trial,
)
from muxjax.metrics.case_study import PANELS, Panel, case_study
from muxjax.metrics.program import evaluate, timeline
from muxjax.metrics.protocol import Protocol
from muxjax.metrics.report import cell
from muxjax.metrics.statistics import Spread
from muxjax.metrics.table2 import Row
from muxjax.metrics.table2 import Table as Comparison
from muxjax.metrics.tables import (
    TextTable,
    as_csv,
    as_latex,
    as_markdown,
    table1,
    table2,
    table3,
)
from muxjax.planning.motion import angles_at

pytest.importorskip("matplotlib")

from matplotlib.backends.backend_agg import FigureCanvasAgg

from muxjax.viz.accuracy import sample_point, trials_figure, workspace_figure
from muxjax.viz.programs import programs_figure
from muxjax.viz.statics import mountings_figure
from muxjax.viz.style import check_ending, save_figure, save_small
from muxjax.viz.tables import save_table, table_figure
from muxjax.viz.training import curves_figure, load_curve
from muxjax.workspace import sweep

UNIT = re.compile(r"\[[^\]]+\]\s*$|\[[^\]]+\]\s*;")


def axes_without_units(figure) -> list[str]:
    """Labels, of axes that show ticks, that end in no unit.

    Axes that share their scale with a neighbour show its ticks, and no label, by intent.
    """
    wrong = []
    for axes in figure.axes:
        if not axes.axison:
            continue
        names = "xyz" if hasattr(axes, "get_zlabel") else "xy"
        for name in names:
            label = getattr(axes, f"get_{name}label")()
            hidden = not getattr(axes, f"{name}axis").get_tick_params().get("labelleft", True)
            shown = [t for t in getattr(axes, f"get_{name}ticklabels")() if t.get_text()]
            if not UNIT.search(label) and shown and not hidden and not _shares(axes, name):
                wrong.append(f"{name} of {axes.get_title()!r}: {label!r}")
    return wrong


def _shares(axes, name: str) -> bool:
    """Whether the ticks are those of a neighbour that has the label."""
    group = getattr(axes, f"get_shared_{name}_axes")().get_siblings(axes)
    return any(UNIT.search(getattr(one, f"get_{name}label")()) for one in group if one is not axes)


def drawn(figure):
    """The figure, laid out, so that ticks and colour bars have their labels."""
    FigureCanvasAgg(figure).draw()
    return figure


@pytest.fixture(scope="module")
def robot():
    return muxjax.load_robot("muxarm")


@pytest.fixture(scope="module")
def programs(robot):
    target = muxjax.tendon_displacements(robot, np.array([0.5, 1.0, 0.7, 2.0, 0.4, 3.0]))
    problem = muxjax.Problem(np.zeros(9), target, max_step=0.018)
    return {
        name: muxjax.schedule(robot, muxjax.plan(robot, problem, name))
        for name in ("sequential", "greedy")
    }


# -- Fig. 6 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, -1])  # panels share scales: the largest may come last
def test_lengths_and_angles_drawn_are_the_programs(robot, programs, order):
    chosen = dict([*programs.items()][::order])
    figure = drawn(programs_figure(robot, chosen, "title", letters="abc"))
    _, *panels = figure.axes
    assert len(panels) == 4
    for number, program in enumerate(chosen.values()):
        lengths, angles = panels[2 * number : 2 * number + 2]
        line = timeline(robot, program)
        assert len(lengths.lines) == robot.n_tendons
        for c, artist in enumerate(lengths.lines):
            np.testing.assert_allclose(artist.get_xdata(), line.time_s)
            np.testing.assert_allclose(artist.get_ydata(), 1e3 * line.displacements[:, c])
        curves = angles.lines[::2]
        assert len(curves) == robot.n_segments
        for i, artist in enumerate(curves):
            times, theta = artist.get_data()
            expected = np.degrees(angles_at(robot, line.at(times))[:, i])
            np.testing.assert_allclose(theta, expected, atol=1e-6)
            final = angles.lines[2 * i + 1].get_ydata()
            np.testing.assert_allclose(final, theta[-1])
        for axes in (lengths, angles):
            (left, low), (right, high) = axes.viewLim.get_points()
            for artist in axes.lines:
                x, y = artist.get_data()
                assert low <= np.min(y)  # nothing is cut off
                assert np.max(y) <= high
                assert left <= np.min(x)
                assert np.max(x) <= right
    assert axes_without_units(figure) == []


def test_a_greys_reader_tells_every_line_apart(robot, programs):
    """Marker by segment and style by tendon: no two lines of a panel have both in common."""
    figure = programs_figure(robot, programs, "title")
    lengths, angles = figure.axes[1:3]
    looks = [(a.get_linestyle(), a.get_marker()) for a in lengths.lines]
    assert len(set(looks)) == robot.n_tendons
    assert len({a.get_marker() for a in angles.lines[::2]}) == robot.n_segments


def test_the_case_study_has_the_papers_panels_with_the_protocols_settings(robot):
    rules = load_yaml(Protocol, resolve("table2", "bench"))
    assert {setting for _, setting, _ in PANELS} <= {s.name for s in rules.settings}
    servos = [n for _, setting, n in PANELS if setting == rules.beamstep]
    assert sorted(servos) == [1, 2, 3]  # Fig. 6 (b), (c) and (g)
    baselines = {setting for _, setting, n in PANELS if n == 1}
    assert set(rules.names("theirs")) <= baselines  # (d) to (f) beside (g)


# -- Fig. 7 and 8c --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trial(robot, programs) -> Trial:
    program = programs["sequential"]
    return run_trial(robot, program, len(program.instructions), CASES["open loop, slip alone"], 3)


def test_slip_of_half_a_millimetre_moves_the_tool_by_millimetres(robot, programs, trial):
    """The sensitivity is that of the arm: without slip the same run is a hundred times closer."""
    program = programs["sequential"]
    position, angle = trial.errors()
    assert trial.at_target == len(trial.time_s) - 1
    assert 3e-4 < position[-1, -1] < 2e-2
    exact = run_trial(robot, program, len(program.instructions), Case("ideal", 0, 0, True), 3)
    at_end, turned = (errors[-1, -1] for errors in exact.errors())
    assert at_end < 5e-5 < position[-1, -1] / 5
    assert turned < 1e-3 < angle[-1, -1]
    assert np.all(np.diff(trial.time_s) >= 0)


def test_targets_are_within_the_robots_limits():
    penta = muxjax.load_robot("penta")  # whose last segment bends less than the others
    theta = muxjax.configuration_from_tendons(penta, random_targets(penta, 200))[:, 0::2]
    assert np.all(theta <= penta.theta_max + 1e-9)
    assert np.all(theta.min(axis=0) < 0.3)
    assert np.all(theta.max(axis=0) > 1.5)


def test_pose_errors_are_a_metric():
    rng = np.random.default_rng(2)
    turns = rng.uniform(0.1, 3.0, 8)
    axes = rng.normal(size=(8, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    base = np.tile(np.eye(4), (8, 1, 1))
    base[:, :3, :3] = Rotation.random(8, rng=rng).as_matrix()
    moved = base.copy()
    moved[:, :3, :3] = base[:, :3, :3] @ Rotation.from_rotvec(turns[:, None] * axes).as_matrix()
    moved[:, :3, 3] = 0.01 * axes
    position, angle = pose_errors(moved, base)
    np.testing.assert_allclose(position, 0.01)
    np.testing.assert_allclose(angle, turns, rtol=1e-9)
    for back, there in zip(pose_errors(base, moved), (position, angle), strict=True):
        np.testing.assert_allclose(back, there, rtol=1e-9)


def test_nearest_points_lie_on_the_path():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    points = np.array([[0.5, 0.3], [1.4, 0.5], [-1.0, -1.0], [2.0, 2.0]])
    expected = [[0.5, 0.0], [1.0, 0.5], [0.0, 0.0], [1.0, 1.0]]
    np.testing.assert_allclose(nearest(path, points), expected)


def test_the_tools_way_is_what_the_trial_says(trial):
    figure = drawn(trials_figure({2: trial}, "a case"))
    by_label = {axes.get_ylabel(): axes for axes in figure.axes[1:]}
    assert len(by_label) == 6
    tool = 1e3 * trial.poses[:, -1, :3, 3]
    for k, name in enumerate("xyz"):
        there = by_label[f"{name} [mm]"].lines[0]
        np.testing.assert_allclose(there.get_ydata(), tool[:, k], atol=1e-9)
        np.testing.assert_allclose(there.get_xdata(), trial.time_s)
    distance = next(axes for label, axes in by_label.items() if "distance" in label)
    np.testing.assert_allclose(distance.lines[0].get_ydata(), 1e3 * trial.errors()[0][:, -1])
    assert axes_without_units(figure) == []


def test_sample_points_are_means_over_their_runs(trial):
    point = sample_point("S", [trial, trial])
    assert point.time_s == trial.time_s[-1]
    assert point.position == pytest.approx(trial.errors()[0][-1, -1])
    assert point.orientation == pytest.approx(trial.errors()[1][-1, -1])
    np.testing.assert_allclose(point.tool, trial.planned[-1, -1, :3, 3])


@pytest.mark.slow
def test_sample_points_stand_on_the_map_where_their_tool_is(robot, trial):
    found = sweep(robot, samples=20_000)
    point = sample_point("S", [trial])
    figure = drawn(workspace_figure(found, [point], "about"))
    plane = figure.axes[0]
    spot = next(line for line in plane.lines if line.get_marker() == "o")
    np.testing.assert_allclose([spot.get_xdata()[0], spot.get_ydata()[0]], 1e3 * point.tool[[0, 2]])
    bars = {axes.get_xlabel().replace("\n", " "): axes for axes in figure.axes[2:]}
    widths = {label: axes.patches[0].get_width() for label, axes in bars.items()}
    assert widths == {
        "time to reach [s]": pytest.approx(point.time_s),
        "position error [mm]": pytest.approx(1e3 * point.position),
        "orientation error [deg]": pytest.approx(np.degrees(point.orientation)),
    }
    assert len({axes.patches[0].get_hatch() for axes in bars.values()}) == 3
    assert axes_without_units(figure) == []


def test_the_commands_cases_are_the_experiments():
    assert set(get_args(CaseName)) == set(CASES)


# -- tables ---------------------------------------------------------------------------------------


def test_table_1_ends_with_what_the_model_says(robot):
    table = table1(robot)
    *_, published, model = table.rows
    assert published[0] == "MuxArm"
    assert published[-1] == "yes"
    # The claim of fault tolerance is a property of the drum's map, checked here by hand.
    reached = {s: {int(c) for c in robot.axial_map[:, s - 1]} for s in (1, 2, 3)}
    assert all(tendons == set(range(9)) for tendons in reached.values())
    assert model[-1] == "3 of 3 servos reach all"
    assert "4 motors, 9 tendons" in model


def test_table_3_adds_up(robot):
    table = table3(robot)
    *parts, total, single = table.rows
    assert sum(float(row[-1]) for row in parts) == pytest.approx(541.85, abs=1e-9)
    assert float(total[-1]) == 541.85
    assert float(single[-1]) == pytest.approx(9 * 482.89)
    assert "87.5 %" in table.notes[0]


def fake_comparison(rules: Protocol, servos: tuple[int, ...]) -> Comparison:
    """Rows that name themselves by their numbers: T is 100 servos + the place of the setting."""
    zero = Spread(0.0, 0.0)
    rows = [
        Row(
            servos=n,
            setting=setting.name,
            time_s=Spread(100.0 * n + k, 1.0),
            stages=Spread(9.0, 0.0),
            overshoot_duration=tuple(Spread(float(i), 0.0) for i in range(3)),
            overshoot_peak=tuple(Spread(10.0 + i, 0.0) for i in range(3)),
            tip_deviation_mm=zero,
            over_least_time=zero,
            none_at_all=0.0,
            certified=0.0,
            cpu_s=zero,
            dominated_by=[],
        )
        for n in servos
        for k, setting in enumerate(rules.settings)
    ]
    return Comparison(15, 0, rows, [], [], [])


def test_table_2_puts_each_rerun_beside_its_published_column():
    rules = load_yaml(Protocol, resolve("table2", "bench"))
    table = table2(rules, fake_comparison(rules, (1, 2, 3)))
    assert len(table.rows) == 3 * 8
    first = table.rows[0]
    assert first[:2] == ("1", "T [s]")
    assert first[2:10:2] == tuple(f"{100 + k:.1f} (1.0)" for k in range(4))
    assert first[3:10:2] == ("114.6 (41.8)", "114.6 (35.8)", "114.6 (35.8)", "141.6 (48.0)")
    greedy = table.header.index("Greedy,\npublished")
    assert table.header[greedy - 1].startswith("greedy")
    assert table.rows[1][greedy] == cell((17.0, 4.5), less=1.0) == "16.0 (4.5)"
    names = [setting.name for setting in rules.settings]
    assert first[-2] == f"{100 + names.index('exact, least overshoot'):.1f} (1.0)"


def test_every_form_of_a_table_has_every_cell(robot, tmp_path):
    table = table3(robot)
    rows = list(csv.reader(io.StringIO(as_csv(table))))
    assert [tuple(row) for row in rows] == [table.header, *table.rows]
    lines = [line for line in as_markdown(table).splitlines() if line.startswith("|")]
    assert [tuple(x.strip() for x in line[1:-1].split("|")) for line in lines[2:]] == [*table.rows]
    tex = as_latex(table)
    assert tex.count(r"\\") == 1 + len(table.rows)
    assert r"87.5 \% less" in tex
    texts = [text.get_text() for text in drawn(table_figure(table)).texts]
    for row in table.rows:
        assert set(row) <= {*texts, ""}
    for ending in ("tex", "md", "csv", "svg"):
        assert save_table(table, tmp_path / f"t.{ending}").stat().st_size > 500


def test_text_of_a_typeset_table_stays_inside_and_does_not_overlap(robot):
    figure = drawn(table_figure(table1(robot)))
    boxes = [t.get_window_extent() for t in figure.texts if t.get_text()]
    width, height = figure.canvas.get_width_height()
    for k, one in enumerate(boxes):
        assert one.x0 >= 0
        assert one.y0 >= 0
        assert one.x1 <= width
        assert one.y1 <= height
        for other in boxes[k + 1 :]:
            overlap = (
                min(one.x1, other.x1) - max(one.x0, other.x0),
                min(one.y1, other.y1) - max(one.y0, other.y0),
            )
            assert min(overlap) <= 1.0, overlap


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match=r"rows: 2 cells each"):
        TextTable("t", ("a", "b"), (("1",),))


# -- statics and training -------------------------------------------------------------------------


def test_postures_drawn_are_the_equilibria():
    from muxjax.statics import forward_statics, load_chain

    chain = load_chain("hyper_redundant")
    lengths = np.array([-4e-3, 0, 4e-3, 0, -6e-3, 0, 6e-3, 0])
    found = {"hanging": forward_statics(chain, displacements=lengths, gravity=[0, 0, 9.81])}
    figure = drawn(mountings_figure(chain, found, {"hanging": [0, 0, 9.81]}))
    (arrow,) = (text for text in figure.axes[0].texts if text.get_text() == "")
    np.testing.assert_allclose(np.array(arrow.xy) - arrow.get_position(), [0, 0.18], atol=1e-9)
    assert figure.axes[0].get_title().startswith("hanging\nconstant curvature is ")
    shape, bars = figure.axes
    lines = {line.get_label(): line.get_xydata() for line in shape.lines}
    tip = 1e3 * np.asarray(found["hanging"].pose)[[0, 2], 3]
    np.testing.assert_allclose(lines["statics"][-1], tip, atol=1e-3)
    np.testing.assert_allclose(lines["straight"][0], 0, atol=1e-9)
    heights = sorted(bar.get_height() for bar in bars.patches)
    np.testing.assert_allclose(heights, np.sort(found["hanging"].tension))
    assert len({bar.get_hatch() for bar in bars.patches}) == 2  # a hatch a segment
    assert axes_without_units(figure) == []


def test_learning_curves_are_those_of_the_files(tmp_path):
    lines = [
        {"steps": 1e6 * k, "solved": 1 - 0.5 / k, "median_gap": 0.1 / k, "lower_quartile": 0.05 / k,
         "upper_quartile": 0.2 / k} for k in (1, 2, 4)
    ]  # fmt: skip
    for name in ("arm_0", "arm_1", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "curve.json").write_text(json.dumps(lines))
    runs = {name: load_curve(tmp_path / name) for name in ("arm_0", "arm_1", "other")}
    figure = drawn(curves_figure(runs))
    gap, unsolved = figure.axes
    np.testing.assert_allclose(gap.lines[0].get_data(), [[1, 2, 4], [10, 5, 2.5]])
    np.testing.assert_allclose(unsolved.lines[2].get_data(), [[1, 2, 4], [50, 25, 12.5]])
    looks = [(a.get_color(), a.get_linestyle(), a.get_marker()) for a in gap.lines]
    assert looks[0] == looks[1] != looks[2]  # seeds of one training look alike
    assert looks[0][2] != looks[2][2]
    assert [t.get_text() for t in gap.get_legend().texts] == ["arm", "other"]
    assert axes_without_units(figure) == []


@pytest.mark.parametrize("text", ["", "[]", '[{"steps": 1}]', '{"steps": 1}', "[3]"])
def test_a_folder_that_is_no_training_is_refused(tmp_path, text):
    if text:
        (tmp_path / "curve.json").write_text(text)
    with pytest.raises(muxjax.ConfigError, match=r"no training of a policy.*training\.train_rl"):
        load_curve(tmp_path)


# -- files and the command ------------------------------------------------------------------------


def test_no_module_of_figures_is_hidden_by_a_function():
    for module in pkgutil.iter_modules(muxjax.viz.__path__):
        found = importlib.import_module(f"muxjax.viz.{module.name}")
        assert getattr(muxjax.viz, module.name) is found


def test_the_unit_check_can_fail(robot, programs):
    figure = programs_figure(robot, programs, "title")
    figure.axes[1].set_ylabel("displacement")
    assert len(axes_without_units(drawn(figure))) == 1


@pytest.mark.parametrize(
    ("ending", "begin"), [("pdf", b"%PDF"), ("svg", b"<?xml"), ("png", b"\x89PNG")]
)
def test_the_ending_chooses_the_format_and_the_file_is_the_same_again(
    tmp_path, robot, ending, begin
):
    files = [
        save_figure(table_figure(table3(robot)), tmp_path / f"{k}.{ending}").read_bytes()
        for k in (1, 2)
    ]
    assert files[0].startswith(begin)
    assert files[0] == files[1]
    if ending == "svg":
        assert b"RX8U50HM" in files[0]  # text stays text


def test_another_ending_is_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"f\.jpg: the ending must be one of \.pdf, \.svg, \.png"):
        check_ending(tmp_path / "f.jpg")
    with pytest.raises(ValueError, match=r"must be one of \.pdf, \.svg, \.png, \.tex"):
        save_table(TextTable("t", ("a",), (("1",),)), tmp_path / "f.xls")
    assert list(tmp_path.iterdir()) == []


def test_a_small_picture_is_small(tmp_path, robot, programs):
    from PIL import Image

    figure = programs_figure(robot, programs, "title")
    path = save_small(figure, tmp_path / "small.png", width=800)
    assert path.stat().st_size < 150_000
    assert Image.open(path).width == 800


@pytest.fixture
def figure_command(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(["figure", *arguments])
        return int(stop.value.code or 0), *capsys.readouterr()

    return call


def test_the_command_draws_and_says_the_numbers(figure_command, tmp_path, robot):
    out = tmp_path / "new" / "table3.svg"
    code, text, _ = figure_command("table3", "--out", str(out), "--json")
    document = json.loads(text)
    assert code == 0
    assert document["file"] == str(out)
    assert ["", "total", "", "541.85"] in document["rows"]
    assert b"541.85" in out.read_bytes()
    code, text, _ = figure_command("training", "--out", str(tmp_path / "t.pdf"))
    assert code == 0
    assert re.search(r"one_servo +\d\.\d\d +0\.\d\d +0\.00", text)


def test_a_wrong_request_is_refused_before_any_work(figure_command, tmp_path, monkeypatch):
    monkeypatch.setattr("muxjax.cli.drawing.draw_fig6", lambda *_: pytest.fail("began to work"))
    for arguments, message in (
        (("fig6", "--out", "a.jpg"), r"a\.jpg: the ending must be one of"),
        (("fig6", "--target", "0"), r"--target: counts from 1, found 0"),
        (("table1", "--out", "a.docx"), r"\.tex, \.md, \.csv"),
        (("fig7", "--trials", "0"), r"--trials: must be at least 1"),
        (("fig8c", "--samples", "1.5"), r"--samples: must be a whole number"),
        (("fig8c", "--robot", "penta"), r"muxjax sweep draws the dexterity of any arm"),
        (("gallery", "--only", "fig9"), r"--only: must be of fig6, .*found 'fig9'"),
    ):
        code, _, error = figure_command(*arguments)
        assert code == 2
        assert re.search(message, error), error


def test_the_gallery_is_small_pictures_named_by_their_commands(figure_command, tmp_path):
    out = tmp_path / "images"
    code, text, _ = figure_command(
        "gallery", "--only", "table1", "table3", "--out", str(out), "--json"
    )
    assert code == 0
    files = json.loads(text)
    assert [row["file"] for row in files] == [
        str(out / "gallery_table1.png"),
        str(out / "gallery_table3.png"),
    ]
    assert all(row["bytes"] < 150_000 for row in files)


@pytest.mark.slow
def test_figure_6_on_the_default_target(figure_command, tmp_path, robot):
    """BeamStep with one servo does not overshoot where the scans do; fewer servos take longer."""
    code, text, _ = figure_command("fig6", "--out", str(tmp_path / "f.pdf"), "--json")
    assert code == 0
    panels = {p["name"]: p for p in json.loads(text)["panels"]}
    assert max(panels["BeamStep, 1 servo"]["overshoot_peak"]) < 1e-9
    assert max(panels["tendons 9 to 1, 1 servo"]["overshoot_peak"]) > 0.1
    times = [panels[f"BeamStep, {n}"]["time_s"] for n in ("1 servo", "2 servos", "3 servos")]
    assert times[0] > times[1] > times[2]


def test_panels_state_what_their_program_takes(robot, programs):
    metrics = evaluate(robot, programs["greedy"])
    panel = Panel("greedy", "greedy", 3, programs["greedy"], metrics)
    figure = programs_figure(robot, {panel.name: panel.program}, "t", letters="ab")
    title = figure.axes[1].get_title()
    assert title == f"(b) greedy\n{metrics.time_s:.1f} s, {metrics.stages} stages"


def test_the_case_study_of_another_robot_says_its_limit_and_names_its_tendons(figure_command):
    path = Path(__file__).resolve().parent.parent / "docs" / "tutorials" / "my_arm.yaml"
    code, _, error = figure_command("fig6", "--robot", str(path), "--out", "six.png")
    assert code == 2
    assert "by up to 91.7 degrees, a segment of 'my_arm' bends by at most 90.0" in error
    assert "--q-deg" in error
    arm = muxjax.load_robot(path)
    goal = np.asarray(muxjax.tendon_displacements(arm, np.radians([30.0, 0.0, 20.0, 90.0])))
    rules = load_yaml(Protocol, resolve("table2", "bench"))
    names = {panel.name for panel in case_study(arm, rules, goal)}
    assert {"tendons 1 to 6, 1 servo", "tendons 6 to 1, 1 servo"} <= names


def test_nine_panels_leave_one_place_blank_and_a_long_legend_has_two_even_rows(robot, programs):
    program = next(iter(programs.values()))
    figure = programs_figure(robot, {str(k): program for k in range(9)}, "t")
    assert figure.axes[-1].get_subplotspec().get_gridspec().get_geometry() == (4, 5)
    arm = muxjax.load_robot("penta")
    goal = muxjax.tendon_displacements(arm, np.radians([30.0, 0.0] * 5))
    plan = muxjax.plan(arm, muxjax.Problem(np.zeros(20), goal), "sequential")
    long = programs_figure(arm, {"one": muxjax.schedule(arm, plan)}, "t")
    words = [text.get_text() for text in long.legends[0].get_texts()]
    assert words[0::2] == [f"segment {i}" for i in range(1, 6)]
    assert words[1::2] == [*(f"tendon {j} of the segment" for j in range(1, 5)), "motion"]


def test_the_page_shows_every_picture_of_the_gallery_and_they_are_small():
    docs = Path(__file__).resolve().parent.parent / "docs"
    shown = re.findall(
        r"!\[[^\]]+\]\(images/(gallery_\w+\.png)\)", (docs / "figures.md").read_text()
    )
    there = sorted(path.name for path in (docs / "images").glob("gallery_*.png"))
    assert sorted(shown) == there
    assert len(there) == 8
    assert all((docs / "images" / name).stat().st_size < 150_000 for name in there)
