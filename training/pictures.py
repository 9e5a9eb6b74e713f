"""The picture of the comparison: python -m training.pictures --records out/compare --out front.png.

`muxjax figure training` draws learning curves.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from muxjax.config import ConfigError
from training.compare import Record, front, medians

# By what orders the beam; shades and marks that are apart in grey, too.
_STYLES = {
    "network and patterns": ("tab:purple", "P"),
    "network": ("tab:red", "o"),
    "patterns": ("tab:blue", "s"),
    "count": ("tab:green", "^"),
    "none": ("tab:gray", "v"),
}


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
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=160)
    print(out)
    return 0


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


if __name__ == "__main__":
    tyro.cli(picture_of_front)
