"""``muxjax firmware`` and ``muxjax conformance``: a board of one's own."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path

from rich.text import Text

from muxjax.cli.output import console, print_json
from muxjax.hardware import BusLink, Link, LockstepLink, load_physics
from muxjax.hardware.conformance import Finding, run_checks
from muxjax.hardware.firmware import write_firmware
from muxjax.hardware.links import open_bus
from muxjax.hardware.mapping import MappedLink, Translation
from muxjax.robot import Robot, load_robot


def firmware(out: Path, robot: str = "muxarm", physics: str = "ideal", json: bool = False) -> int:
    """Write C source for the firmware of a robot's board.

    Pack and unpack of every message, the protocol's values, the robot's constants, the CRC and a
    reference of the board's state machine; docs/real_board.md says how to use them.

    Example: muxjax firmware --out board

    Args:
        out: Folder for the files.
        robot: Shipped robot or path of a YAML file.
        physics: Times of clutches, probe and brake: shipped ones or path of a YAML file.
        json: Print the files' names as JSON.
    """
    written = write_firmware(out, load_robot(robot), load_physics(physics))
    if json:
        print_json({"files": [str(path) for path in written]})
    else:
        console.print(f"{len(written)} files in {out}: {', '.join(p.name for p in written)}")
    return 0


def conformance(
    bus: str | None = None,
    robot: str = "muxarm",
    allow_motion: bool = False,
    just_powered: bool = False,
    straight: bool = False,
    only: tuple[str, ...] | None = None,
    mapping: Path | None = None,
    json: bool = False,
) -> int:
    """Check that a board keeps the protocol's promises; exit code 1 where it breaks one.

    The last check leaves the board in ESTOP: switch it off and on afterwards.

    Example: muxjax conformance --bus '{"interface": "socketcan", "channel": "can0"}'

    Args:
        bus: Arguments of can.Bus as a JSON object, or a section of python-can's configuration; a
            virtual board in lockstep without it.
        robot: Shipped robot or path of a YAML file.
        allow_motion: Make the checks that move the arm, too; let it hang free.
        just_powered: Nobody has spoken to the board since its power-up.
        straight: The arm stands straight, should the board have lost its wheels' turns.
        only: Names of the checks to make; all by default.
        mapping: YAML file of a lab's own DBC that the board on --bus speaks.
        json: Print the findings as JSON.
    """
    if mapping is not None and bus is None:
        raise ValueError("conformance: --mapping is of the board on --bus")
    arm = load_robot(robot)
    translation = None if mapping is None else Translation(mapping)
    on_finding = None if json else _print_finding
    with _open(bus, arm, translation) as link:
        findings = run_checks(
            link,
            allow_motion=allow_motion,
            just_powered=just_powered,
            straight=straight,
            only=only,
            on_finding=on_finding,
        )
    failed = sum(finding.verdict == "fail" for finding in findings)
    if json:
        print_json({"findings": [dataclasses.asdict(finding) for finding in findings]})
    else:
        passed = sum(finding.verdict == "pass" for finding in findings)
        console.print(
            f"{passed} passed, {failed} failed, {len(findings) - passed - failed} skipped"
        )
    return 1 if failed else 0


def _print_finding(finding: Finding) -> None:
    look = {"pass": "good", "fail": "bad"}.get(finding.verdict, "aside")
    said = Text(f"{finding.verdict:8}", look) + f" {finding.name}  {finding.reason}".rstrip()
    console.print(said, soft_wrap=True)


@contextlib.contextmanager
def _open(bus: str | None, arm: Robot, translation: Translation | None) -> Iterator[Link]:
    """The link that --bus asks for."""
    if bus is None:
        yield LockstepLink(arm)
        return
    with open_bus(bus) as opened:
        link = BusLink(opened, arm)
        yield link if translation is None else MappedLink(link, translation)
