"""Postures under load beside constant curvature, tensions, and the errors of the experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from muxjax.statics.chain import ElasticChain
from muxjax.statics.curvature import pcc_bending, pcc_frames
from muxjax.statics.experiment import Experiment
from muxjax.statics.result import Equilibrium
from muxjax.viz.style import GREY, INK, SEGMENT_COLOURS, STYLE, save_figure

_METHODS = {
    "FST": SEGMENT_COLOURS[1],
    "FSL": SEGMENT_COLOURS[0],
    "PCC from lengths": SEGMENT_COLOURS[2],
    "PCC from ends": SEGMENT_COLOURS[3],
}
_HATCHES = ("", "///", "...", "xxx", "---", "+++")  # of segments, for print in grey
_POINTS = 20  # a segment of an arc


def joint_frames(
    chain: ElasticChain, angles: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "frames 4 4"]:
    """Frames of the base, of every body and of the tip in the world."""
    pose = np.asarray(chain.base)
    frames = [pose]
    for axis, offset, angle in zip(chain.axis, chain.offset, angles, strict=True):
        x, y, z = axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        step = np.eye(4)
        step[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        step[:3, 3] = offset
        pose = pose @ step
        frames.append(pose)
    return np.stack([*frames, pose @ np.asarray(chain.tip)])


def draw_posture(chain: ElasticChain, found: Equilibrium, path: str | Path) -> Path:
    """The posture in two views beside constant curvature at the same lengths, and the tensions.

    Args:
        chain: The arm.
        found: One equilibrium, without batch axes.
        path: Image to write; the ending chooses the format.
    """
    figure = Figure(figsize=(9.6, 3.9), layout="constrained")
    views = figure.subplots(1, 3, width_ratios=[1, 1, 1.1])
    lines = _shapes(chain, found)
    home, pcc, ours = lines.values()
    for axes, across in zip(views[:2], (0, 1), strict=True):
        _draw_shapes(axes, lines, across=across, widths=(1.0, 1.8, 2.6))
        _mark_ends(axes, 1e3 * np.asarray(found.segment_ends)[:, :3, 3][:, [across, 2]])
    _same_scale(views[:2], np.concatenate([ours, pcc, home]))
    handles = views[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower left", ncols=3, fontsize=8, frameon=False)
    _draw_tensions(views[2], chain, found)
    gap = np.linalg.norm(ours[-1] - pcc[-1])
    state = "" if found.converged else " (NO EQUILIBRIUM FOUND)"
    figure.suptitle(f"{chain.name}: constant curvature misses the tip by {gap:.0f} mm{state}")
    return save_figure(figure, path, dpi=150)


def mountings_figure(
    chain: ElasticChain,
    found: Mapping[str, Equilibrium],
    gravity: Mapping[str, Sequence[float]],
) -> Figure:
    """The same tendon lengths under other directions of gravity: postures, and tensions below.

    Args:
        chain: The arm.
        found: Equilibria without batch axes, by how the arm is mounted.
        gravity: Its acceleration, by the same [m/s^2]; an arrow in each panel, in the arm's frame.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(2.6 * len(found), 5.2), layout="constrained")
        grid = figure.subplots(2, len(found), height_ratios=[1.5, 1], squeeze=False)
        shapes = {name: _shapes(chain, one) for name, one in found.items()}
        everything = np.concatenate([line for lines in shapes.values() for line in lines.values()])
        for axes, (name, lines) in zip(grid[0], shapes.items(), strict=True):
            _draw_shapes(axes, lines, across=0, widths=(1.0, 1.4, 2.0))
            _draw_weight(axes, gravity[name])
            gap = np.linalg.norm(lines["statics"][-1] - lines["constant curvature"][-1])
            state = "" if found[name].converged else ", NO EQUILIBRIUM"
            axes.set_title(f"{name}\nconstant curvature is {gap:.0f} mm off\nat the tip{state}")
        _same_scale(grid[0], everything, across=[0] * len(found))
        largest = max(float(np.max(one.tension)) for one in found.values())
        for axes, one in zip(grid[1], found.values(), strict=True):
            _draw_tensions(axes, chain, one)
            axes.set_ylim(0, 1.45 * largest)
        handles = grid[0, 0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=4)
        return figure


def _shapes(chain: ElasticChain, found: Equilibrium) -> dict[str, Float[np.ndarray, "P 3"]]:
    """Lines of an arm [mm] by what they are."""
    arcs = pcc_frames(chain, pcc_bending(chain, np.asarray(found.displacements)), _POINTS)
    return {
        "straight": 1e3 * joint_frames(chain, np.zeros(chain.n_joints))[[0, -1], :3, 3],
        "constant curvature": 1e3 * arcs[:, :3, 3],
        "statics": 1e3 * joint_frames(chain, np.asarray(found.angles))[:, :3, 3],
    }


