"""The viewer in the browser: what the panel's controls do to the desk and to the scene.

A browser's events come from viser's threads and take the viewer's lock; ``tick`` moves time on and
solves for the target last dragged to, so that dragging never queues up.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from muxjax.kinematics import roll_pitch_yaw
from muxjax.viz.desk import Desk
from muxjax.viz.panel import BY_HAND, NOTHING, build_panel, legend_html, readout
from muxjax.viz.playback import Moment, Track
from muxjax.viz.scene import Look, looks_by_state, looks_by_tension, tendon_states
from muxjax.viz.serving import start_server, stop_server
from muxjax.viz.stage import Stage, quaternion
from muxjax.viz.surroundings import (
    add_cloud,
    add_ghosts,
    add_grid,
    add_light,
    add_world,
    place_cameras,
)

_FRAME_S = 1 / 25
_APART = 0.85  # of two arms side by side, in lengths of the arm and a half
_TENSION_STEP = 50.0  # the darkest colour's tension is a multiple of it [N]
_PARTS = ("discs", "drum", "IK solutions", "obstacles", "workspace")


class Viewer:
    """A server that browsers connect to.

    Args:
        desk: The arm, the target and the tracks.
        host: Address to serve at.
        port: Likewise; 0 for any free one.
        method: Planner chosen first.
        colour: Of the tendons, by "state" or "tension".
        cloud: Workspace to show: points [m] and their shares from 0 to 1.

    Raises:
        ValueError: The port is taken.
    """

    def __init__(
        self,
        desk: Desk,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        method: str = "exact",
        colour: str = "state",
        cloud: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]] | None = None,
    ) -> None:
        self.desk, self.time_s, self.playing = desk, 0.0, False
        self.server = start_server(host, port, f"muxjax: {desk.robot.config.name}")
        self._lock, self._quiet = threading.RLock(), False
        self._wanted: deque[Float[np.ndarray, "4 4"]] = deque(maxlen=1)
        self._acting: Any = None  # the control that a person has changed and that acts now
        self._most = _TENSION_STEP
        self._ghosts: list[Any] = []
        scene, robot = self.server.scene, desk.robot
        span = _APART * 1.5 * float(np.sum(robot.length))
        self.left = Stage(scene, robot, "/left", (0.0, 0.0, 0.0))
        self.right = Stage(scene, robot, "/right", (span, 0.0, 0.0))
        self.right.root.visible = False
        self._add_surroundings(cloud)
        self._gizmo = scene.add_transform_controls(
            "/target", scale=0.11, line_width=2.5, depth_test=False
        )
        self.panel = build_panel(self.server.gui, desk, method, colour, _PARTS)
        self._connect()
        self.refresh_tracks()
        self._move_gizmo(desk.target)
        self._sync()
        place_cameras(self.server, robot, 0.0, self.left.box())
        self.say("Bend the arm, or drag the target and press Plan.")

    @property
    def url(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def _add_surroundings(self, cloud: Any) -> None:
        scene, robot, world = self.server.scene, self.desk.robot, self.desk.world
        scene.set_up_direction("+z")
        add_light(scene)
        self._parts = {
            part: scene.add_frame(f"/{part}", show_axes=False)
            for part in ("obstacles", "workspace")
        }
        if world is not None:
            add_world(scene, robot, world, "/obstacles")
        else:
            add_grid(scene, robot)
        if cloud is not None:
            add_cloud(scene, "/workspace/points", *cloud)

    # Controls

    def _connect(self) -> None:
        p = self.panel
        for box in p.failed:
            self._on(box, self._servos_changed)
        for slider in p.angles:
            self._on(slider, self._bend)
        for slider in p.tendons:
            self._on(slider, self._pull)
        self._on(p.axial, self._turn_drum)
        self._on(p.colour, self._redraw)
        self._on(p.straighten, self._straighten)
        self._on(p.pose, self._show_parts)
        for typed in (p.position, p.turn):
            self._on(typed, self._type_target)
        self._on(p.goal, self._change_goal)
        self._on(p.to_tool, self._target_to_tool)
        self._on(p.solution, self._pick)
        self._on(p.plan, self.make_plan)
        self._on(p.left, self._choose_tracks)
        self._on(p.right, self._choose_tracks)
        self._on(p.time, self._scrub)
        self._on(p.play, self._play_or_pause)
        self._on(p.rewind, self._rewind)
        for box in p.shown.values():
            self._on(box, self._show_parts)

        @self._gizmo.on_update
        def _(_: Any) -> None:
            self.drag(self._gizmo.position, self._gizmo.wxyz)

    def _on(self, control: Any, act: Callable[[], None]) -> None:
        """Have a control act, unless it was the viewer itself that changed it."""

        def react(_: Any) -> None:
            set_to = control.value
            with self._lock:
                if self._quiet:
                    return
                if control is self.panel.time and self.playing:
                    with self._silently():
                        control.value = set_to  # a frame has moved it on while this waited
                self._acting = control
                try:
                    act()
                except Exception as error:
                    self._acting = None
                    refused = isinstance(error, ValueError)
                    self.warn(str(error) if refused else f"{error!r}: the terminal says where.")
                    self._sync()
                    if not refused:
                        raise  # a mistake of ours; viser prints it and goes on
                finally:
                    self._acting = None

        (control.on_click if hasattr(control, "on_click") else control.on_update)(react)

    def say(self, text: str) -> None:
        """Write what happened at the top of the panel."""
        self.panel.status.content = text

    def warn(self, text: str) -> None:
        """Write what was refused and why, and show it to everybody who looks."""
        self.panel.status.content = f"**Not done.** {text}"
        for client in self.server.get_clients().values():
            client.add_notification("Not done", text, color="red", auto_close_seconds=10)

    def _servos_changed(self) -> None:
        self.desk.failed = np.array([bool(box.value) for box in self.panel.failed])
        left = ", ".join(map(str, self.desk.servos)) or "none"
        self.say(f"Servos left: {left}. A new plan does without the others.")
        self._by_hand()

    def _bend(self) -> None:
        self.desk.set_q_deg(np.array([s.value for s in self.panel.angles]))
        self._by_hand()

    def _pull(self) -> None:
        # Sliders show tenths; a tendon that was not touched keeps its exact length.
        shown = np.array([s.value for s in self.panel.tendons])
        exact = 1e3 * self.desk.displacements
        untouched = np.abs(shown - exact) < 0.051
        self.desk.set_tendons_mm(np.where(untouched, exact, shown))
        self._by_hand()

    def _turn_drum(self) -> None:
        self.desk.axial = int(self.panel.axial.value)
        self._by_hand()

    def _straighten(self) -> None:
        self.desk.set_q_deg(np.zeros(len(self.panel.angles)))
        self._by_hand()

    def _by_hand(self) -> None:
        """The arm is led by hand: the timeline lets go of it."""
        self.playing = False
        with self._silently():
            self.panel.left.value = BY_HAND
            self.panel.right.value = NOTHING
        self._lay_out()
        self._sync()

    # Target and plans

    def drag(self, position: Any, wxyz: Any) -> None:
        """Note where the target is; ``tick`` solves for the last one noted."""
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
        pose[:3, 3] = position
        self._wanted.append(pose)

    def solve(self, pose: Float[np.ndarray, "4 4"]) -> str:
        """All solutions of a target, drawn; a refusal is shown, and returned."""
        refusal = ""
        with self._lock:
            try:
                self.say(self.desk.solve(pose) + ".")
            except ValueError as error:
                refusal = str(error)
                self.warn(refusal)
            self._show_solutions()
        return refusal

    def _show_solutions(self) -> None:
        desk, p = self.desk, self.panel
        names = tuple(desk.label(k) for k in range(len(desk.solutions))) or ("none",)
        with self._silently():
            p.solution.options = names
            p.solution.value = names[desk.chosen]
            p.position.value = tuple(float(x) for x in np.round(1e3 * desk.target[:3, 3], 2))
            angles = np.degrees(roll_pitch_yaw(desk.target[:3, :3]))
            p.turn.value = tuple(float(x) for x in np.round(angles, 2) + 0.0)
        with self.server.atomic():
            for drawn in self._ghosts:
                drawn.remove()
            self._ghosts = []
            if p.shown["IK solutions"].value:
                self._ghosts = add_ghosts(
                    self.server.scene, desk.robot, desk.solutions, desk.chosen, self.choose
                )

    def choose(self, k: int) -> None:
        """Choose a solution, from 0, for the next plan; one that is gone is not chosen."""
        with self._lock:
            if k >= len(self.desk.solutions):
                return  # clicked in a browser that still showed those of the last target
            self.desk.chosen = k
            self.say(f"The next plan goes to solution {self.desk.label(k)}.")
            self._show_solutions()

    def _pick(self) -> None:
        options = self.panel.solution.options
        if self.panel.solution.value in options:
            self.choose(options.index(self.panel.solution.value))

    def _type_target(self) -> None:
        pose = np.eye(4)
        pose[:3, 3] = np.array(self.panel.position.value) / 1e3
        pose[:3, :3] = Rotation.from_euler("xyz", self.panel.turn.value, degrees=True).as_matrix()
        self._move_gizmo(pose)
        self.solve(pose)

    def _change_goal(self) -> None:
        self.desk.goal = self.panel.goal.value
        self.solve(self.desk.target)

    def _target_to_tool(self) -> None:
        self._move_gizmo(self.desk.tool)
        self.solve(self.desk.tool)

    def _move_gizmo(self, pose: Float[np.ndarray, "4 4"]) -> None:
        self._gizmo.position, self._gizmo.wxyz = pose[:3, 3], quaternion(pose[:3, :3])

    def aim(self, pose: Float[np.ndarray, "4 4"], beside: str | None = None) -> str:
        """Put the target somewhere and plan to it.

        Args:
            pose: Of the target [m].
            beside: Method of the plan on the right; None for no such plan.

        Returns:
            What was refused and why, which is shown too; empty if nothing.
        """
        with self._lock:
            self._move_gizmo(pose)
            refusal = self.solve(pose)
            if refusal:
                return refusal
            with self._silently():
                self.panel.beside.value = beside or NOTHING
            try:
                self.make_plan()
            except ValueError as error:
                self.warn(str(error))
                return str(error)
            return ""

    def make_plan(self) -> None:
        """Plan to the chosen solution by one method, or by two side by side, from the same start.

        Raises:
            ValueError: See ``Desk.plan``.
        """
        p = self.panel
        methods = list(dict.fromkeys(m for m in (p.method.value, p.beside.value) if m != NOTHING))
        self.say(f"Planning by {' and '.join(methods)} ...")
        found, said = [], []
        p.plan.disabled = True  # pressed again meanwhile, it would plan once more afterwards
        try:
            for method in methods:
                found.append(self.desk.plan(method))
                said.append(self.desk.last)
        finally:
            p.plan.disabled = False
            self.refresh_tracks()  # if the second fails, the first is still on the timeline
        self.show_tracks([track.name for track in found])
        self.say("; ".join(said) + (". Press Play." if self.duration_s else ": it is there."))

    # Time

    def refresh_tracks(self) -> None:
        """Offer every track of the desk."""
        p, names = self.panel, tuple(self.desk.tracks)
        with self._silently():
            for menu, none in ((p.left, BY_HAND), (p.right, NOTHING)):
                kept = menu.value
                menu.options = (none, *names)
                menu.value = kept if kept in menu.options else none

    def show_tracks(self, names: Sequence[str]) -> None:
        """Put one track on the timeline, or two side by side, by name."""
        left, right = (*names, NOTHING)[:2]
        with self._lock:
            with self._silently():
                self.panel.left.value, self.panel.right.value = left, right
            self._choose_tracks()

    @property
    def shown_tracks(self) -> tuple[Track | None, Track | None]:
        """On the left, by default the arm itself, and on the right."""
        names = self.panel.left.value, self.panel.right.value
        left, right = (self.desk.tracks.get(name) for name in names)
        return left, right

    @property
    def duration_s(self) -> float:
        """Of the longer of the tracks that are shown [s]."""
        return max((t.duration_s for t in self.shown_tracks if t is not None), default=0.0)

    def _choose_tracks(self) -> None:
        self.playing = False
        self._lay_out()
        left = self.shown_tracks[0]
        if left is not None and self.desk.aim_at_end_of(left):
            self._move_gizmo(self.desk.target)
            self._show_solutions()
        self.seek(0.0)

    def _lay_out(self) -> None:
        """One arm, or two side by side."""
        right = self.shown_tracks[1] is not None
        if right != bool(self.right.root.visible):
            self.right.root.visible = right
            beside = float(self.right.root.position[0]) if right else 0.0
            place_cameras(self.server, self.desk.robot, beside, self.left.box())

    def seek(self, time_s: float) -> None:
        """Go to a time [s] of the tracks that are shown."""
        with self._lock:
            self.time_s = float(np.clip(time_s, 0.0, self.duration_s))
            left = self.shown_tracks[0]
            if left is not None:
                self.desk.show(left.at(self.time_s))
            self._sync()

    def _scrub(self) -> None:
        self.playing = False
        self.seek(self.panel.time.value)

    def _rewind(self) -> None:
        self.playing = False
        self.seek(0.0)

    def _play_or_pause(self) -> None:
        if not self.duration_s:
            raise ValueError("play: nothing to play; choose a track or press Plan first")
        if self.time_s >= self.duration_s:
            self.seek(0.0)
        self.playing = not self.playing
        self._sync()

    def tick(self, elapsed_s: float) -> None:
        """Let real time pass [s]: play on, and solve for the target last dragged to."""
        if self._wanted:
            self.solve(self._wanted.pop())
        with self._lock:
            if not self.playing:
                return
            self.time_s += elapsed_s * float(self.panel.speed.value.removesuffix("x"))
            if self.time_s >= self.duration_s:
                self.time_s, self.playing = self.duration_s, False
            left = self.shown_tracks[0]
            if left is not None:
                self.desk.show(left.at(self.time_s))
            # The sliders follow at the end: moving twenty of them each frame is much traffic.
            self._redraw() if self.playing else self._sync()

    def run(self) -> None:
        """Serve until interrupted."""
        last = time.monotonic()
        while True:
            time.sleep(_FRAME_S)
            now = time.monotonic()
            self.tick(now - last)
            last = now

    def stop(self) -> None:
        """Close the server."""
        stop_server(self.server)

    # Drawing

    def _silently(self) -> _Silence:
        return _Silence(self)

    def _put(self, control: Any, value: Any) -> None:
        """Set a control; one that acts now is where a person has it, maybe further on already."""
        if control is not self._acting:
            control.value = value

    def _sync(self) -> None:
        """Bring every control and the scene up to date."""
        p, desk = self.panel, self.desk
        with self._silently(), self.server.atomic():
            for slider, angle in zip(p.angles, np.degrees(desk.q), strict=True):
                self._put(slider, float(np.clip(round(angle, 1), slider.min, slider.max)))
            for slider, length in zip(p.tendons, 1e3 * desk.displacements, strict=True):
                self._put(slider, float(np.clip(round(length, 1), slider.min, slider.max)) + 0.0)
            self._put(p.axial, desk.axial)
            p.time.max = max(round(self.duration_s, 2), 0.01)
            p.play.label = "Pause" if self.playing else "Play"
            for box, lost in zip(p.failed, desk.failed, strict=True):
                self._put(box, bool(lost))
        self._redraw()

    def _redraw(self) -> None:
        """Bring the scene and the texts up to date."""
        desk, p = self.desk, self.panel
        left, right = self.shown_tracks
        moment = desk.now if left is None else left.at(self.time_s)
        with self._silently(), self.server.atomic():
            self.left.draw(moment, desk.q, self._looks(moment))
            self.left.title.text = "" if left is None else left.name
            self.left.title.visible = right is not None
            if right is not None:
                other = right.at(self.time_s)
                q = desk.shape(other.displacements)
                self.right.draw(other, q, self._looks(other))
                self.right.title.text, self.right.title.visible = right.name, True
            self._put(p.time, min(round(self.time_s, 2), p.time.max))
            p.legend.content = legend_html(p.colour.value, self._most)
            p.readout.content = readout(
                desk, moment, self.shown_tracks, self.time_s, p.colour.value
            )

    def _looks(self, moment: Moment) -> Sequence[Look]:
        if self.panel.colour.value == "state":
            return looks_by_state(tendon_states(moment.displacements, moment.moving))
        tension = self.desk.tension(moment.displacements)
        most = float(np.max(tension, initial=0.0))
        self._most = max(self._most, _TENSION_STEP * np.ceil(most / _TENSION_STEP))
        return looks_by_tension(tension, self._most, moment.moving)

    def _show_parts(self) -> None:
        shown = {part: bool(box.value) for part, box in self.panel.shown.items()}
        for stage in (self.left, self.right):
            stage.discs.visible = shown["discs"]
            stage.drum.visible = shown["drum"]
        for part, node in self._parts.items():
            node.visible = shown[part]
        self._gizmo.visible = bool(self.panel.pose.value)
        self._show_solutions()


class _Silence:
    """While it is entered, controls change without acting."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer

    def __enter__(self) -> None:
        self._viewer._lock.acquire()
        self._before, self._viewer._quiet = self._viewer._quiet, True

    def __exit__(self, *_: object) -> None:
        self._viewer._quiet = self._before
        self._viewer._lock.release()
