"""Where the tool really went while clutches slipped (M Fig. 7d-e, the sample points of Fig. 8c)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from muxjax.hardware.accuracy import Trial, rmse
from muxjax.viz.style import INK, MARKERS, SEGMENT_COLOURS, STYLE
from muxjax.workspace import Sweep
from muxjax.workspace.plots import draw_dexterity

_PANELS = (
    ("x [mm]", lambda trial: 1e3 * trial.poses[:, -1, 0, 3]),
    ("y [mm]", lambda trial: 1e3 * trial.poses[:, -1, 1, 3]),
    ("z [mm]", lambda trial: 1e3 * trial.poses[:, -1, 2, 3]),
    ("tool axis\nto z axis [deg]", lambda trial: np.degrees(_inclination(trial.poses[:, -1]))),
    ("distance\nfrom plan [mm]", lambda trial: 1e3 * trial.errors()[0][:, -1]),
    ("turn\nfrom plan [deg]", lambda trial: np.degrees(trial.errors()[1][:, -1])),
)


def _inclination(poses: Float[np.ndarray, "T 4 4"]) -> Float[np.ndarray, " T"]:
    """Angle [rad] of the tool's axis to the base frame's z."""
    return np.arctan2(np.linalg.norm(poses[:, :2, 2], axis=-1), poses[:, 2, 2])


def trials_figure(trials: Mapping[int, Trial], case: str) -> Figure:
    """One trial for each number of servos: the tool in space and over time (M Fig. 7d-e).

    Solid there, dashed back; the last two panels are the errors that the text speaks of.

    Args:
        trials: There and back to the same target, by the number of servos.
        case: What slipped, for the title.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.2, 4.6), layout="constrained")
        figure.suptitle(f"To a target and back: {case}")
        left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.1, 1.7])[0]
        space = left.add_subplot(projection="3d")
        _draw_space(space, trials)
        panels = right.subplots(3, 2, sharex=True)
        for axes, (label, values) in zip(panels.T.ravel(), _PANELS, strict=True):
            for number, (servos, trial) in enumerate(trials.items()):
                _draw_over_time(axes, number, servos, trial, values(trial))
            axes.set_ylabel(label)
        for axes in panels[-1]:
            axes.set_xlabel("time on the board's clock [s]")
        panels[0, 0].set_title("(e) the tool over time", loc="left")
        figure.legend(handles=_legend(list(trials)), loc="outside lower center", ncols=6)
        return figure


