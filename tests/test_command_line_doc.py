"""docs/command_line.md names every command, with examples that its parser knows; completion."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from muxjax.cli import COMMANDS, main

DOC = (Path(__file__).resolve().parent.parent / "docs" / "command_line.md").read_text()
EXAMPLES = dict(re.findall(r"^\| `(\w+)` \|.*\| `(muxjax .*)` \|$", DOC, re.MULTILINE))
# Commands of commands: the help that lists options is one word further.
FIGURES = ["fig6", "fig7", "fig8c", "gallery", "statics", "table1", "table2", "table3", "training"]
NESTED = {
    "config": ["schema", "check"],
    "figure": FIGURES,
    "statics": ["posture", "calibrate", "experiment"],
}


@pytest.fixture
def muxjax(capsys, monkeypatch, tmp_path):
    """Run a command; returns exit code and standard output."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "200")

    def call(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        return int(stop.value.code or 0), capsys.readouterr().out

    return call


def test_the_page_has_every_command_once():
    assert list(EXAMPLES) == sorted(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_examples_and_the_pages_options_exist(muxjax, command):
    words = shlex.split(EXAMPLES[command])
    assert words[:2] == ["muxjax", command]
    for path in [[command, inner] for inner in NESTED.get(command, [])] or [[command]]:
        code, text = muxjax(*path, "--help")
        assert code == 0
        assert f"Example: muxjax {' '.join(path)}" in text
        known = re.findall(r"^\W*(--[a-z0-9-]+)", text, re.MULTILINE)  # where a line begins with it
        assert "--help" not in known  # which -h comes before: a line's later words do not count
        examples = re.findall(r"Example: muxjax (.*)", text)
        if words[1 : 1 + len(path)] == path:
            examples.append(EXAMPLES[command])
        for example in examples:
            assert set(re.findall(r"(?<=\s)--[a-z0-9-]+", example)) <= set(known), example


def test_an_unknown_option_is_bad_input(muxjax):
    assert muxjax("fk", "--colour", "red")[0] == 2


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_options_and_words(muxjax, tmp_path):
    code, script = muxjax("--tyro-print-completion", "bash")
    assert code == 0
    (tmp_path / "completion").write_text(script)
    asks = [("pl",), ("plan", "--me"), ("plan", "--method", "be"), ("config", "sc"), ("zz",)]
    lines = [f"source {tmp_path}/completion", "try() {", "COMP_WORDS=(muxjax $@)"]
    lines += ["COMP_CWORD=$#", 'COMP_LINE="muxjax $*"', "COMP_POINT=${#COMP_LINE}", "COMPREPLY=()"]
    lines += ['_tyro_muxjax muxjax "${@: -1}"', 'echo "${COMPREPLY[*]}"', "}"]
    lines += [f"try {' '.join(words)}" for words in asks]
    done = subprocess.run(
        ["bash", "-c", "\n".join(lines)], capture_output=True, text=True, check=True
    )
    found = done.stdout.splitlines()
    assert found == ["plan", "--method", "beamstep beamstep_printed", "schema", ""]
