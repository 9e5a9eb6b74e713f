"""A wheel carries the configurations, and its package works from anywhere."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent

USE_IT = """
import tempfile
from pathlib import Path
import muxjax
from envs.config import load_env_config
from envs.tdma import Tdma
from muxjax.config import TaskConfig, load_yaml, resolve
from muxjax.hardware import load_physics
from muxjax.hardware.codec import database
from muxjax.hardware.firmware import write_firmware
print(muxjax.__file__)
for name in ("muxarm", "penta"):
    print(muxjax.load_robot(name).config.fingerprint)
print(len(load_yaml(TaskConfig, resolve("fig9a", "tasks")).targets))
print(muxjax.Problem([0.0], [0.0], preset="paper").cost_weights["travel"], load_physics("ideal"))
print(len(database().messages))
with tempfile.TemporaryDirectory() as folder:
    files = write_firmware(Path(folder), muxjax.load_robot("muxarm"), load_physics("ideal"))
    print([path.name for path in files], sum(len(path.read_text()) for path in files))
print(Tdma(load_env_config("muxarm")).n_actions)
"""


def run(cwd: Path, path: Path | None) -> list[str]:
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    if path is not None:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run(
        [sys.executable, "-c", USE_IT],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()


def test_wheel_and_checkout_agree_from_any_folder(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path / "dist")],
        cwd=CHECKOUT,
        check=True,
        capture_output=True,
    )
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    installed, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(installed)
    from_wheel, from_checkout = run(elsewhere, installed), run(elsewhere, None)
    assert from_wheel[0].startswith(str(installed))
    assert from_checkout[0].startswith(str(CHECKOUT))
    assert from_wheel[1:] == from_checkout[1:]
