"""JSON schemas of the YAML files, and ``muxjax config``.

The schemas are judged by a validator of their own draft, written here from its specification, so
that a schema which accepts anything, or refuses shipped files, is noticed.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from muxjax import schemas
from muxjax.cli import main
from muxjax.config import ConfigError, data_folder
from muxjax.schemas import KINDS, Kind, check_file, json_schema, schema_line

FILES = sorted(data_folder("configs").rglob("*.yaml"))
TYPES = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}


class EditorLoader(yaml.SafeLoader):
    """YAML 1.2, as editors read it: 54e9 is a number (to PyYAML, text that pydantic converts)."""


EditorLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$"),
    list("-+.0123456789"),
)


def faults(value: Any, schema: dict[str, Any], root: dict[str, Any], at: str = "") -> list[str]:
    """Where a value breaks a JSON schema (draft 2020-12); unknown keywords are an error."""
    found: list[str] = []
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    for key, rule in schema.items():
        bad: list[str] | bool = False
        match key:
            case "$ref":
                bad = faults(value, root["$defs"][rule.removeprefix("#/$defs/")], root, at)
            case "anyOf":
                bad = all(faults(value, option, root, at) for option in rule)
            case "oneOf":
                bad = sum(not faults(value, option, root, at) for option in rule) != 1
            case "type" if rule in ("number", "integer"):
                bad = not number or (rule == "integer" and value != int(value))
            case "type":
                bad = not isinstance(value, TYPES[rule])
            case "const":
                bad = value != rule
            case "enum":
                bad = value not in rule
            case "minimum":
                bad = number and value < rule
            case "maximum":
                bad = number and value > rule
            case "exclusiveMinimum":
                bad = number and value <= rule
            case "pattern":
                bad = isinstance(value, str) and not re.search(rule, value)
            case "minItems" | "minLength":
                bad = isinstance(value, (list, str)) and len(value) < rule
            case "maxItems" | "maxLength":
                bad = isinstance(value, (list, str)) and len(value) > rule
            case "required":
                bad = isinstance(value, dict) and any(name not in value for name in rule)
            case "properties" if isinstance(value, dict):
                bad = [
                    fault
                    for name, item in value.items()
                    if name in rule
                    for fault in faults(item, rule[name], root, f"{at}.{name}")
                ]
            case "additionalProperties" if isinstance(value, dict):
                extra = {k: v for k, v in value.items() if k not in schema.get("properties", {})}
                bad = (
                    sorted(f"{at}.{k}" for k in extra)
                    if rule is False
                    else [f for k, v in extra.items() for f in faults(v, rule, root, f"{at}.{k}")]
                )
            case "prefixItems" if isinstance(value, list):
                pairs = enumerate(zip(value, rule, strict=False))
                bad = [f for k, (v, r) in pairs for f in faults(v, r, root, f"{at}[{k}]")]
            case "items" if isinstance(value, list):
                rest = list(enumerate(value))[len(schema.get("prefixItems", [])) :]
                bad = [f for k, v in rest for f in faults(v, rule, root, f"{at}[{k}]")]
            case (
                "$defs"
                | "$schema"
                | "default"
                | "description"
                | "discriminator"
                | "title"
                | "properties"
                | "additionalProperties"
                | "prefixItems"
                | "items"
            ):
                pass
            case _:
                raise AssertionError(f"{at}: keyword {key!r} is not known here")
        found += bad if isinstance(bad, list) else [f"{at}: {key}"] if bad else []
    return found


@pytest.fixture(scope="module")
def documents() -> dict[str, dict[str, Any]]:
    return {kind: json_schema(kind) for kind in KINDS}


def test_every_schema_line_names_its_kind(documents):
    for kind in KINDS:
        assert re.fullmatch(rf"muxjax/{kind}/\d+", schema_line(kind))


def test_every_schema_line_of_the_code_has_a_kind():
    """A new kind of YAML file is entered in KINDS; those below are written by muxjax itself."""
    own = {"program", "plan", "journal"}
    root = Path(schemas.__file__).parent.parent
    found = set()
    for room in ("muxjax", "envs", "training"):
        for path in (root / room).rglob("*.py"):
            found |= set(re.findall(r'file_schema: Literal\["muxjax/(\w+)/', path.read_text()))
    assert found - own == KINDS.keys()


@pytest.mark.parametrize("path", FILES, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_shipped_files_are_what_their_schema_says(path, documents):
    raw = yaml.load(path.read_text(), EditorLoader)
    kind = raw["schema"].split("/")[1]
    document = documents[kind]
    assert faults(raw, document, document) == []
    assert faults({**raw, "colour": "red"}, document, document) == [".colour"]
    assert KINDS[kind].folder == path.parent.name


def put(raw: Any, path: str, value: object) -> None:
    *parents, last = (int(p) if p.isdigit() else p for p in path.split("."))
    for parent in parents:
        raw = raw[parent]
    raw[last] = value


@pytest.mark.parametrize(
    ("path", "value", "fault"),
    [
        ("schema", "muxjax/robot/2", ".schema: const"),
        ("segments.0.length_m.value", -1, ".segments[0].length_m.value: exclusiveMinimum"),
        ("segments.1.n_discs.value", 2.5, ".segments[1].n_discs.value: type"),
        ("servo.speed_rpm.source", "guessed", ".servo.speed_rpm.source: enum"),
        ("servo.colour", "red", ".servo.colour"),
        ("segments", [], ".segments: minItems"),
        ("name", "Mux Arm", ".name: pattern"),
        ("base_frame", {"xyz_m": [0, 0]}, ".base_frame.xyz_m: minItems"),
    ],
)
def test_a_robots_schema_refuses_what_loading_refuses(path, value, fault, documents, tmp_path):
    raw = yaml.safe_load((data_folder("configs") / "robots" / "muxarm.yaml").read_text())
    put(raw, path, value)
    assert faults(raw, documents["robot"], documents["robot"]) == [fault]
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(raw))
    with pytest.raises(ConfigError):
        check_file(tmp_path / "arm.yaml")


def test_fields_carry_the_docstrings_text(documents):
    env = documents["env"]
    assert env["description"].startswith("The task, its objective")
    assert "Attributes" not in env["description"]
    for name, item in env["properties"].items():
        assert item.get("description"), name
    # Two lines of the docstring are one text.
    assert env["properties"]["snap_mm"]["description"].endswith("tendon's target ends there.")
    axial = documents["robot"]["$defs"]["AxialConfig"]["properties"]
    assert axial["switch_time_s"]["description"] == "t_sw: repositioning and engagement"


def test_names_are_a_persons(documents):
    text = json.dumps(documents)
    assert "FieldInfo" not in text
    for document in documents.values():
        for reference in re.findall(r'"#/\$defs/([^"]+)"', json.dumps(document)):
            assert reference in document["$defs"]


WORLD = "schema: muxjax/world/1\nname: w\nobstacles:\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: x\n", r"f\.yaml: schema: missing; .*muxjax/robot/1"),
        ("schema: muxjax/robbot/1\n", r"schema: must be muxjax/KIND/VERSION .*'muxjax/robbot/1'"),
        ("schema: muxjax/robot/9\n", r"schema: .*'muxjax/robot/1', found 'muxjax/robot/9'"),
        ("- 1\n", r"f\.yaml: expected a mapping at the top, found list"),
        ("schema: [\n", r"f\.yaml: not readable as YAML"),
        (
            WORLD + "  - {kind: sphere, centre_m: [0, 0, 0], radius_m: -1}\n",
            r"obstacles\[1\].*radius_m: .*greater than 0, found -1",
        ),
        # What only the loader sees: a file that is named, and values together.
        (WORLD + "  - {kind: grid, file: gone.npz}\n", r"f\.yaml: obstacles\[1\].*gone\.npz"),
        (
            WORLD + "  - {kind: half_space, point_m: [0, 0, 0], normal: [0, 0, 0]}\n",
            r"normal: must",
        ),
        (
            "schema: muxjax/env/1\ntheta_rad: [1.0, 0.5]\n",
            r"theta_rad: must not fall, found \(1\.0, 0\.5\)",
        ),
    ],
)
def test_a_wrong_file_is_named_with_field_and_limit(tmp_path, text, message):
    (tmp_path / "f.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        check_file(tmp_path / "f.yaml")
    assert str(caught.value).count(str(tmp_path / "f.yaml")) == 1


def test_a_kind_that_cannot_be_imported_says_what_is_missing(monkeypatch, tmp_path):
    """Missing room and missing library, without uninstalling anything."""
    monkeypatch.setitem(KINDS, "rl", Kind("", "attic.config", "RlConfig"))
    monkeypatch.setitem(sys.modules, "attic", None)
    with pytest.raises(ConfigError, match=r"kind 'rl' lies in the folder attic of a checkout"):
        json_schema("rl")
    (tmp_path / "f.yaml").write_text("schema: muxjax/rl/1\n")
    with pytest.raises(ConfigError, match=r"f\.yaml: kind 'rl' lies in the folder attic"):
        check_file(tmp_path / "f.yaml")
    (tmp_path / "lab_room.py").write_text("import no_such_library\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(KINDS, "rl", Kind("", "lab_room", "RlConfig", extra="train"))
    with pytest.raises(ConfigError, match=r"needs no_such_library: pip install 'muxjax\[train\]'"):
        json_schema("rl")
    with pytest.raises(ConfigError, match=r"kind: must be one of robot, .*found 'robbot'"):
        json_schema("robbot")


@pytest.fixture
def config(capsys, monkeypatch, tmp_path):
    """Run ``muxjax config``; returns exit code, standard output and standard error."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(["config", *arguments])
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out, captured.err

    return call


