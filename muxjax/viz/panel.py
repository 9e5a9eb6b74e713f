"""The viewer's controls, without what they do: sliders, boxes and texts of the side panel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from muxjax.planning import METHODS
from muxjax.viz.desk import GOALS, Desk
from muxjax.viz.playback import Moment, Track
from muxjax.viz.scene import BY_STATE, shades

if TYPE_CHECKING:
    from viser import GuiApi

BY_HAND = "the arm, by hand"
NOTHING = "nothing"
SPEEDS = ("0.5x", "1x", "2x", "5x", "10x")


@dataclass(frozen=True)
class Panel:
    """Handles of the controls; angles in degrees, lengths in millimetres, times in seconds."""

    status: Any  # what happened last
    failed: list[Any]  # a check box a servo
    colour: Any
    legend: Any
    angles: list[Any]  # theta_1, phi_1, ...
    tendons: list[Any]
    axial: Any
    straighten: Any
    pose: Any
    position: Any
    turn: Any
    goal: Any
    to_tool: Any
    solution: Any
    method: Any
    beside: Any
    plan: Any
    left: Any
    right: Any
    time: Any
    play: Any
    rewind: Any
    speed: Any
    readout: Any
    shown: dict[str, Any]  # a check box a part of the scene


def build_panel(gui: GuiApi, desk: Desk, method: str, colour: str, parts: tuple[str, ...]) -> Panel:
    """Add every control to the side panel.

    Args:
        gui: Of the viser server.
        desk: For names, limits and first values.
        method: Planner chosen first.
        colour: "state" or "tension".
        parts: Of the scene, that can be hidden.
    """
    robot = desk.robot
    status = gui.add_markdown("")
    with gui.add_folder("failed servos: a new plan does without"):
        failed = [
            gui.add_checkbox(f"servo {s + 1} failed", bool(desk.failed[s]))
            for s in range(robot.tendons_per_segment)
        ]
    tabs = gui.add_tab_group()
    with tabs.add_tab("Arm"):
        shade = gui.add_dropdown("tendons by", ("state", "tension"), initial_value=colour)
        legend = gui.add_html("")
        with gui.add_folder("bending"):
            angles = []
            for i in range(robot.n_segments):
                most = float(np.degrees(robot.theta_max[i]))
                label = f"theta {i + 1} [deg]"
                angles.append(gui.add_slider(label, 0.0, round(most, 1), 0.1, 0.0))
                angles.append(gui.add_slider(f"phi {i + 1} [deg]", 0.0, 360.0, 0.1, 0.0))
            straighten = gui.add_button("straighten")
        with gui.add_folder("tendons"):
            tendons = [
                gui.add_slider(f"tendon {c} [mm]", _floor(low), -_floor(-high), 0.1, 0.0)
                for c, (low, high) in enumerate(desk.limits_mm, start=1)
            ]
        axial = gui.add_slider("drum at", 1, len(robot.axial_map), 1, desk.axial)
    with tabs.add_tab("Plan"):
        pose = gui.add_checkbox("drag the target", True)
        position = gui.add_vector3("x, y, z [mm]", (0.0, 0.0, 0.0), step=0.1)
        turn = gui.add_vector3("roll, pitch, yaw [deg]", (0.0, 0.0, 0.0), step=0.1)
        goal = gui.add_dropdown("what counts", tuple(GOALS), initial_value=desk.goal)
        to_tool = gui.add_button("target to the tool")
        solution = gui.add_dropdown("solution", ("none",))
        chosen = gui.add_dropdown("method", tuple(METHODS), initial_value=method)
        beside = gui.add_dropdown("beside it", (NOTHING, *METHODS))
        plan = gui.add_button("Plan")
    with tabs.add_tab("Play"):
        left = gui.add_dropdown("left", (BY_HAND,))
        right = gui.add_dropdown("right", (NOTHING,))
        play = gui.add_button("Play")
        rewind = gui.add_button("to the start")
        time = gui.add_slider("time [s]", 0.0, 1.0, 0.01, 0.0)
        speed = gui.add_dropdown("speed", SPEEDS, initial_value="1x")
    with tabs.add_tab("Show"):
        shown = {part: gui.add_checkbox(part, True) for part in parts}
    readout = gui.add_markdown("")
    return Panel(
        status=status,
        failed=failed,
        colour=shade,
        legend=legend,
        angles=angles,
        tendons=tendons,
        axial=axial,
        straighten=straighten,
        pose=pose,
        position=position,
        turn=turn,
        goal=goal,
        to_tool=to_tool,
        solution=solution,
        method=chosen,
        beside=beside,
        plan=plan,
        left=left,
        right=right,
        time=time,
        play=play,
        rewind=rewind,
        speed=speed,
        readout=readout,
        shown=shown,
    )


def legend_html(colour: str, most: float) -> str:
    """What the tendons' lines mean, as lines of the same colour, weight and dashes.

    Args:
        colour: "state" or "tension".
        most: Tension of the darkest colour [N].
    """
    rows: list[tuple[str, str, float, bool]]
    if colour == "state":
        rows = [
            (name, f"rgb{shade}", 1500 * thickness, dashed)
            for name, (shade, thickness, dashed) in BY_STATE.items()
        ]
    else:
        shares = np.linspace(0.0, 1.0, 5)
        rows = [
            (f"{most * s:.0f} N", f"rgb{tuple(shade.tolist())}", 1.5 + 4 * s, False)
            for s, shade in zip(shares, shades(shares), strict=True)
        ]
        rows.append(("moves", "rgb(60, 60, 60)", 3.0, True))
    lines = "".join(
        f'<div style="display:flex;align-items:center;gap:.6em;line-height:1.35">'
        f'<svg width="46" height="10"><line x1="1" y1="5" x2="45" y2="5" stroke="{shade}" '
        f'stroke-width="{weight:.1f}"{_DASHES if dashed else ""}/></svg>{name}</div>'
        for name, shade, weight, dashed in rows
    )
    note = "" if colour == "state" else '<div style="opacity:.7">stiffness is assumed</div>'
    return f'<div style="font-size:.8em;padding:.2em 1em">{lines}{note}</div>'


_DASHES = ' stroke-dasharray="6 5"'


def readout(
    desk: Desk,
    moment: Moment,
    tracks: tuple[Track | None, Track | None],
    time_s: float,
    colour: str,
) -> str:
    """Tool, tracks and drum in words.

    Args:
        desk: The arm and its target.
        moment: Of the arm on the left.
        tracks: On the left and on the right.
        time_s: On the timeline [s].
        colour: "state" or "tension".
    """
    x, y, z = 1e3 * desk.tool[:3, 3]
    off = 1e3 * float(np.linalg.norm(desk.tool[:3, 3] - desk.target[:3, 3]))
    lines = [f"tool at {x:.1f}, {y:.1f}, {z:.1f} mm; {off:.1f} mm from the target"]
    for side, track in zip(("left", "right"), tracks, strict=True):
        if track is not None:
            phase = track.at(time_s).marks.phase
            ends = f"{min(time_s, track.duration_s):.1f} of {track.duration_s:.1f} s"
            lines.append(f"**{side}**: {track.name}, {ends}: {phase} ({track.kind})")
    if colour == "tension":
        most = float(np.max(desk.tension(moment.displacements)))
        lines.append(f"most tension {most:.0f} N (stiffness is assumed)")
    if tracks[0] is None:
        facing = ", ".join(str(c + 1) for c in desk.robot.axial_map[desk.axial - 1])
        lines.append(f"drum at {desk.axial}: servos face tendons {facing}")
    return "\n\n".join(lines)


def _floor(value: float) -> float:
    """Down to a tenth, so that a slider's end does not cut the range."""
    return float(np.floor(10 * value) / 10)
