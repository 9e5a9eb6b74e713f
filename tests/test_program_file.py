"""Program files: the same program back, or a refusal that names the field."""

from __future__ import annotations

import json

import numpy as np
import pytest

import muxjax
from muxjax.program_file import load_program, save_program


@pytest.fixture
def program(muxarm):
    target = muxjax.tendon_displacements(muxarm, [0.5, 1.0, 0.7, 2.0, 0.4, 3.0])
    problem = muxjax.Problem(np.zeros(9), target, servos=(1, 3), max_step=0.01, axial=2)
    return muxjax.schedule(muxarm, muxjax.plan(muxarm, problem, "greedy"))


def test_a_program_survives_the_file(program, tmp_path):
    save_program(program, tmp_path / "program.json")
    assert load_program(tmp_path / "program.json") == program


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("schema",), "muxjax/program/9", r"schema: .*muxjax/program/1.*found 'muxjax/program/9'"),
        (("program", "start"), None, r"program\.start"),
        (("program", "extra"), 1, r"program\.extra"),
        (("program", "instructions", 0, "axial"), "x", r"program\.instructions\[1\]\.axial"),
        (("program", "instructions", 0, "via"), 3, r"program\.instructions\[1\]\.via"),
    ],
)
def test_a_wrong_file_is_refused_by_field(program, tmp_path, path, value, message):
    save_program(program, tmp_path / "program.json")
    document = json.loads((tmp_path / "program.json").read_text())
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    (tmp_path / "program.json").write_text(json.dumps(document))
    with pytest.raises(muxjax.ConfigError, match=message):
        load_program(tmp_path / "program.json")


def test_a_torn_or_missing_file_is_refused(program, tmp_path):
    path = tmp_path / "program.json"
    save_program(program, path)
    path.write_text(path.read_text()[:200])
    with pytest.raises(muxjax.ConfigError, match=r"program\.json: .*JSON"):
        load_program(path)
    with pytest.raises(muxjax.ConfigError, match="cannot be read"):
        load_program(tmp_path / "nothing.json")
