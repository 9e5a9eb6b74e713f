"""The conformance suite: passes on boards that keep the protocol, names what others break."""

from __future__ import annotations

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
from c_board import SHIM, CBoard, build

from muxjax.cli import main
from muxjax.hardware import BusLink, LockstepLink
from muxjax.hardware.conformance import CHECKS, MOVING, run_checks
from muxjax.hardware.links import open_bus
from muxjax.hardware.protocol import Frame, Port, Received


def verdicts(findings) -> dict[str, str]:
    return {f.name: f"{f.verdict} {f.reason}".strip() for f in findings}


def test_virtual_boards_pass_every_check(robot):
    found = run_checks(LockstepLink(robot), allow_motion=True, just_powered=True)
    assert verdicts(found) == dict.fromkeys(CHECKS, "pass")


def test_c_board_passes_every_check(muxarm, tmp_path):
    link = LockstepLink(muxarm)
    link.board = CBoard(build(tmp_path, muxarm, {"shim.c": SHIM}), muxarm)
    found = run_checks(link, allow_motion=True, just_powered=True)
    assert verdicts(found) == dict.fromkeys(CHECKS, "pass")


def test_nothing_moves_unless_allowed(muxarm):
    link = LockstepLink(muxarm, axial=2)
    found = {f.name: f for f in run_checks(link)}
    assert {name for name, f in found.items() if f.verdict == "skipped"} == MOVING | {
        "powers_up_silent",
        "silent_board_refuses_motion",
    }
    assert "not allowed" in found["servo_moves_its_tendon"].reason
    assert not link.board.mechanics.displacements.any()
    assert link.board.mechanics.slot == 1


class Deaf(LockstepLink):
    """A bus with nobody on it."""

    def send(self, frames):
        """Lost."""


def test_a_silent_bus_fails_with_a_reason(muxarm):
    (found,) = run_checks(Deaf(muxarm), only=["handshake_in_order"])
    assert (found.verdict, found.reason) == ("fail", "no answer to HELLO within 0.2 s")


def test_a_board_that_talks_at_power_up_fails(muxarm):
    link = LockstepLink(muxarm)
    chatter = Port("BOARD")
    step = link.board.step
    link.board.step = lambda now, frames=(): [*step(now, frames), chatter.pack("BOARD_HB")]
    link.send([Frame(0x7FF, b"")])
    (found,) = run_checks(link, just_powered=True, only=["powers_up_silent"])
    assert found.verdict == "fail"


def test_unknown_checks_are_refused(muxarm):
    with pytest.raises(ValueError, match="no check 'speed'; there are powers_up_silent, "):
        run_checks(LockstepLink(muxarm), only=["speed"])


def test_command_prints_findings_and_fails_with_code_1(capsys, monkeypatch):
    with pytest.raises(SystemExit) as stop:
        main(["conformance", "--only", "sequence_window", "watchdog_expires", "--json"])
    assert stop.value.code == 0
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert [f["verdict"] for f in findings] == ["pass", "pass"]
    monkeypatch.setattr("muxjax.hardware.virtual_board.SEQUENCE_WINDOW", 10**5)
    with pytest.raises(SystemExit) as stop:
        main(["conformance", "--only", "sequence_window"])
    assert stop.value.code == 1
    assert "fail     sequence_window  a number 17 ahead" in capsys.readouterr().out


def test_frames_of_the_suite_are_the_protocol_s(muxarm):
    """Whatever the suite sends on purpose broken, the rest is well formed."""
    link = LockstepLink(muxarm)
    sent, send, ears = [], link.send, Port("BOARD")
    link.send = lambda frames: (sent.extend(ears.unpack(f) for f in frames), send(frames))
    run_checks(link, only=["handshake_in_order", "nonsense_is_refused"])
    assert all(isinstance(s, Received) for s in sent)


def test_a_board_that_lost_its_turns_is_told_them_if_the_arm_is_straight(muxarm):
    start = np.array([1, -1, 0, 0, 0, 0, 0, 0, 0]) * 1e-3
    for straight, verdict in ((False, "skipped"), (True, "pass")):
        link = LockstepLink(muxarm, displacements=start)
        link.board.power_cycle(off_s=0.0)
        link.wait(1.0)
        found = run_checks(link, allow_motion=True, straight=straight, only=["clutch_interlocks",
                           "tendon_range_is_kept"])  # fmt: skip
        assert {f.verdict for f in found} == {verdict}
    assert link.board.senses.displacements() == pytest.approx(start, abs=1e-5)


@pytest.mark.slow
def test_over_a_bus_and_another_process(muxarm):
    """What does not hang on the times of a loaded machine."""
    command = [sys.executable, "-c", "from muxjax.cli import main; main()", "board", "--port", "0"]
    board = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        with open_bus(board.stdout.readline().partition(" on ")[2].strip()) as bus:
            found = run_checks(BusLink(bus, muxarm), just_powered=True, only=["powers_up_silent",
                               "handshake_in_order", "nonsense_is_refused", "sequence_window",
                               "broken_frames_are_refused"])  # fmt: skip
        board.send_signal(signal.SIGINT)
        assert board.wait(20) == 0
    finally:
        board.kill()
        board.communicate()
    assert [(f.name, f.verdict, f.reason) for f in found] == [(f.name, "pass", "") for f in found]
