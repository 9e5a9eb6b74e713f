"""``muxjax statics`` as a user meets it."""

from __future__ import annotations

import json

import equinox as eqx
import numpy as np
import pytest
from PIL import Image

from muxjax.cli import main
from muxjax.config import resolve
from muxjax.statics import forward_statics, load_chain

HOOK = ("--displacements-mm", "-8", "0", "8", "0", "-12", "0", "12", "0")


@pytest.fixture
def muxjax(capsys):
    """Run a command; returns exit code, standard output and standard error."""

    def call(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(["statics", *arguments])
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out, captured.err

    return call


def test_posture_is_that_of_the_library(muxjax, tmp_path):
    picture = tmp_path / "posture.png"
    hanging = ("--mounting", "hanging", "--payload-kg", "0.1")
    code, out, _ = muxjax("posture", *HOOK, *hanging, "--json", "--plot", str(picture))
    assert code == 0
    document = json.loads(out)
    wanted = forward_statics(
        load_chain("hyper_redundant"),
        displacements=np.array([-8, 0, 8, 0, -12, 0, 12, 0]) / 1e3,
        gravity=[0, 0, 9.81],
        tip_wrench=[0, 0, 0, 0, 0, 0.981],
    )
    np.testing.assert_allclose(document["tip"]["matrix"], wanted.pose, atol=1e-9)
    np.testing.assert_allclose(document["tension_n"], wanted.tension, atol=1e-6)
    assert document["slack"] == list(wanted.slack)
    with Image.open(picture) as image:
        assert len(image.convert("RGB").getcolors(1 << 24)) > 50
    code, out, _ = muxjax("posture", *HOOK, *hanging)
    assert code == 0
    assert "slack" in out
    position = np.array(document["tip"]["position_m"])
    assert "  ".join(f"{1e3 * x:.1f}" for x in position) in out
    assert "constant curvature is" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("posture",), "either --tension-n or --displacements-mm"),
        (("posture", "--tension-n", "1", "2"), "last axis must have 8 entries"),
        (("posture", "--tension-n", *["1"] * 7, "-1"), "tendon 8 is at -1"),
        (("posture", *HOOK, "--chain", "snake"), "no 'snake' among"),
        (("posture", *HOOK, "--chain", "tdcr_a", "--robot", "muxarm"), "either --chain or --robot"),
        (("posture", *HOOK, "--mounting", "hanging", "--gravity", "0", "0", "0"), "--mounting or"),
        (("posture", *HOOK, "--payload-kg", "-1"), "--payload-kg: must be at least 0"),
        (("posture", *HOOK, "--tip-force-n", "nan", "0", "0"), "must be finite"),
        (("calibrate", "nowhere.csv"), "nowhere.csv"),
        (("calibrate", "nowhere.csv", "--out", "chain.txt"), "--out: must end in .yaml"),
        (("experiment", "--postures", "0"), "postures: must be at least 1"),
    ],
)
def test_bad_input_is_named(muxjax, arguments, message):
    code, _, err = muxjax(*arguments)
    assert code == 2
    assert message in err


def test_calibrate_takes_a_table_and_gives_a_chain(muxjax, tmp_path, rng):
    """A stiffer arm than the file's is found again."""
    chain = load_chain("hyper_redundant")
    tension = rng.uniform(1, 4, (6, 8))
    hanging = [0.0, 0.0, 9.81]
    path, start = tmp_path / "data.csv", tmp_path / "hanging.yaml"
    text = resolve("hyper_redundant", "chains").read_text()
    start.write_text(text.replace("[0, 0, -9.81]", "[0, 0, 9.81]"))
    stiff = eqx.tree_at(lambda c: c.stiffness, chain, 1.2 * chain.stiffness)
    found = forward_statics(stiff, tension=tension, gravity=hanging)
    names = [f"tension_{k}_n" for k in range(1, 9)] + ["x_m", "y_m", "z_m"]
    noisy = found.pose[:, :3, 3] + rng.normal(0, 2e-4, (6, 3))
    rows = np.concatenate([tension, noisy], axis=1)
    lines = [",".join(names), *(",".join(f"{x:.9g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines))
    out = tmp_path / "mine.yaml"
    command = ("calibrate", str(path), "--chain", str(start), "--out", str(out), "--json")
    code, text, _ = muxjax(*command)
    assert code == 0
    document = json.loads(text)
    assert document["converged"] is True
    for name in ("stiffness_1", "stiffness_2"):
        fitted = document["parameters"][name]
        width = fitted["high"] - fitted["low"]
        assert abs(fitted["value"] - 2.4) < width < 0.2
    loaded = load_chain(out)
    assert loaded.stiffness[0] == pytest.approx(document["parameters"]["stiffness_1"]["value"])
    code, _, _ = muxjax("posture", *HOOK, "--chain", str(out))
    assert code == 0
