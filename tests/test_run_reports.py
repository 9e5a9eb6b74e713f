"""What ``muxjax run`` and ``muxjax resume`` say of a run on a bus, and their exit codes."""

from __future__ import annotations

import json
import re

import pytest
from test_executor import program, visit

from muxjax.cli import main, runs
from muxjax.cli.progress import Reporter
from muxjax.hardware import Journal, LockstepLink
from muxjax.hardware.executor import begin
from muxjax.program_file import load_program, save_program
from muxjax.robot import load_robot

OPTIONS = ("--bus", "a wire", "--journal")


@pytest.fixture
def bench(muxarm, monkeypatch, tmp_path, capsys):
    """A virtual board in place of the one on the bus, a program, and a way to run commands."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    link = LockstepLink(muxarm, stream_divider=5)

    def on_bus(bus, arm, divider, translation, log, go):
        with Reporter() as tell:
            return runs.go_logged(link, log, 0.0, lambda logged: go(logged, tell))

    monkeypatch.setattr(runs, "on_bus", on_bus)
    legs = [visit(muxarm, a, [{1: 0.004}]) for a in (1, 2, 3)]
    save_program(program(muxarm, legs), "program.json")

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        return int(stop.value.code or 0), *capsys.readouterr()

    return link, call


@pytest.fixture
def ctrl_c(monkeypatch):
    """Ctrl-C while the second instruction moves, once."""
    show, pressed = Reporter.__call__, []

    def press(self, progress):
        show(self, progress)
        if progress.instruction == 2 and progress.phase.startswith("leg") and not pressed:
            pressed.append(True)
            raise KeyboardInterrupt

    monkeypatch.setattr(Reporter, "__call__", press)


def first_column(out: str) -> list[str]:
    return [line.split("│")[1].strip() for line in out.splitlines() if line.startswith("│")]


def test_ctrl_c_then_resume_on_the_latched_board_then_after_its_power_up(bench, ctrl_c):
    link, call = bench
    code, out, _ = call("run", "program.json", *OPTIONS, "arm.journal", "--no-rehearse")
    assert code == 130
    assert "stopped from the keyboard: " in out
    assert first_column(out) == ["1"]
    advice = "switch it off and on (end and restart muxjax board); then muxjax resume arm.journal"
    assert advice in out

    code, out, _ = call("resume", "arm.journal", "--bus", "a wire")
    assert code == 1
    assert "HELLO rejected by the board: ESTOPPED: the board did not arm\n" in out
    assert advice in out
    assert "nan" not in out
    assert first_column(out) == []

    code, out, _ = call("resume", "arm.journal", "--bus", "a wire", "--json")
    assert code == 1
    assert json.loads(out)["estopped"] is True

    link.board.power_cycle()
    code, out, err = call("resume", "arm.journal", "--bus", "a wire")
    assert code == 0
    assert "completed: " in out
    assert "instruction 2 of 3" in err
    assert first_column(out) == ["2", "3"]
    assert "muxjax resume" not in out

    code, out, err = call("resume", "arm.journal", "--bus", "a wire")
    assert code == 0
    assert "none needed" in err
    assert out.startswith("completed: nothing was left to do, wheels within 0.0")


def test_ctrl_c_with_json_is_130_as_well(bench, ctrl_c):
    _, call = bench
    code, out, _ = call("run", "program.json", *OPTIONS, "arm.journal", "--no-rehearse", "--json")
    assert code == 130
    document = json.loads(out)
    assert document["estopped"] is True
    assert [item["number"] for item in document["instructions"]] == [1]


def test_ctrl_c_in_the_rehearsal_is_130_and_opens_no_bus(bench, monkeypatch):
    _, call = bench
    opened, waits = [], LockstepLink.wait
    monkeypatch.setattr(runs, "on_bus", lambda *_: opened.append(True))

    def wait(self, until):
        if self.now > 5.0 and not self.board.pressed:
            self.board.pressed = True
            raise KeyboardInterrupt
        return waits(self, until)

    monkeypatch.setattr("muxjax.hardware.virtual_board.VirtualBoard.pressed", False, raising=False)
    monkeypatch.setattr(LockstepLink, "wait", wait)
    code, out, err = call("run", "program.json", *OPTIONS, "arm.journal")
    assert (code, out, opened) == (130, "", [])
    assert "interrupted" in err


def test_a_journal_and_a_program_are_told_apart(bench):
    _, call = bench
    with Journal.open("arm.journal") as journal:
        begin(load_robot("muxarm"), load_program("program.json"), journal)
    for arguments, message in (
        (("resume", "program.json", "--bus", "a wire"), r"this is a program, which muxjax run"),
        (("run", "program.json", *OPTIONS, "program.json"), r"line 1: not that of a journal"),
        (("run", "arm.journal"), r"arm\.journal: is a journal; muxjax resume goes on with it"),
        (("export", "arm.journal", "--out", "a.csv"), r"is the journal.*muxjax run --log"),
    ):
        code, out, err = call(*arguments)
        assert (code, out) == (2, "")
        assert re.search(message, err.strip().splitlines()[-1])
