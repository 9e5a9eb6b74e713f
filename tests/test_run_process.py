"""``muxjax run`` and ``muxjax board`` as processes, in real time, killed as a system kills."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_executor import program, visit

from muxjax.program_file import save_program
from muxjax.robot import load_robot

pytestmark = pytest.mark.slow
MUXJAX = [sys.executable, "-c", "from muxjax.cli import main; main()"]


class Lab:
    """A folder with a program, and a board that serves it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        values = load_robot("muxarm").config.model_dump(mode="json", by_alias=True)
        values["axial"]["switch_time_s"]["value"] = 0.5
        self.robot_file = folder / "quick.yaml"
        self.robot_file.write_text(yaml.safe_dump(values))
        robot = load_robot(self.robot_file)
        self.program = program(
            robot, [visit(robot, 1, [{1: 0.004, 2: -0.002}]), visit(robot, 2, [{1: 0.001}])]
        )
        save_program(self.program, folder / "program.json")
        self.arm, self.journal, self.log = folder / "arm", folder / "journal", folder / "log"
        self.board = self.start(
            "board", "--port", "0", "--robot", str(self.robot_file), "--arm", str(self.arm)
        )
        assert self.board.stdout is not None
        self.bus = self.board.stdout.readline().partition(" on ")[2].strip()

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*MUXJAX, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def run(self) -> subprocess.Popen[str]:
        """A run that has started its first leg."""
        options = ("--robot", str(self.robot_file), "--bus", self.bus, "--no-rehearse", "--json")
        files = ("--journal", str(self.journal), "--log", str(self.log))
        running = self.start("run", str(self.folder / "program.json"), *options, *files)
        end = time.monotonic() + 60
        while not (self.journal.is_file() and '"kind":"leg"' in self.journal.read_text()):
            assert running.poll() is None
            assert time.monotonic() < end
            time.sleep(0.01)
        time.sleep(0.5)
        return running

    def resume(self) -> dict[str, object]:
        options = ("--robot", str(self.robot_file), "--bus", self.bus, "--json")
        done = self.start("resume", str(self.journal), *options)
        out, err = done.communicate(timeout=90)
        return json.loads(out[out.index("{\n") :]) if out else {"error": err}

    def truth(self) -> np.ndarray:
        time.sleep(0.2)
        return np.array(json.loads(self.arm.read_text())["displacements_m"])


@pytest.fixture
def lab(tmp_path):
    pytest.importorskip("can")
    made = Lab(tmp_path)
    yield made
    made.board.terminate()
    assert made.board.wait(10) == 0


def test_kill_9_leaves_a_log_and_a_journal_and_resume_arrives(lab):
    can = pytest.importorskip("can")
    running = lab.run()
    running.send_signal(signal.SIGKILL)
    running.wait(10)
    stopped = lab.truth()
    assert 0.0005 < stopped[0] < 0.0035
    with can.CanutilsLogReader(lab.log) as reader:
        messages = list(reader)
    assert {0x20, 0x21, 0x30, 0x31, 0x50, 0x58} <= {m.arbitration_id for m in messages}
    assert messages[-1].timestamp - messages[0].timestamp > 0.5
    done = lab.resume()
    assert done.get("completed") is True, done
    assert np.abs(lab.truth() - lab.program.target).max() < 2e-5


def test_sigterm_is_an_emergency_stop(lab):
    running = lab.run()
    running.send_signal(signal.SIGTERM)
    out, _ = running.communicate(timeout=20)
    assert running.returncode == 130
    assert json.loads(out)["reason"] == "stopped from the keyboard"
    assert json.loads(lab.arm.read_text())["state"] == "ESTOPPED"
    assert lab.truth()[0] < 0.0035
