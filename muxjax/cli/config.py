"""``muxjax config``: what a YAML file may say, and whether one says it."""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich import box
from rich.table import Table

from muxjax.cli.output import choice_of, complain, console, print_json, verdict
from muxjax.config import ConfigError
from muxjax.schemas import KINDS, check_file, json_schema, schema_line


def schema(
    kind: Annotated[str | None, tyro.conf.Positional] = None, out: Path | None = None
) -> int:
    """JSON schema of a kind of YAML file; without a kind, the kinds that there are.

    docs/config.md says how an editor completes and checks files by it.

    Example: muxjax config schema robot

    Example: muxjax config schema --out schemas

    Args:
        kind: Such as robot, world, task, planner, hardware, env, training.
        out: Write KIND.schema.json into this folder instead; of every kind if none is named.
    """
    if out is None and kind is None:
        _print_kinds()
        return 0
    if out is None and kind is not None:
        print_json(json_schema(kind))
        return 0
    assert out is not None  # the two cases above
    documents = {kind: json_schema(kind)} if kind is not None else _all()
    out.mkdir(parents=True, exist_ok=True)
    for name, document in documents.items():
        text = json_text.dumps(document, indent=2) + "\n"
        (out / f"{name}.schema.json").write_text(text, encoding="utf-8")
    console.print(f"written to {out}: {', '.join(f'{name}.schema.json' for name in documents)}")
    return 0


def _all() -> dict[str, dict[str, Any]]:
    """Schemas of every kind; standard error says which are left out, and why."""
    found = {}
    for kind in KINDS:
        try:
            found[kind] = json_schema(kind)
        except ConfigError as error:
            complain(f"left out: {error}")
    return found


def _print_kinds() -> None:
    table = Table("kind", "first line", "states", "shipped files", box=box.SIMPLE_HEAD)
    for name, kind in KINDS.items():
        try:
            line = f"schema: {schema_line(name)}"
        except ConfigError as error:
            line = str(error)
        table.add_row(name, line, kind.about, f"configs/{kind.folder}" if kind.folder else "")
    console.print(table)


def check(files: Annotated[tuple[Path, ...], tyro.conf.Positional], json: bool = False) -> int:
    """Check YAML files, by the kind that its "schema:" line names; exit code 2 if one is wrong.

    Example: muxjax config check my_arm.yaml my_world.yaml

    Args:
        files: The files.
        json: Print what was found as JSON.
    """
    if not files:
        raise ValueError("config check: name at least one file")
    findings = []
    for path in files:
        try:
            findings.append({"file": str(path), "kind": check_file(path), "error": None})
        except ConfigError as error:
            findings.append({"file": str(path), "kind": None, "error": str(error)})
    wrong = [item for item in findings if item["error"] is not None]
    if json:
        print_json(findings)
    else:
        for item in findings:
            if item["error"] is None:
                said = verdict(f"{item['file']}: {item['kind']}, as it should be", True)
                console.print(said, soft_wrap=True)
            else:
                complain(item["error"])
    return 2 if wrong else 0


COMMANDS: dict[str, Any] = {"schema": schema, "check": check}
_Choice: Any = choice_of(COMMANDS)


def config(command: tyro.conf.OmitArgPrefixes[_Choice]) -> int:
    """What YAML files may say: their JSON schemas, and checks of files.

    Example: muxjax config check my_arm.yaml
    """
    code: int = command
    return code
