"""The cost sheet: M Table III, and what the robot's identity makes of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

import muxjax
from muxjax.bom import cost_sheet
from muxjax.cli import main
from muxjax.config import ConfigError, RobotConfig, data_folder

CHECKOUT = Path(__file__).resolve().parent.parent


@pytest.fixture
def raw() -> dict:
    return yaml.safe_load((data_folder("configs") / "robots" / "muxarm.yaml").read_text())


def test_the_parts_add_up_to_the_published_total(muxarm):
    sheet = cost_sheet(muxarm)
    assert sheet.total == pytest.approx(541.85, abs=1e-9)
    assert muxarm.config.cost.total_usd.value == 541.85
    assert (sheet.motors, sheet.single_count) == (4, 9)
    assert sheet.single_total == pytest.approx(9 * 482.89)


def test_the_published_shares_are_what_the_prices_give(muxarm):
    """M VI-D and VII print 88 % and 55 %; 5 of 9 is 55.6 %, cut off."""
    sheet = cost_sheet(muxarm)
    assert round(100 * sheet.saving) == muxarm.config.cost.saving_percent.value
    assert int(100 * sheet.fewer_motors) == muxarm.config.cost.fewer_motors_percent.value
    # Motors alone: 447.62 of 4346.01.
    assert sheet.motors_saving == pytest.approx(1 - 447.62 / 4346.01)


def test_the_parts_list_is_no_part_of_the_robots_identity(raw, muxarm):
    with_cost = RobotConfig.model_validate(raw)
    del raw["cost"]
    without = RobotConfig.model_validate(raw)
    assert with_cost.cost is not None
    assert without.cost is None
    assert without.fingerprint == with_cost.fingerprint
    # What was written before there was a parts list still names this robot.
    problems = CHECKOUT / "configs" / "training" / "problems_muxarm.json"
    assert json.loads(problems.read_text())["fingerprint"] == muxarm.fingerprint


@pytest.mark.parametrize(
    ("line", "field", "value", "message"),
    [
        (2, "price_usd", 15.82, r"cost\.total_usd: the parts add up to 542\.85, found 541\.85"),
        (1, "count", 4, r"cost\.parts: must count 4 motors, the 3 servos .*found 5"),
        (0, "price_usd", 0, r"cost\.parts\[1\]\.price_usd: .*greater than 0.*found 0"),
        (0, "kind", "engine", r"cost\.parts\[1\]\.kind: .*'motor', 'standard' or"),
        (3, "count", 0, r"cost\.parts\[4\]\.count: .*equal to 1.*found 0"),
        (3, "colour", "red", r"cost\.parts\[4\]\.colour: .*not permitted"),
    ],
)
def test_a_wrong_sheet_is_refused_by_field(raw, tmp_path, line, field, value, message):
    raw["cost"]["parts"][line][field] = value
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(raw))
    with pytest.raises(ConfigError, match=message):
        muxjax.load_robot(tmp_path / "arm.yaml")


def test_a_robot_without_a_sheet_is_refused():
    with pytest.raises(ConfigError, match=r"cost: the file of robot 'penta' has no parts list"):
        cost_sheet(muxjax.load_robot("penta"))


def bom(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main(["bom", *arguments])
    out, err = capsys.readouterr()
    return int(stop.value.code or 0), out, err


def test_the_command_tells_published_from_derived(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    code, out, _ = bom(capsys)
    assert code == 0
    for text in ("541.85", "4346.01", "87.5 %", "88 % (published", "55.6 %", "55 % (published"):
        assert text in out
    code, out, _ = bom(capsys, "--json")
    document = json.loads(out)
    assert document["derived"]["total_usd"] == document["stated"]["total_usd"]["value"] == 541.85
    assert document["stated"]["saving_percent"]["source"] == "published"
    assert len(document["parts"]) == 16
    code, _, err = bom(capsys, "--robot", "penta")
    assert code == 2
    assert "no parts list" in err
