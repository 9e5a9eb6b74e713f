"""A mission in pictures: the arm among obstacles at chosen moments, and the clearance of stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from muxjax.collision import World
from muxjax.kinematics import backbone
from muxjax.robot import Robot
from muxjax.tendons import configuration_from_tendons
from muxjax.viz.programs import colour

_POINTS = 24  # a segment
_PANELS_A_ROW = 4
_WALL, _BALL, _GRIPPER = "0.62", "#E69F00", "0.25"
_KINDS = {"tendons": "#0072B2", "base": "#D55E00", "grasp": _BALL, "release": _BALL}
_FAR = 10.0  # [m]; what is further away is not drawn
_LETTER = 0.09  # of a step's name [inch]
_NAME_HEIGHT = 0.17  # of a step's name [inch], with the room to the next one


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The arm at one moment.

    Attributes:
        title: Above it.
        robot: The arm, its root where it stands.
        displacements: Of the tendons [m].
        world: Obstacles, and what the tool carries.
    """

    title: str
    robot: Robot
    displacements: Float[np.ndarray, " SJ"]
    world: World


@dataclass(frozen=True)
class Bar:
    """The least clearance of one stage [m], and the step and kind it belongs to."""

    step: str
    kind: str
    clearance: float


def draw_mission(
    snapshots: Sequence[Snapshot],
    bars: Sequence[Bar],
    margin: float,
    title: str,
    path: str | Path,
    *,
    views: Sequence[tuple[int, int]] = ((0, 2), (1, 2)),
) -> Path:
    """Panels of the arm in plain projections, and below them the least clearance by stage.

    Args:
        snapshots: The moments to draw.
        bars: All stages.
        margin: What every plan keeps [m].
        title: Above the figure.
        path: Image to write; the ending chooses the format.
        views: Axes to the right and up of each projection: x, y, z are 0, 1, 2.
    """
    columns = min(len(snapshots), _PANELS_A_ROW)
    bands = -(-len(snapshots) // columns)
    rows = bands * len(views)
    heights = [2.5 * _tallness(_limits(snapshots, view)) + 0.8 for view in views] * bands
    below = 1.8 + _LETTER * max(len(bar.step) for bar in bars)
    figure = Figure(figsize=(3.0 * columns, sum(heights) + below + 0.5), layout="constrained")
    figure.suptitle(title)
    parts = figure.subfigures(2, 1, squeeze=False, height_ratios=[sum(heights), below])
    panels, strip = parts[:, 0]
    grid = panels.add_gridspec(rows, columns, height_ratios=heights)
    for number, snapshot in enumerate(snapshots):
        band, column = divmod(number, columns)
        for k, view in enumerate(views):
            axes = panels.add_subplot(grid[band * len(views) + k, column])
            _draw_view(axes, snapshot, view, _limits(snapshots, view))
            axes.tick_params(labelsize=7)
            axes.set_ylabel(f"{'xyz'[view[1]]} [mm]" if column == 0 else "", fontsize=8)
            axes.set_xlabel(f"{'xyz'[view[0]]} [mm]", fontsize=8)
            if k == 0:
                axes.set_title(snapshot.title, fontsize=9)
    _draw_bars(strip.add_subplot(), bars, margin)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    return path


def animate_mission(
    snapshots: Sequence[Snapshot], path: str | Path, *, view: tuple[int, int] = (0, 2)
) -> Path:
    """The moments one after the other in one projection, as an animated GIF."""
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    limits = _limits(snapshots, view)

    def show(k: int) -> list[Any]:
        axes.clear()
        _draw_view(axes, snapshots[k], view, limits)
        axes.set_title(snapshots[k].title, fontsize=9)
        return []

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    animation = FuncAnimation(figure, show, frames=len(snapshots), blit=False)
    animation.save(path, writer=PillowWriter(fps=8), dpi=80)
    return path


def _axis(snapshot: Snapshot) -> Float[np.ndarray, "n 3"]:
    q = configuration_from_tendons(snapshot.robot, snapshot.displacements)
    return np.asarray(1e3 * backbone(snapshot.robot, q, _POINTS)[:, :3, 3])


def _limits(snapshots: Sequence[Snapshot], view: tuple[int, int]) -> Float[np.ndarray, "2 2"]:
    """Least and greatest coordinate [mm] of arms, boxes and tubes in a projection."""
    world = snapshots[0].world
    points = [_axis(s) for s in snapshots]
    points += [1e3 * np.asarray(line) for line in world.tube_line]
    points += [1e3 * _corners(f, h) for f, h in zip(world.box_frame, world.box_half, strict=True)]
    every = np.concatenate(points)[:, list(view)]
    return np.stack([every.min(axis=0) - 70.0, every.max(axis=0) + 70.0])


def _tallness(limits: Float[np.ndarray, "2 2"]) -> float:
    """Height over width, within what a page bears."""
    width, height = limits[1] - limits[0]
    return float(np.clip(height / width, 0.3, 1.4))


def _corners(frame: Any, half: Any) -> Float[np.ndarray, "8 3"]:
    """Corners of a box in the world [m]; its frame takes the world to the box."""
    local = np.array(list(product((-1, 1), repeat=3))) * np.asarray(half)
    turn, shift = np.asarray(frame)[:3, :3], np.asarray(frame)[:3, 3]
    return np.asarray((local - shift) @ turn)


def _draw_view(
    axes: Any, snapshot: Snapshot, view: tuple[int, int], limits: Float[np.ndarray, "2 2"]
) -> None:
    axes.set_aspect("equal")
    axes.set_xlim(*limits[:, 0])
    axes.set_ylim(*limits[:, 1])
    _draw_world(axes, snapshot, list(view), limits)
    points = _axis(snapshot)
    flat = points[:, list(view)]
    radius = 1e3 * float(snapshot.robot.body_radius)
    for segment in range(snapshot.robot.n_segments):
        part = slice(segment * _POINTS, (segment + 1) * _POINTS + 1)
        _draw_band(axes, flat[part], radius, colour(segment), 0.45, 3)
        axes.plot(*flat[part].T, color=colour(segment), lw=1.2, zorder=4)
    _draw_held(axes, snapshot, list(view))
    axes.plot(*flat[0], "s", color=_GRIPPER, ms=6, zorder=5)


def _draw_band(
    axes: Any,
    line: Float[np.ndarray, "n 2"],
    radius: float,
    shade: str,
    alpha: float,
    order: float,
    *,
    caps: bool = True,
) -> None:
    """Everything within a radius of a line, as one shape without darker overlaps."""
    turn = np.linspace(0, 2 * np.pi, 25)
    rim = radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    shapes = []
    for begin, end in pairwise(line):
        along = end - begin
        size = float(np.hypot(*along))
        if size > 1e-9:
            aside = radius * np.array([-along[1], along[0]]) / size
            shapes.append(np.stack([begin + aside, end + aside, end - aside, begin - aside]))
    ends = np.linalg.norm(line[:, None] - line[[0, -1]], axis=2).min(axis=1)
    shapes += [point + rim for point in (line if caps else line[ends > radius])]
    axes.add_collection(
        PolyCollection(shapes, facecolors=_paler(shade, alpha), edgecolors="none", zorder=order)
    )


def _paler(shade: str, alpha: float) -> tuple[float, ...]:
    """What a colour looks like on white at some opacity, itself opaque."""
    return tuple(1 - alpha * (1 - c) for c in mpl.colors.to_rgb(shade))


def _draw_world(
    axes: Any, snapshot: Snapshot, view: list[int], limits: Float[np.ndarray, "2 2"]
) -> None:
    world = snapshot.world
    for line, bore, wall in zip(world.tube_line, world.tube_bore, world.tube_wall, strict=True):
        flat, inner = 1e3 * np.asarray(line)[:, view], 1e3 * float(bore)
        thick = 1e3 * float(wall) if wall is not None else 15.0
        _draw_band(axes, flat, inner + thick, "0.35", 0.9, 1, caps=False)
        _draw_band(axes, flat, inner, "#dfeefa", 1.0, 1.5, caps=False)
    for frame, half in zip(world.box_frame, world.box_half, strict=True):
        corners = 1e3 * _corners(frame, half)[:, view]
        low, high = corners.min(axis=0), corners.max(axis=0)
        square = [low, [high[0], low[1]], high, [low[0], high[1]]]
        axes.add_patch(
            Polygon(square, facecolor=_WALL, edgecolor="0.35", lw=0.6, alpha=0.55, zorder=2)
        )
    for point, normal in zip(world.plane_point, world.plane_normal, strict=True):
        if abs(normal[view[1]]) > 0.99:
            level = 1e3 * point[view[1]]
            axes.axhspan(limits[0, 1], level, color=_WALL, alpha=0.55, lw=0, zorder=0)
    for begin, end, radius in zip(
        world.round_from, world.round_to, world.round_radius, strict=True
    ):
        if radius > 0 and np.abs(begin).max() < _FAR:
            ends = 1e3 * np.stack([begin, end])[:, view]
            _draw_band(axes, ends, 1e3 * float(radius), _BALL, 1.0, 4.5)


def _draw_held(axes: Any, snapshot: Snapshot, view: list[int]) -> None:
    robot, world = snapshot.robot, snapshot.world
    q = configuration_from_tendons(robot, snapshot.displacements)
    tool = backbone(robot, q, 1)[-1] @ np.asarray(robot.tool)
    for centre, radius in zip(world.carried, world.carried_radius, strict=True):
        if radius <= 0:
            continue
        at = 1e3 * (tool[:3, :3] @ np.asarray(centre) + tool[:3, 3])[view]
        shade = _BALL if radius == np.max(world.carried_radius) and radius > 0.015 else _GRIPPER
        axes.add_patch(Circle(tuple(at), 1e3 * float(radius), color=shade, lw=0, zorder=5))


def _draw_bars(axes: Any, bars: Sequence[Bar], margin: float) -> None:
    heights = [1e3 * bar.clearance for bar in bars]
    axes.bar(range(len(bars)), heights, color=[_KINDS[bar.kind] for bar in bars], width=0.8)
    axes.axhline(1e3 * margin, color="0.2", lw=0.9, ls="--")
    axes.set_ylabel("least clearance [mm]", fontsize=8)
    axes.set_xlim(-0.6, len(bars) - 0.4)
    axes.tick_params(labelsize=7)
    _name_steps(axes, bars)
    shown = {kind: shade for kind, shade in _KINDS.items() if any(b.kind == kind for b in bars)}
    marks = [mpl.patches.Patch(color=shade) for shade in shown.values()]
    line = mpl.lines.Line2D([], [], color="0.2", lw=0.9, ls="--")
    axes.legend(
        [*marks, line],
        [f"{kind} stage" for kind in shown] + ["margin"],
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        frameon=False,
        fontsize=7,
        ncols=5,
    )
    axes.grid(axis="y", alpha=0.3)


def _name_steps(axes: Any, bars: Sequence[Bar]) -> None:
    """Below the bars, a bracket around the stages of each step, and upright its name."""
    starts = [k for k, bar in enumerate(bars) if k == 0 or bars[k - 1].step != bar.step]
    ends = [k - 1 for k in [*starts[1:], len(bars)]]
    middles = [(first + last) / 2 for first, last in zip(starts, ends, strict=True)]
    bars_an_inch = len(bars) / (0.9 * axes.figure.bbox.width / axes.figure.dpi)
    places = _apart(middles, _NAME_HEIGHT * bars_an_inch, len(bars) - 1.0)
    axes.set_xticks([])
    below = axes.get_xaxis_transform()
    line = {"color": "0.3", "lw": 0.9, "clip_on": False, "transform": below}
    for first, last, middle, place in zip(starts, ends, middles, places, strict=True):
        axes.plot([first - 0.35, last + 0.35], [-0.03, -0.03], **line)
        axes.plot([middle, place], [-0.03, -0.08], **line)
        axes.text(
            place,
            -0.1,
            bars[first].step,
            rotation=90,
            ha="center",
            va="top",
            fontsize=8,
            transform=below,
        )


def _apart(wanted: Sequence[float], gap: float, last: float) -> list[float]:
    """Rising places with at least a gap between them, the last one no further than ``last``."""
    places: list[float] = []
    for place in wanted:
        places.append(max(place, places[-1] + gap) if places else place)
    highest = last
    for k in reversed(range(len(places))):
        places[k] = min(places[k], highest)
        highest = places[k] - gap
    return places
