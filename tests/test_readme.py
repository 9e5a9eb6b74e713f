"""The README's example runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

README = Path(__file__).resolve().parent.parent / "README.md"


def test_the_python_example_runs(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    metrics, outcome = done.stdout.splitlines()
    assert metrics.startswith("Metrics(time_s=")
    reason, error = outcome.split()
    assert reason == "completed"
    assert float(error) < 2e-5
