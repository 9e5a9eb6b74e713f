"""Arms, and tendon lengths and bending angles of programs over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from muxjax.kinematics import backbone
from muxjax.metrics import timeline
from muxjax.planning.motion import angles_at
from muxjax.robot import Robot
from muxjax.scheduler import Program, Trajectory
from muxjax.tendons import configuration_from_tendons
from muxjax.viz.scene import guide_frames, tendon_points
from muxjax.viz.style import MARKERS, SEGMENT_COLOURS, STYLE, TENDON_STYLES, save_figure

_POINTS_A_SEGMENT = 24
_PANELS_A_ROW = 5
_NAMES_A_ROW = 7  # of the legend, before it takes two rows
_FRAMES_A_SECOND = 10


def colour(segment: int) -> str:
    """Colour of a segment, counting from 0."""
    return SEGMENT_COLOURS[segment % len(SEGMENT_COLOURS)]


def marker(segment: int) -> str:
    """Marker of a segment, counting from 0."""
    return MARKERS[segment % len(MARKERS)]


def tendon_style(tendon: int) -> str:
    """Line style of a tendon within its segment, counting from 0."""
    return TENDON_STYLES[tendon % len(TENDON_STYLES)]


def compare_programs(
    robot: Robot, programs: Mapping[str, Program], title: str, path: str | Path
) -> Path:
    """Write ``programs_figure``.

    Args:
        robot: The arm.
        programs: By the name that heads their panel.
        title: Above the figure.
        path: Image to write; the ending chooses the format.
    """
    return save_figure(programs_figure(robot, programs, title), path, dpi=110)


def programs_figure(
    robot: Robot, programs: Mapping[str, Program], title: str, *, letters: str = ""
) -> Figure:
    """Tendon displacements and bending angles over time, a panel a program (after M Fig. 6).

    Shaded stretches are motion, blank ones repositioning; dotted lines are the final angles.

    Args:
        robot: The arm.
        programs: By the name that heads their panel.
        title: Above the figure.
        letters: Of the arm and of the panels, in the order of the programs; none by default.
    """
    with mpl.rc_context(STYLE):
        return _programs_figure(robot, programs, title, [f"({x}) " for x in letters])


def _programs_figure(
    robot: Robot, programs: Mapping[str, Program], title: str, letters: list[str]
) -> Figure:
    letters = letters or [""] * (len(programs) + 1)
    bands = -(-len(programs) // _PANELS_A_ROW)
    columns = -(-len(programs) // bands)  # as few blank places as can be
    figure = Figure(figsize=(1.75 * columns + 3.0, 3.3 * bands + 0.6), layout="constrained")
    figure.suptitle(title)
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[2.8, 1.75 * columns])[0]
    arm = left.add_subplot(projection="3d")
    first = next(iter(programs.values()))
    draw_arm(arm, robot, np.array(first.start), alpha=0.35)
    draw_arm(arm, robot, np.array(first.target))
    _frame_arm(arm, robot)
    arm.set_title(f"{letters[0]}start (pale) and target")
    grid = right.add_gridspec(2 * bands, columns)
    top: list[Any] = []
    for number, (name, program) in enumerate(programs.items()):
        band, column = divmod(number, columns)
        lengths = right.add_subplot(grid[2 * band, column], sharey=top[0] if top else None)
        angles = right.add_subplot(
            grid[2 * band + 1, column], sharex=lengths, sharey=top[1] if top else None
        )
        top = top or [lengths, angles]
        line = timeline(robot, program)
        _draw_lengths(lengths, robot, line)
        _draw_angles(angles, robot, line)
        lengths.set_title(
            f"{letters[number + 1]}{name}\n"
            f"{line.time_s[-1]:.1f} s, {len(program.instructions)} stages"
        )
        for axes in (lengths, angles):
            _shade_motion(axes, line)
            axes.tick_params(labelleft=column == 0)
        lengths.tick_params(labelbottom=False)
        angles.set_xlabel("time [s]")
        if column == 0:
            lengths.set_ylabel("displacement [mm]")
            angles.set_ylabel("bending angle [deg]")
    # Of all panels, which share their scales: a limit before the last one would cut those after it.
    top[1].set_ylim(0, top[1].get_ylim()[1])
    _add_legend(figure, robot)
    return figure


def _draw_lengths(axes: Any, robot: Robot, line: Trajectory) -> None:
    for c, values in enumerate(line.displacements.T):
        segment, tendon = divmod(c, robot.tendons_per_segment)
        at = [0, *np.flatnonzero(np.diff(values)) + 1, len(values) - 1]  # where it has moved
        axes.plot(
            line.time_s, 1e3 * values, tendon_style(tendon), marker=marker(segment), markevery=at,
            ms=2.5, color=colour(segment), lw=1.0,
        )  # fmt: skip


def _draw_angles(axes: Any, robot: Robot, line: Trajectory) -> None:
    times = np.union1d(np.linspace(0, line.time_s[-1], 400), line.time_s)
    theta = np.degrees(angles_at(robot, line.at(times)))
    for segment, values in enumerate(theta.T):
        # Markers of segments that run together stand beside each other.
        every = (0.03 * segment, 0.16)
        axes.plot(times, values, color=colour(segment), lw=1.2, marker=marker(segment), ms=3,
                  markevery=every)  # fmt: skip
        axes.axhline(values[-1], color=colour(segment), ls=":", lw=0.9)


def _shade_motion(axes: Any, line: Trajectory) -> None:
    moving = np.any(np.diff(line.displacements, axis=0) != 0, axis=-1)
    for begin, end in zip(line.time_s[:-1][moving], line.time_s[1:][moving], strict=True):
        axes.axvspan(begin, end, color="0.5", alpha=0.15, lw=0)
    axes.set_xlim(0, max(line.time_s[-1], 1e-9))


def _add_legend(figure: Figure, robot: Robot) -> None:
    """Names of segments, tendons and motion: in one row, or segments above the others."""
    segments = [
        mpl.lines.Line2D([], [], color=colour(i), lw=1.5, marker=marker(i), ms=4)
        for i in range(robot.n_segments)
    ]
    tendons = [
        mpl.lines.Line2D([], [], color="0.3", ls=tendon_style(j))
        for j in range(robot.tendons_per_segment)
    ]
    motion = mpl.patches.Patch(color="0.5", alpha=0.15, lw=0)
    above = [(line, f"segment {i}") for i, line in enumerate(segments, start=1)]
    below: list[tuple[Any, str]] = [
        (line, f"tendon {j} of the segment") for j, line in enumerate(tendons, start=1)
    ]
    below.append((motion, "motion"))
    names = [*above, *below]
    if len(names) > _NAMES_A_ROW:
        blank = mpl.lines.Line2D([], [], ls="none"), ""
        # Legends fill columns first.
        names = [n for both in zip_longest(above, below, fillvalue=blank) for n in both]
        columns = len(names) // 2
    else:
        columns = len(names)
    handles, words = zip(*names, strict=True)
    figure.legend(handles, words, loc="outside lower center", ncols=columns)


def draw_arm(
    axes: Any,
    robot: Robot,
    displacements: Float[np.ndarray, " SJ"],
    *,
    moving: Sequence[int] = (),
    alpha: float = 1.0,
) -> None:
    """Backbone, discs and tendons of the arm on 3-D axes [mm].

    Args:
        axes: Matplotlib 3-D axes.
        robot: The arm.
        displacements: Tendon displacements [m].
        moving: Tendons, from 0, that are drawn thick.
        alpha: Opacity.
    """
    q = np.asarray(configuration_from_tendons(robot, displacements))
    points = 1e3 * backbone(robot, q, _POINTS_A_SEGMENT)[:, :3, 3]
    for segment in range(robot.n_segments):
        part = slice(segment * _POINTS_A_SEGMENT, (segment + 1) * _POINTS_A_SEGMENT + 1)
        axes.plot(*points[part].T, color=colour(segment), lw=3, alpha=alpha)
    frames = guide_frames(robot, q)
    _draw_discs(axes, robot, frames[1:], alpha)
    for c, path in enumerate(tendon_points(robot, frames)):
        segment, j = divmod(c, robot.tendons_per_segment)
        thick = c in moving
        axes.plot(
            *(1e3 * path.T), tendon_style(j), color=colour(segment), lw=2.4 if thick else 0.7,
            alpha=alpha * (1.0 if thick else 0.7),
        )  # fmt: skip


def arm_picture(
    robot: Robot,
    displacements: Float[np.ndarray, " SJ"],
    target: Float[np.ndarray, " SJ"],
    title: str,
) -> UInt8[np.ndarray, "400 400 3"]:
    """The arm, and pale where it is to go, as RGB pixels.

    Args:
        robot: The arm.
        displacements: Tendon displacements [m].
        target: Tendon displacements wanted [m].
        title: Above the arm.
    """
    figure = Figure(figsize=(5, 5), dpi=80)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    draw_arm(axes, robot, target, alpha=0.35)
    draw_arm(axes, robot, displacements)
    _frame_arm(axes, robot)
    axes.set_title(title, fontsize=9)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]


def _draw_discs(axes: Any, robot: Robot, discs: Float[np.ndarray, "D 4 4"], alpha: float) -> None:
    turn = np.linspace(0, 2 * np.pi, 33)
    rim = float(robot.body_radius) * np.stack([np.cos(turn), np.sin(turn), 0 * turn])
    for disc in discs:
        axes.plot(
            *(1e3 * (disc[:3, :3] @ rim + disc[:3, 3:])), color="0.4", lw=0.5, alpha=0.6 * alpha
        )


def _frame_arm(axes: Any, robot: Robot) -> None:
    reach = 1e3 * float(np.sum(robot.length))
    # A cube about the middle of the straight arm, wherever its base points.
    middle = 1e3 * robot.base[:3, 3] + 0.52 * reach * robot.base[:3, 2]
    half = 0.62 * reach
    for set_limits, centre in zip(
        (axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True
    ):
        set_limits(centre - half, centre + half)
    axes.set_box_aspect((1, 1, 1), zoom=0.85)  # so that the axes' names have room beside it
    axes.set_xlabel("x [mm]", fontsize=8)
    axes.set_ylabel("y [mm]", fontsize=8)
    axes.set_zlabel("z [mm]", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=4)
    axes.view_init(elev=18, azim=-60)


def animate(
    robot: Robot, program: Program, title: str, path: str | Path, *, seconds: float = 4.0
) -> Path:
    """The arm executing a program, as an animated GIF.

    Args:
        robot: The arm.
        program: What it executes.
        title: Above the arm.
        path: File to write, ending in .gif.
        seconds: Length of the animation; the true time stands in the picture.
    """
    line = timeline(robot, program)
    times = np.linspace(0, line.time_s[-1], max(2, int(seconds * _FRAMES_A_SECOND)))
    states = line.at(times)
    figure = Figure(figsize=(5, 5), layout="constrained")
    axes = figure.add_subplot(projection="3d")

    def show(k: int) -> list[Any]:
        axes.clear()
        moving = [] if k == len(times) - 1 else _moving_at(line, times[k])
        draw_arm(axes, robot, states[k], moving=moving)
        _frame_arm(axes, robot)
        what = (
            "tendons " + ", ".join(str(c + 1) for c in moving) if len(moving) else "repositioning"
        )
        if k == len(times) - 1:
            what = "done"
        axes.set_title(f"{title}\n{times[k]:5.1f} of {times[-1]:.1f} s: {what}", fontsize=10)
        return []

    animation = FuncAnimation(figure, show, frames=len(times), blit=False)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    animation.save(path, writer=PillowWriter(fps=_FRAMES_A_SECOND), dpi=80)
    return path


def _moving_at(line: Trajectory, time: float) -> list[int]:
    """Tendons, from 0, that move at a time."""
    stretch = min(int(np.searchsorted(line.time_s, time, side="right")), len(line.time_s) - 1)
    step = line.displacements[stretch] - line.displacements[max(stretch - 1, 0)]
    return [int(c) for c in np.flatnonzero(step)]
