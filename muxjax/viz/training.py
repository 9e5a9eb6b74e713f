"""Learning curves of policies, from the files that ``training.train_rl`` writes."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from muxjax.config import ConfigError
from muxjax.viz.style import MARKERS, SEGMENT_COLOURS, STYLE, TENDON_STYLES

Curve = Sequence[Mapping[str, float]]  # a line an evaluation


def load_curve(run: Path) -> Curve:
    """The evaluations of a training, from its folder.

    Raises:
        ConfigError: No ``curve.json`` lies there, or it is none.
    """
    try:
        curve = json.loads((run / "curve.json").read_text(encoding="utf-8"))
        keys = {"steps", "solved", "median_gap", "lower_quartile", "upper_quartile"}
        if not curve or any(keys - line.keys() for line in curve):
            raise ValueError(f"every line needs {', '.join(sorted(keys))}")
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"{run}: is no training of a policy ({error}); python -m training.train_rl makes one"
        ) from None
    return list(curve)


def curves_figure(runs: Mapping[str, Curve]) -> Figure:
    """Median gap and unsolved share of policies over environment steps, a line a training.

    Args:
        runs: Curves by the name of their training; names that differ only in a number after the
            last underscore, the seed, share their look.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.0, 4.2), layout="constrained")
        axes: Any = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        groups: list[str] = []
        for run, curve in runs.items():
            group = re.sub(r"_\d+$", "", run)
            first = group not in groups
            groups += [group] * first
            _draw(axes, curve, groups.index(group), group if first else None)
        axes[0].set(ylabel="over the optimum [%]", yscale="log")
        axes[0].yaxis.set_major_formatter("{x:g}")
        axes[0].legend(title="median; bands: quartiles")
        axes[1].set(ylabel="unsolved [%]", xlabel="environment steps [million]")
        axes[1].set_yscale("symlog", linthresh=0.5)
        axes[1].set(ylim=(-0.1, 110), yticks=(0, 1, 10, 100), yticklabels=("0", "1", "10", "100"))
        return figure


def _draw(axes: Any, curve: Curve, number: int, label: str | None) -> None:
    look: dict[str, Any] = {
        "color": SEGMENT_COLOURS[number % len(SEGMENT_COLOURS)],
        "ls": TENDON_STYLES[number % len(TENDON_STYLES)],
        "marker": MARKERS[number % len(MARKERS)],
        "ms": 3.5,
        "lw": 1.2,
    }
    steps = 1e-6 * np.array([line["steps"] for line in curve])
    low, middle, high = (
        100 * np.array([line[key] for line in curve])
        for key in ("lower_quartile", "median_gap", "upper_quartile")
    )
    axes[0].fill_between(steps, low, high, color=look["color"], alpha=0.12, linewidth=0)
    axes[0].plot(steps, middle, label=label, **look)
    axes[1].plot(steps, [100 * (1 - line["solved"]) for line in curve], **look)
