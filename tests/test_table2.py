"""The comparison of Table II: its protocol, statistics, resumption and what it writes."""

from __future__ import annotations

import json

import numpy as np
import pytest

import muxjax
from muxjax.config import load_yaml, resolve
from muxjax.metrics.protocol import Protocol
from muxjax.metrics.report import cell, csv_text, markdown
from muxjax.metrics.statistics import dominated_by, median_interval, paired_difference, spread
from muxjax.metrics.table2 import run_table, summarise


def shipped() -> Protocol:
    return load_yaml(Protocol, resolve("table2", "bench"))


@pytest.fixture(scope="module")
def small() -> Protocol:
    """Full moves and few settings: quick, and with the same laws."""
    kept = ("greedy", "tendons 1 to 9", "BeamStep, as printed", "exact, fastest first")
    text = shipped().model_dump(mode="json", by_alias=True)
    text["settings"] = [s for s in text["settings"] if s["name"] in kept]
    text["max_step_mm"]["value"] = 200
    text["servo_sets"] = [[1], [1, 2]]
    return Protocol.model_validate(text)


@pytest.fixture(scope="module")
def records(muxarm, small):
    return run_table(muxarm, small, targets=4, seed=3)


def test_greedy_needs_about_16_moves_at_the_protocols_step(muxarm):
    rules = shipped()
    moves = []
    for number in range(1, 201):
        residual = np.abs(rules.target(muxarm, 0, number))
        moves.append(np.ceil((residual - 1e-5) / (rules.max_step_mm.value / 1e3)).clip(0).sum())
    assert np.median(moves) == 16
    assert np.median(moves[:15]) == 16


def test_the_published_cells_are_those_of_the_paper():
    """Transcribed a second time, from the bold statements of the text: spot checks by column."""
    by = {(c.name.split(",")[0], c.servos): c for c in shipped().published}
    assert len(by) == 12
    assert by["BeamStep", 2].time_s == (96.2, 23.1)
    assert [by[n, 2].time_s[0] for n in ("Reversed", "Sequential", "Greedy")] == [81.3, 79.8, 74.2]
    assert by["Reversed", 2].printed_stages == (8.0, 1.0)
    assert by["Greedy", 3].overshoot_peak[2] == (21.8, 44.4)
    assert by["Sequential", 1].overshoot_duration[2] == (70.2, 28.0)
    for column in by.values():
        assert column.overshoot_duration[0] == column.overshoot_peak[0] == (0.0, 0.0)


def test_targets_are_drawn_as_the_protocol_says(muxarm):
    rules = shipped()
    q = muxjax.configuration_from_tendons(
        muxarm, np.array([rules.target(muxarm, 0, n) for n in range(1, 101)])
    )
    theta = q[:, 0::2]
    assert theta.min() > 0.2 - 1e-9
    assert theta.max() < 1.6 + 1e-9
    assert np.mean(theta) == pytest.approx(0.9, abs=0.1)
    assert (rules.target(muxarm, 0, 1) != rules.target(muxarm, 1, 1)).all()
    assert (rules.target(muxarm, 0, 1) != rules.target(muxarm, 0, 2)).all()


def test_records_are_the_programs_metrics(muxarm, small, records):
    goal = small.target(muxarm, 3, 2)
    setting = next(s for s in small.settings if s.name == "greedy")
    problem = small.problem(goal, (1, 2), setting)
    program = muxjax.schedule(muxarm, muxjax.plan(muxarm, problem, "greedy"))
    metrics = muxjax.evaluate(muxarm, program)
    record = next(r for r in records[1] if r.servos == 2 and r.setting == "greedy")
    assert record.time_s == metrics.time_s
    assert record.stages == metrics.stages
    assert record.overshoot_peak == pytest.approx([100 * x for x in metrics.overshoot_peak])
    assert record.time_s >= record.least_time_s


def test_an_interrupted_run_goes_on_to_the_same_end(muxarm, small, records, tmp_path):
    kept = tmp_path / "targets.jsonl"
    run_table(muxarm, small, targets=2, seed=3, kept=kept)
    with kept.open("a") as file:
        file.write('{"key": "torn')  # killed while writing
    done: list[int] = []
    whole = run_table(
        muxarm, small, targets=4, seed=3, kept=kept, progress=lambda n, _: done.append(n)
    )
    assert done == [3, 4]
    again = run_table(muxarm, small, targets=4, seed=3, kept=kept, progress=lambda n, _: 1 / 0)
    for got in (whole, again):
        table, first = summarise(small, got, 3), summarise(small, records, 3)
        assert [r.point for r in table.rows] == [r.point for r in first.rows]
        assert table.differences == first.differences
    assert len(kept.read_text().splitlines()) == 4
    with pytest.raises(ValueError, match="line 1 is of another protocol, robot or seed"):
        run_table(muxarm, small, targets=4, seed=4, kept=kept)