def test_the_command_prints_and_writes_schemas(config, tmp_path, documents):
    code, out, _ = config("schema")
    assert code == 0
    assert all(f"muxjax/{kind}/" in out for kind in KINDS)
    code, out, _ = config("schema", "task")
    assert code == 0
    assert json.loads(out) == documents["task"]
    code, out, _ = config("schema", "--out", str(tmp_path / "schemas"))
    assert code == 0
    written = {p.name: json.loads(p.read_text()) for p in (tmp_path / "schemas").iterdir()}
    assert written == {f"{kind}.schema.json": documents[kind] for kind in KINDS}
    code, out, err = config("schema", "robbot")
    assert (code, out) == (2, "")
    assert "must be one of robot" in err


def test_one_kind_that_is_missing_does_not_stop_the_others(config, monkeypatch, tmp_path):
    monkeypatch.setitem(KINDS, "rl", Kind("", "attic.config", "RlConfig"))
    monkeypatch.setitem(sys.modules, "attic", None)
    code, _, err = config("schema", "--out", str(tmp_path / "schemas"))
    assert code == 0
    assert "left out: kind 'rl'" in err
    assert not (tmp_path / "schemas" / "rl.schema.json").exists()
    assert (tmp_path / "schemas" / "robot.schema.json").exists()


def test_the_command_checks_every_file_and_fails_with_2(config, tmp_path):
    good, bad = str(FILES[0]), tmp_path / "bad.yaml"
    bad.write_text("schema: muxjax/planner/1\nname: x\nweights: {time: {value: -1}}\n")
    code, out, err = config("check", good)
    assert (code, err) == (0, "")
    code, out, err = config("check", str(bad), good)
    assert code == 2
    assert good in out
    assert "weights.time.value: Input should be greater than or equal to 0, found -1" in err
    assert "weights.time.source: Field required" in err
    code, out, _ = config("check", str(bad), good, "--json")
    assert code == 2
    assert [item["kind"] for item in json.loads(out)] == [None, "bench"]
    code, _, err = config("check")
    assert code == 2
    assert "name at least one file" in err