def _draw_shapes(
    axes: Any,
    lines: Mapping[str, Float[np.ndarray, "P 3"]],
    *,
    across: int,
    widths: Sequence[float],
) -> None:
    """Lines of ``_shapes`` in one view; ``across`` is its axis to the right, 0 for x, 1 for y."""
    looks = {
        "straight": {"color": GREY, "ls": ":"},
        "constant curvature": {"color": _METHODS["PCC from lengths"], "ls": "--"},
        "statics": {"color": _METHODS["FSL"]},
    }
    for (name, line), width in zip(lines.items(), widths, strict=True):
        axes.plot(*line[:, [across, 2]].T, label=name, lw=width, **looks[name])
    axes.set_xlabel(f"{'xy'[across]} [mm]")
    axes.set_ylabel("z [mm]")


def _draw_weight(axes: Any, gravity: Sequence[float]) -> None:
    """An arrow in a lower corner that says where weight pulls, in the plane of the panel."""
    x, z = np.array(gravity, dtype=float)[[0, 2]] / np.linalg.norm(gravity)
    middle, half = np.array([0.84, 0.2]), 0.09 * np.array([x, z])
    axes.annotate(
        "", middle + half, middle - half, xycoords="axes fraction", textcoords="axes fraction",
        arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.6},
    )  # fmt: skip
    axes.text(0.84, 0.05, "weight", transform=axes.transAxes, ha="center", va="center", fontsize=8,
              color=INK)  # fmt: skip


def _mark_ends(axes: Any, points: Float[np.ndarray, "S 2"]) -> None:
    axes.plot(*points.T, "o", color="white", markeredgecolor=_METHODS["FSL"], ms=6, mew=1.6)


def _same_scale(
    views: Sequence[Any], points: Float[np.ndarray, "P 3"], across: Sequence[int] = (0, 1)
) -> None:
    """Views with equal axes and the same height; ``across`` is their axis to the right."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.55 * max(high - low)
    for axes, right in zip(views, across, strict=True):
        middle = 0.5 * (low + high)
        axes.set_xlim(middle[right] - half, middle[right] + half)
        axes.set_ylim(middle[2] - half, middle[2] + half)
        axes.set_aspect("equal")
        axes.grid(alpha=0.25)
        axes.tick_params(labelsize=8)


def _draw_tensions(axes: Any, chain: ElasticChain, found: Equilibrium) -> None:
    """A bar a tendon, coloured by the segment that it ends in; slack ones are named so."""
    tension = np.asarray(found.tension)
    ends = [sorted(set(chain.end_bodies)).index(body) for body in chain.end_bodies]
    numbers = np.arange(1, chain.n_tendons + 1)
    for end in sorted(set(ends)):
        own = np.array(ends) == end
        axes.bar(numbers[own], tension[own], color=SEGMENT_COLOURS[end % 6], width=0.7,
                 hatch=_HATCHES[end % 6], edgecolor="white", label=f"segment {end + 1}",
                 )  # fmt: skip
    top = max(float(tension.max()), 1e-3)
    for number, slack in zip(numbers, np.asarray(found.slack), strict=True):
        if slack:
            axes.text(number, 0.02 * top, "slack", rotation=90, ha="center", va="bottom",
                      fontsize=8, color=GREY)  # fmt: skip
    axes.set_xticks(numbers)
    axes.set_ylim(0, 1.15 * top)
    axes.set_xlabel("tendon [-]")
    axes.set_ylabel("tension [N]")
    axes.tick_params(labelsize=8)
    axes.grid(axis="y", alpha=0.25)
    axes.legend(fontsize=8, frameon=False, ncols=3, loc="upper right", handlelength=1.0,
                columnspacing=0.8, borderaxespad=0.2)  # fmt: skip


def draw_errors(found: Experiment, path: str | Path) -> Path:
    """Boxes of the four errors by method (after S Fig. 5 and 8)."""
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    quantities = (
        ("position", 1e3, "absolute position error [mm]"),
        ("relative_position", 100, "relative position error [%]"),
        ("orientation", np.degrees(1), "absolute orientation error [deg]"),
        ("relative_orientation", 100, "relative orientation error [%]"),
    )
    for axes, (name, scale, label) in zip(panels, quantities, strict=True):
        _boxes(axes, {k: scale * getattr(e, name) for k, e in found.errors.items()})
        axes.set_ylabel(label, fontsize=9)
    count = len(found.travel)
    figure.suptitle(f"{found.chain.name}, synthetic experiment: {count} static configurations")
    return save_figure(figure, path, dpi=150)


def _boxes(axes: Any, values: Mapping[str, Float[np.ndarray, " N"]]) -> None:
    """Quartiles and whiskers with every value as a dot, on a logarithmic scale."""
    for place, (name, all_values) in enumerate(values.items()):
        own = all_values[np.isfinite(all_values)]
        hue = _METHODS[name]
        axes.boxplot(own, positions=[place], widths=0.55, showfliers=False, patch_artist=True,
                     boxprops={"facecolor": mpl.colors.to_rgba(hue, 0.25), "edgecolor": hue},
                     medianprops={"color": hue, "lw": 2}, whiskerprops={"color": hue},
                     capprops={"color": hue})  # fmt: skip
        shift = np.linspace(-0.18, 0.18, len(own))
        axes.plot(place + shift, own, ".", color=hue, ms=5, alpha=0.8)
    axes.set_xticks(range(len(values)), [name.replace(" from", "\nfrom") for name in values])
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda v, _: f"{v:g}"))
    axes.tick_params(labelsize=8)
    axes.grid(axis="y", alpha=0.25)


def draw_configurations(found: Experiment, path: str | Path, *, most: int = 6) -> Path:
    """Measured and predicted tips of the configurations that moved most, and the motion's filter.

    Args:
        found: The experiment.
        path: Image to write.
        most: Configurations at most.
    """
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    tips, filtered = figure.subplots(1, 2, width_ratios=[1, 1.25])
    chosen = np.sort(np.argsort(-found.travel)[:most])
    target = 1e3 * found.measured.segment_ends[:, -1, :3, 3]
    wide = int(np.argmax(np.ptp(target[chosen, :2], axis=0)))
    tips.plot(*target[chosen][:, [wide, 2]].T, "o", color=INK, ms=9, mfc="none", label="measured")
    for name, marker in zip(found.predicted, "^svx", strict=True):
        points = 1e3 * found.predicted[name][chosen, :3, 3][:, [wide, 2]]
        tips.plot(*points.T, marker, color=_METHODS[name], ms=6, ls="none", label=name)
    tips.set_xlabel(f"{'xy'[wide]} [mm]")
    tips.set_ylabel("z [mm]")
    tips.set_title("tips that moved most", fontsize=10)
    tips.set_aspect("equal", adjustable="datalim")
    tips.grid(alpha=0.25)
    tips.legend(fontsize=8, frameon=False)
    _draw_filter(filtered, found)
    figure.suptitle(f"{found.chain.name}, synthetic experiment")
    return save_figure(figure, path, dpi=150)


def _draw_filter(axes: Any, found: Experiment) -> None:
    """Tensions over time; shaded where the arm is static by the paper's criteria."""
    time = found.motion.time
    ends = [sorted(set(found.chain.end_bodies)).index(b) for b in found.chain.end_bodies]
    for k, values in enumerate(found.motion.tension.T):
        axes.plot(time, values, color=SEGMENT_COLOURS[ends[k] % 6], lw=0.9)
    edges = np.flatnonzero(np.diff(found.static.astype(int), prepend=0, append=0))
    last = len(time) - 1
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        axes.axvspan(time[begin], time[min(end, last)], color="0.5", alpha=0.18, lw=0)
    segments = sorted(set(ends))
    handles: list[Any] = [mpl.lines.Line2D([], [], color=SEGMENT_COLOURS[s % 6]) for s in segments]
    handles.append(mpl.patches.Patch(color="0.5", alpha=0.18))
    names = [f"tendons of segment {s + 1}" for s in segments] + ["static"]
    axes.legend(handles, names, fontsize=8, frameon=False, loc="upper right", ncols=3)
    axes.set_xlim(0, time[-1])
    axes.set_ylim(0, 1.2 * found.motion.tension.max())
    axes.set_xlabel("time [s]")
    axes.set_ylabel("tension at the load cell [N]")
    axes.set_title("the motion and its static stretches", fontsize=10)


