"""docs/command_line.md names every command, with examples that its parser knows; completion."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from muxjax.cli import COMMANDS, main
from muxjax.config import TaskConfig

DOC = (Path(__file__).resolve().parent.parent / "docs" / "command_line.md").read_text()
EXAMPLES = dict(re.findall(r"^\| `(\w+)` \|.*\| `(muxjax .*)` \|$", DOC, re.MULTILINE))


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


def test_the_task_file_on_the_page_is_one():
    (text,) = re.findall(r"```yaml\n(.*?)```", DOC, re.DOTALL)
    task = TaskConfig.model_validate(yaml.safe_load(text))
    assert len(task.targets) == 2


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
