"""The tutorials' scripts run as they stand, each in a fresh process, and print what is shown.

A page shows NAME.txt beside NAME.py. To renew it, run the script from the repository's root and
keep its output; of a training, whose output is long, the lines that the page needs. A line that
ends in "..." is compared up to there.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "tutorials"
TRAININGS = {"train_a_guide", "reinforcement_learning"}
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py"))
SLOW = {"own_cost_term"}  # compiles a planner for each of its terms
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
# Figures of a training depend on how a processor rounds; the others only in their last digit.
LOOSE, CLOSE = {"rel": 0.5, "abs": 0.5}, {"rel": 0.02, "abs": 0.02}


@pytest.fixture
def root(tmp_path):
    """A folder that looks like the repository's root to a script, and takes what it writes."""
    for name in ("docs", "configs"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def started(script: str, root: Path, **environment: str) -> subprocess.Popen[str]:
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, f"docs/tutorials/{script}.py"],
        cwd=root,
        env={**os.environ, "PYTHONPATH": paths, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def printed(process: subprocess.Popen[str]) -> list[str]:
    out, errors = process.communicate(timeout=500)
    assert process.returncode == 0, errors[-2000:]
    return out.splitlines()


def shown(script: str) -> list[str]:
    return (FOLDER / f"{script}.txt").read_text().splitlines()


def agree(line: str, expected: str, tolerance: dict[str, float]) -> bool:
    """The same words, and numbers that are close."""
    if expected.endswith("..."):
        words = NUMBER.sub("#", expected[:-3].rstrip())
        if not NUMBER.sub("#", line).startswith(words):
            return False
    elif NUMBER.sub("#", line) != NUMBER.sub("#", expected):
        return False
    wanted = [float(n) for n in NUMBER.findall(expected)]
    found = [float(n) for n in NUMBER.findall(line)][: len(wanted)]
    return found == pytest.approx(wanted, **tolerance)


def test_agreement_is_of_words_and_numbers():
    assert agree("cost 0.2391, 3 stages", "cost 0.2390, 3 stages", CLOSE)
    assert not agree("cost 0.30, 3 stages", "cost 0.24, 3 stages", CLOSE)
    assert not agree("cost 0.239, 3 steps", "cost 0.239, 3 stages", CLOSE)
    assert agree("10 steps: gap 0.02, 9 s", "10 steps: gap 0.02, ...", CLOSE)
    assert not agree("10 steps: gap 0.09, 9 s", "10 steps: gap 0.02, ...", CLOSE)


@pytest.mark.parametrize(
    "script",
    [
        pytest.param(script, marks=pytest.mark.slow if script in SLOW else ())
        for script in SCRIPTS
        if script not in TRAININGS
    ],
)
def test_prints_what_its_page_shows(root, script):
    lines, expected = printed(started(script, root)), shown(script)
    assert len(lines) == len(expected), lines
    for line, wanted in zip(lines, expected, strict=True):
        assert agree(line, wanted, CLOSE), (line, wanted)


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted(TRAININGS))
def test_trains_as_its_page_says(root, script):
    lines = printed(started(script, root))
    rest = iter(lines)
    for wanted in shown(script):  # in this order, with others in between
        assert any(agree(line, wanted, LOOSE) for line in rest), wanted
    if script == "train_a_guide":  # what its page concludes
        over = {
            (int(width), name): float(percent)
            for line in lines
            for width, name, percent in re.findall(r"^width (\d+), (.+): (.+) % over", line)
        }
        for width in (1, 4):
            assert over[width, "trained"] < min(over[width, "count"], over[width, "no guide"])


@pytest.mark.slow
def test_two_processes_sweep_to_the_figures_of_one(root):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    both = [
        started("cluster", root, COORDINATOR=address, PROCESSES="2", RANK=str(rank))
        for rank in range(2)
    ]
    first, second = (printed(process) for process in both)
    assert first[-2:] == shown("cluster")
    assert not any("dexterity" in line for line in second)


@pytest.mark.parametrize("script", SCRIPTS)
def test_its_page_shows_all_of_it(script):
    """Every cell of the script and every line of its output is on the page, in order."""
    page = (FOLDER / f"{script}.md").read_text()
    code = (FOLDER / f"{script}.py").read_text()
    cells = re.findall(r"\[start:(\w+)\]", code)
    assert re.findall(r"\[end:(\w+)\]", code) == cells
    assert len(cells) >= 2
    assert re.findall(rf'--8<-- "docs/tutorials/{script}\.py:(\w+)"', page) == cells
    ranges = re.findall(rf'--8<-- "docs/tutorials/{script}\.txt:(\d+):(\d+)"', page)
    numbers = [n for first, last in ranges for n in range(int(first), int(last) + 1)]
    assert numbers == list(range(1, len(shown(script)) + 1))


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_the_job_script_is_bash_and_runs_the_tutorial():
    job = FOLDER / "cluster.sh"
    subprocess.run(["bash", "-n", str(job)], check=True)
    assert "srun python docs/tutorials/cluster.py" in job.read_text()
    named = set(re.findall(r"\b(FOLDER|SAMPLES)=", job.read_text()))
    assert named == set(re.findall(r'environ\.get\("(\w+)"', (FOLDER / "cluster.py").read_text()))