def draw_pitch(
    errors: Mapping[str, tuple[Sequence[int], Sequence[float]]], path: str | Path
) -> Path:
    """Error against the number of beads a segment, a line for each case or statistic.

    Args:
        errors: By name: beads a segment, and tip error as a share of length.
        path: Image to write.
    """
    figure, axes = _log_log("beads a segment", "tip error [% of length]")
    for name, (beads, values) in errors.items():
        axes.plot(beads, 100 * np.asarray(values), marker="o", label=name)
    counts = [n for beads, _ in errors.values() for n in beads]
    doublings = int(np.log2(max(counts) / min(counts)) + 1)
    ticks = [min(counts) * 2**k for k in range(doublings + 1)]
    axes.set_xticks(ticks, [str(n) for n in ticks])
    axes.xaxis.set_minor_locator(mpl.ticker.NullLocator())
    axes.legend(frameon=False, fontsize=9)
    return save_figure(figure, path, dpi=150)


def draw_cost(
    joints: Sequence[int], seconds: Mapping[str, Sequence[float]], path: str | Path
) -> Path:
    """CPU time against the number of joints, with the slope of each line.

    Args:
        joints: Of the chain.
        seconds: By what they are the time of.
        path: Image to write.
    """
    figure, axes = _log_log("joints", "CPU time [ms]")
    for name, values in seconds.items():
        slope = float(np.polyfit(np.log(joints), np.log(values), 1)[0])
        axes.plot(joints, 1e3 * np.asarray(values), marker="o", label=f"{name}, slope {slope:.2f}")
    axes.set_xticks(list(joints), [str(n) for n in joints])
    axes.xaxis.set_minor_locator(mpl.ticker.NullLocator())
    axes.legend(frameon=False, fontsize=9)
    return save_figure(figure, path, dpi=150)


def _log_log(x: str, y: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=(5.2, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25)
    return figure, axes