def test_summary_agrees_with_the_records(small, records):
    table = summarise(small, records, 3)
    rows = {(r.servos, r.setting): r for r in table.rows}
    assert set(rows) == {(n, s.name) for n in (1, 2) for s in small.settings}
    times = [
        next(r.time_s for r in of_target if (r.servos, r.setting) == (2, "greedy"))
        for of_target in records
    ]
    assert rows[2, "greedy"].time_s.median == pytest.approx(np.median(times))
    fastest = rows[1, "exact, fastest first"]
    assert fastest.dominated_by == []
    assert fastest.certified == 100
    assert fastest.over_least_time.median == pytest.approx(0, abs=1e-9)  # one servo: the bound
    for difference in table.differences:
        assert difference.time_s.median <= 1e-9, difference.theirs
    for step in table.speed_ups:
        assert 1 < step.factor.median < 2


def test_reports_hold_every_setting_and_note(small, records):
    table = summarise(small, records, 3)
    text = markdown(small, table)
    for wanted in (*(s.name for s in small.settings), *small.notes, "Greedy, published"):
        assert wanted in text
    assert "| Reversed, published | 81.3 (20.8) |  | 7.0 (1.0) |" in text  # printed 8.0
    assert cell((-1e-15, 0.04)) == "0.0 (0.0)"
    lines = csv_text(table).splitlines()
    assert len(lines) == 1 + len(table.rows)
    assert len({line.count(",") - line.count(", ") for line in lines}) == 1


def test_the_plot_is_not_blank(small, records, tmp_path):
    from muxjax.metrics import plots

    written = plots.pareto(small, summarise(small, records, 3), tmp_path / "pareto.pdf")
    assert [p.suffix for p in written] == [".pdf", ".svg", ".png"]
    assert all(p.stat().st_size > 5_000 for p in written)
    assert (
        "greedy" in (tmp_path / "pareto.svg").read_text()
        or "path" in (tmp_path / "pareto.svg").read_text()
    )


def test_spread_is_median_and_interquartile_range():
    assert spread([1.0, 2.0, 3.0, 4.0, 100.0]) == (3, 2)
    with pytest.raises(ValueError, match="entry 1 is not finite"):
        spread([1.0, np.nan])
    with pytest.raises(ValueError, match="row of numbers"):
        spread([])


def test_paired_interval_sees_what_an_unpaired_one_would_not(rng):
    hard = rng.normal(100, 30, 40)
    found = paired_difference(hard - 1.0 + rng.normal(0, 0.1, 40), hard)
    assert found.low < found.median < found.high < -0.8
    with pytest.raises(ValueError, match="3 targets against 2"):
        paired_difference([1.0, 2.0, 3.0], [1.0, 2.0])


def test_bootstrap_covers_the_true_median():
    rng = np.random.default_rng(7)
    inside = 0
    for _ in range(200):
        found = median_interval(rng.normal(5.0, 2.0, 25))
        inside += found.low <= 5.0 <= found.high
    assert 180 <= inside <= 199  # nominally 190


def test_dominance():
    points = {"a": (1.0, 1.0), "b": (1.0, 2.0), "c": (0.0, 5.0), "twin": (1.0, 1.0)}
    assert dominated_by("a", points) == []
    assert dominated_by("b", points) == ["a", "twin"]
    assert dominated_by("c", points) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"greedy": "nobody"}, "greedy: no setting is named 'nobody'"),
        ({"servo_sets": []}, "servo_sets"),
        (
            {"settings": [{"name": "a", "method": "magic", "preset": "paper", "whose": "ours"}]},
            "a: method must be one of .* found 'magic'",
        ),
        (
            {"settings": [{"name": "a", "method": "exact", "whose": "ours"}]},
            "a: give either preset or weights",
        ),
        ({"theta_rad": {"value": [2, 1], "source": "assumed", "why": "test"}}, "2 to 1 is empty"),
    ],
)
def test_a_wrong_protocol_is_refused_by_field(changes, message):
    text = shipped().model_dump(mode="json", by_alias=True) | changes
    with pytest.raises(ValueError, match=message):
        Protocol.model_validate(text)


def test_targets_beyond_the_robot_or_too_few(muxarm, small):
    with pytest.raises(ValueError, match="targets: must be at least 2, found 1"):
        run_table(muxarm, small, targets=1)
    wide = small.model_dump(mode="json", by_alias=True)
    wide["theta_rad"]["value"] = [0.2, 3.0]
    with pytest.raises(ValueError, match=r"by up to 171\.9 degrees, .* at most 140\.0"):
        Protocol.model_validate(wide).target(muxarm, 0, 1)


def test_the_command_prints_and_writes(capsys, monkeypatch, tmp_path, small):
    from muxjax.cli.bench import bench

    rules = tmp_path / "small.yaml"
    rules.write_text(small.model_dump_json(by_alias=True, exclude_none=True))
    out = tmp_path / "out"
    assert bench("table2", targets=2, protocol=str(rules), out=out) == 0
    printed = capsys.readouterr().out
    assert "greedy" in printed
    assert "Table II counts one stage more" in printed.replace("\n", " ")
    names = {p.name for p in out.iterdir()}
    assert names >= {"table2.json", "table2.md", "table2.csv", "pareto.png", "targets.jsonl"}
    assert json.loads((out / "table2.json").read_text())["targets"] == 2
    assert bench("table2", targets=2, protocol=str(rules), out=out, json=True) == 0
    assert json.loads(capsys.readouterr().out)["rows"]
