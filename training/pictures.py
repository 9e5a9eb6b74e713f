"""Pictures of trainings and of the comparison.

python -m training.pictures curves --runs out/rl/one_servo_0 out/rl/one_servo_1 --out curve.png
python -m training.pictures front --records out/compare --out front.png
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from muxjax.config import ConfigError
from training.compare import Record, front, medians, trained_in

# By what orders the beam; shades and marks that are apart in grey, too.
_STYLES = {
    "network and patterns": ("tab:purple", "P"),
    "network": ("tab:red", "o"),
    "patterns": ("tab:blue", "s"),
    "count": ("tab:green", "^"),
    "none": ("tab:gray", "v"),
}


def curves(runs: tuple[Path, ...], out: Path = Path("out/curves.png")) -> int:
    """Median gap and solved share of policies over environment steps, a line a training.

    Args:
        runs: Folders of ``training.train_rl``; those whose names differ only after the last
            underscore share their colour.
        out: Picture to write.
    """
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    axes: Any = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    names: list[str] = []
    for run in runs:
        lines, name = _curve(run), trained_in(run)
        first = name not in names
        names += [name] * first
        shade = f"C{names.index(name)}"
        steps = 1e-6 * np.array([line["steps"] for line in lines])
        low, middle, high = (
            100 * np.array([line[key] for line in lines])
            for key in ("lower_quartile", "median_gap", "upper_quartile")
        )
        axes[0].fill_between(steps, low, high, color=shade, alpha=0.12, linewidth=0)
        axes[0].plot(steps, middle, color=shade, label=name if first else None)
        axes[1].plot(steps, [100 * (1 - line["solved"]) for line in lines], color=shade)
    axes[0].set(ylabel="over the optimum [%]", yscale="log")
    axes[0].yaxis.set_major_formatter("{x:g}")
    axes[0].legend(title="median; bands: quartiles")
    axes[1].set(ylabel="unsolved [%]", xlabel="environment steps [million]")
    axes[1].set_yscale("symlog", linthresh=0.5)
    axes[1].set(ylim=(-0.1, 110), yticks=(0, 1, 10, 100), yticklabels=("0", "1", "10", "100"))
    for each in axes:
        each.grid(alpha=0.3)
    return _written(figure, out)


def picture_of_front(records: tuple[Path, ...], out: Path = Path("out/front.png")) -> int:
    """Median gap over the best known plan against median time, a panel a regime.

    Args:
        records: Folders of ``training.compare``.
        out: Picture to write.
    """
    found = [
        Record(**row)
        for folder in records
        for path in sorted(folder.glob("*_[0-9]*.json"))
        for row in json.loads(path.read_text())
    ]
    if not found:
        raise ConfigError(f"{', '.join(map(str, records))}: no records")
    regimes = list(dict.fromkeys(r.regime for r in found))
    columns = min(3, len(regimes))
    rows = -(-len(regimes) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.1 * rows + 0.5), layout="constrained")
    panels: Any = figure.subplots(rows, columns, squeeze=False)
    for panel, regime in zip(panels.flat, regimes, strict=False):
        _draw_front(panel, [r for r in found if r.regime == regime])
        panel.set(title=regime, xlabel="time with tables [ms]", ylabel="over the best known [%]")
    for panel in panels.flat[len(regimes) :]:
        panel.axis("off")
    handles: dict[str, Any] = {}
    for panel in panels.flat:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=6)
    return _written(figure, out)


def _draw_front(panel: Any, records: Sequence[Record]) -> None:
    points = medians(records)
    for guide, (shade, mark) in _STYLES.items():
        own = [p for name, p in points.items() if name.rsplit(" ", 1)[0] == guide]
        if own:
            panel.plot(*zip(*own, strict=True), mark + "-", color=shade, markersize=5, label=guide)
    rest = [p for name, p in points.items() if name.rsplit(" ", 1)[0] not in _STYLES]
    panel.plot(*zip(*rest, strict=True), "kx", markersize=5, label="baselines, exact, policies")
    ahead = sorted(points[name] for name in front(records))
    panel.step(
        *zip(*ahead, strict=True), where="post", color="k", linewidth=0.8, label="front", zorder=0
    )
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.xaxis.set_minor_formatter(NullFormatter())  # its labels run into each other
    panel.set_yscale("symlog", linthresh=1.0)
    panel.yaxis.set_major_formatter("{x:g}")
    panel.set_ylim(bottom=-0.1)
    panel.grid(alpha=0.3)


def _curve(run: Path) -> list[dict[str, float]]:
    try:
        return list(json.loads((run / "curve.json").read_text()))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{run}: is no training of a policy ({error})") from None


def _written(figure: Figure, out: Path) -> int:
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=160)
    print(out)
    return 0


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"curves": curves, "front": picture_of_front})
