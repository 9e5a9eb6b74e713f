"""How far the URDF's chain is from constant curvature, by its resolution.

    python -m tests.benchmarks.urdf --samples 200

Configurations are uniform over the allowed bending angles and all azimuths, the same for each
resolution; the chain is evaluated from the XML.
"""

from __future__ import annotations

import argparse

import numpy as np

import muxjax
from tests.benchmarks.common import table
from tests.conftest import random_configurations
from tests.test_urdf import errors

RESOLUTIONS = (4, 5, 6, 8, 12, 16, 24, 48)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=200)
    samples = parser.parse_args().samples
    rows = []
    robot = muxjax.load_robot("muxarm")
    q = random_configurations(robot, np.random.default_rng(0), samples)
    for per_segment in RESOLUTIONS:
        off = errors(robot, q, per_segment)
        figures = [
            f"{scale * f(part):.3f}"
            for part, scale in zip(off, (1e3, 180 / np.pi), strict=True)
            for f in (np.median, np.max)
        ]
        rows.append([str(per_segment), *figures])
    heading = ["joints a segment", "median [mm]", "most [mm]", "median [deg]", "most [deg]"]
    print(table(heading, rows))


if __name__ == "__main__":
    main()