def _draw_space(axes: Any, trials: Mapping[int, Trial]) -> None:
    for number, trial in enumerate(trials.values()):
        tool = 1e3 * trial.poses[:, -1, :3, 3]
        for part, style in _ways(trial):
            own = tool[part]
            axes.plot(*own.T, style, color=_colour(number), lw=1.0, marker=MARKERS[number], ms=3,
                      markevery=max(1, len(own) // 5))  # fmt: skip
        axes.plot(*tool[[trial.at_target]].T, MARKERS[number], color=_colour(number), ms=5)
    wanted = next(iter(trials.values()))
    axes.plot(*1e3 * wanted.planned[[wanted.at_target], -1, :3, 3].T, "x", color=INK, ms=8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.locator_params(nbins=4)
    axes.set_box_aspect(None, zoom=0.85)  # room for the label of z
    axes.set_title("(d) the tool in space")


def _ways(trial: Trial) -> tuple[tuple[slice, str], ...]:
    at = trial.at_target
    return (slice(0, at + 1), "-"), (slice(at, None), "--")


def _draw_over_time(
    axes: Any, number: int, servos: int, trial: Trial, values: Float[np.ndarray, " T"]
) -> None:
    for part, style in _ways(trial):
        axes.plot(
            trial.time_s[part], values[part], style, color=_colour(number), lw=1.0,
            marker=MARKERS[number], markevery=0.22, ms=3,
            label=f"{servos} servos, {'there' if style == '-' else 'back'}",
        )  # fmt: skip
    at = trial.at_target
    axes.plot(trial.time_s[at], values[at], MARKERS[number], color=_colour(number), ms=6,
              mfc="none")  # fmt: skip


def _legend(servos: Sequence[int]) -> list[Any]:
    def line(label: str, **how: Any) -> Any:
        return mpl.lines.Line2D([], [], label=label, **how)

    sets = [
        line(f"{n} servo{'s' if n > 1 else ''}", color=_colour(k), marker=MARKERS[k], ms=4, lw=1)
        for k, n in enumerate(servos)
    ]
    return [
        *sets,
        line("there", color="0.3", ls="-"),
        line("back", color="0.3", ls="--"),
        line("planned target", color=INK, ls="", marker="x"),
    ]


def _colour(number: int) -> str:
    return SEGMENT_COLOURS[number % len(SEGMENT_COLOURS)]


@dataclass(frozen=True, eq=False)
class SamplePoint:
    """A shape of the arm whose tool lies in the xz plane, reached several times.

    Attributes:
        name: Of the shape.
        tool: Where the tool should be [m].
        time_s: To get there, mean over the trials, on the board's clock [s].
        position: RMS distance of the tool from there [m].
        orientation: RMS angle [rad].
    """

    name: str
    tool: Float[np.ndarray, " 3"]
    time_s: float
    position: float
    orientation: float


def sample_point(name: str, trials: Sequence[Trial]) -> SamplePoint:
    """Time to reach and accuracy of trials to one target."""
    ends = [t.at_target for t in trials]
    errors = [t.errors() for t in trials]
    position, angle = (
        np.array([e[k][end, -1] for e, end in zip(errors, ends, strict=True)]) for k in (0, 1)
    )
    return SamplePoint(
        name,
        trials[0].planned[ends[0], -1, :3, 3],
        float(np.mean([t.time_s[end] for t, end in zip(trials, ends, strict=True)])),
        rmse(position),
        rmse(angle),
    )


def workspace_figure(sweep: Sweep, points: Sequence[SamplePoint], about: str) -> Figure:
    """Dexterity in the xz plane with numbered sample points, their times and errors (M Fig. 8c).

    Args:
        sweep: Of the workspace.
        points: What was reached.
        about: How, for the title of the bars.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.2, 4.4), layout="constrained")
        plane, bars = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.35, 1])[0]
        axes = plane.subplots()
        axes.grid(False)
        draw_dexterity(plane, axes, sweep)
        axes.set_title(f"dexterity from {sweep.samples:,} samples", loc="left")
        for number, point in enumerate(points, start=1):
            x, _, z = 1e3 * point.tool
            axes.plot(x, z, "o", ms=11, mfc="white", mec=INK, mew=0.9)
            axes.text(x, z, str(number), ha="center", va="center_baseline", fontsize=7, color=INK)
        panels = bars.subplots(1, 3, sharey=True)
        names = [f"{k}  {p.name}" for k, p in enumerate(points, start=1)]
        quantities = (
            ("time to\nreach [s]", [p.time_s for p in points]),
            ("position\nerror [mm]", [1e3 * p.position for p in points]),
            ("orientation\nerror [deg]", [float(np.degrees(p.orientation)) for p in points]),
        )
        for panel, (label, values), hatch in zip(panels, quantities, ("", "//", ".."), strict=True):
            panel.barh(range(len(points)), values, color="0.85", edgecolor=INK, hatch=hatch, lw=0.7)
            panel.set_xlabel(label)
            panel.set_xlim(0, 1.45 * max(values))
            panel.grid(axis="y", visible=False)
            for row, value in enumerate(values):
                panel.text(value, row, f" {value:.3g}", va="center", fontsize=7)
        panels[0].set_yticks(range(len(points)), names)
        panels[0].set_ylabel("sample point [-]")
        panels[0].invert_yaxis()
        bars.suptitle(about, fontsize=8)
        return figure
